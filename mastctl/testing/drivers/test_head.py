"""What a pan/tilt driver promises (docs/drivers.md), tested on any head."""

from __future__ import annotations

import logging
import math
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field
from functools import partial

import numpy as np
import pytest

from calib.geometry.rigid import FloatArray
from drivers.clock import Clock, SystemClock
from drivers.errors import BadReply, DriverError, NoReply
from drivers.interfaces import PanTilt, Reading
from drivers.options import is_number
from mastctl.conform.device_checks import PATIENCE_S, NotTried, PromiseBroken, beside, call, ended, expect
from mastctl.conform.rig import Angles
from mastctl.devices.devices import MOVE_TIMEOUT_S, READ_TIMEOUT_S, STOP_TIMEOUT_S
from mastctl.devices.frames import CLOCK_TOLERANCE_S

log = logging.getLogger(__name__)
moves_head = pytest.mark.moves_head

LONGER = "a larger --reach or a lower --speed helps"
SETTLES_WITHIN_S, HOLDS_S = 30.0, 0.3
READ_EVERY_S = 0.002  # on the way
OUTSIDE_COUNT_RAD = 1e-3  # assumed for a count that is not known; a 12-bit servo has 1.5e-3


@dataclass
class HeadTrial:
    """A head under test, and what is known of it. Angles are (pan, tilt), radians.

    ``box_rad`` is where it may be moved: the ends of pan, and of tilt; ``limits_rad`` are the driver's own
    ends, where they are to be tried. A settled head may be ``settle_rad`` from its goal beyond the rounding
    to counts. ``open_again`` opens the same head once more after it was closed; None where that is not to be
    tried.
    """

    head: PanTilt
    box_rad: tuple[Angles, Angles]
    speed_rad_per_s: float
    limits_rad: tuple[Angles, Angles] | None = None
    count_rad: float | None = None
    settle_rad: float = 0.006
    open_again: Callable[[], PanTilt] | None = None
    closed: bool = False
    clock: Clock = field(default_factory=SystemClock)

    @property
    def near_rad(self) -> float:
        """How near to a goal a settled head is."""
        return (self.count_rad or OUTSIDE_COUNT_RAD) + self.settle_rad

    def goal(self, pan_part: float, tilt_part: float) -> Angles:
        """Return angles in the box; parts from -1 (its lower end) to 1."""
        (a, b), (c, d) = self.box_rad
        return a + (pan_part + 1) / 2 * (b - a), c + (tilt_part + 1) / 2 * (d - c)

    def read(self) -> Reading:
        """Read, and check that the reading can be true. Raises PromiseBroken."""
        began_s = self.clock.now_s()
        reading = call("read()", self.head.read)
        ended_s = self.clock.now_s()
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
        return reading

    def move(self, goal: Angles, speed_rad_per_s: float | None = None) -> None:
        """Send the head to a goal."""
        call("move()", lambda: self.head.move(*goal, speed_rad_per_s or self.speed_rad_per_s))

    def stop(self) -> None:
        """Stop where it is."""
        call("stop()", self.head.stop)

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
        """Return how far from its goal a settled head is. Raises PromiseBroken beyond the bound."""
        off_rad = away(reading, goal)
        message = f"sent to {goal[0]:.5f}, {goal[1]:.5f} rad it settled {off_rad:.5f} rad away"
        expect(off_rad <= bound_rad, f"{message}, {bound_rad:.1e} is allowed")
        return off_rad

    def on_its_way(self, goal: Angles) -> None:
        """Send the head off and return after a fifth of the way. Raises NotTried if that was missed."""
        way_rad = away(self.read(), goal)
        self.move(goal)
        until_s = self.clock.now_s() + SETTLES_WITHIN_S
        while away(reading := self.read(), goal) > 0.8 * way_rad:
            expect(
                self.clock.now_s() < until_s and (reading.moving or away(reading, goal) <= self.near_rad),
                f"sent to {goal[0]:.4f}, {goal[1]:.4f} rad the head does not go there",
            )
            self.clock.sleep(READ_EVERY_S)
        if away(reading, goal) < 0.3 * way_rad:
            raise NotTried(f"the way was too short to catch the head on it; {LONGER}")

    def check_stopped_short(self, goal: Angles, what: str) -> Reading:
        """Return the reading of a head that a stop ended on its way. Raises PromiseBroken at its goal."""
        reading = self.settled()
        expect(away(reading, goal) > self.near_rad, f"{what} on its way the head went on to its goal")
        log.info(f"{away(reading, goal):.3f} rad before the goal")
        return reading

    def travelled(self, goal: Angles, speed_rad_per_s: float | None = None) -> tuple[float, list[Reading]]:
        """Send the head off; return when, and its readings until it rests."""
        began_s = self.clock.now_s()
        self.move(goal, speed_rad_per_s)
        readings: list[Reading] = []
        while not readings or readings[-1].moving:
            expect(self.clock.now_s() < began_s + SETTLES_WITHIN_S, "the head does not come to rest")
            with suppress(BadReply):  # read too seldom to be sure of an axis at this speed: the next may be
                readings.append(self.read())
            self.clock.sleep(READ_EVERY_S)
        return began_s, readings

    def angles_at(self, moments_s: FloatArray, readings: list[Reading]) -> FloatArray:
        """Return pan and tilt at moments (n,), shape (n, 2), between readings."""
        stamps_s = [reading.time_s for reading in readings]
        angles = np.array([at(reading) for reading in readings])
        return np.stack([np.interp(moments_s, stamps_s, axis) for axis in angles.T], axis=1)

    def fastest_seen(self, requested_rad_per_s: float) -> tuple[float, float]:
        """Send the head across its box; return the fastest that was seen, rad/s, and how unsure that is."""
        self.sent(self.goal(-0.7, -0.7))
        _, readings = self.travelled(self.goal(0.3, 0.3), requested_rad_per_s)
        moments_s = np.linspace(readings[0].time_s, readings[-1].time_s, 13)
        step_s = float(moments_s[1] - moments_s[0])
        if step_s < 0.004:
            raise NotTried(f"the way was too short to measure a speed; {LONGER}")
        fastest = float(np.abs(np.diff(self.angles_at(moments_s, readings), axis=0)).max()) / step_s
        return fastest, 2 * (self.count_rad or OUTSIDE_COUNT_RAD) / step_s


