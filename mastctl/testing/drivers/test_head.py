"""What a pan/tilt driver promises (docs/drivers.md), tested on any head."""

from __future__ import annotations

import logging
import math
from contextlib import suppress
from functools import partial
from itertools import pairwise

import numpy as np
import pytest

from drivers.errors import BadReply, DriverError, NoReply
from mastctl.conform.checks import NotTried, PromiseBroken, expect
from mastctl.conform.rig import Angles
from mastctl.devices.devices import MOVE_TIMEOUT_S, READ_TIMEOUT_S, STOP_TIMEOUT_S
from mastctl.testing.drivers.calls import PATIENCE_S, beside, call, ended
from mastctl.testing.drivers.head_trial import (
    LONGER,
    OUTSIDE_COUNT_RAD,
    READ_EVERY_S,
    SETTLES_WITHIN_S,
    HeadTrial,
    at,
    away,
)

log = logging.getLogger(__name__)
moves_head = pytest.mark.moves_head

HOLDS_S = 0.3


def test_reading(head: HeadTrial) -> None:
    """A reading is finite, stamped within its call, and without faults."""
    readings = [head.read() for _ in range(5)]
    for before, after in pairwise(readings):
        expect(after.time_s >= before.time_s, f"the stamps went back by {before.time_s - after.time_s:.4f} s")
    faults = readings[-1].faults
    expect(
        not isinstance(faults, str) and all(isinstance(word, str) for word in faults),
        f"faults is {faults!r} where a sequence of sentences is expected",
    )
    expect(len(faults) == 0, f"the head is not healthy: {'; '.join(faults)}")
    log.info(f"pan {readings[-1].pan_rad:.4f} rad, tilt {readings[-1].tilt_rad:.4f} rad")


@moves_head
def test_move(head: HeadTrial) -> None:
    """A move returns at once and ends at its goal, at the nearest count."""
    worst_rad = 0.0
    shares: list[tuple[float, str]] = []  # of each way's time, that move() took; a busy machine delays some
    for parts in ((0.3, -0.2), (0.25033, -0.25047), (-0.0007, 0.0004), (-0.6, 0.5), (0.6, -0.5)):
        goal = head.goal(*parts)
        way_rad = away(head.settled(), goal)
        began_s = head.clock.now_s()
        head.move(goal)
        took_s = head.clock.now_s() - began_s
        needs_s = way_rad / head.speed_rad_per_s
        expect(took_s < MOVE_TIMEOUT_S, f"move() took {took_s:.2f} s, {MOVE_TIMEOUT_S:g} s are allowed")
        if needs_s >= 0.2:
            message = f"move() came back after {took_s:.2f} s, when the way of {way_rad:.3f} rad was gone"
            shares.append((took_s / needs_s, f"{message}: not at once"))
        reading = head.settled()
        bound_rad = head.settle_rad + (0.5 * head.count_rad if head.count_rad else OUTSIDE_COUNT_RAD)
        worst_rad = max(worst_rad, head.check_arrived(reading, goal, bound_rad))
    if shares:
        share, message = min(shares)
        expect(share < 0.7, message)
    log.info(f"within {worst_rad:.1e} rad")


@moves_head
def test_under_way(head: HeadTrial) -> None:
    """Under way it reports measured angles and motion, and its stamps grow."""
    start = head.sent(head.goal(-0.5, -0.5))
    goal = head.goal(0.7, 0.6)
    way_rad = away(start, goal)
    began_s = head.clock.now_s()
    head.move(goal)
    readings = [head.read()]
    until_s = began_s + SETTLES_WITHIN_S
    while readings[-1].moving and head.clock.now_s() < until_s:
        head.clock.sleep(READ_EVERY_S)
        readings.append(head.read())
    for before, after in pairwise(readings):
        expect(
            after.time_s > before.time_s, "two readings one after the other bear one stamp, or an older one"
        )
    between = 0
    for reading in readings:
        gone_s = reading.time_s - began_s
        left_rad = away(reading, goal)
        least_rad = way_rad - 1.1 * head.speed_rad_per_s * gone_s - 2 * head.near_rad
        expect(
            left_rad >= least_rad,
            f"{gone_s:.3f} s after the move it says that {left_rad:.3f} of {way_rad:.3f} rad are left, "
            f"at {head.speed_rad_per_s:g} rad/s: commanded, not measured?",
        )
        expect(
            reading.moving or left_rad <= head.near_rad,
            f"{left_rad:.3f} rad before its goal, {gone_s:.3f} s after the move, it says that it is at rest",
        )
        between += 0.05 * way_rad < left_rad < 0.95 * way_rad
    if between < 3:
        raise NotTried(f"only {between} readings came on the way; {LONGER} helps")
    log.info(f"{between} readings on the way of {way_rad:.3f} rad")


