"""Routes of panoramas and of targets that are kept by a name."""

from __future__ import annotations

from typing import Annotated, Literal, Self

from fastapi import FastAPI, Path
from fastapi.responses import FileResponse, Response
from pydantic import Field, model_validator

from mastctl.answers import PanoramaDrawn, PanoramaList, Started, TargetList
from mastctl.control.entry import Command
from mastctl.http import PREFIX
from mastctl.motion.requests import Angle, Name, Place, StrictBody
from mastctl.panorama.folder import Index
from mastctl.service.steering import usual_s
from mastctl.web.commands import Here, command, file_of, whole_file
from mastctl.web.keeping import PlaceName

Panorama = Annotated[str, Path(pattern=r"^[A-Za-z0-9][A-Za-z0-9-]{0,60}$", description="a panorama's id")]
VIEW_S = 60.0  # its move, its pictures, and those taken once more


class PanoramaBody(StrictBody):
    """``POST /panoramas``: which field, azimuth and elevation, by which cameras; or what to go on with.

    By default the widest stereo pair, all that the limits let it see, 0.7 rad down to 0.2 rad up.
    ``exposure``: fixed from the first view on, or each view's own.
    """

    pair: Name | None = None
    camera: Name | None = None
    pan_rad: Annotated[list[Angle], Field(min_length=2, max_length=2)] | None = None
    tilt_rad: Annotated[list[Angle], Field(min_length=2, max_length=2)] | None = None
    overlap: Annotated[float, Field(ge=0.05, le=0.8)] = 0.2
    exposure: Literal["first", "auto-per-view"] = "first"
    resume: Name | None = None

    @model_validator(mode="after")
    def _one(self) -> Self:
        if self.pair is not None and self.camera is not None:
            raise ValueError("pair and camera are both there, one of them is expected")
        if self.resume is not None and self.model_fields_set - {"resume", "deadline_s"}:
            raise ValueError("resume goes alone: a panorama goes on as it was begun")
        return self


class TargetBody(StrictBody):
    """``POST /targets/{name}``: a point of the rover or site frame, and its covariance if it is known.

    Without ``position_m`` the one that ``operation`` measured, a pointing since which the rover stood.
    """

    position_m: Place | None = None
    operation: Name | None = None
    frame: Literal["rover", "site"] = "rover"
    covariance_m2: Annotated[list[Place], Field(min_length=3, max_length=3)] | None = None

    @model_validator(mode="after")
    def _one(self) -> TargetBody:
        if (self.position_m is None) == (self.operation is None):
            raise ValueError("exactly one of position_m and operation is expected")
        return self


def add_panoramas(app: FastAPI) -> None:
    """Panoramas begun, listed, read and deleted."""

    @command(
        app,
        "POST /panoramas",
        Command("panorama", steers=True, need="motion"),
        status_code=202,
        usual_s=lambda here, body: 400 * VIEW_S + usual_s(here.service.config.limits, 0),
    )
    def take(body: PanoramaBody, here: Here) -> Started:
        """Take a panorama, or what an earlier one lacks."""
        return {"id": here.service.panoramas.begin(body, body.model_dump(exclude_none=True)).id}

    @app.get(f"{PREFIX}/panoramas", summary="Every panorama, the newest first")
    async def listed(here: Here) -> PanoramaList:
        return await here.waiting.run(here.service.panoramas.listed)

    @app.get(
        f"{PREFIX}/panoramas/{{name}}",
        summary="A panorama's index: its views, its mosaic, its seams",
        response_model_exclude_none=True,
    )
    async def about(name: Panorama, here: Here) -> Index:
        return await here.waiting.run(lambda: here.service.panoramas.open(name).index)

    @command(app, "DELETE /panoramas/{name}", Command("panorama.delete", "admin"))
    def delete(name: Panorama, here: Here) -> PanoramaList:
        """Delete a panorama with its pictures."""
        return here.service.panoramas.delete(name)

    @app.get(
        f"{PREFIX}/panoramas/{{name}}/picture",
        summary="The mosaic as it is so far, JPEG",
        response_class=Response,
        responses=file_of("image/jpeg"),
    )
    async def picture(name: Panorama, here: Here) -> Response:
        data = await here.waiting.run(lambda: here.service.panoramas.so_far(name))
        return Response(data, media_type="image/jpeg")

    @app.get(
        f"{PREFIX}/panoramas/{{name}}/drawing",
        summary="What is drawn over it: the camera's present view, targets",
    )
    async def drawing(name: Panorama, here: Here) -> PanoramaDrawn:
        return await here.waiting.run(lambda: here.service.panorama_drawn(name))

    @app.get(
        f"{PREFIX}/panoramas/{{name}}/files/{{file:path}}",
        summary="A file of a panorama's folder",
        response_class=FileResponse,
        responses=file_of("application/octet-stream"),
    )
    async def read(name: Panorama, file: str, here: Here) -> FileResponse:
        return whole_file(await here.waiting.run(lambda: here.service.panoramas.file(name, file)))


def add_targets(app: FastAPI) -> None:
    """Targets by a name; who points at one asks `POST /point` for its position."""

    @app.get(f"{PREFIX}/targets", summary="The targets that are kept by a name")
    async def targets(here: Here) -> TargetList:
        return {"targets": await here.waiting.run(here.service.targets.all)}

    @command(app, "POST /targets/{name}", Command("target.keep"))
    def keep(name: PlaceName, body: TargetBody, here: Here) -> TargetList:
        """Keep a target by a name."""
        return {"targets": here.service.targets.keep_measured(name, body)}

    @command(app, "DELETE /targets/{name}", Command("target.forget"))
    def forget(name: PlaceName, here: Here) -> TargetList:
        """Forget a target."""
        return {"targets": here.service.targets.forget(name)}
