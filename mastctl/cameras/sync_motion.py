"""How a joint went to and fro by its readings: angle and speed at any moment, and the ways between turns."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicHermiteSpline

from calib.geometry.rigid import FloatArray
from mastctl.errors import MastctlError

LEAST_FRAMES = 30  # and readings
LEAST_REVERSAL_RAD = 5e-4
LEAST_WAY_RAD = 0.010  # after a turn back: until then the gears of a plain servo are not all on one side
LARGEST_GAP_S = 0.1  # between the readings around a frame; beyond it the angle is a guess
LEAST_SPEED_RAD_PER_S = 0.06
SMOOTHING_S = 0.065  # readings so far to either side even each other out; short beside a ramp of the speed


class CannotTell(MastctlError):
    """The pictures do not tell the offset; the message says why."""

    code = "cannot_tell"


class JointMotion:
    """The joint angle over time by its readings, cut into legs between turns back.

    Parameters
    ----------
    times_s, angles_rad
        (m,) readings in the order of their times.
    """

    def __init__(self, times_s: FloatArray, angles_rad: FloatArray) -> None:
        self.times_s, first = np.unique(times_s, return_index=True)
        self.angles_rad = angles_rad[first]
        if len(self.times_s) < LEAST_FRAMES:
            raise CannotTell(f"the head was read {len(self.times_s)} times, {LEAST_FRAMES} are needed")
        self._turns, self._signs = _legs(self.angles_rad)
        self._curve = _smoothed(self.times_s, self.angles_rad)
        self._speed = self._curve.derivative()

    def at(self, times_s: FloatArray) -> FloatArray:
        """Return the angle, radians, on a curve through the readings that evens their counts out."""
        return np.asarray(self._curve(np.clip(times_s, self.times_s[0], self.times_s[-1])))

    def slope(self, times_s: FloatArray) -> FloatArray:
        """Return the speed, rad/s."""
        return np.asarray(self._speed(np.clip(times_s, self.times_s[0], self.times_s[-1])))

    def leg(self, times_s: FloatArray) -> tuple[NDArray[np.int64], FloatArray]:
        """Return which leg a moment is of (-1: it tells nothing) and the sign of that leg's motion."""
        turns_s = self.times_s[self._turns]
        leg = np.searchsorted(turns_s, times_s, side="right") - 1
        after = np.clip(np.searchsorted(self.times_s, times_s), 1, len(self.times_s) - 1)
        sure = (leg >= 0) & (times_s < self.times_s[-1])
        sure &= self.times_s[after] - self.times_s[after - 1] <= LARGEST_GAP_S
        known = np.clip(leg, 0, len(self._turns) - 1)
        sure &= np.abs(self.slope(times_s)) >= LEAST_SPEED_RAD_PER_S  # one at rest tells nothing of time
        sure &= np.abs(self.at(times_s) - self.angles_rad[self._turns[known]]) >= LEAST_WAY_RAD
        return np.where(sure, leg, -1), self._signs[known]


def _smoothed(times_s: FloatArray, angles_rad: FloatArray) -> CubicHermiteSpline:
    """A curve with, at each reading, the place and speed of the parabola that fits its neighbours best."""
    place, speed = np.empty(len(times_s)), np.empty(len(times_s))
    first = np.searchsorted(times_s, times_s - SMOOTHING_S)
    last = np.searchsorted(times_s, times_s + SMOOTHING_S, side="right")
    for number, (begin, end) in enumerate(zip(first, last, strict=True)):
        if end - begin < 4:
            begin, end = max(0, number - 2), min(len(times_s), number + 3)
        since_s = times_s[begin:end] - times_s[number]
        parabola = np.linalg.lstsq(np.vander(since_s, 3), angles_rad[begin:end], rcond=None)[0]
        place[number], speed[number] = parabola[2], parabola[1]
    return CubicHermiteSpline(times_s, place, speed)


def _legs(angles_rad: FloatArray) -> tuple[NDArray[np.int64], FloatArray]:
    """Where the motion turns back (indices), and its sign from there on; dither of a count is no turn."""
    steps = np.abs(np.diff(np.unique(angles_rad)))
    count_rad = float(steps.min()) if len(steps) else 0.0
    threshold_rad = max(LEAST_REVERSAL_RAD, 2.5 * count_rad if count_rad < LEAST_WAY_RAD / 3 else 0.0)
    turns, signs = [0], [0.0]
    extreme = 0
    for index, angle_rad in enumerate(angles_rad):
        way_rad = angle_rad - angles_rad[extreme]
        if signs[-1] == 0.0:
            if abs(way_rad) > threshold_rad:
                signs[-1] = np.sign(way_rad)
                extreme = index
        elif way_rad * signs[-1] >= 0:
            extreme = index
        elif abs(way_rad) > threshold_rad:
            turns.append(extreme)
            signs.append(-signs[-1])
            extreme = index
    return np.array(turns), np.array(signs)
