"""The camera's own clock tied to ours: in which bounds their difference lies, and a frame's window by it.

Two observations bound the difference. A *reading* (the camera latches its clock between two moments of ours)
bounds it from both sides. The *arrival* of a frame's first packet bounds it from above alone, since no packet
comes before its exposure. The least delay of the path must then be stated (`CameraClock.least_delay_s`).
Bounds widen as long as nothing new is observed, by the most that two crystals drift apart.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass, field

from drivers.aravis.settings import Stamped
from drivers.newest import ExposureWindow

DRIFT = 1e-4
"""100 ppm: two crystals of 50 ppm each, in opposite directions; usual ones have 20 to 50."""


SET_S = 1e-3
"""The wall's clock was set if it moved by more against CLOCK_MONOTONIC between two frames; time servers slew
by 500 ppm at most."""


LATEST_S = 1.0
"""No frame waits longer in Aravis before it is taken."""


@dataclass
class WallClock:
    """How long ago Aravis stamped a frame's first packet; it stamps by the wall's clock, which can be set."""

    _offsets_s: deque[float] = field(default_factory=lambda: deque(maxlen=8))

    def ago_s(self, stamped_s: float, wall_s: float, now_s: float) -> float:
        """Return how long before ``now_s`` (CLOCK_MONOTONIC) it was, at most; both clocks were read at once.

        0 where the wall's clock was set in the last eight frames: the frame came by now, no more is known.
        """
        offset_s = wall_s - now_s
        same = bool(self._offsets_s) and all(abs(offset_s - was_s) <= SET_S for was_s in self._offsets_s)
        self._offsets_s.append(offset_s)
        return min(max(0.0, wall_s - stamped_s), LATEST_S) if same else 0.0


class ClockStepped(Exception):
    """The camera's clock was set, or began again: nothing that was known of it holds."""


@dataclass
class CameraClock:
    """Bounds of our clock minus the camera's, seconds; of one stream.

    Attributes
    ----------
    least_delay_s
        At its best, the path brings a frame's first packet at most so long after its stamp. It counts only
        for a camera whose clock cannot be read.
    low_s, high_s
        The bounds when they were last looked at, at ``at_s``.
    """

    least_delay_s: float
    low_s: float = -math.inf
    high_s: float = math.inf
    at_s: float = 0.0
    readings: int = 0

    def read(self, before_s: float, camera_s: float, after_s: float) -> None:
        """Take in that the camera's clock stood at ``camera_s`` between two moments of ours.

        Raises ClockStepped if that contradicts what was observed before.
        """
        self._widen(after_s)
        low_s, high_s = before_s - camera_s, after_s - camera_s
        if self.readings:
            low_s, high_s = max(self.low_s, low_s), min(self.high_s, high_s)
        else:
            high_s = min(self.high_s, high_s)
        self.readings += 1
        self.low_s, self.high_s = low_s, high_s
        self._check()

    def arrived(self, stamp_s: float, arrived_s: float) -> None:
        """Take in that a frame stamped ``stamp_s`` by the camera began to come at ``arrived_s`` of ours.

        Raises ClockStepped if the frame came before it was stamped.
        """
        self._widen(arrived_s)
        above_s = arrived_s - stamp_s
        if above_s < self.high_s:
            self.high_s = above_s
            if not self.readings:
                self.low_s = above_s - self.least_delay_s
        self._check()

    def window(self, stamp_s: float, stamped: Stamped, longest_s: float, arrived_s: float) -> ExposureWindow:
        """Return in which stretch of our time a frame was exposed.

        At ``arrived_s`` its first packet came: the exposure was over.
        """
        begin_s = stamp_s + self.low_s - (0.0 if stamped == "start" else longest_s)
        end_s = stamp_s + self.high_s + (0.0 if stamped == "end" else longest_s)
        return ExposureWindow(begin_s, max(begin_s, min(end_s, arrived_s)))

    def _widen(self, now_s: float) -> None:
        """Let the bounds grow by what the clocks may have drifted apart."""
        by_s = DRIFT * max(0.0, now_s - self.at_s) if self.at_s else 0.0
        self.low_s -= by_s
        self.high_s += by_s
        self.at_s = max(self.at_s, now_s)

    def _check(self) -> None:
        if self.low_s > self.high_s:
            raise ClockStepped(f"the camera's clock was set: it is off by {self.low_s - self.high_s:.3g} s")
