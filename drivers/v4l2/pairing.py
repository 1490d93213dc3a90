"""Stereo pairs from two cameras: which two frames belong together, and whether they may serve a measurement.

Free-running cameras expose up to half a period apart, by an offset that stays nearly the same. It is learned,
so that the same partner is taken each time even where the offset is near half a period. Cameras with one
hardware trigger are paired by their counts instead.
"""

from __future__ import annotations

import statistics
from collections import deque
from dataclasses import dataclass
from typing import Generic, Protocol, TypeVar

SLOP_S = 0.002
"""How much more than half a period two frames of a pair may be apart: jitter of the stamps."""

LEARNED_FROM = 30
LEAST_TO_LEARN = 5
IMAGE_MOTION_PX = 0.5
"""How far the picture may move between the two exposures of a pair that serves a measurement."""


class Stamped(Protocol):
    """What pairing looks at: `drivers.v4l2.camera.V4l2Frame` has it."""

    @property
    def sequence(self) -> int: ...
    @property
    def driver_sequence(self) -> int: ...
    @property
    def stream(self) -> int: ...
    @property
    def mid_exposure_s(self) -> float: ...


F = TypeVar("F", bound=Stamped)


@dataclass(frozen=True, eq=False)
class Pair(Generic[F]):
    """Two frames that belong together.

    Attributes
    ----------
    left, right
        The frames.
    dt_s
        Mid-exposure of the right minus that of the left, seconds.
    offset_s
        What ``dt_s`` usually is, None before it is known.
    """

    left: F
    right: F
    dt_s: float
    offset_s: float | None

    def may_measure(self, still: bool, image_speed_px_per_s: float | None = None) -> bool:
        """Return whether the pair may serve a measurement.

        Parameters
        ----------
        still
            Whether neither the mast nor the target moves.
        image_speed_px_per_s
            How fast the picture moves if something does; None if that is not known.
        """
        return still or (
            image_speed_px_per_s is not None and abs(self.dt_s) * image_speed_px_per_s < IMAGE_MOTION_PX
        )


class Pairing(Generic[F]):
    """Pairs the frames of two cameras as they come; each frame serves one pair at most. For one thread.

    Parameters
    ----------
    period_s
        From frame to frame, of both cameras.
    triggered
        Whether one hardware trigger exposes both: then frames of equal count belong together.
    kept
        How many frames of each camera wait for a partner.
    """

    def __init__(self, period_s: float, triggered: bool = False, kept: int = 8) -> None:
        self._period_s = period_s
        self._triggered = triggered
        self._left: deque[F] = deque(maxlen=kept)
        self._right: deque[F] = deque(maxlen=kept)
        self._offsets_s: deque[float] = deque(maxlen=LEARNED_FROM)
        self._counts_apart: int | None = None  # right minus left, of frames of the same trigger
        self._last_sequences = [-1, -1]
        self._streams = [-1, -1]

    @property
    def offset_s(self) -> float | None:
        """The learned offset, right minus left, seconds; None before enough pairs were seen."""
        return statistics.median(self._offsets_s) if len(self._offsets_s) >= LEAST_TO_LEARN else None

    def add_left(self, frame: F) -> Pair[F] | None:
        """Take a frame of the left camera and return the pair that it completes, if any."""
        if not self._take(0, frame, self._left):
            return None
        return self._paired([(frame, right) for right in self._right])

    def add_right(self, frame: F) -> Pair[F] | None:
        """Take a frame of the right camera and return the pair that it completes, if any."""
        if not self._take(1, frame, self._right):
            return None
        return self._paired([(left, frame) for left in self._left])

    def _take(self, side: int, frame: F, queue: deque[F]) -> bool:
        """Keep a new frame; False for one that was seen before. A camera opened again is learned anew."""
        if frame.sequence <= self._last_sequences[side]:
            return False
        self._last_sequences[side] = frame.sequence
        if frame.stream != self._streams[side]:
            self._streams[side] = frame.stream
            queue.clear()
            self._learn_anew()
        queue.append(frame)
        return True

    def _paired(self, candidates: list[tuple[F, F]]) -> Pair[F] | None:
        """The best of the candidates, if it is good enough; its frames and all older ones are used up."""
        if self._triggered and self._counts_apart is not None:
            candidates = [(left, right) for left, right in candidates if self._same_trigger(left, right)]
        usual_s = self.offset_s
        if not candidates:
            return None
        left, right = min(candidates, key=lambda pair: abs(_dt_s(*pair) - (usual_s or 0.0)))
        dt_s = _dt_s(left, right)
        if abs(dt_s) > self._period_s / 2 + SLOP_S:
            if usual_s is not None and abs(dt_s - usual_s) < self._period_s / 4:
                self._learn_anew()  # the cameras drifted past each other
            if self._triggered and self._counts_apart is not None:
                self._learn_anew()  # one of them missed a trigger
            return None
        if usual_s is not None and abs(dt_s - usual_s) > self._period_s / 2:
            return None
        self._offsets_s.append(dt_s)
        self._counts_apart = right.driver_sequence - left.driver_sequence
        _use_up(self._left, left)
        _use_up(self._right, right)
        return Pair(left, right, dt_s, usual_s)

    def _same_trigger(self, left: F, right: F) -> bool:
        return right.driver_sequence - left.driver_sequence == self._counts_apart

    def _learn_anew(self) -> None:
        self._offsets_s.clear()
        self._counts_apart = None


def _dt_s(left: Stamped, right: Stamped) -> float:
    return right.mid_exposure_s - left.mid_exposure_s


def _use_up(queue: deque[F], frame: F) -> None:
    """Take a frame and all before it out of the queue."""
    while queue and queue[0].sequence <= frame.sequence:
        queue.popleft()