@moves_head
def test_new_goal(head: HeadTrial) -> None:
    """A new goal replaces the old one at once."""
    head.sent(head.goal(-0.9, -0.3))
    far, back = head.goal(0.9, 0.3), head.goal(-0.6, -0.4)
    head.on_its_way(far)
    head.move(back)
    nearest_rad = math.inf
    until_s = head.clock.now_s() + SETTLES_WITHIN_S
    while (reading := head.read()).moving and head.clock.now_s() < until_s:
        nearest_rad = min(nearest_rad, abs(reading.pan_rad - far[0]))
        head.clock.sleep(READ_EVERY_S)
    expect(nearest_rad > head.near_rad, "sent back on its way, the head went to its old goal first")
    off_rad = away(reading, back)
    expect(off_rad <= head.near_rad, f"it settled {off_rad:.4f} rad from the new goal")


@moves_head
def test_stop(head: HeadTrial) -> None:
    """A stop brakes both axes where they are, and holds."""
    head.sent(head.goal(-0.9, -0.9))
    goal = head.goal(0.9, 0.9)
    head.on_its_way(goal)
    head.stop()
    reading = head.settled()
    left_rad = away(reading, goal)
    expect(left_rad > head.near_rad, "the stop came on the way, and the head went on to its goal")
    until_s = head.clock.now_s() + HOLDS_S
    while head.clock.now_s() < until_s:
        later = head.read()
        expect(
            away(later, at(reading)) <= head.near_rad,
            f"after the stop it moved on by {away(later, at(reading)):.4f} rad",
        )
        head.clock.sleep(0.01)
    head.sent(head.goal(0.0, 0.0))
    log.info(f"{left_rad:.3f} rad before the goal")


@moves_head
def test_stop_beside(head: HeadTrial) -> None:
    """A stop comes beside a read and a move under way, and several at once."""
    goal = head.goal(0.9, 0.9)
    head.sent(head.goal(-0.9, -0.9))
    waited_s = _stop_beside_a_move(head, goal)
    expect(waited_s < STOP_TIMEOUT_S / 2, f"a stop beside a move waited {waited_s:.2f} s for it")
    head.sent(head.goal(-0.9, -0.9))
    head.on_its_way(goal)
    longest_s = _stops_beside_reads(head)
    message = f"a stop beside reads took {longest_s:.2f} s of {STOP_TIMEOUT_S:g} s"
    expect(longest_s < STOP_TIMEOUT_S, message)
    left_rad = away(head.settled(), goal)
    expect(left_rad > head.near_rad, "stopped beside reads the head went on to its goal")
    log.info(f"within {max(longest_s, waited_s):.3f} s")


def _stop_beside_a_move(trial: HeadTrial, goal: Angles) -> float:
    """Stop from another thread while a move goes out; return how long it took."""
    move = beside(lambda: trial.head.move(*goal, trial.speed_rad_per_s), trial.clock)
    trial.clock.sleep(0.05)
    took_s = ended("stop() beside move()", beside(partial(_timed_stop, trial), trial.clock))
    with suppress(DriverError):  # a stop may end a move that is just going out
        ended("move()", move)
    trial.stop()
    return took_s


def _timed_stop(trial: HeadTrial) -> float:
    """Stop; return how long that took."""
    began_s = trial.clock.now_s()
    trial.head.stop()
    return trial.clock.now_s() - began_s


def _stops_beside_reads(trial: HeadTrial) -> float:
    """Stop twice at once, twice over, while two threads read; return how long the longest took."""

    def read_often() -> None:
        for _ in range(8):
            try:
                trial.head.read()
            except (NoReply, BadReply):  # a stop that cuts in may cost an answer: the service asks once more
                trial.head.read()

    reads = [beside(read_often, trial.clock) for _ in range(2)]
    longest_s = 0.0
    for _ in range(2):
        for stop in [beside(partial(_timed_stop, trial), trial.clock) for _ in range(2)]:
            longest_s = max(longest_s, ended("stop() beside read()", stop))
    for read in reads:
        ended("read() beside stop()", read)
    return longest_s


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
    off_rad = away(head.settled(), goals[-1])
    expect(off_rad <= head.near_rad, f"it settled {off_rad:.4f} rad from the last goal")


