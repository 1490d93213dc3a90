"""Moving the head and knowing that it has arrived: deadlines, readings judged, solutions chosen."""

from __future__ import annotations

import math
import threading
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager
from typing import Protocol

from calib.geometry.pointing import Solution, ordered
from drivers.clock import Clock
from mastctl.devices.frames import StampedFrame
from mastctl.devices.joint_history import HeadReading, RestWatch
from mastctl.devices.keep_out import KeptOut, Pair
from mastctl.devices.limits import Limits
from mastctl.motion.results import PointingError
from mastctl.motion.settings import PointingSettings

WATCHED_S = 0.05
"""How often a head at rest is read while a moment is waited for; a stop is noticed as soon."""


class DevicesLike(Protocol):
    """What of `mastctl.devices.devices.Devices` a pointing needs."""

    def read(self) -> HeadReading: ...
    @property
    def reading_sigma_rad(self) -> Pair: ...
    @property
    def counts_rad(self) -> Mapping[str, float]: ...
    def goal(self, true_rad: Pair, here: HeadReading) -> Pair: ...
    def move(self, pan_rad: float, tilt_rad: float, speed_rad_per_s: float | None = None) -> None: ...
    def stop(self) -> None: ...
    def check_from(self, start: Pair, goal: Pair) -> None: ...
    def frames(
        self,
        cameras: Sequence[str],
        exposed_after_s: float,
        timeout_s: float,
        check: Callable[[], None] = ...,
    ) -> dict[str, StampedFrame]: ...
    def newest_frames(self) -> Mapping[str, StampedFrame | None]: ...
    def frame_by_id(self, frame_id: str) -> StampedFrame: ...
    def exposure_held(self) -> AbstractContextManager[None]: ...


