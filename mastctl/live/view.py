"""What viewers of the live view see: the topics of a recording, as they come, and nothing while nobody looks.

A thread of its own hears the publisher only while a viewer watches something, and always the newest; cameras
that are watched are asked for pictures, as a client that shows them would.
"""

from __future__ import annotations

import contextlib
import importlib.util
import logging
import math
import threading
import time
from collections.abc import Sequence
from typing import Any, Protocol

from calib.geometry.rig import Rig
from drivers.clock import Clock
from drivers.errors import DriverError
from mastctl.control.publisher import TOPICS, Published, Publisher, ThreadSubscription
from mastctl.control.standing import StandingFault
from mastctl.devices.frames import StampedFrame
from mastctl.errors import MastctlError, Unable
from mastctl.live.screen import Screen
from mastctl.live.settings import LiveSettings
from mastctl.recorder.entries import Entries
from mastctl.recorder.feed import ELSEWHERE
from mastctl.recorder.recorder import RecordedNews
from mastctl.recorder.schemas import OWN_TOPICS
from mastctl.recorder.writer import Clocks

log = logging.getLogger(__name__)

NAME = "foxglove"
PICTURES_S = 0.2
"""At most so often a camera is asked for a picture, however many watch it."""

PICTURE_TIMEOUT_S = 5.0
FAILING_S = 5.0
"""How long a camera is left alone that gave none."""

AGAIN_S = 5.0
CLOSE_S = 3.0


class CamerasLike(Protocol):
    """Who takes pictures, and finds them again."""

    def glance(
        self, camera: str, exposed_after_s: float, max_age_s: float, timeout_s: float, told: bool
    ) -> StampedFrame: ...
    def frame_by_id(self, frame_id: str) -> StampedFrame: ...


class LiveView:
    """Shows what a daemon publishes until it is closed; safe to use from any thread.

    Parameters
    ----------
    settings
        Where.
    rig, digest
        The mast file in use.
    names
        The configured cameras.
    publisher, cameras, clock
        The daemon's.
    """

    def __init__(
        self,
        settings: LiveSettings,
        rig: Rig,
        digest: str,
        names: Sequence[str],
        publisher: Publisher,
        cameras: CamerasLike,
        clock: Clock,
    ) -> None:
        self._settings = settings
        self._mast = rig, digest
        self._publisher = publisher
        self._cameras = cameras
        self._clock = clock
        self._closing = threading.Event()
        self._stirred = threading.Event()
        self._news: ThreadSubscription | None = None
        self._screen: Screen | None = None
        self._fault: StandingFault | None = None
        self._lookers = {name: _Looker(name, cameras, self._closing, self._looked) for name in names}
        self._thread = threading.Thread(target=self._work, name="live view", daemon=True)
        self._thread.start()

    @property
    def port(self) -> int | None:
        """Where viewers connect; None while nobody can."""
        screen = self._screen
        return None if screen is None else screen.port

    def use_mast(self, rig: Rig, digest: str) -> None:
        """Stand by another mast file from now on."""
        self._mast = rig, digest
        self._stir()

    def faults(self) -> tuple[StandingFault, ...]:
        """Return what keeps it from showing anything."""
        fault = self._fault
        return () if fault is None else (fault,)

    def close(self) -> None:
        """Show nothing more and end the process; bounded."""
        self._closing.set()
        self._stir()
        if (screen := self._screen) is not None:
            screen.close()
        for looker in self._lookers.values():
            looker.wanted.set()
        self._thread.join(CLOSE_S)

    def _stir(self) -> None:
        """Have the thread see what has changed."""
        self._stirred.set()
        if (news := self._news) is not None:
            news.close()

    # In the thread of its own

    def _work(self) -> None:
        settings = self._settings
        while not self._closing.is_set():
            clocks = Clocks(self._clock.now_s(), time.time_ns())
            try:
                with Screen(settings.host, settings.port, clocks, self._stir) as screen:
                    self._screen, self._fault = screen, None
                    log.info("the live view is at ws://%s:%d", settings.host, screen.port)
                    self._show(screen)
                    self._stands("ended", "the live view's process has ended; it is started again")
            except MastctlError as error:
                self._stands(error.code, str(error))
            except OSError as error:
                self._stands("ended", f"the live view's process has ended ({error}); it is started again")
            except Exception:  # a defect must not end the thread
                log.exception("the live view met a defect of the program")
            finally:
                self._screen = None
            self._closing.wait(AGAIN_S)

    def _stands(self, code: str, words: str) -> None:
        before = self._fault
        if self._closing.is_set() or (before is not None and before.code == code):
            return
        self._fault = StandingFault(NAME, code, words, self._clock.now_s(), "viewers can connect again")
        log.warning("%s", words)

    def _show(self, screen: Screen) -> None:
        """Offer every topic; while some are watched, show them."""
        self._offer(screen)
        while screen.alive and not self._closing.is_set():
            self._stirred.wait()
            self._stirred.clear()
            watched = screen.watched if screen.alive else frozenset()
            for name, looker in self._lookers.items():
                looker.want(image_of(name) in watched)
            if watched:
                self._tell(screen, watched)

    def _offer(self, screen: Screen) -> None:
        rig, _ = self._mast
        for topic in OWN_TOPICS:
            screen.offer(f"/{topic}", f"mastctl.{topic}")
        screen.offer("/tf", "foxglove.FrameTransforms")
        screen.offer("/target/scene", "foxglove.SceneUpdate")
        for name in rig.cameras:
            screen.offer(f"/camera/{name}/calibration", "foxglove.CameraCalibration")
            screen.offer(f"/camera/{name}/cahvor", "mastctl.cahvor")
        for name, looker in self._lookers.items():
            screen.offer(f"/camera/{name}/frame", "mastctl.frame")
            if looker.schema:
                screen.offer(image_of(name), looker.schema)

    def _looked(self, camera: str, schema: str) -> None:
        """A camera has shown of which kind its pictures are."""
        if (screen := self._screen) is not None:
            with contextlib.suppress(OSError):
                screen.offer(image_of(camera), schema)

    def _tell(self, screen: Screen, watched: frozenset[str]) -> None:
        """Show the newest of everything, and what follows, until something else is watched."""
        rig, digest = self._mast
        entries = Entries(rig, digest)
        self._news = news = self._publisher.subscribe(*(TOPICS - ELSEWHERE))
        entries.tell_cameras(screen, self._clock.now_s(), time.monotonic())
        known = _not_the_past(news.wait(0.0))
        while not news.closed and not self._stirred.is_set():
            for one in known:
                self._hand_on(screen, entries, one, watched)
            known = news.wait()
        news.close()

    def _hand_on(self, screen: Screen, entries: Entries, one: Published, watched: frozenset[str]) -> None:
        value: Any = one.value
        time_s = self._clock.now_s()
        if one.topic == "frame":
            if not watched & {image_of(one.key), f"/camera/{one.key}/frame"}:
                return
            try:
                value = self._cameras.frame_by_id(value.frame_id)
            except MastctlError:
                return  # a newer one is on its way
        entries.write(screen, RecordedNews(one.topic, one.key, value, time_s), time.monotonic())


