"""One axis' bookkeeping, by hand-made samples: settling, approach, stuck axes, replies from other moments."""

from __future__ import annotations

import math
from typing import Any

import pytest

from drivers.dynamixel.models import MODELS
from drivers.dynamixel.settings import dynamixel_settings
from drivers.errors import BadOptions, BadReply
from drivers.servo_bus.course import AxisCourse, ServoSample, Truth

COUNT_RAD = math.tau / 4096
PERIOD_S = 0.02


def options(**pan: Any) -> dict[str, Any]:
    """A head's options; keywords change the pan axis."""
    return {
        "port": "/dev/ttyUSB0",
        "pan": {"id": 1, "model": "XM430-W350", "limits_rad": [-2.0, 2.0], **pan},
        "tilt": {"id": 2, "model": "MX-28", "limits_rad": [-1.0, 0.8]},
    }


class Bench:
    """A pan axis whose samples the test makes."""

    def __init__(self, start: int = 2048, **pan: Any) -> None:
        self.settings = dynamixel_settings(options(**pan)).pan
        self.motion = AxisCourse("pan", self.settings, settle_s=0.1)
        self.truth = Truth("pan", self.settings)
        self.now_s = 100.0
        self.motion.begin(start)
        self.be(start)

    def sample(self, counts: int, velocity: int = 0, status: int = 1, tick: int | None = None) -> ServoSample:
        values = {
            "present_position": counts, "present_velocity": velocity, "moving_status": status,
            "realtime_tick": int(1000 * self.now_s) % 32768 if tick is None else tick,
            "goal_position": self.motion.goal, "present_current": 10, "present_temperature": 40,
            "present_voltage": 121,
        }  # fmt: skip
        return ServoSample(values, False, self.now_s, self.now_s + 0.002)

    def be(self, counts: int, velocity: int = 0, status: int = 1, for_s: float = PERIOD_S) -> None:
        """Be seen there for a while."""
        until_s = self.now_s + for_s
        while self.now_s < until_s:
            self.now_s += PERIOD_S
            self.motion.take(self.sample(counts, velocity, status))

    def plan(self, angle_rad: float) -> int:
        return self.motion.plan(angle_rad, 1.0, 4.0)


def test_settled_is_in_position_and_still_for_the_dwell() -> None:
    bench = Bench()
    goal = bench.plan(0.5)
    assert goal == 2048 + round(0.5 / COUNT_RAD)
    bench.be(2200, velocity=40, status=2)
    assert not bench.motion.settled(bench.now_s)
    bench.be(goal, velocity=5, status=3)  # there, but the profile is under way
    assert not bench.motion.settled(bench.now_s)
    bench.be(goal)
    assert not bench.motion.settled(bench.now_s)  # there and still, for an instant
    bench.be(goal, for_s=0.2)
    assert bench.motion.settled(bench.now_s)


def test_standing_away_from_the_goal_is_not_settled_and_is_told() -> None:
    bench = Bench()
    goal = bench.plan(0.5)
    bench.be(goal - 30, status=0, for_s=0.5)
    assert not bench.motion.settled(bench.now_s)
    assert bench.motion.stuck_words(bench.now_s) == ""
    bench.be(goal - 30, status=0, for_s=1.0)
    assert bench.motion.stuck_words(bench.now_s) == (
        f"pan stands still {30 * COUNT_RAD:.4f} rad from its goal: something holds it"
    )


def test_creeping_by_a_count_now_and_then_is_not_still() -> None:
    bench = Bench()
    goal = bench.plan(0.5)
    for step in range(6, 0, -1):
        bench.be(goal - 2 * step, status=1, for_s=0.06)
        assert not bench.motion.settled(bench.now_s)


def test_a_goal_from_the_wrong_side_is_passed_and_approached() -> None:
    bench = Bench(approach="positive", approach_rad=0.03)
    stretch = math.ceil(0.03 / COUNT_RAD)
    final = 2048 - round(0.4 / COUNT_RAD)
    assert bench.plan(-0.4) == final - stretch
    bench.be(final - stretch, velocity=-3, status=2)
    assert bench.motion.next_leg() is None
    bench.be(final - stretch)
    assert bench.motion.next_leg() == final
    bench.motion.begin_leg()
    bench.be(final, for_s=0.3)
    assert bench.motion.settled(bench.now_s)
    report = bench.motion.report()
    assert report is not None
    assert (report.side, report.goal_counts, report.measured_counts) == ("positive", final, final)


def test_a_goal_far_enough_on_the_right_side_is_gone_to_at_once() -> None:
    bench = Bench(approach="positive", approach_rad=0.03)
    assert bench.plan(0.4) == 2048 + round(0.4 / COUNT_RAD)
    assert bench.motion.next_leg() is None


