"""Pictures with their facts, one at a time or through a WebSocket at the pace at which they are shown, and
what the cameras are set to.

A message is 4 bytes (the length of what follows, little-endian), the picture's facts as JSON, and the
picture as JPEG. A client that has shown one sends ``CAMERA`` or ``CAMERA MOST_BYTES`` back, and gets another
one then: one of a camera is on its way, and none waits. ``? TEXT`` is answered with the clock by which
pictures are stamped when they are sent, which shows how long they were on their way.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
from typing import Annotated, Any, Literal, Self

from fastapi import FastAPI, Query, Response, WebSocket
from pydantic import Field, model_validator
from starlette.websockets import WebSocketDisconnect

from calib.geometry.mode import flip_name
from drivers.interfaces import SETTINGS
from mastctl.answers import CameraSettingsAnswer
from mastctl.as_json import as_json
from mastctl.control.entry import Command
from mastctl.frame_facts import described_headers, headers_of
from mastctl.http import PREFIX
from mastctl.motion.requests import Name, StrictBody
from mastctl.report.pictures import encoded
from mastctl.web.commands import Here, Parts, StrictQuery, caller_of, command, file_of
from mastctl.web.events import MOST_KEYS, UNSUPPORTED, close_ended
from mastctl.web.pictures import Picture, Viewer

IMAGES = f"{PREFIX}/images"
TIME = "?"
LONGEST_MESSAGE = 100  # a camera's name, and how large its next image may be


class CameraSettingsBody(StrictBody):
    """``PATCH /cameras/{camera}/settings``: what is to change; one at least."""

    exposure_s: float | None = None
    gain: float | None = None
    white_balance_k: float | None = None
    focus: float | None = None

    @model_validator(mode="after")
    def _some(self) -> Self:
        if not self.model_dump(exclude_none=True):
            raise ValueError(f"one of {', '.join(type(self).model_fields)} at least is expected")
        return self


class SnapshotQuery(StrictQuery):
    """``GET /snapshot/{camera}``; ``frame_id`` names a frame that is still kept."""

    format: Literal["png", "jpeg"] = "png"
    fresh: bool = False
    frame_id: Name | None = None


class ImagesQuery(StrictQuery):
    """``GET /images``, a WebSocket: of which cameras; whether their first pictures are requested too, and all
    of them come at the cameras' own rate.
    """

    camera: Annotated[list[Name], Field(min_length=1, max_length=MOST_KEYS)]
    on_request: bool = False
    every: bool = False


def add_images(app: FastAPI) -> None:
    """A picture with its facts, and the WebSocket of live pictures."""

    @app.get(
        f"{PREFIX}/snapshot/{{camera}}",
        summary="A picture; its facts are in Mastctl headers",
        response_class=Response,
        responses=file_of("image/png", "image/jpeg", headers=described_headers()),
    )
    async def snapshot(camera: str, query: Annotated[SnapshotQuery, Query()], here: Here) -> Response:
        service, waiting = here.service, here.waiting
        service.check_camera(camera)
        frame_id = query.frame_id

        def picture() -> Response:
            if frame_id is None:
                frame = service.snapshot(camera, query.fresh)
            else:
                frame = service.kept_frame(camera, frame_id)
            with waiting.encoding:
                data = encoded(frame.image, query.format)
            return Response(data, media_type=f"image/{query.format}", headers=headers_of(frame))

        return await waiting.image(camera, picture, kept=frame_id is not None)

    @app.websocket(IMAGES)
    async def socket(line: WebSocket, query: Annotated[ImagesQuery, Query()], here: Here) -> None:
        for camera in query.camera:
            here.service.check_camera(camera)
        with here.streams.listening((), frozenset(), caller_of(line).credential) as ending:
            await line.accept()
            with here.feeds.viewer(query.camera, not query.on_request, query.every) as viewer:
                await _Line(here, line, viewer).run(asyncio.ensure_future(ending.wait()))


def add_cameras(app: FastAPI) -> None:
    """The settings of a camera."""

    @app.get(f"{PREFIX}/cameras/{{camera}}/settings", summary="The settings of a camera, with their bounds")
    async def settings(camera: str, here: Here) -> CameraSettingsAnswer:
        here.service.check_camera(camera)
        return await here.waiting.run(lambda: _settings(here, camera, []))

    @command(app, "PATCH /cameras/{camera}/settings", Command("camera.settings", steers=True, need="idle"))
    def change(camera: str, body: CameraSettingsBody, here: Here) -> CameraSettingsAnswer:
        """Change some of a camera's settings, each with its automatic turned off."""
        wanted = body.model_dump(exclude_none=True)
        return _settings(here, camera, here.service.devices.change_settings(camera, wanted))


