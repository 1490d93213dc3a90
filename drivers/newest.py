"""The newest good frame of a camera, between the thread that captures and the threads that request frames.

The frame stays where the driver put it until the next one is there. Its picture is made from there when a
caller first requests it, once for all callers: a frame without a request is not converted and not copied.
"""

from __future__ import annotations

import logging
import threading
import time
from abc import abstractmethod
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, Generic, NamedTuple, Protocol, TypeVar

from drivers.errors import BadFrame, DriverError, NoCamera, NoFreshFrame
from drivers.interfaces import Camera, Frame, FrameTime, Image
from drivers.values_set import ValuesSet

RECENT_FRAMES = 30  # a second's: from their times the offset between two cameras is learned
ROUNDING_S = 1e-9  # a frame stated by its middle and length is not newer than itself
LATE_S = 0.005  # a frame is late if it comes more than a period and this after its stamp
FIRST_PAUSE_S, LONGEST_PAUSE_S = 0.05, 1.0  # between tries to open a camera that is there and fails
CLOSE_PATIENCE_S = 2.0  # for the thread to end: a device that died may hold it

log = logging.getLogger(__name__)


class ExposureWindow(NamedTuple):
    """A stretch of time in which the whole exposure lay, seconds of CLOCK_MONOTONIC."""

    begin_s: float
    end_s: float

    @property
    def mid_s(self) -> float:
        """The middle: the best guess of mid-exposure."""
        return (self.begin_s + self.end_s) / 2

    @property
    def length_s(self) -> float:
        """From its begin to its end."""
        return self.end_s - self.begin_s

    def mid_uncertainty_s(self, exposure_s: float | None) -> float:
        """Return the most that mid-exposure may be from the middle; less if the exposure is known."""
        return max(0.0, self.length_s - (exposure_s or 0.0)) / 2


class Kept(Protocol):
    """A frame, as far as this module needs it."""

    @property
    def window(self) -> ExposureWindow: ...

    @property
    def sequence(self) -> int: ...


@dataclass(frozen=True, eq=False)
class TimedFrame(Frame):
    """A frame with what is known of its time.

    ``exposure_s`` of `Frame` is here the window in which the exposure of all rows surely lay, and
    ``mid_exposure_s`` is its middle.

    Attributes
    ----------
    mid_uncertainty_s
        The most that the true mid-exposure may be away from ``mid_exposure_s``.
    set_exposure_s
        The camera's own exposure time, None if not known: also for the first frames after it was changed.
    stamp_s, received_s
        The stamp (of the kernel, or of the camera's own clock), and when the frame was whole, by
        CLOCK_MONOTONIC; seconds.
    """

    mid_uncertainty_s: float
    set_exposure_s: float | None
    stamp_s: float
    received_s: float
    driver_sequence: int
    stream: int


@dataclass
class Counters:
    """Counts of a camera's frames since it was opened.

    Good ones were published, damaged ones refused (error flag, lost packets, length, stamp). The first ones
    of a stream are neither, where nothing shows yet when their exposure began. Dropped ones never came, by
    gaps in the camera's count. Late are good ones that came more than a period and 5 ms after their stamp.
    """

    good: int = 0
    damaged: int = 0
    dropped: int = 0
    late: int = 0
    reopened: int = 0
    last_damage: str = ""


Arrived = TypeVar("Arrived", bound=Kept)