def away(reading: Reading, goal: Angles) -> float:
    """Return how far a reading is from angles, the farther axis, radians."""
    return max(abs(reading.pan_rad - goal[0]), abs(reading.tilt_rad - goal[1]))


def at(reading: Reading) -> Angles:
    """Return the angles of a reading."""
    return reading.pan_rad, reading.tilt_rad


def test_reading(head: HeadTrial) -> None:
    """A reading is finite, stamped within its call, and without faults."""
    readings = [head.read() for _ in range(5)]
    stamps_s = [reading.time_s for reading in readings]
    expect(stamps_s == sorted(stamps_s), f"the stamps of readings go back: {stamps_s}")
    faults = readings[-1].faults
    expect(
        not isinstance(faults, str) and all(isinstance(fault, str) for fault in faults),
        f"faults is {faults!r} where a sequence of sentences is expected",
    )
    expect(len(faults) == 0, f"the head is not healthy: {'; '.join(faults)}")
    log.info(f"pan {readings[-1].pan_rad:.4f} rad, tilt {readings[-1].tilt_rad:.4f} rad")


@moves_head
def test_move(head: HeadTrial) -> None:
    """A move returns at once and ends at its goal, at the nearest count."""
    worst_rad, least_share = 0.0, math.inf  # of a way's time, that move() took; a busy machine delays some
    for parts in ((0.3, -0.2), (0.25033, -0.25047), (-0.0007, 0.0004), (-0.6, 0.5), (0.6, -0.5)):
        goal = head.goal(*parts)
        needs_s = away(head.settled(), goal) / head.speed_rad_per_s
        began_s = head.clock.now_s()
        head.move(goal)
        if needs_s >= 0.2:
            least_share = min(least_share, (head.clock.now_s() - began_s) / needs_s)
        bound_rad = head.settle_rad + (0.5 * head.count_rad if head.count_rad else OUTSIDE_COUNT_RAD)
        worst_rad = max(worst_rad, head.check_arrived(head.settled(), goal, bound_rad))
    message = f"move() came back when {least_share:.0%} of its way's time was over: not at once"
    expect(least_share < 0.7 or math.isinf(least_share), message)
    log.info(f"within {worst_rad:.1e} rad")


