"""The judge: limits and keep-outs of the moment, judged from where the head may be when the move goes out."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest

from drivers.clock import ManualClock, SystemClock
from drivers.errors import BadOptions, BadReply
from drivers.interfaces import AxisMotion, HeadInfo, Reading
from hil_tests.mastctl.service_fakes import FakeHardware, FakeHead, rig
from hil_tests.waiting import present
from mastctl.devices.cameras import HEAD
from mastctl.devices.devices import Devices
from mastctl.devices.judge import TRAVEL_S, KeepOutJudge, Limits, SunDirection, direction_of
from mastctl.devices.keep_out import Box, KeptOut, Pair

DECK = Box("deck", (-1.0, 1.0), (-1.2, -0.8))
LIMITS = Limits((-2.5, 2.5), (-1.2, 0.6), 0.5, margin_rad=0.02, keep_out=(DECK,))
ACCELERATION = 2.0
BRAKING_RAD = 0.5**2 / (2 * ACCELERATION)


class StatedHead(FakeHead):
    """A head that says how it moves."""

    beyond_rad = 0.0

    @property
    def info(self) -> HeadInfo:
        return HeadInfo(motion=dict.fromkeys(("pan", "tilt"), AxisMotion(ACCELERATION, self.beyond_rad)))


def judge_of(
    limits: Limits = LIMITS,
    head: FakeHead | None = None,
    sun: SunDirection | None = None,
    clock: ManualClock | None = None,
) -> KeepOutJudge:
    return KeepOutJudge(limits, head or StatedHead(), clock or ManualClock(100.0), HEAD, rig(), sun)


def at(pan_rad: float, tilt_rad: float, moving: bool = False) -> Reading:
    return Reading(pan_rad, tilt_rad, moving, 100.0)


def lets(judge: KeepOutJudge, reading: Reading, goal: Pair) -> bool:
    try:
        judge.check_move(goal, lambda: reading)
    except KeptOut:
        return False
    return True


@pytest.fixture
def hardware() -> FakeHardware:
    made = FakeHardware()
    made.head = StatedHead(tilt_rad=-0.4)
    return made


@pytest.fixture
def devices(hardware: FakeHardware) -> Iterator[Devices]:
    made = Devices(hardware.pan_tilt, hardware.cameras, LIMITS, "0" * 64, SystemClock(), rig())
    yield made
    made.close()


def test_a_move_that_might_pass_a_keep_out_never_reaches_the_driver(
    devices: Devices, hardware: FakeHardware
) -> None:
    devices.move(-1.5, -0.4)
    devices.move(-1.5, -1.0)
    with pytest.raises(KeptOut, match=r"between .* the head may pass the keep-out deck"):
        devices.move(1.5, -1.0)
    with pytest.raises(KeptOut, match="is in the keep-out deck"):
        devices.move(0.0, -1.0)
    moves = [call[1:3] for call in hardware.head.calls if call[0] == "move"]
    assert moves == [(-1.5, -0.4), (-1.5, -1.0)]


def test_the_head_is_read_again_before_a_move_near_a_keep_out(
    devices: Devices, hardware: FakeHardware
) -> None:
    devices.move(-1.5, -0.4)
    hardware.head.pan_rad = 0.0  # turned by hand
    with pytest.raises(KeptOut):
        devices.move(-1.5, -1.0)
    hardware.head.pan_rad = -1.5
    lost: list[str] = []

    def once(name: str) -> None:
        if name == "read" and not lost:
            lost.append(name)
            raise BadReply("garbled")

    hardware.head.hook = once
    devices.move(-1.5, -1.0)
    assert lost and hardware.head.tilt_rad == -1.0


def test_no_head_is_read_for_a_move_where_nothing_is_kept_out() -> None:
    judge = judge_of(replace(LIMITS, keep_out=()))

    def read() -> Reading:
        raise AssertionError("read")

    assert judge.check_move((0.0, -1.0), read) is None


def test_a_moving_heads_place_counts_braking_and_travel() -> None:
    judge = judge_of()
    far = BRAKING_RAD + 0.5 * TRAVEL_S
    edge = -0.8 + far  # from here it may brake just above the deck
    assert lets(judge, at(0.0, edge + 0.001, moving=True), (0.5, 0.0))
    assert not lets(judge, at(0.0, edge - 0.021, moving=True), (0.5, 0.0)), "it may be in the deck"
    assert lets(judge, at(0.0, edge - 0.021), (0.5, 0.0)), "at rest it stands where it was read"


def test_a_moving_head_is_assumed_in_the_rectangle_passed_last() -> None:
    judge = judge_of()
    start = judge.check_move((1.5, -0.5), lambda: at(0.0, -0.5))
    judge.sent(start, (1.5, -0.5), 0.5)
    near_the_deck = at(0.7, -0.76, moving=True)  # lower than the rectangle: it brakes there at most
    assert not lets(judge, near_the_deck, (0.7, -0.78))
    inside = at(0.7, -0.5, moving=True)
    assert lets(judge, inside, (0.7, -0.78)), "tilt rests: it cannot be on its way down"
    assert not lets(judge, inside, (0.0, -0.79)), "that is the margin"


def test_a_head_at_rest_right_after_a_move_is_not_believed() -> None:
    judge = judge_of()
    start = judge.check_move((1.5, -1.0), lambda: at(1.5, -0.4))
    judge.sent(start, (1.5, -1.0), 0.5)
    assert not lets(judge, at(1.5, -0.4), (0.0, -0.4)), "it may be on its way down beside the deck"


def test_an_approach_from_one_side_is_part_of_the_slack() -> None:
    head = StatedHead()
    head.beyond_rad = 0.1
    judge = judge_of(head=head)
    assert not lets(judge, at(0.0, 0.0), (0.0, -0.75))
    assert lets(judge, at(0.0, 0.0), (0.0, -0.67))


def test_a_head_faster_than_the_limit_is_refused_with_the_option() -> None:
    slow = replace(LIMITS, acceleration_rad_per_s2=1.0)
    words = r"limits.acceleration_rad_per_s2 is 1, and pan speeds up with 2 .* set acceleration_rad_per_s2 of"
    with pytest.raises(BadOptions, match=words):
        judge_of(slow)
    judge_of(replace(LIMITS, acceleration_rad_per_s2=2.0))


def test_the_sun_is_kept_out_until_its_moment_and_then_missed_aloud() -> None:
    clock = ManualClock(100.0)
    judge = judge_of(replace(LIMITS, keep_out=()), clock=clock)
    judge.use_sun(SunDirection(direction_of(0.5, 0.0), "rover", 0.1, 110.0))
    with pytest.raises(KeptOut, match="keep-out sun"):
        judge.check_goal(0.5, 0.0)
    assert [fault.code for fault in judge.faults(at(0.5, 0.02))] == ["sun_in_view"]
    assert judge.faults(at(0.5, 0.5)) == ()
    told = present(judge.sun_as_json()["sun"])
    assert (told["left_s"], told["active"]) == (10.0, True)
    clock.advance(10.5)
    judge.check_goal(0.5, 0.0)
    assert [fault.code for fault in judge.faults(at(0.5, 0.02))] == ["sun_not_known"]
    judge.use_sun(None)
    assert judge.faults(at(0.5, 0.02)) == () and judge.sun_as_json() == {"sun": None, "boxes": []}


def test_a_new_sun_is_found_ahead_of_a_head_and_not_behind_it() -> None:
    clock = ManualClock(100.0)
    judge = judge_of(replace(LIMITS, keep_out=()), clock=clock)
    judge.use_sun(SunDirection(direction_of(2.4, 0.5), "rover", 0.1))  # somewhere else
    start = judge.check_move((1.0, 0.0), lambda: at(-1.0, 0.0))
    judge.sent(start, (1.0, 0.0), 0.5)
    assert judge.in_the_way(at(-0.8, 0.0, moving=True)) is None
    judge.use_sun(SunDirection(direction_of(0.0, 0.0), "rover", 0.1))
    assert judge.in_the_way(at(-0.8, 0.0, moving=True)) == "sun"
    assert judge.in_the_way(at(0.0, 0.0, moving=True)) is None  # it looks there and goes out
    assert judge.in_the_way(at(0.8, 0.0, moving=True)) is None  # it has passed
    judge.use_sun(SunDirection(direction_of(1.0, 0.0), "rover", 0.1))
    assert judge.in_the_way(at(0.95, 0.0, moving=True)) == "sun"  # it would come to rest there
    clock.advance(1.0)
    assert judge.in_the_way(at(1.0, 0.0)) is None  # it rests; nothing is to be stopped
    assert judge.in_the_way(None) is None


def test_a_sun_of_the_site_turns_with_the_rover() -> None:
    sun = SunDirection(direction_of(0.5, 0.0), "site", 0.1)
    judge = judge_of(replace(LIMITS, keep_out=()), sun=sun)
    with pytest.raises(KeptOut):
        judge.check_goal(0.5, 0.0)
    heading = 0.9  # the rover turned right: what was ahead to the right is now to the left
    cosine, sine = math.cos(heading), math.sin(heading)
    judge.rover_stands(np.array([[cosine, sine, 0.0], [-sine, cosine, 0.0], [0.0, 0.0, 1.0]]))
    judge.check_goal(0.5, 0.0)
    with pytest.raises(KeptOut):
        judge.check_goal(0.5 - heading, 0.0)


def test_a_head_in_a_keep_out_is_told_since_it_was_first_read_there() -> None:
    judge = judge_of()
    clear, inside = at(0.0, 0.0), at(0.0, -0.9)

    def since(time_s: float, reading: Reading) -> list[float]:
        return [fault.since_s for fault in judge.faults(replace(reading, time_s=time_s))]

    assert since(1.0, clear) == []
    assert since(2.0, inside) == since(3.0, inside) == since(9.0, inside) == [2.0]
    assert since(10.0, clear) == []
    assert since(11.0, inside) == [11.0]