def _settings(here: Parts, camera: str, notes: list[str]) -> CameraSettingsAnswer:
    devices = here.service.devices
    found, fixed = devices.settings(camera)
    mode = devices.sensor_modes.get(camera)
    return {
        "camera": camera,
        "settings": [
            as_json(one) | {"unit": SETTINGS[one.name], "refusal": one.refusal or None} for one in found
        ],
        "fixed": fixed,
        "sensor_mode": None if mode is None else as_json(mode) | {"flip": flip_name(mode.flip)},
        "notes": notes,
    }


class _Line:
    """One WebSocket of pictures, until the daemon or the client ends."""

    def __init__(self, here: Parts, line: WebSocket, viewer: Viewer) -> None:
        self._here, self._line, self._viewer = here, line, viewer

    async def run(self, ending: asyncio.Future[Any]) -> None:
        """Send pictures until ``ending`` is done."""
        jobs = {ending, asyncio.ensure_future(self._receive()), asyncio.ensure_future(self._send())}
        try:
            await asyncio.wait(jobs, return_when=asyncio.FIRST_COMPLETED)
            if ending.done():
                with contextlib.suppress(WebSocketDisconnect, RuntimeError):
                    await close_ended(self._line, self._here)
        finally:
            for job in jobs:
                job.cancel()
            await asyncio.gather(*jobs, return_exceptions=True)

    async def _receive(self) -> None:
        """Take which images were shown, and answer requests for the time."""
        with contextlib.suppress(WebSocketDisconnect):
            while (message := await self._line.receive())["type"] == "websocket.receive":
                text = message.get("text") or ""
                name, _, more = text.partition(" ")
                if name == TIME and len(text) <= LONGEST_MESSAGE:
                    await self._line.send_text(json.dumps({"asked": more, "now_s": _now_s()}))
                elif not 0 < len(text) <= LONGEST_MESSAGE or (more and not more.isdecimal()):
                    await self._line.close(UNSUPPORTED, "CAMERA, CAMERA MOST_BYTES or ? TEXT is expected")
                    return
                else:
                    self._viewer.want(name, int(more) if more else None)
                    self._here.feeds.stir()

    async def _send(self) -> None:
        """Send each image that is ready."""
        with contextlib.suppress(WebSocketDisconnect):
            while await self._viewer.news.wait():
                for picture in self._viewer.take():
                    await self._line.send_bytes(self._message(picture))

    def _message(self, picture: Picture) -> bytes:
        frame = picture.frame
        height, width = frame.image.shape[:2]
        age_s = max(0.0, self._here.service.clock.now_s() - frame.mid_exposure_s)
        facts = as_json(frame.facts) | {"size_px": [width, height], "reduced": picture.reduced}
        facts |= {"age_s": age_s, "sent_s": _now_s(), "track": self._here.service.targets.track_in(frame)}
        if targets := self._here.service.targets.shown_in(frame):
            facts["targets"] = targets
        head = json.dumps(facts, allow_nan=False).encode()
        return b"".join((len(head).to_bytes(4, "little"), head, picture.jpeg))


def _now_s() -> float:
    """The clock that stamps what is sent: the event loop's, seconds."""
    return asyncio.get_running_loop().time()
