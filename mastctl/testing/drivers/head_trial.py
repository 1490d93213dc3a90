"""A head under test: the calls of every test, and where it may be moved."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from drivers.clock import Clock, SystemClock
from drivers.interfaces import PanTilt, Reading
from drivers.options import is_number
from mastctl.conform.checks import NotTried, SubjectLost, expect
from mastctl.conform.rig import Angles
from mastctl.devices.frames import CLOCK_TOLERANCE_S
from mastctl.devices.opening import GuardedHead
from mastctl.testing.drivers.calls import call

LONGER = "a larger --reach or a lower --speed"
SETTLES_WITHIN_S = 30.0
READ_EVERY_S = 0.002  # on the way
OUTSIDE_COUNT_RAD = 1e-3
"""Assumed for a count that is not known; a 12-bit servo has 1.5e-3."""


@dataclass
class HeadTrial:
    """A head under test, and what is known of it. Angles are (pan, tilt).

    Attributes
    ----------
    box_rad
        Where it may be moved: lowest and highest pan, lowest and highest tilt.
    limits_rad
        The ends of each axis, where the head is to be sent too; None: it is not.
    own_limits
        Whether they are the driver's own, so that it refuses goals beyond them.
    settle_rad
        How far from its goal a settled head may be, beyond the rounding to counts.
    true_rad
        Where the axes truly are at a moment of the last minute; None where that is not known.
    open_again
        Opens the same head once more after it was closed; None where that is not to be tried.
    unplaced
        Why it is not known where it may be moved; empty where it is.
    """

    head: PanTilt
    box_rad: tuple[Angles, Angles]
    speed_rad_per_s: float
    limits_rad: tuple[Angles, Angles] | None = None
    own_limits: bool = False
    count_rad: float | None = None
    settle_rad: float = 0.006
    true_rad: Callable[[float], Angles] | None = None
    open_again: Callable[[], PanTilt] | None = None
    closed: bool = False
    unplaced: str = ""
    clock: Clock = field(default_factory=SystemClock)

    @property
    def near_rad(self) -> float:
        """How near to a goal a settled head is."""
        return (OUTSIDE_COUNT_RAD if self.count_rad is None else self.count_rad) + self.settle_rad

    def goal(self, pan_part: float, tilt_part: float) -> Angles:
        """Return angles in the box; parts from -1 (its lower end) to 1. Raises SubjectLost without a box."""
        if self.unplaced:
            raise SubjectLost(f"the head is not moved: {self.unplaced}")
        (a, b), (c, d) = self.box_rad
        return a + (pan_part + 1) / 2 * (b - a), c + (tilt_part + 1) / 2 * (d - c)

    def read(self) -> Reading:
        """Read; the reading is one that can be true."""
        began_s = self.clock.now_s()
        reading = call("read()", self.head.read)
        self.check_reading(reading, began_s, self.clock.now_s())
        return reading

    def move(self, goal: Angles, speed_rad_per_s: float | None = None) -> None:
        """Send the head to a goal."""
        speed = self.speed_rad_per_s if speed_rad_per_s is None else speed_rad_per_s
        call("move()", lambda: self.head.move(goal[0], goal[1], speed))

    def try_refusal(self, goal: Angles, speed_rad_per_s: float) -> None:
        """Send a goal or speed that the driver has to refuse."""
        move = self.head.try_refusal if isinstance(self.head, GuardedHead) else self.head.move
        call("move()", lambda: move(goal[0], goal[1], speed_rad_per_s))

    def stop(self) -> None:
        """Stop where it is."""
        call("stop()", self.head.stop)

    def check_reading(self, reading: Reading, began_s: float, ended_s: float) -> None:
        """Pass a reading of a call that can be true. Raises PromiseBroken."""
        for name in ("pan_rad", "tilt_rad"):
            angle = getattr(reading, name, None)
            expect(
                isinstance(angle, (int, float)) and abs(angle) <= math.tau,
                f"read(): {name} is {angle!r} where a finite angle within a turn is expected",
            )
        moving, stamp_s = getattr(reading, "moving", None), getattr(reading, "time_s", None)
        expect(isinstance(moving, (bool, np.bool_)), f"read(): moving is {moving!r}, neither true nor false")
        expect(is_number(stamp_s), f"read(): time_s is {stamp_s!r}")
        expect(
            began_s - CLOCK_TOLERANCE_S <= reading.time_s <= ended_s + CLOCK_TOLERANCE_S,
            f"read(): stamped {reading.time_s - began_s:+.3f} s from the call's begin, "
            f"and the call took {ended_s - began_s:.3f} s",
        )
        if self.true_rad is not None:
            self._check_truth(reading, began_s, ended_s)

    def _check_truth(self, reading: Reading, began_s: float, ended_s: float) -> None:
        """Pass a reading that was true at some moment of its call, to a count."""
        assert self.true_rad is not None and self.count_rad is not None
        truths = [self.true_rad(float(moment_s)) for moment_s in np.linspace(began_s, ended_s, 21)]
        for axis, angle in enumerate((reading.pan_rad, reading.tilt_rad)):
            seen = [truth[axis] for truth in truths]
            expect(
                min(seen) - self.count_rad <= angle <= max(seen) + self.count_rad,
                f"read(): {('pan', 'tilt')[axis]} {angle:.5f} rad, it was {min(seen):.5f} to {max(seen):.5f}",
            )

    def settled(self) -> Reading:
        """Read until the head says that it does not move."""
        until_s = self.clock.now_s() + SETTLES_WITHIN_S
        while (reading := self.read()).moving:
            message = f"the head still says that it moves after {SETTLES_WITHIN_S:g} s"
            expect(self.clock.now_s() < until_s, message)
            self.clock.sleep(0.005)
        return reading

    def sent(self, goal: Angles) -> Reading:
        """Send the head somewhere and wait until it has settled there."""
        self.move(goal)
        reading = self.settled()
        self.check_arrived(reading, goal, self.near_rad)
        return reading

    def check_arrived(self, reading: Reading, goal: Angles, bound_rad: float) -> float:
        """Return how far from its goal a settled head stands. Raises PromiseBroken beyond the bound."""
        off_rad = away(reading, goal)
        message = f"sent to {goal[0]:.5f}, {goal[1]:.5f} rad it settled {off_rad:.5f} rad away"
        expect(off_rad <= bound_rad, f"{message}, {bound_rad:.1e} is allowed")
        return off_rad

    def on_its_way(self, goal: Angles, part: float = 0.2) -> Reading:
        """Send the head off; return a reading after that part of the way. Raises NotTried if missed."""
        way_rad = away(self.read(), goal)
        self.move(goal)
        until_s = self.clock.now_s() + SETTLES_WITHIN_S
        while away(reading := self.read(), goal) > (1 - part) * way_rad:
            expect(
                self.clock.now_s() < until_s and (reading.moving or away(reading, goal) <= self.near_rad),
                f"sent to {goal[0]:.4f}, {goal[1]:.4f} rad the head does not go there",
            )
            self.clock.sleep(READ_EVERY_S)
        if away(reading, goal) < 0.3 * way_rad:
            raise NotTried(
                "the way was too short to catch the head on it; a larger --reach or a lower --speed helps"
            )
        return reading


def away(reading: Reading, goal: Angles) -> float:
    """How far a reading is from angles, the farther axis, radians."""
    return max(abs(reading.pan_rad - goal[0]), abs(reading.tilt_rad - goal[1]))


def at(reading: Reading) -> Angles:
    """The angles of a reading."""
    return reading.pan_rad, reading.tilt_rad