@moves_head
def test_under_way(head: HeadTrial) -> None:
    """Under way it reports measured angles and motion, and its stamps grow."""
    goal = head.goal(0.7, 0.6)
    way_rad = away(head.sent(head.goal(-0.5, -0.5)), goal)
    began_s, readings = head.travelled(goal)
    stamps_s = [reading.time_s for reading in readings]
    expect(stamps_s == sorted(set(stamps_s)), "readings one after the other bear one stamp, or an older one")
    between = 0
    for reading in readings:
        gone_s, left_rad = reading.time_s - began_s, away(reading, goal)
        expect(
            left_rad >= way_rad - 1.1 * head.speed_rad_per_s * gone_s - 2 * head.near_rad,
            f"{gone_s:.3f} s after the move it says that {left_rad:.3f} of {way_rad:.3f} rad are left, "
            f"at {head.speed_rad_per_s:g} rad/s: commanded, not measured?",
        )
        expect(
            reading.moving or left_rad <= head.near_rad,
            f"{left_rad:.3f} rad before its goal, {gone_s:.3f} s after the move, it says that it is at rest",
        )
        between += 0.05 * way_rad < left_rad < 0.95 * way_rad
    if between < 3:
        raise NotTried(f"only {between} readings came on the way; {LONGER}")
    log.info(f"{between} readings on the way of {way_rad:.3f} rad")


@moves_head
def test_new_goal(head: HeadTrial) -> None:
    """A new goal replaces the old one at once."""
    head.sent(head.goal(-0.9, -0.3))
    far, back = head.goal(0.9, 0.3), head.goal(-0.6, -0.4)
    head.on_its_way(far)
    _, readings = head.travelled(back)
    nearest_rad = min(abs(reading.pan_rad - far[0]) for reading in readings)
    expect(nearest_rad > head.near_rad, "sent back on its way, the head went to its old goal first")
    head.check_arrived(readings[-1], back, head.near_rad)


@moves_head
def test_stop(head: HeadTrial) -> None:
    """A stop brakes both axes where they are, and holds."""
    head.sent(head.goal(-0.9, -0.9))
    goal = head.goal(0.9, 0.9)
    head.on_its_way(goal)
    head.stop()
    rest = head.check_stopped_short(goal, "stopped")
    until_s = head.clock.now_s() + HOLDS_S
    while head.clock.now_s() < until_s:
        crept_rad = away(head.read(), at(rest))
        expect(crept_rad <= head.near_rad, f"after the stop it moved on by {crept_rad:.4f} rad")
        head.clock.sleep(0.01)
    head.sent(head.goal(0.0, 0.0))


@moves_head
def test_stop_beside(head: HeadTrial) -> None:
    """A stop comes beside a read and a move under way, and several at once."""
    goal = head.goal(0.9, 0.9)

    def read_often() -> None:
        for _ in range(16):
            try:
                head.head.read()
            except (NoReply, BadReply):  # a stop that cuts in may cost an answer: the service repeats once
                head.head.read()

    def stop() -> float:
        began_s = head.clock.now_s()
        head.head.stop()
        return head.clock.now_s() - began_s

    head.sent(head.goal(-0.9, -0.9))
    move = beside(lambda: head.head.move(*goal, head.speed_rad_per_s), head.clock)
    head.clock.sleep(0.05)
    took_s = ended("stop() beside move()", beside(stop, head.clock))
    expect(took_s < STOP_TIMEOUT_S / 2, f"a stop beside a move waited {took_s:.2f} s for it")
    with suppress(DriverError):  # a stop may end a move that is just going out
        ended("move()", move)
    head.stop()
    head.sent(head.goal(-0.9, -0.9))
    head.on_its_way(goal)
    reads = [beside(read_often, head.clock) for _ in range(2)]
    for stops in ([beside(stop, head.clock) for _ in range(2)] for _ in range(2)):
        took_s = max(ended("stop() beside read()", one) for one in stops)
        expect(took_s < STOP_TIMEOUT_S, f"a stop beside reads took {took_s:.2f} s of {STOP_TIMEOUT_S:g} s")
    for read in reads:
        ended("read() beside stop()", read)
    head.check_stopped_short(goal, "stopped beside reads")


@moves_head
def test_threads(head: HeadTrial) -> None:
    """Calls from several threads at once are all answered."""
    goals = [head.goal(0.1 * step, 0.0) for step in range(5)]

    def work(moves: bool) -> None:
        for goal in goals:
            head.head.read()
            if moves:
                head.head.move(*goal, head.speed_rad_per_s)

    for one in [beside(partial(work, moves), head.clock) for moves in (True, False, False, False)]:
        try:
            ended("a call beside others", one, 2 * PATIENCE_S)
        except DriverError as error:
            raise PromiseBroken(f"a call beside others failed: {error}") from None
    head.check_arrived(head.settled(), goals[-1], head.near_rad)


