"""Cameras that somebody watches: each asked for its newest picture once for all who are ready for one.

Nothing is queued, and no frame that somebody needs waits for one that is only watched. A watcher says for
each camera when it is ready for another picture, and is given the newest when there is one; one that was not
fetched yet is replaced. A camera that nobody is ready for is not asked.
"""

from __future__ import annotations

import logging
import math
import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import count
from typing import Protocol

import cv2

from drivers.clock import Clock
from drivers.errors import DriverError
from mastctl.devices.frames import StampedFrame
from mastctl.errors import MastctlError
from mastctl.report.pictures import encoded

log = logging.getLogger(__name__)

JPEG_QUALITY = 80  # 110 kB of 1024x768 gravel; a pixel's own grey is off by 2 of 255
APART_S = 0.045  # least time between two pictures: more than 15 a second from cameras of 15, 20, 30 or 60
NEXT_S = 1e-3  # the same where somebody watches every picture
NEW_S = 0.05  # a picture that was exposed this long ago is still new
STANDS_S = 0.25  # and one this long ago where the clock may stand: two frames of 15 Hz, and their read-out
AGAIN_S = 0.25  # a picture that stays the newest, since its clock stands, is shown again so often, real time
TIMEOUT_S = 1.0
FAILING_S = 0.5  # how long a camera is left alone that gave none
HELD = 4  # pictures of a camera that each watcher may click though newer ones came
HELD_OF_EVERY, HELD_BYTES = (
    32,
    64_000_000,
)  # the same where every picture is watched: a second of 30 Hz, at most
REDUCED = ((1, 55), (1, 35), (2, 70), (2, 45), (2, 25), (4, 60), (4, 30))
"""By what a picture's sides are divided, and the quality of its JPEG, the largest first: some 110 kB of
gravel become 70, 50, 28, 18, 12, 7 and 4."""


class CamerasLike(Protocol):
    """Who takes pictures, and keeps those that are looked at."""

    def glance(
        self, camera: str, exposed_after_s: float, max_age_s: float, timeout_s: float
    ) -> StampedFrame: ...
    def hold(self, frame: StampedFrame, by: str, kept: int) -> None: ...
    def let_go(self, by: str) -> None: ...


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


class WatchedCameras:
    """Pictures of cameras for as long as somebody watches them; safe to use from any thread.

    Parameters
    ----------
    cameras, clock
        The daemon's.
    """

    def __init__(self, cameras: CamerasLike, clock: Clock) -> None:
        self._cameras = cameras
        self._clock = clock
        self._changed = threading.Condition()
        self._watchers: set[Watcher] = set()
        self._at_work: set[str] = set()
        self._closed = False
        self._numbers = count(1)

    def watch(
        self, cameras: Sequence[str], wake: Callable[[], None], ready: bool = True, every: bool = False
    ) -> Watcher:
        """Begin to watch some cameras. Whoever does ends it by `Watcher.end`.

        Parameters
        ----------
        cameras
            Names of configured cameras.
        wake
            Called from another thread when a picture is there; must return at once.
        ready
            Whether a first picture of each is wanted before `Watcher.shown` asks for one.
        every
            Whether pictures are wanted at the cameras' own rate, and not only as a person sees them move.

        Raises
        ------
        RuntimeError
            If the system gives no thread; nobody watches then.
        """
        watcher = Watcher(self, f"watcher {next(self._numbers)}", cameras, wake, ready, every)
        with self._changed:
            self._watchers.add(watcher)
            self._changed.notify_all()  # a camera's thread may be waiting for a viewer that is ready
        try:
            for camera in watcher.cameras:
                self._begin(camera)
        except BaseException:
            self.leave(watcher)
            raise
        return watcher

    def _begin(self, camera: str) -> None:
        """Have a thread at work for a camera."""
        with self._changed:
            if camera not in self._at_work and not self._closed:
                name = f"pictures of {camera}"
                threading.Thread(target=self._work, args=(camera,), name=name, daemon=True).start()
                self._at_work.add(camera)  # it waits for this lock before it looks whether anybody watches

    def close(self) -> None:
        """Ask no camera any more."""
        with self._changed:
            self._closed = True
            self._watchers.clear()
            self._changed.notify_all()

    # What watchers call

    def stir(self) -> None:
        """Somebody is ready for another picture."""
        with self._changed:
            self._changed.notify_all()

    def leave(self, watcher: Watcher) -> None:
        """Somebody watches no longer."""
        with self._changed:
            self._watchers.discard(watcher)
            self._changed.notify_all()
        self._cameras.let_go(watcher.name)

    # In a camera's own thread, which ends when nobody watches

    def _work(self, camera: str) -> None:
        stands = self._clock.stands_for_work
        made: Picture | None = None
        pause_s = 0.0
        while self._wanted(camera, pause_s):
            try:
                after_s = (
                    -math.inf
                    if made is None or stands
                    else made.frame.exposure_began_s + self._apart_s(camera)
                )
                frame = self._cameras.glance(camera, after_s, STANDS_S if stands else NEW_S, TIMEOUT_S)
                if made is not None and made.frame is frame:
                    pause_s = AGAIN_S
                else:
                    made = Picture(frame, frame.jpeg or encoded(frame.image, "jpeg", JPEG_QUALITY))
                    pause_s = 0.0
                for watcher in self._ready(camera):
                    self._hand_to(watcher, made)
            except (DriverError, MastctlError) as error:  # its fault tells more
                log.debug("no picture of %s for its viewers: %s", camera, error)
                made, pause_s = None, FAILING_S
            except Exception:  # a defect must not end the thread
                log.exception("pictures of %s met a defect of the program", camera)
                made, pause_s = None, FAILING_S

    def _hand_to(self, watcher: Watcher, made: Picture) -> None:
        """Hand a picture to a watcher; one that fails is left out from then on, and no other waits for it."""
        camera = made.frame.camera
        try:
            self._cameras.hold(made.frame, watcher.name, watcher.held_of(made.frame))
            if self._is_there(watcher):
                watcher.put(made.within(watcher.most_bytes(camera)))
            else:  # it left before the frame was stored for it, which would be kept for ever
                self._cameras.let_go(watcher.name)
        except Exception:
            log.exception("%s of %s met a defect of the program", watcher.name, camera)
            self.leave(watcher)

    def _wanted(self, camera: str, pause_s: float) -> bool:
        """Wait until somebody is ready for a picture; False if nobody watches any more."""
        with self._changed:
            if pause_s:
                self._changed.wait_for(lambda: not self._watch(camera), pause_s)
            self._changed.wait_for(
                lambda: not self._watch(camera) or any(one.ready(camera) for one in self._watchers)
            )
            if self._watch(camera):
                return True
            self._at_work.discard(camera)
            return False

    def _apart_s(self, camera: str) -> float:
        with self._changed:
            every = any(one.every for one in self._watchers if camera in one.cameras)
        return NEXT_S if every else APART_S

    def _watch(self, camera: str) -> bool:
        return not self._closed and any(camera in one.cameras for one in self._watchers)

    def _is_there(self, watcher: Watcher) -> bool:
        with self._changed:
            return watcher in self._watchers

    def _ready(self, camera: str) -> list[Watcher]:
        with self._changed:
            return [one for one in self._watchers if one.ready(camera)]