def test_a_goal_already_held_from_the_right_side_is_left_alone() -> None:
    bench = Bench(approach="positive", approach_rad=0.03)
    goal = bench.plan(0.4)
    bench.be(goal, for_s=0.3)
    assert bench.plan(0.4) == goal


def test_a_short_way_on_the_right_side_takes_the_long_one() -> None:
    bench = Bench(approach="positive", approach_rad=0.03)
    goal = bench.plan(0.4)
    bench.be(goal, for_s=0.3)
    assert bench.plan(0.41) < goal


def test_a_head_with_the_sign_turned_approaches_in_the_masts_direction() -> None:
    bench = Bench(sign=-1, approach="positive", approach_rad=0.03)
    final = 2048 + round(0.4 / COUNT_RAD)  # pan to the left is up in counts
    assert bench.plan(-0.4) == final + math.ceil(0.03 / COUNT_RAD)


@pytest.mark.parametrize(("goal_rad", "side"), [(0.2, 1), (1.0, -1)])
def test_gravity_decides_the_side(goal_rad: float, side: int) -> None:
    # Below the turnover the weight pulls the head down: coming up keeps gears and weight on one flank.
    settings = dynamixel_settings(
        options(approach="gravity", approach_rad=0.03, gravity_turnover_rad=0.6)
    ).pan
    assert settings.approach_sign(goal_rad) == side


def test_what_the_counts_leave_is_told_in_pixels() -> None:
    bench = Bench()
    angle_rad = 100.25 * COUNT_RAD
    goal = bench.plan(angle_rad)
    bench.be(goal, for_s=0.3)
    report = bench.motion.report()
    assert report is not None
    assert report.measured_counts - 2048 == 100
    # A quarter of a 12-bit count is 0.49 pixels at a focal length of 1280 pixels (facts, section 4).
    assert report.left_px(1280.0) == pytest.approx(-0.49, abs=0.005)
    assert report.current_A == pytest.approx(10 * 0.00269)
    assert report.voltage_V == pytest.approx(12.1)


def test_a_brake_ends_where_the_speed_carries_it() -> None:
    bench = Bench()
    bench.plan(1.0)
    unit = MODELS["XM430-W350"].velocity_unit_rad_per_s
    bench.be(2300, velocity=40, status=2)
    way_rad = (40 * unit) ** 2 / (2 * 4.0)
    assert bench.motion.stopping_counts(4.0) == 2300 + round(way_rad / COUNT_RAD)


def test_a_position_that_leaps_is_refused() -> None:
    bench = Bench()
    bench.truth.check(bench.sample(20))
    bench.now_s += PERIOD_S
    with pytest.raises(BadReply, match="leapt from 20 to 4090 counts"):
        bench.truth.check(bench.sample(4090))


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"model": "XM430-W530"}, "did you mean 'XM430-W350'"),
        ({"id": 2}, "are both 2"),
        ({"limits_rad": [-3.2, 2.0]}, "does not cross the seam"),
        ({"zero_counts": 3000}, "holds 0 to 4095"),
        ({"limits_rad": [1.0, -1.0]}, "low below high"),
        ({"limits": [1.0, -1.0]}, "did you mean 'limits_rad'"),
        ({"approach": "positive"}, "with approach_rad 0"),
        ({"approach": "positive", "approach_rad": 0.004}, "does not take up the backlash"),
        ({"approach": "up", "approach_rad": 0.04}, "none or positive or negative or gravity"),
        ({"sign": 0}, "expected 1 or -1"),
        ({"sign": True}, "expected 1 or -1"),
        ({"model": "YM070-210-M001-RH"}, "which the Y family's are not"),
        ({"model": "XW540-T260-R"}, "(model number 1170); mastctl servo info reads it. Needed is a row"),
        ({"model": "MX-28", "current_limit_A": 1.0}, "has no current limit"),
        ({"current_limit_A": 3.3}, "expected 0.00269 to 3.209 A for a XM430-W350"),
        ({"current_limit_A": 0.001}, "expected 0.00269 to 3.209 A for a XM430-W350"),
        ({"limits_rad": [0.1, 0.1012]}, "hold no two counts of a XM430-W350, whose count is 0.0015 rad"),
        ({"id": 253}, "from 0 to 252"),
    ],
)
def test_options_that_cannot_be_are_refused_in_words(change: dict[str, Any], words: str) -> None:
    with pytest.raises(BadOptions, match=r"options\.pan") as caught:
        dynamixel_settings(options(**change))
    assert words in str(caught.value)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"port": 7}, "/dev/ttyUSB0"),
        ({"baud": "fast"}, "whole number"),
        ({"baud": 57600}, "too long for poll_hz 50"),
        ({"watchdog_s": 0.6}, "from 0 to 0.5"),
        ({"watchdog_s": 0.3}, "braking from 1 rad/s at 4 rad/s2 takes 0.25 s"),
        (
            {"speed_rad_per_s": 2.0},
            "acceleration_rad_per_s2 is 4: braking from 2 rad/s at 4 rad/s2 takes 0.5 s",
        ),
        ({"speed_rad_per_s": 2.0}, "0.5 s in all"),
        ({"poll_hz": 1}, "from 10 to 500"),
        ({"reply_timeout_s": 0.2}, "one lost reply would stop the head; expected 0.18 s or less"),
        ({"reply_timeout_s": 0.185, "watchdog_s": 0.23}, "which the servos count as 0.22 s"),
        ({"reply_timeout_s": 1.0, "watchdog_s": 0}, "from 0.002 to 0.3"),
        ({"speed_rad_s": 1}, "did you mean 'speed_rad_per_s'"),
        ({"tilt": 3}, "expected a mapping"),
    ],
)
def test_options_of_the_head_that_cannot_be_are_refused_in_words(change: dict[str, Any], words: str) -> None:
    with pytest.raises(BadOptions) as caught:
        dynamixel_settings({**options(), **change})
    assert words in str(caught.value)


