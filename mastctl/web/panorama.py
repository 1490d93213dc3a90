"""Routes of panoramas and of targets that are kept by a name."""

from __future__ import annotations

from typing import Annotated

from fastapi import FastAPI, Path, Request
from fastapi.responses import FileResponse, Response

from mastctl.answers import PanoramaDrawn, PanoramaList, Started, TargetList
from mastctl.control.entry import PANORAMA, PANORAMA_DELETE, TARGET_FORGET, TARGET_KEEP
from mastctl.http import PREFIX
from mastctl.panorama.folder import Index
from mastctl.service.steering import usual_s
from mastctl.web.commands import Here, command, file_of
from mastctl.web.keeping import PlaceName
from mastctl.web.models import PanoramaBody, TargetBody

Panorama = Annotated[str, Path(pattern=r"^[A-Za-z0-9][A-Za-z0-9-]{0,60}$", description="a panorama's id")]
WAY_S = 60.0
"""A view's move, its pictures, and those taken once more."""


def add_panoramas(app: FastAPI) -> None:
    """Panoramas begun, listed, read and deleted."""

    @command(
        app,
        "POST /panoramas",
        PANORAMA,
        status_code=202,
        usual_s=lambda here, body: 400 * WAY_S + usual_s(here.service.config.limits, 0),
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

    @command(app, "DELETE /panoramas/{name}", PANORAMA_DELETE)
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
    async def read(name: Panorama, file: str, request: Request, here: Here) -> FileResponse:
        path = await here.waiting.run(lambda: here.service.panoramas.file(name, file))
        request.scope["headers"] = [one for one in request.scope["headers"] if one[0] != b"range"]
        return FileResponse(path, media_type="application/octet-stream", filename=path.name)


def add_targets(app: FastAPI) -> None:
    """Targets by a name; who points at one asks `POST /point` for its position."""

    @app.get(f"{PREFIX}/targets", summary="The targets that are kept by a name")
    async def targets(here: Here) -> TargetList:
        return {"targets": await here.waiting.run(here.service.targets.all)}

    @command(app, "POST /targets/{name}", TARGET_KEEP)
    def keep(name: PlaceName, body: TargetBody, here: Here) -> TargetList:
        """Keep a target by a name."""
        return {"targets": here.service.targets.keep_measured(name, body)}

    @command(app, "DELETE /targets/{name}", TARGET_FORGET)
    def forget(name: PlaceName, here: Here) -> TargetList:
        """Forget a target."""
        return {"targets": here.service.targets.forget(name)}
