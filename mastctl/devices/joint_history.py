"""What the head measured lately: checked readings, from which a frame gets its joint angles.

Here read angles become true ones, once: by the mast file's ``joints`` (`calib.geometry.rig`), and by the side
from which each axis came, which the readings show. Behind gears with play b the load is between the
reading less b/2 and the reading plus b/2, and stays where it is until one of the two takes it along.
"""

from __future__ import annotations

import bisect
import math
import threading
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import islice, pairwise, takewhile

import numpy as np

from calib.geometry.rig import Approach, JointErrors, Pair
from calib.geometry.rigid import FloatArray
from drivers.errors import BadReply
from drivers.interfaces import Reading
from mastctl.devices.frames import number
from mastctl.errors import one_line

KEPT_READINGS = 3000  # one minute at 50 Hz
OLDEST_READING_S = 1.0  # a reading stamped further back is not a present measurement
CLOCK_TOLERANCE_S = 0.005  # what a stamp may lie in the future by rounding
LARGEST_GAP_S = 1.0  # between the readings around an exposure of a head that moves: its angles are a guess
LARGEST_GAP_AT_REST_S = 10.0  # of one that rests before and after: a late reading is not a fault
MOST_FAULTS, LONGEST_FAULT = 20, 200  # what a head may report of itself at once, and how long each may be
STILL_RAD = 3e-3  # between neighbours; two counts of a 12-bit servo
USUAL_PLAY_RAD = 6e-3  # of hobby servos' gears; it shows the side where the mast file states none

DITHER_RAD = 5e-3  # from end to end: three counts of a 12-bit servo, 4.6 mrad
DITHER_S = 1.0  # how long a dither is watched: a dozen readings in each half at the pace of a resting head
SAME_RAD = 5e-4  # no change: below a count of any servo that counts on its output side
TURNING = 7.0  # see RestWatch
QUIET_SHARE = 0.25  # of the readings that must say rest; fewer is a head that says that it moves


@dataclass(frozen=True)
class HeadReading(Reading):
    """A reading of the head, and its true angles (pan, tilt) by the mast file's joints.

    ``approach`` says for each axis from which side it came: 1 from smaller readings, -1 from larger, 0 not
    known, between them where it has not gone through all of its play since it turned round.
    """

    true_rad: Pair = field(kw_only=True)
    approach: Approach = field(kw_only=True, default=(0.0, 0.0))


def checked(answer: object, device: str, now_s: float, newest_s: float | None) -> Reading:
    """Return a driver's answer to ``read`` as a Reading, if it can be true.

    ``newest_s`` is the stamp of the last good reading, None before it. Raises BadReply if it is no reading,
    an angle is not finite or beyond a full turn, or the stamp lies in the future, more than 1 s back, or
    before the last one.
    """
    try:
        pan_rad, tilt_rad, time_s = (
            number(getattr(answer, name, None), name) for name in ("pan_rad", "tilt_rad", "time_s")
        )
        moving, faults = getattr(answer, "moving", None), getattr(answer, "faults", ()) or ()
        if not isinstance(moving, (bool, np.bool_)):
            raise TypeError(f"moving is {str(moving)[:40]} where true or false is expected")
        if max(abs(pan_rad), abs(tilt_rad)) > math.tau:
            raise ValueError(
                f"pan_rad {pan_rad:.6g}, tilt_rad {tilt_rad:.6g} is beyond a full turn (6.28319)"
            )
        if time_s > now_s + CLOCK_TOLERANCE_S:
            raise ValueError(f"it is stamped {time_s - now_s:.3f} s in the future")
        if time_s < now_s - OLDEST_READING_S:
            raise ValueError(f"it is {now_s - time_s:.3f} s old, at most {OLDEST_READING_S} s is allowed")
        if newest_s is not None and time_s < newest_s:
            raise ValueError(f"its time goes back by {newest_s - time_s:.3f} s")
        sentences = (faults,) if isinstance(faults, str) else islice(faults, MOST_FAULTS)
        reported = tuple(one_line(fault, LONGEST_FAULT) for fault in sentences)
    except (TypeError, ValueError) as reason:
        found = f"read returned {type(answer).__name__} that is no reading: {reason}"
        raise BadReply(found, device=device) from None
    return Reading(pan_rad, tilt_rad, bool(moving), time_s, reported)


