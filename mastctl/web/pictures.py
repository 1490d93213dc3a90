"""Live pictures: the newest of each camera, taken once for all its viewers that are ready for one.

Nothing is queued, and no frame that an operation needs waits for one that is only watched. A viewer says for
each camera when it is ready for another picture, and gets the newest when there is one; one that was not
sent yet is replaced. A camera for which no viewer is ready takes none.
"""

from __future__ import annotations

import asyncio
import logging
import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import count
from typing import TypeVar

import cv2
from anyio import CapacityLimiter
from anyio.to_thread import run_sync

from drivers.clock import Clock
from drivers.errors import DriverError
from mastctl.devices.devices import Devices
from mastctl.devices.frames import StampedFrame
from mastctl.errors import MastctlError
from mastctl.report.pictures import encoded

log = logging.getLogger(__name__)
T = TypeVar("T")

JPEG_QUALITY = 80  # 110 kB of 1024x768 gravel; a pixel's own grey is off by 2 of 255
APART_S = 0.045  # least time between two pictures: more than 15 a second from cameras of 15, 20, 30 or 60
NEXT_S = 1e-3  # the same where a viewer wants every picture
NEW_S = 0.05  # a picture that was exposed this long ago is still new
STANDS_S = 0.25  # and one this long ago where the clock may stand: two frames of 15 Hz, and their read-out
AGAIN_S = 0.25  # a picture that stays the newest, since its clock stands, is shown again so often, real time
TIMEOUT_S = 1.0
FAILING_S = 0.5  # how long a camera is left alone that gave none
KEPT = 4  # pictures of a camera that each viewer may click though newer ones came
KEPT_OF_EVERY, KEPT_BYTES = 32, 64_000_000
"""The same where every picture is watched: a second of 30 Hz, at most."""
REDUCED = ((1, 55), (1, 35), (2, 70), (2, 45), (2, 25), (4, 60), (4, 30))
"""By what a picture's sides are divided, and the quality of its JPEG, the largest first: some 110 kB of
gravel become 70, 50, 28, 18, 12, 7 and 4."""
MOST_THREADS = 64