class Watcher:
    """Somebody who watches; made by `WatchedCameras.watch`.

    Attributes
    ----------
    name
        Nobody else's.
    cameras
        What is watched.
    every
        Whether at the cameras' own rate.
    """

    def __init__(
        self,
        owner: WatchedCameras,
        name: str,
        cameras: Sequence[str],
        wake: Callable[[], None],
        ready: bool,
        every: bool = False,
    ) -> None:
        self.name = name
        self.cameras = frozenset(cameras)
        self.every = every
        self._owner = owner
        self._wake = wake
        self._lock = threading.Lock()
        self._wanted = dict.fromkeys(self.cameras, ready)
        self._most_bytes: dict[str, int | None] = dict.fromkeys(self.cameras)
        self._pictures: dict[str, Picture] = {}

    def shown(self, camera: str, most_bytes: int | None = None) -> None:
        """A picture of a camera was shown: another is wanted, of at most so many bytes (None: any).

        What is not watched counts nothing.
        """
        with self._lock:
            if camera not in self._wanted:
                return
            self._wanted[camera], self._most_bytes[camera] = True, most_bytes
        self._owner.stir()

    def ready(self, camera: str) -> bool:
        """Whether a picture of a camera would be taken."""
        return self._wanted.get(camera, False) or camera in self._pictures

    def most_bytes(self, camera: str) -> int | None:
        """Of a camera's next picture; None: any number."""
        return self._most_bytes[camera]

    def held_of(self, frame: StampedFrame) -> int:
        """How many pictures of a camera may be clicked."""
        return max(HELD, min(HELD_OF_EVERY, HELD_BYTES // frame.image.nbytes)) if self.every else HELD

    def put(self, picture: Picture) -> None:
        """Leave a picture to be taken, in the place of one that was not; none if that was taken meanwhile."""
        camera = picture.frame.camera
        with self._lock:
            if not self.ready(camera):
                return
            self._wanted[camera] = False
            self._pictures[camera] = picture
        self._wake()

    def take(self) -> list[Picture]:
        """Return what is there, the newest of each camera."""
        with self._lock:
            pictures, self._pictures = self._pictures, {}
        return list(pictures.values())

    def end(self) -> None:
        """Watch no longer."""
        self._owner.leave(self)
