"""Pictures with their facts, one at a time or through a WebSocket at the pace at which they are shown, and
what the cameras are set to.

A message is 4 bytes (the length of what follows, little-endian), the picture's facts as JSON, and the
picture as JPEG. Whoever has shown one sends ``CAMERA`` or ``CAMERA MOST_BYTES`` back, and is sent another one
then: one of a camera is on its way, and none waits. ``? WORDS`` is answered with the clock by which pictures
are stamped when they are sent: whoever asks can tell how long they were on their way.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
from typing import Annotated, Any

from fastapi import FastAPI, Query, Response, WebSocket
from starlette.websockets import WebSocketDisconnect

from calib.geometry.mode import SensorMode, flip_name
from drivers.interfaces import SETTINGS
from mastctl.answers import CameraSettingsTold, SensorModeTold
from mastctl.as_json import as_json
from mastctl.control.entry import CAMERA_SETTINGS
from mastctl.frame_facts import headers_of
from mastctl.http import PREFIX
from mastctl.http.refusals import query_of
from mastctl.report.pictures import encoded
from mastctl.web.commands import command
from mastctl.web.events import UNSUPPORTED, close_ended, credential_of
from mastctl.web.models import CameraSettingsBody, ImagesQuery, SnapshotQuery
from mastctl.web.parts import Here, Parts
from mastctl.web.pictures import Picture, Watcher

IMAGES = f"{PREFIX}/images"
TIME = "?"
LONGEST_MESSAGE = 100  # a camera's name, and how large its next image may be


def add_images(app: FastAPI) -> None:
    """A picture with its facts, and the WebSocket of live pictures."""

    @app.get(
        f"{PREFIX}/snapshot/{{camera}}",
        summary="A picture; its facts are in Mastctl headers",
        response_class=Response,
        responses={200: {"content": {"image/png": {}, "image/jpeg": {}}}},
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
            data = waiting.encode(lambda: encoded(frame.image, query.format))
            return Response(data, media_type=f"image/{query.format}", headers=headers_of(frame))

        return await waiting.image(camera, picture, kept=frame_id is not None)

    @app.websocket(IMAGES)
    async def socket(line: WebSocket, here: Here) -> None:
        async with query_of(line, ImagesQuery, "camera") as query:
            for camera in query.camera:
                here.service.check_camera(camera)
            with here.streams.listening((), frozenset(), credential_of(line)) as ending:
                await line.accept()
                await _Line(here, line, query).run(asyncio.ensure_future(ending.wait()))


def add_cameras(app: FastAPI) -> None:
    """The settings of a camera."""

    @app.get(f"{PREFIX}/cameras/{{camera}}/settings", summary="The settings of a camera, with their bounds")
    async def settings(camera: str, here: Here) -> CameraSettingsTold:
        here.service.check_camera(camera)
        return await here.waiting.run(lambda: _told(here, camera, []))

    @command(
        app,
        "PATCH /cameras/{camera}/settings",
        CAMERA_SETTINGS,
        "Change some of a camera's settings, each with its automatic turned off",
    )
    def change(camera: str, body: CameraSettingsBody, here: Here) -> CameraSettingsTold:
        return _told(here, camera, here.service.devices.set_camera(camera, body.wanted))


def _told(here: Parts, camera: str, notes: list[str]) -> CameraSettingsTold:
    found, held = here.service.devices.camera_settings(camera)
    mode = here.service.devices.sensor_modes.get(camera)
    return {
        "camera": camera,
        "settings": [
            {
                "name": one.name,
                "value": one.value,
                "minimum": one.minimum,
                "maximum": one.maximum,
                "step": one.step,
                "unit": SETTINGS[one.name],
                "automatic": one.automatic,
                "refusal": one.refusal or None,
            }
            for one in found
        ],
        "held": held,
        "sensor_mode": None if mode is None else _mode_told(mode),
        "notes": notes,
    }


def _mode_told(mode: SensorMode) -> SensorModeTold:
    return {
        "size_px": list(mode.size_px),
        "sensor_px": None if mode.sensor_px is None else list(mode.sensor_px),
        "crop_px": None if mode.crop_px is None else list(mode.crop_px),
        "flip": flip_name(mode.flip),
    }


class _Line:
    """One WebSocket of pictures, until the daemon or the client ends."""

    def __init__(self, here: Parts, line: WebSocket, query: ImagesQuery) -> None:
        self._here = here
        self._line = line
        self._there = asyncio.Event()
        self._loop = asyncio.get_running_loop()
        self._watcher: Watcher = here.watched.watch(
            query.camera, self._wake, not query.on_request, query.every
        )

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
            self._watcher.end()

    async def _receive(self) -> None:
        """Take which images were shown, and answer requests for the time."""
        with contextlib.suppress(WebSocketDisconnect):
            while (message := await self._line.receive())["type"] == "websocket.receive":
                text = message.get("text") or ""
                name, _, more = text.partition(" ")
                if name == TIME and len(text) <= LONGEST_MESSAGE:
                    await self._line.send_text(json.dumps({"asked": more, "now_s": self._loop.time()}))
                elif not 0 < len(text) <= LONGEST_MESSAGE or (more and not more.isdecimal()):
                    await self._line.close(UNSUPPORTED, "CAMERA, CAMERA MOST_BYTES or ? WORDS are taken here")
                    return
                else:
                    self._watcher.shown(name, int(more) if more else None)

    async def _send(self) -> None:
        """Send each image that is ready."""
        with contextlib.suppress(WebSocketDisconnect):
            while True:
                await self._there.wait()
                self._there.clear()
                for picture in self._watcher.take():
                    await self._line.send_bytes(self._message(picture))

    def _message(self, picture: Picture) -> bytes:
        frame = picture.frame
        height, width = frame.image.shape[:2]
        age_s = max(0.0, self._here.service.clock.now_s() - frame.mid_exposure_s)
        facts = as_json(frame.facts) | {"size_px": [width, height], "reduced": picture.reduced}
        facts |= {"age_s": age_s, "sent_s": self._loop.time()}
        facts["track"] = self._here.service.track_in(frame)
        head = json.dumps(facts, allow_nan=False).encode()
        return b"".join((len(head).to_bytes(4, "little"), head, picture.jpeg))

    def _wake(self) -> None:
        with contextlib.suppress(RuntimeError):  # the loop has ended
            self._loop.call_soon_threadsafe(self._there.set)