@moves_head
def test_speed(head: HeadTrial) -> None:
    """No axis goes faster than requested."""
    requested = 0.5 * head.speed_rad_per_s
    fastest, unsure = fastest_seen(head, requested)
    expect(
        fastest <= requested * 1.05 + unsure,
        f"{fastest:.3f} rad/s were measured where {requested:.3f} rad/s were requested",
    )
    log.info(f"{fastest:.3f} rad/s, requested {requested:.3f}")


def fastest_seen(trial: HeadTrial, requested_rad_per_s: float) -> tuple[float, float]:
    """Send the head across its box; return the fastest that was seen, rad/s, and how unsure that is."""
    trial.sent(trial.goal(-0.7, -0.7))
    goal = trial.goal(0.3, 0.3)
    readings: list[tuple[float, Angles]] = []
    began_s = trial.clock.now_s()
    trial.move(goal, requested_rad_per_s)
    while True:
        try:
            reading = trial.read()
        except BadReply:  # read too seldom to be sure of an axis at this speed: the next may be
            if trial.clock.now_s() > began_s + SETTLES_WITHIN_S:
                raise
            continue
        readings.append((reading.time_s, at(reading)))
        if not reading.moving or reading.time_s > began_s + SETTLES_WITHIN_S:
            break
        trial.clock.sleep(READ_EVERY_S)
    stamps_s = np.array([stamp_s for stamp_s, _ in readings])
    moments_s = np.linspace(stamps_s[0], stamps_s[-1], 13)
    step_s = float(moments_s[1] - moments_s[0])
    if step_s < 0.004:
        raise NotTried("the way was too short to measure a speed; a larger --reach helps")
    fastest = 0.0
    for axis in (0, 1):
        if trial.true_rad is not None:
            angles = np.array([trial.true_rad(float(moment_s))[axis] for moment_s in moments_s])
        else:
            angles = np.interp(moments_s, stamps_s, [angles[axis] for _, angles in readings])
        fastest = max(fastest, float(np.abs(np.diff(angles)).max()) / step_s)
    count_rad = OUTSIDE_COUNT_RAD if trial.count_rad is None else trial.count_rad
    return fastest, 2 * count_rad / step_s


@moves_head
def test_limits(head: HeadTrial) -> None:
    """Goals at the limits are reached, and those beyond the driver's own refused."""
    if head.limits_rad is None:
        raise NotTried("the limits of its motion are not known; state them by --limits")
    pan, tilt = head.limits_rad
    home = head.sent(head.goal(0.0, 0.0))
    for end, far in ((0, -math.inf), (1, math.inf)) if head.own_limits else ():
        for beyond in (
            (math.nextafter(pan[end], far), at(home)[1]),
            (at(home)[0], math.nextafter(tilt[end], far)),
        ):
            _refused(head, beyond, head.speed_rad_per_s, "beyond a limit")
    for end in (0, 1):
        head.sent((pan[end], tilt[end]))


@moves_head
def test_not_a_number(head: HeadTrial) -> None:
    """A goal or speed that is no number, or a speed that is none, is refused."""
    pan, tilt = head.goal(0.2, 0.2)
    for goal in ((math.nan, tilt), (pan, math.nan), (math.inf, tilt), (pan, -math.inf)):
        _refused(head, goal, head.speed_rad_per_s, "that is no number")
    for speed in (0.0, -1.0, math.nan):
        _refused(head, (pan, tilt), speed, "at no speed")


def _refused(trial: HeadTrial, goal: Angles, speed_rad_per_s: float, message: str) -> None:
    """Send the head where it cannot go: a DriverError, and nothing moves."""
    before = trial.settled()
    what = f"move({goal[0]!r}, {goal[1]!r}, {speed_rad_per_s!r})"
    try:
        trial.try_refusal(goal, speed_rad_per_s)
    except DriverError as error:
        expect("\n" not in str(error), f"{what}: {str(error)!r} is not one sentence")
    else:
        trial.stop()
        raise PromiseBroken(f"{what}, a goal {message}, was not refused")
    trial.clock.sleep(0.05)
    after = trial.read()
    expect(
        away(after, at(before)) <= trial.near_rad,
        f"{what} was refused, and the head moved by {away(after, at(before)):.4f} rad",
    )


@moves_head
def test_deadlines(head: HeadTrial) -> None:
    """Every call ends within half of the time that the service gives it."""
    goal = head.goal(0.2, -0.1)
    measured = []
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
        measured.append(f"{name} {1e3 * min(took_s):.1f} ms")
    log.info(", ".join(measured))


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
    if head.open_again is None:
        head.closed = True
        return
    head.head = head.open_again()
    reading = head.settled()
    expect(away(reading, goal) > head.near_rad, "closed on its way the head went on to its goal")
    log.info(f"opened again {away(reading, goal):.3f} rad before the goal")
