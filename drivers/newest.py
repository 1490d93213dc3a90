"""The newest good frame of a camera, between the thread that captures and those that ask for frames.

The frame stays where the driver put it until the next one is there. Its picture is made from there when a
caller first asks, once for all that ask: a frame without a request is not converted and not copied.
"""

from __future__ import annotations

import threading
import time
from abc import abstractmethod
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Generic, Protocol, TypeVar

from drivers.errors import BadFrame, NoCamera, NoFreshFrame
from drivers.interfaces import Camera, CameraSetting, Frame, FrameTime, Image

RECENT_FRAMES = 30  # a second's: from their times the offset between two cameras is learned
ROUNDING_S = 1e-9  # a frame told by its middle and length is not newer than itself


class Window(Protocol):
    """In which stretch of time a frame was exposed."""

    @property
    def begin_s(self) -> float: ...


class Kept(Protocol):
    """A frame, as far as this module needs it."""

    @property
    def window(self) -> Window: ...

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
    driver_sequence, stream
        The driver's or the camera's own count, and the stream's number.
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

    Attributes
    ----------
    good, damaged
        Frames that were published, and frames that were refused (error flag, lost packets, length, stamp).
        The first ones of a stream are neither, where nothing shows yet when their exposure began.
    dropped
        Frames that never came, by gaps in the camera's count.
    late
        Good frames that came more than a period and 5 ms after their stamp.
    """

    good: int = 0
    damaged: int = 0
    dropped: int = 0
    late: int = 0
    reopened: int = 0
    last_damage: str = ""


Arrived = TypeVar("Arrived", bound=Kept)


class Newest(Generic[Arrived]):
    """Holds one frame; safe from any thread."""

    def __init__(self) -> None:
        self._changed = threading.Condition(threading.Lock())
        self._frame: Arrived | None = None
        self._make: Callable[[], tuple[Image, bytes]] | None = None
        self._picture: tuple[Image, bytes] | None = None
        self._recent: deque[Arrived] = deque(maxlen=RECENT_FRAMES)  # of this stream
        self._counters = Counters()
        self._lost = ""
        self._closed = False

    @property
    def counters(self) -> Counters:
        """The counts so far."""
        with self._changed:
            return replace(self._counters)

    @property
    def lost(self) -> str:
        """Why there are no frames now; empty while there are."""
        return self._lost

    @property
    def frame(self) -> Arrived | None:
        """The newest good frame, however old; None if there is none."""
        return self._frame

    def instead(self, exposed_after_s: float, timeout_s: float, damaged_before: int, now_s: float) -> str:
        """Return what to say when no fresh frame came, in plain words."""
        counters, last = self.counters, self.frame
        message = f"no frame exposed after the asked moment came within {timeout_s:.3g} s"
        if damaged := counters.damaged - damaged_before:
            message += f"; {damaged} came damaged ({counters.last_damage})"
        if last is None:
            return message if damaged else f"{message}; none came at all"
        age_s = exposed_after_s - last.window.begin_s
        if age_s < 0.0:  # late enough, but older than a frame that is still to come
            age_s = now_s - last.window.begin_s
            return f"{message}; the last good one is frame {last.sequence}, {age_s:.3f} s old"
        return f"{message}; the last good one is frame {last.sequence}, exposed {age_s:.3f} s before"

    def recent(self) -> list[Arrived]:
        """Return the last good frames of this stream, oldest first."""
        with self._changed:
            return list(self._recent)

    def take(
        self, exposed_after_s: float, timeout_s: float, is_young: Callable[[Arrived], bool]
    ) -> tuple[Arrived, Image, bytes] | None:
        """Return the newest frame, once its exposure began after that moment, and its read-only picture, with
        the JPEG that it was made of (empty where the camera gives none).

        A frame that was there before is given only while it ``is_young``. None after ``timeout_s``, and at
        once when the camera is lost or closed.
        """
        until_s = time.monotonic() + timeout_s
        with self._changed:
            first = self._frame
            while True:
                newest = self._frame
                if (
                    newest is not None
                    and newest.window.begin_s > exposed_after_s + ROUNDING_S
                    and (newest is not first or is_young(newest))
                    and (picture := self._converted()) is not None
                ):
                    return newest, *picture
                left_s = until_s - time.monotonic()
                if self._closed or self._lost or left_s <= 0:
                    return None
                self._changed.wait(left_s)

    def wait_until(self, holds: Callable[[], bool], timeout_s: float) -> None:
        """Wait until a frame came with which something ``holds``, or none will come, for so long at most."""
        with self._changed:
            self._changed.wait_for(lambda: self._closed or bool(self._lost) or holds(), timeout_s)

    def _converted(self) -> tuple[Image, bytes] | None:
        """The newest frame's picture; None if making it finds it damaged.

        It is made under the lock: the frame's buffer does not go back meanwhile.
        """
        if self._picture is None and self._make is not None:
            try:
                self._picture = self._make()
                self._picture[0].setflags(write=False)
            except BadFrame as error:
                self._frame = None
                self._counters.good -= 1
                self._counters.damaged += 1
                self._counters.last_damage = str(error)
        return self._picture

    # Called by the thread that captures

    def publish(
        self, frame: Arrived, make: Callable[[], tuple[Image, bytes]], *, dropped: int, late: bool
    ) -> None:
        """Put a good frame in the place of the last one, whose memory may be filled again."""
        with self._changed:
            self._counters.dropped += dropped
            self._counters.good += 1
            self._counters.late += late
            self._frame, self._make, self._picture = frame, make, None
            self._recent.append(frame)
            self._changed.notify_all()

    def refuse(self, dropped: int, wrong: str = "") -> None:
        """Count a frame that is not published; ``wrong`` says why it is damaged, if it is."""
        with self._changed:
            self._counters.dropped += dropped
            if wrong:
                self._counters.damaged += 1
                self._counters.last_damage = wrong

    def lose(self, why: str) -> bool:
        """Say that there are no frames for now, and forget the last one; return whether there were any."""
        with self._changed:
            had, self._lost = not self._lost, why
            self._forget()
            self._changed.notify_all()
        return had

    def forget(self) -> None:
        """Forget the last frame: what it lies in goes away."""
        with self._changed:
            self._forget()

    def come_back(self) -> None:
        """Say that the camera was opened again."""
        with self._changed:
            self._lost = ""
            self._counters.reopened += 1

    def close(self) -> bool:
        """End every call that waits; return whether it was open."""
        with self._changed:
            was_open, self._closed = not self._closed, True
            self._changed.notify_all()
        return was_open

    def _forget(self) -> None:
        self._frame = self._make = self._picture = None
        self._recent.clear()


class CapturedCamera(Camera):
    """A camera whose ``capture`` has a thread of its own and a `Newest`; safe from any thread."""

    capture: Any
    name: str
    _last: TimedFrame | None = None

    @abstractmethod
    def _timed(self, arrived: Any, image: Image, jpeg: bytes) -> TimedFrame:
        """Return a frame that arrived, with its picture."""

    @property
    def counters(self) -> Counters:
        """The counts of good, damaged and missing frames so far."""
        counters: Counters = self.capture.newest.counters
        return counters

    def next_frame(self, exposed_after_s: float, timeout_s: float) -> TimedFrame:
        """Return the newest frame whose exposure surely began after ``exposed_after_s``, waiting if need be.

        Its stamp is at most a period and 5 ms old, or it came during the call. Raises NoFreshFrame if none
        came within ``timeout_s`` seconds; the message says what came instead; NoCamera (at once, if the
        camera is gone).
        """
        newest: Newest[Any] = self.capture.newest
        damaged = newest.counters.damaged
        taken = self.capture.take(exposed_after_s, timeout_s)
        if taken is None:
            if lost := newest.lost:
                raise NoCamera(lost)
            words = newest.instead(exposed_after_s, timeout_s, damaged, self.now_s())
            raise NoFreshFrame(words, device=self.name)
        if self._last is None or self._last.image is not taken[1]:
            self._last = self._timed(*taken)
        return self._last

    def now_s(self) -> float:
        """Return the time by the clock of its stamps."""
        return time.monotonic()

    def recent_times(self) -> list[FrameTime]:
        """Return the times of the last good frames of this stream, oldest first."""
        return [FrameTime(frame.sequence, frame.window.begin_s) for frame in self.capture.newest.recent()]

    def settings(self) -> Sequence[CameraSetting]:
        """Return exposure, gain, white balance and focus, as far as it has them. Raises DriverError."""
        settings: Sequence[CameraSetting] = self.capture.settings()
        return settings

    def adjust(self, wanted: Mapping[str, float]) -> Sequence[str]:
        """Change some of them, as `drivers.interfaces.Camera.adjust`."""
        notes: Sequence[str] = self.capture.adjust(wanted)
        return notes