@moves_head
def test_speed(head: HeadTrial) -> None:
    """No axis goes faster than requested."""
    requested = 0.5 * head.speed_rad_per_s
    fastest, unsure = head.fastest_seen(requested)
    expect(
        fastest <= requested * 1.05 + unsure,
        f"{fastest:.3f} rad/s were measured where {requested:.3f} rad/s were requested",
    )
    log.info(f"{fastest:.3f} rad/s, requested {requested:.3f}")


@moves_head
def test_limits(head: HeadTrial) -> None:
    """The driver's own limits are reached, and goals just beyond them refused."""
    if head.limits_rad is None:
        raise NotTried("the driver's own limits are not known; state them by --limits")
    pan, tilt = head.limits_rad
    home = head.sent(head.goal(0.0, 0.0))
    for end, far in ((0, -math.inf), (1, math.inf)):
        for goal in (
            (math.nextafter(pan[end], far), home.tilt_rad),
            (home.pan_rad, math.nextafter(tilt[end], far)),
        ):
            _check_refused(head, goal, head.speed_rad_per_s, "beyond a limit")
    for end in (0, 1):
        head.sent((pan[end], tilt[end]))


@moves_head
def test_not_a_number(head: HeadTrial) -> None:
    """A goal or speed that is no number, or a speed that is none, is refused."""
    pan, tilt = head.goal(0.2, 0.2)
    for goal in ((math.nan, tilt), (pan, math.nan), (math.inf, tilt), (pan, -math.inf)):
        _check_refused(head, goal, head.speed_rad_per_s, "that is no number")
    for speed in (0.0, -1.0, math.nan):
        _check_refused(head, (pan, tilt), speed, "at no speed")


def _check_refused(trial: HeadTrial, goal: Angles, speed_rad_per_s: float, message: str) -> None:
    """Send the head where it cannot go: a DriverError, and nothing moves."""
    before = trial.settled()
    what = f"move({goal[0]!r}, {goal[1]!r}, {speed_rad_per_s!r})"
    try:
        call("move()", lambda: trial.head.move(*goal, speed_rad_per_s))
    except DriverError as error:
        expect("\n" not in str(error), f"{what}: {str(error)!r} is not one sentence")
    else:
        trial.stop()
        raise PromiseBroken(f"{what}, a goal {message}, was not refused")
    trial.clock.sleep(0.05)
    moved_rad = away(trial.read(), at(before))
    expect(moved_rad <= trial.near_rad, f"{what} was refused, and the head moved by {moved_rad:.4f} rad")


@moves_head
def test_deadlines(head: HeadTrial) -> None:
    """Every call ends within half of the time that the service gives it."""
    goal = head.goal(0.2, -0.1)
    for name, function, deadline_s in (
        ("read", head.read, READ_TIMEOUT_S),
        ("move", lambda: head.move(goal), MOVE_TIMEOUT_S),
        ("read", head.read, READ_TIMEOUT_S),
        ("stop", head.stop, STOP_TIMEOUT_S),
    ):
        took_s = []
        for _ in range(3):
            began_s = head.clock.now_s()
            function()
            took_s.append(head.clock.now_s() - began_s)
        expect(min(took_s) < deadline_s / 2, f"{name}() took {min(took_s):.2f} s of {deadline_s:g} s at best")
        log.info(f"{name} {1e3 * min(took_s):.1f} ms")


@moves_head
def test_close(head: HeadTrial) -> None:
    """Close stops the head, twice does no harm, and then no reading comes."""
    head.sent(head.goal(-0.9, -0.9))
    goal = head.goal(0.9, 0.9)
    head.on_its_way(goal)
    for name in ("close()", "a second close()"):
        try:
            call(name, head.head.close)
        except DriverError as error:
            raise PromiseBroken(f"{name} raised {type(error).__name__}: {error}") from None
    with suppress(DriverError):
        call("read() of a closed head", head.head.read)
        raise PromiseBroken("a closed head gave a reading")
    head.closed = head.open_again is None
    if head.open_again is not None:
        head.head = head.open_again()
        head.check_stopped_short(goal, "closed")
