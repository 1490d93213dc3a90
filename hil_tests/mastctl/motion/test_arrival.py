"""A move's deadline, when a head has arrived, and which readings cannot be true; the clock is a test's."""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import pytest

from calib.geometry.pointing import Solution
from drivers.clock import ManualClock
from drivers.interfaces import Reading
from hil_tests.mastctl.motion.pointing_world import rig
from mastctl.devices.joint_history import HeadReading
from mastctl.devices.judge import Limits
from mastctl.devices.keep_out import KeptOut
from mastctl.motion.requests import PointingError
from mastctl.motion.steps import Steps

SPEED_RAD_PER_S = 0.5


class Turning:
    """A head whose place is ``at(time)``: pan, tilt and whether it says that it moves."""

    def __init__(self, at: Callable[[float], tuple[float, float, bool]]) -> None:
        self.at = at
        self.judge = self
        self.limits = Limits((-2.0, 2.0), (-1.0, 1.0), SPEED_RAD_PER_S)
        self.clock = ManualClock(100.0)
        self.moves: list[tuple[float, float]] = []
        self.stamp: Callable[[Reading], Reading] = lambda reading: reading

    def read(self) -> HeadReading:
        pan_rad, tilt_rad, moving = self.at(self.clock.now_s())
        told = self.stamp(Reading(pan_rad, tilt_rad, moving, self.clock.now_s()))
        true_rad = told.pan_rad, told.tilt_rad
        return HeadReading(*true_rad, told.moving, told.time_s, told.faults, true_rad=true_rad)

    def move(self, pan_rad: float, tilt_rad: float, speed_rad_per_s: float | None = None) -> None:
        self.moves.append((pan_rad, tilt_rad))

    def goal(self, true_rad: tuple[float, float], start: HeadReading) -> tuple[float, float]:
        return true_rad

    def check_from(self, start: tuple[float, float], goal: tuple[float, float]) -> None: ...
    def stop(self) -> None: ...


def request(turning: Turning, cancelled: threading.Event | None = None) -> Steps:
    stopped, steps = cancelled or threading.Event(), list[Any]()
    return Steps(rig(), turning, turning.clock, steps.append, stopped)  # type: ignore[arg-type]


def standing(pan_rad: float = 0.3, tilt_rad: float = -0.2) -> Turning:
    return Turning(lambda time_s: (pan_rad, tilt_rad, False))


@pytest.mark.parametrize(
    ("goal", "allowed_s"),
    [((0.8, -0.2), 1.0 + 4.15), ((0.3, 0.8), 2.0 + 4.15), ((-0.7, -0.1), 2.0 + 4.15), ((0.3, -0.2), 4.15)],
)
def test_a_move_is_allowed_its_longer_way_at_the_cap_and_four_seconds(
    goal: tuple[float, float], allowed_s: float
) -> None:
    assert request(standing()).time_allowed_s(*goal) == pytest.approx(allowed_s)


def test_a_request_that_was_stopped_sends_nothing() -> None:
    turning, cancelled = standing(), threading.Event()
    head = request(turning, cancelled)
    cancelled.set()
    for call in (lambda: head.send(0.1, 0.1), head.resting, lambda: head.arrived(0.3, -0.2, 200.0)):
        with pytest.raises(PointingError) as told:
            call()
        assert told.value.code == "stopped"
    assert turning.moves == []


@pytest.mark.parametrize("off", [(0.0059, 0.0), (0.0, -0.0059)])
def test_a_head_that_rests_within_the_tolerance_has_arrived(off: tuple[float, float]) -> None:
    turning = standing(0.3 + off[0], -0.2 + off[1])
    reading = request(turning).arrived(0.3, -0.2, 105.0)
    assert (reading.pan_rad, reading.tilt_rad) == (0.3 + off[0], -0.2 + off[1])
    assert turning.clock.now_s() == pytest.approx(100.15, abs=0.03), "unchanged for the dwell"


