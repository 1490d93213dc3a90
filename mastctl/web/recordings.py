"""Routes of the recorder: what there is, and runs begun and ended."""

from __future__ import annotations

from typing import Any

from fastapi import FastAPI

from mastctl.commands.entry import RECORD_START, RECORD_STOP
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
