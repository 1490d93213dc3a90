"""Routes of the recorder: what there is, and runs begun and ended."""

from __future__ import annotations

from typing import Any

from fastapi import FastAPI

from mastctl.commands.entry import RECORD_START, RECORD_STOP
from mastctl.service.service import Service
from mastctl.web import PREFIX
from mastctl.web.commands import Commands, Headers
from mastctl.web.models import RecordBody
from mastctl.web.waiting import Waiting


def add_recordings(app: FastAPI, service: Service, waiting: Waiting, commands: Commands) -> None:
    """What is recorded."""
    recording = service.recording

    @app.get(f"{PREFIX}/recordings", summary="Every recording, and what is recorded now")
    async def recordings() -> dict[str, Any]:
        return await waiting.run(recording.told)

    @app.post(f"{PREFIX}/recordings/start", summary="Record until it is ended, or there is no room left")
    async def start(body: RecordBody, came: Headers) -> dict[str, Any]:
        told = body.model_dump()
        return await commands.run(RECORD_START, came, told, lambda: recording.recorder.start_run(body.name))

    @app.post(f"{PREFIX}/recordings/stop", summary="End the recording that was begun")
    async def stop(came: Headers) -> dict[str, Any]:
        return await commands.run(RECORD_STOP, came, {}, recording.recorder.stop_run)
