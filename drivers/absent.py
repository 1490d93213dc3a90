"""Devices that are away: why, when they are worth another try, and a camera that joins when it can be opened.

A factory may fail, which is tried again with a growing wait, or block for as long as it likes, and nothing
can end that from outside. So each opening has a thread of its own, and a caller gets its present state at
once.
"""

from __future__ import annotations

import copy
import logging
import threading
import time
from collections.abc import Callable
from concurrent.futures import Future
from typing import Any

from drivers.clock import Clock
from drivers.errors import DriverError
from drivers.interfaces import Camera, CameraInfo, Frame, FrameCounts

log = logging.getLogger(__name__)

FIRST_WAIT_S, LONGEST_WAIT_S = 0.1, 2.0
LAST_STOP_S = 1.0
"""How long the stop of a head that is closed is tried again; all of closing may take 3 s."""

Opening = Future[Any]


class Absence:
    """Whether a device is away. Each failed try doubles the wait before the next one, up to a bound.

    ``error`` says why it is away, None while it is here; ``again_s`` is when to try again, on the caller's
    clock, seconds.
    """

    def __init__(self) -> None:
        self.error: DriverError | None = None
        self.again_s = 0.0
        self._wait_s = FIRST_WAIT_S

    def note(self, error: DriverError, now_s: float, silent_s: float = 0.0) -> None:
        """Note that it is away, or still away after a try; it is left alone for ``silent_s`` at least."""
        self.again_s = now_s + max(self._wait_s, silent_s)
        self._wait_s = min(2 * self._wait_s, LONGEST_WAIT_S)
        self.error = error

    def end(self) -> None:
        """Note that it is here."""
        self.error, self._wait_s = None, FIRST_WAIT_S

    def check(self) -> None:
        """Raise why it is away, if it is; each time a new error, since one grows with every raise."""
        error = self.error
        if error is not None:
            raise copy.copy(error)


def stop_at_last(stop: Callable[[], object], clock: Clock, device: str) -> None:
    """Stop a head that is closed, which no silence stops; tried again for `LAST_STOP_S`.

    Raises nothing but what ``stop`` raises beside DriverError.
    """
    until_s = clock.now_s() + LAST_STOP_S
    while True:
        try:
            stop()
        except DriverError as error:
            if clock.now_s() < until_s:
                clock.sleep(FIRST_WAIT_S)
                continue
            message = "the last stop was not confirmed; 'mastctl stop --without-daemon' stops the head"
            log.warning("%s: %s: %s", device, message, error)
        return


def begin_opening(name: str, make: Callable[[], Any]) -> Opening:
    """Open a device in a thread of its own, which is left behind if it never returns."""
    opening: Opening = Future()

    def work() -> None:
        try:
            opening.set_result(make())
        except BaseException as error:  # it belongs to the caller of the result
            opening.set_exception(error)

    threading.Thread(target=work, name=f"opening {name}", daemon=True).start()
    return opening


def let_go(opening: Opening) -> None:
    """Close what an opening brings, now or whenever it ends."""

    def close(ended: Opening) -> None:
        if ended.exception() is None:
            ended.result().close()

    opening.add_done_callback(close)


class AbsentCamera(Camera):
    """Stands for a camera until it can be opened."""

    def __init__(
        self,
        name: str,
        driver: str,
        make: Callable[[], Camera],
        opening: Opening | None = None,
        error: DriverError | None = None,
    ) -> None:
        self._name = name
        self._driver = driver
        self._make = make
        self._lock = threading.Lock()
        self._opening = opening
        self._since_s = time.monotonic()
        self._absence = Absence()
        if error is not None:
            self._absence.note(error, self._since_s)
        self._closed = False
        self.camera: Camera | None = None
        """The camera, once it is open."""

    @property
    def error(self) -> DriverError | None:
        """Why the last opening failed; None while one is under way, or when it is there."""
        error = self._absence.error
        return None if error is None else self._named(error, "")

    def appeared(self) -> Camera:
        """Return the camera if it is open by now, and see to it that it is tried; never waits.

        Raises DriverError (why it is not, and that it joins by itself; with the code of the driver's own
        error).
        """
        with self._lock:
            if self.camera is None and not self._closed:
                self._try(time.monotonic())
            if self.camera is None:
                raise self._why(time.monotonic())
            return self.camera

    def next_frame(self, exposed_after_s: float, timeout_s: float) -> Frame:
        """Return a frame if the camera is there by now. Raises DriverError as `appeared`."""
        return self.appeared().next_frame(exposed_after_s, timeout_s)

    @property
    def info(self) -> CameraInfo:
        """What the camera states of itself, once it is open."""
        return CameraInfo() if self.camera is None else self.camera.info

    @property
    def counters(self) -> FrameCounts | None:
        """The camera's counts of its frames, once it is open."""
        return None if self.camera is None else self.camera.counters

    def close(self) -> None:
        """Close the camera, also one that is opened later yet."""
        with self._lock:
            self._closed = True
            opening, self._opening = self._opening, None
            camera = self.camera
        if opening is not None:
            let_go(opening)
        if camera is not None:
            camera.close()

    def _try(self, now_s: float) -> None:
        """Take what an opening brought, or begin the next one when it is due."""
        if self._opening is None:
            if now_s < self._absence.again_s:
                return
            self._opening, self._since_s = begin_opening(self._name, self._make), now_s
        if not self._opening.done():
            return
        opening, self._opening = self._opening, None
        error = opening.exception()
        if error is None:
            self.camera = opening.result()
            self._absence.end()
        else:
            fault = (
                error if isinstance(error, DriverError) else DriverError(f"{type(error).__name__}: {error}")
            )
            self._absence.note(fault, now_s)

    def _why(self, now_s: float) -> DriverError:
        """Why it is not there."""
        error = self._absence.error
        if error is None:
            message = (
                f"driver {self._driver!r} has been opening it for {now_s - self._since_s:.0f} s; "
                "it joins by itself when the driver returns"
            )
            return DriverError(message, device=self._name)
        again = f"; tried again every {LONGEST_WAIT_S:g} s, it joins by itself"
        return self._named(error, "absent since the start: ", again)

    def _named(self, error: DriverError, before: str, after: str = "") -> DriverError:
        """The same error with the camera's name in front, and text around its own."""
        own = str(error).removeprefix(f"{self._name}: ")
        named = DriverError(f"{before}{own}{after}", device=self._name, detail=error.detail)
        named.code = error.code
        return named