@dataclass(frozen=True, eq=False)
class Picture:
    """A frame and its JPEG, which may be ``reduced``: coarser, or of fewer pixels than the frame."""

    frame: StampedFrame
    jpeg: bytes
    reduced: bool = False

    def within(self, most_bytes: int | None) -> Picture:
        """Return it with a JPEG of at most so many bytes, None: any, or the smallest that there is."""
        if most_bytes is None or len(self.jpeg) <= most_bytes:
            return self
        image, jpeg = self.frame.image, self.jpeg
        height, width = image.shape[:2]
        for parts, quality in REDUCED:
            size = max(1, width // parts), max(1, height // parts)
            small = image if parts == 1 else cv2.resize(image, size, interpolation=cv2.INTER_AREA)
            jpeg = encoded(small, "jpeg", quality)
            if len(jpeg) <= most_bytes:
                break
        return Picture(self.frame, jpeg, reduced=True)


class Viewer:
    """One client's view of some cameras, ``every`` at their own rate; `CameraFeeds.viewer` makes one.

    ``news`` is set when a picture came; ``most_bytes`` bounds each camera's next picture.
    """

    def __init__(self, name: str, cameras: Sequence[str], ready: bool, every: bool) -> None:
        self.name = name
        self.every = every
        self.news = asyncio.Event()
        self.most_bytes: dict[str, int | None] = dict.fromkeys(cameras)
        self._wanted = set(cameras) if ready else set[str]()
        self._pictures: dict[str, Picture] = {}

    def want(self, camera: str, most_bytes: int | None = None) -> None:
        """Be ready for a picture of a camera, of at most so many bytes; another camera changes nothing."""
        if camera in self.most_bytes:
            self._wanted.add(camera)
            self.most_bytes[camera] = most_bytes

    def ready(self, camera: str) -> bool:
        """Return whether a picture of a camera would be taken."""
        return camera in self._wanted or camera in self._pictures

    def kept_of(self, frame: StampedFrame) -> int:
        """Return how many pictures of a camera may be clicked."""
        return max(KEPT, min(KEPT_OF_EVERY, KEPT_BYTES // frame.image.nbytes)) if self.every else KEPT

    def put(self, picture: Picture) -> None:
        """Leave a picture to be taken, in the place of one that was not."""
        camera = picture.frame.camera
        if self.ready(camera):
            self._wanted.discard(camera)
            self._pictures[camera] = picture
            self.news.set()

    def take(self) -> list[Picture]:
        """Return the newest picture of each camera since the last call."""
        self.news.clear()
        pictures, self._pictures = self._pictures, {}
        return list(pictures.values())


class CameraFeeds:
    """Pictures of cameras for as long as they have viewers; for the event loop."""

    def __init__(self, cameras: Devices, clock: Clock) -> None:
        self._cameras = cameras
        self._stands = clock.stands_for_work
        self._viewers: set[Viewer] = set()
        self._feeds: dict[str, asyncio.Task[None]] = {}
        self._changed = asyncio.Event()
        self._numbers = count(1)
        self._threads = CapacityLimiter(MOST_THREADS)

    @contextmanager
    def viewer(self, cameras: Sequence[str], ready: bool = True, every: bool = False) -> Iterator[Viewer]:
        """View some configured cameras inside the block.

        ``ready``: whether a first picture of each is wanted before `Viewer.want`; ``every``: whether pictures
        are wanted at the cameras' own rate, and not only as a person sees them move.
        """
        viewer = Viewer(f"viewer {next(self._numbers)}", cameras, ready, every)
        self._viewers.add(viewer)
        for camera in cameras:
            if camera not in self._feeds:
                self._feeds[camera] = asyncio.create_task(self._feed(camera))
        self.stir()
        try:
            yield viewer
        finally:
            self._viewers.discard(viewer)
            self._cameras.store.release(viewer.name)
            self.stir()

    def stir(self) -> None:
        """Have every feed see which viewers are ready."""
        self._changed.set()

    def close(self) -> None:
        """Take no more pictures."""
        for feed in self._feeds.values():
            feed.cancel()

    async def _feed(self, camera: str) -> None:
        """Hand out a camera's pictures until it has no viewer."""
        made: Picture | None = None
        while await self._wanted(camera):
            try:
                before = made
                made = await self._in_thread(lambda: self._next(camera, before))  # noqa: B023
                await self._hand_out(camera, made)
                pause_s = AGAIN_S if made is before else 0.0
            except (DriverError, MastctlError) as error:  # its fault says more
                log.debug("no picture of %s for its viewers: %s", camera, error)
                made, pause_s = None, FAILING_S
            except Exception:  # a defect must not end the feed
                log.exception("pictures of %s met a defect of the program", camera)
                made, pause_s = None, FAILING_S
            if pause_s:
                await asyncio.sleep(pause_s)

    def _next(self, camera: str, before: Picture | None) -> Picture:
        """Take and encode the next picture; the one before where it is still the newest."""
        after_s = -math.inf
        if before is not None and not self._stands:
            every = any(one.every for one in self._of(camera))
            after_s = before.frame.exposure_began_s + (NEXT_S if every else APART_S)
        frame = self._cameras.watched_frame(camera, after_s, STANDS_S if self._stands else NEW_S, TIMEOUT_S)
        if before is not None and before.frame is frame:
            return before
        return Picture(frame, frame.jpeg or encoded(frame.image, "jpeg", JPEG_QUALITY))

    async def _hand_out(self, camera: str, made: Picture) -> None:
        """Hand a picture to each viewer that is ready, which may click it from then on."""
        ready = [one for one in self._of(camera) if one.ready(camera)]

        def prepared() -> list[Picture]:
            for viewer in ready:
                self._cameras.store.keep(made.frame, viewer.name, viewer.kept_of(made.frame))
            return [made.within(viewer.most_bytes[camera]) for viewer in ready]

        for viewer, picture in zip(ready, await self._in_thread(prepared), strict=True):
            if viewer in self._viewers:
                viewer.put(picture)
            else:  # it left before the frame was kept for it, which would be kept for ever
                self._cameras.store.release(viewer.name)

    async def _wanted(self, camera: str) -> bool:
        """Wait until a viewer is ready for a picture; False if there is no viewer any more."""
        while viewers := self._of(camera):
            if any(one.ready(camera) for one in viewers):
                return True
            self._changed.clear()
            await self._changed.wait()
        del self._feeds[camera]
        return False

    def _of(self, camera: str) -> list[Viewer]:
        return [one for one in tuple(self._viewers) if camera in one.most_bytes]

    async def _in_thread(self, work: Callable[[], T]) -> T:
        return await run_sync(work, abandon_on_cancel=True, limiter=self._threads)
