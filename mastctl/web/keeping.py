"""Routes of what a daemon keeps: mast files, places, recordings, benches."""

from __future__ import annotations

from typing import Annotated

from fastapi import FastAPI, Path
from fastapi.responses import FileResponse, Response
from pydantic import Field, model_validator

from mastctl import answers
from mastctl.bench.runs import NAME
from mastctl.control.entry import Command
from mastctl.http import PREFIX
from mastctl.motion.requests import Angle, Name, StrictBody
from mastctl.service.masts import MastInUse, Masts
from mastctl.web.commands import Here, command, file_of, whole_file

REPORT = (
    "default-src 'none'; style-src 'unsafe-inline'; img-src data:; sandbox; base-uri 'none'; "
    "form-action 'none'; frame-ancestors 'none'"
)
"""The Content-Security-Policy of a report: its own styles and drawings, no script, its own origin."""
PlaceName = Annotated[
    str,
    Path(
        pattern=r"^[\w+−-][\w .,:°+−-]{0,39}$",
        description="a name of 1 to 40 letters, digits, spaces and . , : ° + - that begins with no space",
    ),
]
RunName = Annotated[
    str, Path(pattern=f"^{NAME.pattern}$", description="a run's name, such as 20261126-093000,")
]


class MastBody(StrictBody):
    """``POST /mast``: the name of a file beside the configured mast file."""

    file: Name


class PlaceBody(StrictBody):
    """``POST /places/{name}``: the angles that are kept, as the head reads them."""

    pan_rad: Angle
    tilt_rad: Angle


class RecordBody(StrictBody):
    """``POST /recordings/start``: a word for the file's name."""

    name: Annotated[str, Field(max_length=60)] = ""


class BenchBody(StrictBody):
    """``POST /bench``: with which board, and how far; or with which run to go on.

    ``board`` names a packaged one, ``board_file`` is the text of a BOARD.yaml. ``wanted_px`` is what the
    calibration may leave of a first pointing, rms an axis; ``pictures`` of each camera at most; ``by_hand``:
    a simulated board waits for `POST /bench/stands` too, as a real one always does. Left out they are 0.2,
    60 and false, or as the run had them that goes on.
    """

    board: Name | None = None
    board_file: Annotated[str, Field(min_length=1, max_length=20000)] | None = None
    resume: Name | None = None
    wanted_px: Annotated[float, Field(ge=0.01, le=20.0)] | None = None
    pictures: Annotated[int, Field(ge=12, le=500)] | None = None
    by_hand: bool | None = None

    @model_validator(mode="after")
    def _one(self) -> BenchBody:
        if sum(one is not None for one in (self.board, self.board_file, self.resume)) != 1:
            raise ValueError("board, board_file or resume is expected, and one of them")
        return self


def add_masts(app: FastAPI) -> None:
    """The mast file in use, and another one."""

    @app.get(
        f"{PREFIX}/mast",
        summary="The mast file in use, byte for byte",
        response_class=Response,
        responses={200: {"content": {"application/yaml": {"schema": {"type": "object"}}}}},
    )
    async def mast(here: Here) -> Response:
        in_use = here.service.masts.in_use
        return Response(
            in_use.data,
            media_type="application/yaml",
            headers={"Mastctl-Mast-Digest": in_use.stored.digest},
        )

    @command(app, "POST /mast", Command("mast", steers=True))
    def load_mast(body: MastBody, here: Here) -> answers.MastChange:
        """Use another mast file from now on."""
        masts = here.service.masts
        return _mast_change(masts, masts.load(body.file))

    @command(app, "POST /mast/back", Command("mast.back", steers=True))
    def back(here: Here) -> answers.MastChange:
        """Go back to the former mast file."""
        masts = here.service.masts
        return _mast_change(masts, masts.back())


def _mast_change(masts: Masts, mast: MastInUse) -> answers.MastChange:
    former = masts.former
    return {"mast": mast.as_json(), "former_mast": None if former is None else former.as_json()}