class SteeredHead:
    """The head during one request.

    A reading must be finite, of now, not before the last one, and free of faults; it must be reachable from
    the last one at twice the speed cap, or lie on the way to the commanded angles (a replayed head is there
    at once). The head has settled when it rests (`RestWatch`); it has arrived when it rests where
    it was sent.
    """

    def __init__(
        self,
        devices: DevicesLike,
        limits: Limits,
        clock: Clock,
        settings: PointingSettings,
        cancelled: threading.Event,
    ) -> None:
        self._head = devices
        self._limits = limits
        self._clock = clock
        self._settings = settings
        self._cancelled = cancelled
        self._last: HeadReading | None = None
        self._goal: Pair | None = None

    def check_not_stopped(self) -> None:
        """Pass unless the request was cancelled. Raises PointingError ``stopped``."""
        if self._cancelled.is_set():
            raise PointingError("stopped", "the operation was stopped")

    def resting(self) -> HeadReading:
        """Return the reading of a head that rests now.

        Raises PointingError ``head_moving`` if it still moves after ``rest_wait_s``; else as `read`.
        """
        watch = RestWatch(0.0, self._settings.rest_tolerance_rad)
        settled, last = self._rests(watch, self._clock.now_s() + self._settings.rest_wait_s)
        if not settled:
            message = f"the head still moves after {self._settings.rest_wait_s:g} s of waiting"
            raise PointingError("head_moving", f"{message}: {watch.seen()}")
        return last

    def time_allowed_s(self, pan_rad: float, tilt_rad: float) -> float:
        """Return the deadline of a move to these angles: distance over speed, ramps, dwell, margin."""
        now, settings = self.read(), self._settings
        distance = max(abs(pan_rad - now.pan_rad), abs(tilt_rad - now.tilt_rad))
        rest_s = settings.acceleration_s + settings.dwell_s + settings.margin_s
        return distance / self._limits.speed_rad_per_s + rest_s

    def check_goal(self, pan_rad: float, tilt_rad: float) -> None:
        """Pass angles to which the head may be sent from where it rests.

        Raises OutsideLimits, KeptOut if they may not be commanded, or the move may pass a keep-out.
        """
        now = self.read()
        self._head.check_from((now.pan_rad, now.tilt_rad), (pan_rad, tilt_rad))

    def chosen(self, solutions: Sequence[Solution], start: HeadReading) -> Solution:
        """Return the one of several true joint angles that is taken from a start; raises as `reached`."""

        def read(one: Solution) -> Pair:
            return self._head.goal((one.pan_rad, one.tilt_rad), start)

        return reached(solutions, self._limits, self._head.check_from, (start.pan_rad, start.tilt_rad), read)

    def send(self, pan_rad: float, tilt_rad: float) -> None:
        """Start the move at the speed cap. Raises OutsideLimits, Stopped, DriverError."""
        self.check_not_stopped()
        self._goal = (pan_rad, tilt_rad)
        self._head.move(pan_rad, tilt_rad)

    def arrived(self, pan_rad: float, tilt_rad: float, deadline_s: float) -> HeadReading:
        """Wait until the head rests at these angles and return the reading.

        Raises PointingError ``did_not_arrive`` with how far it is off, ``did_not_settle`` if it never rests
        before the deadline (clock time, seconds), ``stopped``; else as `read`.
        """
        tolerance = self._settings.arrival_tolerance_rad
        watch = RestWatch(self._settings.dwell_s, self._settings.rest_tolerance_rad)
        while True:
            settled, last = self._rests(watch, deadline_s)
            off = last.pan_rad - pan_rad, last.tilt_rad - tilt_rad
            if settled and max(map(abs, off)) <= tolerance:
                return last
            if self._clock.now_s() < deadline_s:
                self._clock.sleep(self._settings.poll_s)
                continue  # a head that rests elsewhere may not have started yet
            where = f"pan {off[0]:+.4f} rad and tilt {off[1]:+.4f} rad from the commanded angles"
            if max(map(abs, off)) > tolerance:
                message = f"at its deadline the head is {where}, at most {tolerance:g} rad is expected"
                raise PointingError("did_not_arrive", message)
            raise PointingError(
                "did_not_settle", f"at its deadline the head still moves, {where}: {watch.seen()}"
            )

    def watch_until(self, until_s: float) -> None:
        """Read the head until a moment, clock time in seconds. Raises PointingError ``stopped``."""
        while (left_s := until_s - self._clock.now_s()) > 0.0:
            self.check_not_stopped()
            self.read()
            self._clock.sleep(min(left_s, WATCHED_S))

    def read(self) -> HeadReading:
        """Return a reading that can be true.

        Raises PointingError ``bad_reading`` or ``head_fault``; DriverError if the head does not answer.
        """
        reading, before = self._head.read(), self._last
        if self._clock.now_s() - reading.time_s > self._settings.reading_age_s:
            reading = self._head.read()  # a process that got no processor meanwhile is no fault of the head
        age_s = self._clock.now_s() - reading.time_s
        if not all(map(math.isfinite, (reading.pan_rad, reading.tilt_rad, reading.time_s))):
            message = f"the head reads pan {reading.pan_rad}, tilt {reading.tilt_rad}"
            message += "" if math.isfinite(reading.time_s) else f" at {reading.time_s} s"
            raise PointingError("bad_reading", f"{message}: not finite numbers")
        if reading.faults:
            raise PointingError("head_fault", f"the head reports: {'; '.join(reading.faults)}")
        most_s = self._settings.reading_age_s
        if age_s > most_s:
            message = f"the head's reading is {age_s:.2f} s old, at most {most_s:g} s is taken"
            raise PointingError("bad_reading", message)
        if before is not None:
            passed_s = reading.time_s - before.time_s
            if passed_s < 0:
                raise PointingError("bad_reading", f"the head's time went back by {-passed_s:.3f} s")
            reach = 2.0 * self._limits.speed_rad_per_s * passed_s + self._settings.jump_rad
            goal = self._goal or (before.pan_rad, before.tilt_rad)
            jump = max(
                _outside(reading.pan_rad, before.pan_rad, goal[0]),
                _outside(reading.tilt_rad, before.tilt_rad, goal[1]),
            )
            if jump > reach:
                message = f"the head's reading jumped {jump:.3f} rad off its way in {passed_s:.3f} s"
                raise PointingError("bad_reading", f"{message}, at most {reach:.3f} rad is possible")
        self._last = reading
        return reading

    def _rests(self, watch: RestWatch, deadline_s: float) -> tuple[bool, HeadReading]:
        """Read until the head rests (True) or the deadline passes; return the last reading."""
        while True:
            self.check_not_stopped()
            reading = self.read()
            if watch.rests(reading):
                return True, reading
            if self._clock.now_s() >= deadline_s:
                return False, reading
            self._clock.sleep(self._settings.poll_s)


def _outside(value: float, one: float, other: float) -> float:
    """Return how far a value lies outside the range between two others."""
    return max(min(one, other) - value, value - max(one, other), 0.0)


def reached(
    solutions: Sequence[Solution],
    limits: Limits,
    check_from: Callable[[Pair, Pair], None],
    start: Pair,
    read: Callable[[Solution], Pair],
) -> Solution:
    """Return the solution to take, of those that no keep-out bars: upright ones first, then the nearest.

    Parameters
    ----------
    solutions
        Of the closed form; at least one.
    limits
        Of the joints: an angle is taken whole turns away too, where a cable lets the pan turn so far.
    check_from
        Raises KeptOut where a move from one pose to another, in readings, may not be sent.
    start
        Where the head rests, as read.
    read
        Returns the readings to send the head to, so that it comes to a solution's true angles.

    Raises Unreachable if none lies within the limits; KeptOut if keep-outs bar all that do; of the one that
    would have been taken.
    """
    refused: KeptOut | None = None
    for one in ordered(solutions, limits.pan_rad, limits.tilt_rad, *start, read):
        try:
            check_from(start, read(one))
        except KeptOut as error:
            refused = refused or error
        else:
            return one
    assert refused is not None
    raise refused