@pytest.mark.parametrize(
    ("off", "words"), [((0.0061, 0.0), r"pan \+0\.0061 rad"), ((0.0, -0.0061), r"tilt -0\.0061")]
)
def test_a_head_that_rests_elsewhere_is_given_until_its_deadline(
    off: tuple[float, float], words: str
) -> None:
    turning = standing(0.3 + off[0], -0.2 + off[1])
    with pytest.raises(PointingError, match=words) as told:
        request(turning).arrived(0.3, -0.2, 105.0)
    assert told.value.code == "did_not_arrive"
    assert turning.clock.now_s() == pytest.approx(105.0, abs=0.03)


def test_a_head_that_begins_late_has_not_arrived_where_it_stood() -> None:
    def at(time_s: float) -> tuple[float, float, bool]:
        pan_rad = min(max(0.0, 0.5 * (time_s - 101.0)), 0.3)
        return pan_rad, 0.0, 0.0 < pan_rad < 0.3

    reading = request(Turning(at)).arrived(0.3, 0.0, 110.0)
    assert reading.pan_rad == 0.3


def test_a_head_at_its_goal_that_never_rests_did_not_settle() -> None:
    turning = Turning(lambda time_s: (0.3, -0.2, True))
    with pytest.raises(PointingError, match="still moves") as told:
        request(turning).arrived(0.3, -0.2, 105.0)
    assert told.value.code == "did_not_settle"


def test_a_request_waits_two_seconds_for_a_head_that_moves() -> None:
    turning = Turning(lambda time_s: (0.1 * (time_s - 100.0), 0.0, True))
    with pytest.raises(PointingError, match="still moves after 2 s of waiting") as told:
        request(turning).resting()
    assert told.value.code == "head_moving"
    assert turning.clock.now_s() == pytest.approx(102.0, abs=0.03)


def test_a_head_that_says_rest_is_taken_at_its_word_before_a_move() -> None:
    turning = standing()
    assert request(turning).resting().pan_rad == 0.3
    assert turning.clock.now_s() == 100.0, "not watched for a dwell"


def test_a_reading_with_a_fault_is_refused() -> None:
    turning = standing()
    turning.stamp = lambda reading: replace(reading, faults=("the motor is hot",))
    with pytest.raises(PointingError, match="reports: the motor is hot"):
        request(turning).read()


@pytest.mark.parametrize("axis", [0, 1])
@pytest.mark.parametrize(
    ("jump_rad", "possible"), [(0.134, True), (-0.134, True), (0.136, False), (-0.136, False)]
)
def test_between_readings_a_head_goes_twice_its_speed_and_a_slip_at_most(
    axis: int, jump_rad: float, possible: bool
) -> None:
    """0.1 s at twice 0.5 rad/s, and 0.035 rad."""
    place = [0.3, -0.2]
    turning = Turning(lambda time_s: (place[0], place[1], False))
    head = request(turning)
    head.read()
    turning.clock.advance(0.1)
    place[axis] += jump_rad
    if possible:
        head.read()
    else:
        with pytest.raises(PointingError, match=r"jumped 0\.136 rad off its way in 0\.100 s, at most 0\.135"):
            head.read()


def test_a_head_may_be_anywhere_on_its_way_at_once_but_not_beyond_its_goal() -> None:
    place = [0.0, 0.0]
    turning = Turning(lambda time_s: (place[0], place[1], False))
    head = request(turning)
    head.read()
    head.send(1.0, -0.5)
    assert turning.moves == [(1.0, -0.5)]
    place[:] = [1.0, -0.5]
    head.read()
    place[:] = [1.04, -0.5]
    with pytest.raises(PointingError, match=r"jumped 0\.040 rad off its way"):
        head.read()


def test_the_nearest_solution_that_no_keep_out_bars_is_taken() -> None:
    near, far = Solution(0.2, 0.1, 3.0), Solution(-0.9, 0.3, 3.0)
    barred: set[float] = set()

    def check_from(here: tuple[float, float], goal: tuple[float, float]) -> None:
        if goal[0] in barred:
            raise KeptOut("deck", f"pan {goal[0]} is kept out")

    turning = standing(0.0, 0.0)
    turning.check_from = check_from  # type: ignore[method-assign, assignment]

    def taken() -> Solution:
        return request(turning).chosen([far, near], turning.read())

    assert taken() == near
    barred.add(near.pan_rad)
    assert taken() == far
    barred.add(far.pan_rad)
    with pytest.raises(KeptOut, match=r"pan 0\.2 is kept out"):
        taken()