class CapturedCamera(Camera, Generic[Arrived]):
    """A camera with a thread of its own, which takes frames until closed, and opens it again when it fails.

    Safe from any thread. A camera that cannot be opened at first raises DriverError.

    ``gone_pause_s`` is between tries to open one that is not there, where that disturbs nothing; 0: as ever.
    """

    gone_pause_s = 0.0

    def __init__(self, name: str) -> None:
        self.name = name
        self._changed = threading.Condition(threading.Lock())  # guards what follows
        self._newest: Arrived | None = None
        self._make: Callable[[], tuple[Image, bytes]] | None = None
        self._picture: tuple[Image, bytes] | None = None
        self._recent: deque[Arrived] = deque(maxlen=RECENT_FRAMES)  # of this stream
        self._counters = Counters()
        self._lost = ""
        self._closed = False
        self._over = threading.Event()
        self._opening = threading.Lock()  # guards what is adjusted, and which values are in force
        self._in_force: Mapping[str, ValuesSet] = {}  # of the stream that was opened last
        self._pause_s = FIRST_PAUSE_S
        self._thread: threading.Thread | None = None
        self._last: TimedFrame | None = None

    @abstractmethod
    def _open(self) -> Any:
        """Return the opened stream. Raises DriverError."""

    @abstractmethod
    def _stream(self, stream: Any) -> None:
        """Take frames until `_over`. Raises DriverError when the camera fails."""

    @abstractmethod
    def _let_go(self, stream: Any) -> None:
        """Close a stream; the newest frame is forgotten."""

    @abstractmethod
    def _is_young(self, frame: Arrived) -> bool:
        """Whether a frame is the last one that should be here by now."""

    @abstractmethod
    def _timed(self, arrived: Arrived, image: Image, jpeg: bytes) -> TimedFrame:
        """Return a frame that arrived, with its picture."""

    @property
    def lost(self) -> str:
        """Why there are no frames now: the camera is gone or its stream failed; empty while it streams."""
        return self._lost

    @property
    def newest(self) -> Arrived | None:
        """The newest good frame, however old; None if there is none."""
        return self._newest

    @property
    def counters(self) -> Counters:
        """The counts of good, damaged and missing frames so far."""
        with self._changed:
            return replace(self._counters)

    def next_frame(self, exposed_after_s: float, timeout_s: float) -> TimedFrame:
        """Return the newest frame whose exposure surely began after ``exposed_after_s``, waiting if need be.

        Its stamp is at most a period and 5 ms old, or it came during the call. Raises NoFreshFrame if none
        came within ``timeout_s`` seconds; the message says what came instead; NoCamera (at once, if the
        camera is gone).
        """
        damaged = self._counters.damaged
        taken = self._fresh(exposed_after_s, timeout_s)
        if taken is None:
            if self._lost:
                raise NoCamera(self._lost)
            raise NoFreshFrame(self._instead(exposed_after_s, timeout_s, damaged), device=self.name)
        if self._last is None or self._last.image is not taken[1]:
            self._last = self._timed(*taken)
        return self._last

    def _fresh(self, exposed_after_s: float, timeout_s: float) -> tuple[Arrived, Image, bytes] | None:
        """The newest frame, once its exposure began after that moment, its read-only picture, and its JPEG.

        A frame that was there before is given only while it is young. None after ``timeout_s``, and at once
        when the camera is lost or closed.
        """
        until_s = time.monotonic() + timeout_s
        with self._changed:
            first = self._newest
            while True:
                newest = self._newest
                if (
                    newest is not None
                    and newest.window.begin_s > exposed_after_s + ROUNDING_S
                    and (newest is not first or self._is_young(newest))
                    and (picture := self._converted()) is not None
                ):
                    return newest, *picture
                left_s = until_s - time.monotonic()
                if self._closed or self._lost or left_s <= 0:
                    return None
                self._changed.wait(left_s)

    def _converted(self) -> tuple[Image, bytes] | None:
        """The newest frame's picture; None if making it finds it damaged.

        It is made under the lock: the frame's buffer does not go back meanwhile.
        """
        if self._picture is None and self._make is not None:
            try:
                self._picture = self._make()
                self._picture[0].setflags(write=False)
            except BadFrame as error:
                self._newest = None
                self._counters.good -= 1
                self._counters.damaged += 1
                self._counters.last_damage = str(error)
        return self._picture

    def _instead(self, exposed_after_s: float, timeout_s: float, damaged_before: int) -> str:
        """What to say when no fresh frame came, in one sentence."""
        counters, last = self.counters, self._newest
        message = f"no frame exposed after the requested moment came within {timeout_s:.3g} s"
        if damaged := counters.damaged - damaged_before:
            message += f"; {damaged} came damaged ({counters.last_damage})"
        if last is None:
            return message if damaged else f"{message}; none came at all"
        age_s = exposed_after_s - last.window.begin_s
        if age_s < 0.0:  # late enough, but older than a frame that is still to come
            age_s = self.now_s() - last.window.begin_s
            return f"{message}; the last good one is frame {last.sequence}, {age_s:.3f} s old"
        return f"{message}; the last good one is frame {last.sequence}, exposed {age_s:.3f} s before"

    def now_s(self) -> float:
        """Return the time by the clock of its stamps."""
        return time.monotonic()

    def recent_times(self) -> list[FrameTime]:
        """Return the times of the last good frames of this stream, oldest first."""
        with self._changed:
            return [FrameTime(frame.sequence, frame.window.begin_s) for frame in self._recent]

    def await_settled(self, timeout_s: float) -> None:
        """Wait until a frame came that shows no setting of before, or none will, for so long at most."""
        with self._changed:
            self._changed.wait_for(
                lambda: self._closed or self._lost or all(one.settled for one in self._in_force.values()),
                timeout_s,
            )

    def close(self) -> None:
        """End the thread and let go of the camera; one that hangs is left behind after 2 s."""
        with self._changed:
            was_closed, self._closed = self._closed, True
            self._changed.notify_all()
        if was_closed:
            return
        self._over.set()
        if self._thread is not None:
            self._thread.join(CLOSE_PATIENCE_S)
            if self._thread.is_alive():
                log.warning("%s: its driver hangs; it is closed when the driver comes back", self.name)

    def _begin(self, stream: Any) -> None:
        """Start the thread, with a stream that is open."""
        serve = partial(self._serve, stream)
        self._thread = threading.Thread(target=serve, name=f"capture {self.name}", daemon=True)
        self._thread.start()

    def _serve(self, stream: Any) -> None:
        """Take frames, and open again after every failure, until closed."""
        while True:
            if stream is not None:
                try:
                    self._stream(stream)
                    return
                except DriverError as error:
                    self._lose(str(error))
                except Exception as error:  # a defect here must not end in a thread that is silently gone
                    log.exception("%s: the capture failed", self.name)
                    self._lose(f"{self.name}: the capture failed: {type(error).__name__}: {error}")
                finally:
                    with self._changed:
                        self._forget()  # what the frame lies in goes away
                    self._let_go(stream)
            if self._over.wait(self._pause_s):
                return
            self._pause_s = min(2 * self._pause_s, LONGEST_PAUSE_S)
            stream = self._reopened()

    def _lose(self, why: str) -> None:
        """Note that there are no frames for now, and forget the last one."""
        with self._changed:
            had, self._lost = not self._lost, why
            self._forget()
            self._changed.notify_all()
        if had:
            log.warning("%s; it is opened again when it is back", why)

    def _forget(self) -> None:
        self._newest = self._make = self._picture = None
        self._recent.clear()

    def _publish(
        self, frame: Arrived, make: Callable[[], tuple[Image, bytes]], *, dropped: int, late: bool
    ) -> None:
        """Put a good frame in the place of the last one, whose memory may be filled again."""
        with self._changed:
            self._counters.dropped += dropped
            self._counters.good += 1
            self._counters.late += late
            self._newest, self._make, self._picture = frame, make, None
            self._recent.append(frame)
            self._changed.notify_all()

    def _refuse(self, dropped: int, wrong: str = "") -> None:
        """Count a frame that is not published; ``wrong`` says why it is damaged, if it is."""
        with self._changed:
            self._counters.dropped += dropped
            if wrong:
                self._counters.damaged += 1
                self._counters.last_damage = wrong

    def _reopened(self) -> Any:
        """Try to open the camera again; None if it is not back."""
        try:
            stream = self._open()
        except Exception as error:
            if isinstance(error, NoCamera):
                self._pause_s = self.gone_pause_s or self._pause_s
            elif not isinstance(error, DriverError):  # a defect: the thread goes on trying, and says so
                log.exception("%s: opening again failed", self.name)
            self._lose(str(error) or type(error).__name__)
            return None
        with self._changed:
            self._lost = ""
            self._counters.reopened += 1
        log.warning("%s is back", self.name)
        return stream
