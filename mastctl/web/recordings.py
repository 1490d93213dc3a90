"""Routes of the recorder: what there is, its files, and runs begun, ended and deleted."""

from __future__ import annotations

from typing import Any

from fastapi import FastAPI, Request
from fastapi.responses import FileResponse

from mastctl.commands.entry import RECORD_DELETE, RECORD_START, RECORD_STOP
from mastctl.web import PREFIX
from mastctl.web.commands import Headers
from mastctl.web.models import RecordBody
from mastctl.web.parts import Here


def add_recordings(app: FastAPI) -> None:
    """What is recorded."""

    @app.get(f"{PREFIX}/recordings", summary="Every recording, and what is recorded now")
    async def recordings(here: Here) -> dict[str, Any]:
        return await here.waiting.run(here.service.recording.told)

    @app.post(f"{PREFIX}/recordings/start", summary="Record until it is ended, or there is no room left")
    async def start(body: RecordBody, came: Headers, here: Here) -> dict[str, Any]:
        told, recorder = body.model_dump(), here.service.recording.recorder
        return await here.commands.run(RECORD_START, came, told, lambda: recorder.start_run(body.name))

    @app.post(f"{PREFIX}/recordings/stop", summary="End the recording that was begun")
    async def stop(came: Headers, here: Here) -> dict[str, Any]:
        return await here.commands.run(RECORD_STOP, came, {}, here.service.recording.recorder.stop_run)

    @app.get(
        f"{PREFIX}/recordings/{{name}}/{{file}}", summary="A recording's file", response_class=FileResponse
    )
    async def read(name: str, file: str, request: Request, here: Here) -> FileResponse:
        path = await here.waiting.run(lambda: here.service.recording.recorder.file(name, file))
        headers = request.scope["headers"]
        request.scope["headers"] = [one for one in headers if one[0] != b"range"]  # it is given whole
        return FileResponse(path, media_type="application/octet-stream", filename=path.name)

    @app.delete(f"{PREFIX}/recordings/{{name}}", summary="Delete a run, or what was kept at a fault")
    async def delete(name: str, came: Headers, here: Here) -> dict[str, Any]:
        recorder = here.service.recording.recorder
        return await here.commands.run(RECORD_DELETE, came, {"name": name}, lambda: recorder.delete(name))