class JointHistory:
    """Readings of the last minute, and when moves were sent. Safe to use from any thread.

    A head that says now and then that it moves, although its readings are those of a head at rest
    (`dithers`) and no move was sent for a second, is treated as resting. ``joints`` are the mast file's.
    """

    def __init__(self, joints: JointErrors) -> None:
        self._joints = joints
        self._readings: deque[Reading] = deque(maxlen=KEPT_READINGS)  # as the driver gave them
        self._loads: deque[FloatArray] = deque(maxlen=KEPT_READINGS)  # where the loads may be then, (2, 2)
        self._newest: HeadReading | None = None  # with what is true of its motion
        self._moves_s: deque[float] = deque(maxlen=200)
        self._lock = threading.Lock()

    @property
    def newest(self) -> HeadReading | None:
        """The last good reading; read without a lock."""
        return self._newest

    @property
    def oldest_s(self) -> float | None:
        """When the oldest kept reading was measured, None before the first."""
        with self._lock:
            return self._readings[0].time_s if self._readings else None

    def use_joints(self, joints: JointErrors) -> None:
        """Take another mast file's joints, for the readings that are kept too."""
        with self._lock:
            self._joints = joints
            self._loads.clear()
            for reading in self._readings:
                self._follow(reading)

    def add(self, reading: Reading) -> HeadReading:
        """Keep a checked reading, in place of one of the same time; return it, ``moving`` as above."""
        with self._lock:
            if self._readings and reading.time_s <= self._readings[-1].time_s:
                self._readings.pop()
                self._loads.pop()
            self._readings.append(reading)
            self._follow(reading)
            moving = reading.moving and not self._dithers(reading.time_s)
            read = reading.pan_rad, reading.tilt_rad
            self._newest = self._true(
                read, self._loads[-1].mean(axis=1), moving, reading.time_s, reading.faults
            )
            return self._newest

    def move_sent(self, time_s: float) -> None:
        """Remember that a move went out, so that no exposure around it counts as still."""
        with self._lock:
            self._moves_s.append(time_s)

    def at_exposure(self, began_s: float, mid_s: float, ended_s: float, device: str) -> HeadReading:
        """Return the head at mid-exposure, linear between the readings around it.

        The head is treated as moving if a move was sent between the last reading before the exposure and the
        first one after it, if any of them says so, or if these differ by more than 3 mrad; the last two not
        of a head that dithers at rest. Raises BadReply if the readings do not reach around the exposure, or
        leave a gap of more than 1 s in it, 10 s at rest.
        """
        with self._lock:
            times_s = [reading.time_s for reading in self._readings]
            first = bisect.bisect_right(times_s, began_s) - 1
            last = bisect.bisect_left(times_s, ended_s)
            if first < 0 or last >= len(times_s):
                side = "before" if first < 0 else "after"
                raise BadReply(f"there is no joint reading {side} the frame's exposure", device=device)
            around = [self._readings[i] for i in range(first, last + 1)]
            loads = np.array([self._loads[i].mean(axis=1) for i in range(first, last + 1)])
            stamps_s = np.array([one.time_s for one in around])
            angles = np.array([(one.pan_rad, one.tilt_rad) for one in around])
            seems = any(one.moving for one in around) or np.ptp(angles, axis=0).max() > STILL_RAD
            moving = any(stamps_s[0] <= sent_s <= stamps_s[-1] for sent_s in self._moves_s) or (
                bool(seems) and not self._dithers(around[-1].time_s)
            )
            gap_s = max(np.diff(stamps_s), default=0.0)
            most_s = LARGEST_GAP_S if moving else LARGEST_GAP_AT_REST_S
            if gap_s > most_s:
                gap = f"the joint readings around the exposure are {gap_s:.2f} s apart"
                raise BadReply(f"{gap}, at most {most_s:g} s is taken", device=device)
            pan, tilt, *middles = (
                float(np.interp(mid_s, stamps_s, values)) for values in np.hstack([angles, loads]).T
            )
            return self._true((pan, tilt), np.array(middles), moving, mid_s, ())

    def _true(
        self, read: Pair, middles: FloatArray, moving: bool, time_s: float, faults: Sequence[str]
    ) -> HeadReading:
        """A reading with what is true, by the middles of where the loads may be, (2,); the lock is kept."""
        pan, tilt = np.clip((np.array(read) - middles) / self._half_plays(), -1.0, 1.0).round(6).tolist()
        true_rad = self._joints.true_rad(read, (pan, tilt))
        return HeadReading(*read, moving, time_s, faults, true_rad=true_rad, approach=(pan, tilt))

    def _half_plays(self) -> FloatArray:
        joints = self._joints
        return np.array([one.backlash_rad or USUAL_PLAY_RAD for one in (joints.pan, joints.tilt)]) / 2

    def _follow(self, reading: Reading) -> None:
        """Note the lowest and the highest place of each load behind its play; the lock is kept."""
        read, half = np.array([[reading.pan_rad], [reading.tilt_rad]]), self._half_plays()[:, None]
        before = self._loads[-1] if self._loads else np.array([[-np.inf, np.inf]] * 2)  # not known
        self._loads.append(np.clip(before, read - half, read + half))

    def _dithers(self, until_s: float) -> bool:
        """Whether the readings up to a moment are those of a head that dithers at rest; the lock is kept."""
        for for_s in (DITHER_S, 2 * DITHER_S):
            if any(until_s - for_s <= sent_s <= until_s for sent_s in self._moves_s):
                continue
            late = takewhile(lambda one: one.time_s >= until_s - for_s, reversed(self._readings))  # noqa: B023
            window = [one for one in late if one.time_s <= until_s]
            if window and dithers(window[::-1], for_s=for_s):
                return True
        return False


def dithers(readings: Sequence[Reading], tolerance_rad: float = DITHER_RAD, for_s: float = DITHER_S) -> bool:
    """Return whether a head rests although its readings flicker, or say now and then that it moves.

    ``readings`` are as the driver gave them, oldest first; the last ``for_s`` seconds are judged, and
    ``tolerance_rad`` is how far they may lie from each other.
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

    ``dwell_s``: how long a head that does not dither must be unchanged; at least seven times as long as its
    last two changes were apart. One that creeps changes by a count now and then, and one that rings stands
    longer where it turns than before, by up to 2 / (sqrt(2) - 1) = 4.8 times and what the pace of the
    readings hides. ``tolerance_rad``: how far the readings of one that dithers may lie from each other,
    radians.
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
        moving = sum(one.moving for one in self._readings)
        return (
            f"its last {len(self._readings)} readings lie within {pan_rad:.4f} rad in pan and "
            f"{tilt_rad:.4f} rad in tilt, and {moving} of them say that it moves"
        )


def _apart_rad(one: Reading, other: Reading) -> float:
    return max(abs(one.pan_rad - other.pan_rad), abs(one.tilt_rad - other.tilt_rad))
