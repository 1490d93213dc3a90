"""Whether a head rests, by its readings: real servos dither by a count or more, and their word flickers too.

A head rests if it has not changed for a dwell and says that it does not move; or if for a second its readings
stay within a few counts of each other, with the same range in its first, middle and last half, and not all
say that it moves. A creep or a slow swing has another range in each; beyond a few counts nothing is a dither.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from itertools import pairwise

import numpy as np

from drivers.interfaces import Reading

DITHER_RAD = 5e-3  # from end to end: three counts of a 12-bit servo, 4.6 mrad
DITHER_S = 1.0  # how long a dither is watched: a dozen readings in each half at the pace of a resting head
SAME_RAD = 5e-4  # no change: below a count of any servo that counts on its output side
TURNING = 7.0  # see RestWatch
QUIET_SHARE = 0.25  # of the readings that must say rest; fewer is a head that says that it moves


def dithers(readings: Sequence[Reading], tolerance_rad: float = DITHER_RAD, for_s: float = DITHER_S) -> bool:
    """Return whether a head rests although its readings flicker, or say now and then that it moves.

    Parameters
    ----------
    readings
        As the driver gave them, oldest first.
    tolerance_rad
        How far they may lie from each other, radians.
    for_s
        How much of them is looked at, seconds.
    """
    window = [one for one in readings if one.time_s >= readings[-1].time_s - for_s]
    if len(window) < 8 or window[-1].time_s - window[0].time_s < 0.9 * for_s:
        return False
    says = [one.moving for one in window]
    if any(says):
        falls = sum(before and not after for before, after in pairwise(says))
        if falls == 0 or says.count(False) < QUIET_SHARE * len(says):
            return False
    angles_rad = np.array([(one.pan_rad, one.tilt_rad) for one in window])
    if (np.ptp(angles_rad, axis=0) > tolerance_rad).any():
        return False
    spent = (np.array([one.time_s for one in window]) - window[0].time_s) / for_s
    halves = [angles_rad[(spent >= begin) & (spent <= begin + 0.5)] for begin in (0.0, 0.25, 0.5)]
    ranges_rad = np.array([[half.min(axis=0), half.max(axis=0)] for half in halves if len(half)])
    return len(ranges_rad) == len(halves) and bool((np.ptp(ranges_rad, axis=0) <= SAME_RAD).all())


class RestWatch:
    """Watches a head's readings, one after the other.

    Parameters
    ----------
    dwell_s
        How long a head that does not dither must be unchanged; at least seven times as long as its last two
        changes were apart. One that creeps changes by a count now and then, and one that rings stands longer
        where it turns than before, by up to 2 / (sqrt(2) - 1) = 4.8 times and what the pace of the readings
        hides.
    tolerance_rad
        How far the readings of one that dithers may lie from each other, radians.
    """

    def __init__(self, dwell_s: float, tolerance_rad: float = DITHER_RAD) -> None:
        self._dwell_s = dwell_s
        self._tolerance_rad = tolerance_rad
        self._readings: deque[Reading] = deque()
        self._anchor: Reading | None = None
        self._changed_s: float | None = None
        self._between_s = 0.0
        self._quiet_s: float | None = None

    def rests(self, reading: Reading) -> bool:
        """Take the next reading and return whether the head rests."""
        self._readings.append(reading)
        while self._readings[0].time_s < reading.time_s - 1.1 * DITHER_S:
            self._readings.popleft()
        anchor = self._anchor
        if anchor is None or _apart_rad(reading, anchor) > SAME_RAD:
            if anchor is not None:
                self._between_s = 0.0 if self._changed_s is None else reading.time_s - self._changed_s
                self._changed_s = reading.time_s
            self._anchor = reading
            self._quiet_s = None
        if reading.moving:
            self._quiet_s = None
        elif self._quiet_s is None:
            self._quiet_s = reading.time_s
        if self._quiet_s is not None:
            quiet_s = reading.time_s - self._quiet_s
            if quiet_s >= max(self._dwell_s, TURNING * self._between_s):
                return True
        return dithers(self._readings, self._tolerance_rad)

    def seen(self) -> str:
        """Say what the readings of the last second were like."""
        angles_rad = np.array([(one.pan_rad, one.tilt_rad) for one in self._readings])
        pan_rad, tilt_rad = np.ptp(angles_rad, axis=0)
        said = sum(one.moving for one in self._readings)
        return (
            f"its last {len(self._readings)} readings lie within {pan_rad:.4f} rad in pan and "
            f"{tilt_rad:.4f} rad in tilt, and {said} of them say that it moves"
        )


def _apart_rad(one: Reading, other: Reading) -> float:
    return max(abs(one.pan_rad - other.pan_rad), abs(one.tilt_rad - other.tilt_rad))