class _Looker:
    """Asks one camera for pictures while it is wanted; at first for one, to know of which kind they are."""

    def __init__(self, camera: str, cameras: CamerasLike, closing: threading.Event, on_kind: Any) -> None:
        self.schema = ""
        self.wanted = threading.Event()
        self._camera, self._cameras = camera, cameras
        self._closing, self._on_kind = closing, on_kind
        threading.Thread(target=self._work, name=f"live view of {camera}", daemon=True).start()

    def want(self, wanted: bool) -> None:
        """Ask for pictures, or no longer."""
        if wanted:
            self.wanted.set()
        else:
            self.wanted.clear()

    def _work(self) -> None:
        while not self.schema and not self._closing.is_set():
            self._closing.wait(0.0 if self._look() else FAILING_S)
        while self.wanted.wait() and not self._closing.is_set():
            self._closing.wait(PICTURES_S if self._look() else FAILING_S)

    def _look(self) -> bool:
        try:
            frame = self._cameras.glance(self._camera, -math.inf, PICTURES_S, PICTURE_TIMEOUT_S, told=True)
        except (DriverError, MastctlError):
            return False
        schema = "foxglove.CompressedImage" if frame.jpeg else "foxglove.RawImage"
        if schema != self.schema:
            self.schema = schema
            self._on_kind(self._camera, schema)
        return True


def check_installed() -> None:
    """Pass if the server for viewers is installed. Raises Unable ``no_foxglove``."""
    if importlib.util.find_spec("foxglove") is None:
        words = "the configuration asks for a live view (foxglove), and foxglove-sdk is not installed"
        raise Unable("no_foxglove", f"{words}: pip install 'mastctl[foxglove]'")


def image_of(camera: str) -> str:
    """Return the topic of a camera's pictures."""
    return f"/camera/{camera}/image"


def _not_the_past(known: list[Published]) -> list[Published]:
    """Of what was published before anybody watched, leave out commands and all operations but the last."""
    last = max((one.sequence for one in known if one.topic == "operation"), default=0)
    return [
        one for one in known if one.topic != "command" and (one.topic != "operation" or one.sequence == last)
    ]