def add_places(app: FastAPI) -> None:
    """Places of the head by a name; `POST /point` goes to its angles."""

    @app.get(f"{PREFIX}/places", summary="The places of the head that are kept by a name")
    async def places(here: Here) -> answers.PlaceList:
        return {"places": await here.waiting.run(here.service.places.all)}

    @command(app, "POST /places/{name}", Command("place.keep"))
    def keep(name: PlaceName, body: PlaceBody, here: Here) -> answers.PlaceList:
        """Keep a place by a name."""
        return {"places": here.service.places.keep(name, body.model_dump())}

    @command(app, "DELETE /places/{name}", Command("place.forget"))
    def forget(name: PlaceName, here: Here) -> answers.PlaceList:
        """Forget a place; a forgotten home is 0, 0 again."""
        return {"places": here.service.places.forget(name)}


def add_recordings(app: FastAPI) -> None:
    """What is recorded, its files, and runs begun, ended and deleted."""

    @app.get(f"{PREFIX}/recordings", summary="Every recording, and what is recorded now")
    async def recordings(here: Here) -> answers.Recordings:
        return await here.waiting.run(here.service.recorder.listing)

    @command(app, "POST /recordings/start", Command("record.start"))
    def start(body: RecordBody, here: Here) -> answers.RecorderState:
        """Record until it is ended, or there is no room left."""
        return here.service.recorder.start_run(body.name)

    @command(app, "POST /recordings/stop", Command("record.stop"))
    def stop(here: Here) -> answers.RecordingEnded:
        """End the recording that was begun."""
        return here.service.recorder.stop_run()

    @app.get(
        f"{PREFIX}/recordings/{{name}}/{{file}}",
        summary="A recording's file",
        response_class=FileResponse,
        responses=file_of("application/octet-stream"),
    )
    async def read(name: str, file: str, here: Here) -> FileResponse:
        return whole_file(await here.waiting.run(lambda: here.service.recorder.file(name, file)))

    @command(app, "DELETE /recordings/{name}", Command("record.delete", "admin"))
    def delete(name: str, here: Here) -> answers.RecordingDeleted:
        """Delete a run, or what was kept at a fault."""
        return here.service.recorder.delete(name)


def add_bench(app: FastAPI) -> None:
    """A bench calibration begun, answered, ended; its report."""

    @app.get(f"{PREFIX}/bench", summary="The bench calibration at work, and those that are kept")
    async def bench(here: Here) -> answers.BenchRuns:
        return await here.waiting.run(here.service.bench.answer)

    @command(app, "POST /bench", Command("bench", steers=True, need="track"), status_code=202)
    def begin(body: BenchBody, here: Here) -> answers.BenchAnswer:
        """Begin a bench calibration, or go on with one."""
        bench = here.service.bench
        return {"run": bench.start(here.requested.caller.name, here.requested.last_stop, **body.model_dump())}

    @command(app, "POST /bench/stands", Command("bench.stands"))
    def stands(here: Here) -> answers.BenchAnswer:
        """Confirm that the board stands where it is requested."""
        return {"run": here.service.bench.stands()}

    @command(app, "POST /bench/leave", Command("bench.leave"), beside=True)
    def leave(here: Here) -> answers.BenchAnswer:
        """End the bench calibration; it can go on later."""
        return {"run": here.service.bench.leave(here.requested.caller.name)}

    @command(app, "DELETE /bench/runs/{name}", Command("bench.forget"))
    def forget(name: RunName, here: Here) -> answers.BenchRuns:
        """Remove a bench calibration that is over, pictures and report."""
        return here.service.bench.forget(name)

    @app.get(
        f"{PREFIX}/reports/{{name}}",
        summary="The report of a bench calibration",
        response_class=Response,
        responses=file_of("text/html"),
    )
    async def report(name: RunName, here: Here) -> Response:
        page = await here.waiting.run(lambda: here.service.bench.runs.report(name))
        headers = {"Content-Security-Policy": REPORT, "Cross-Origin-Opener-Policy": "same-origin"}
        return Response(page, media_type="text/html; charset=utf-8", headers=headers)