def test_a_watchdog_and_braking_that_fill_half_a_second_exactly_are_taken() -> None:
    settings = dynamixel_settings({**options(), "watchdog_s": 0.28, "acceleration_rad_per_s2": 5.0})
    assert settings.watchdog_counts == 14


def test_a_line_is_left_silent_for_the_watchdog_the_braking_and_a_twentieth_of_a_second() -> None:
    settings = dynamixel_settings({**options(), "watchdog_s": 0.28, "acceleration_rad_per_s2": 5.0})
    assert settings.silence_s == pytest.approx(0.28 + 1.0 / 5.0 + 0.05)
    assert dynamixel_settings({**options(), "watchdog_s": 0}).silence_s == 0.0


def test_the_acceleration_that_braking_relies_on_is_not_rounded_down() -> None:
    settings = dynamixel_settings(options()).pan
    unit = settings.model.acceleration_unit_rad_per_s2
    assert [settings.acceleration_counts(a * unit) for a in (0.5, 1.0, 1.1, 10.7)] == [1, 1, 2, 11]


@pytest.mark.parametrize(("low", "high", "fits"), [(0, 4095, True), (-1, 4095, False), (0, 4096, False)])
def test_limits_may_reach_the_last_count_that_position_mode_holds_and_no_further(
    low: int, high: int, fits: bool
) -> None:
    asked = options(limits_rad=[(low - 2048) * COUNT_RAD, (high - 2048) * COUNT_RAD])
    if fits:
        assert dynamixel_settings(asked).pan.limit_counts == (low, high)
    else:
        with pytest.raises(BadOptions, match="holds 0 to 4095"):
            dynamixel_settings(asked)


@pytest.mark.parametrize(
    ("current_A", "fits"), [(0.00269, True), (3.209, True), (0.0013, False), (3.211, False)]
)
def test_a_current_limit_is_one_count_to_what_the_model_takes(current_A: float, fits: bool) -> None:
    """XM430-W350: 2.69 mA a count, 1193 counts at most."""
    asked = options(current_limit_A=current_A)
    if fits:
        assert dynamixel_settings(asked).pan.current_limit_A == current_A
    else:
        with pytest.raises(BadOptions, match=r"expected 0\.00269 to 3\.209 A"):
            dynamixel_settings(asked)


def test_an_axis_is_in_position_within_three_counts_and_may_droop_as_far_unless_told_otherwise() -> None:
    settings = dynamixel_settings(options()).pan
    assert settings.settle_rad == pytest.approx(3 * COUNT_RAD)
    assert settings.gravity_turnover_rad == pytest.approx(1.5707963267948966)
    with pytest.raises(BadOptions, match=r"settle_rad is 0\.001, expected a number from 0\.00153"):
        dynamixel_settings(options(settle_rad=0.001))


def test_limits_are_rounded_inwards() -> None:
    settings = dynamixel_settings(options(limits_rad=[-0.5001, 0.5001])).pan
    low, high = settings.limit_counts
    assert settings.angle_rad(low) >= -0.5001 > settings.angle_rad(low - 1)
    assert settings.angle_rad(high) <= 0.5001 < settings.angle_rad(high + 1)
