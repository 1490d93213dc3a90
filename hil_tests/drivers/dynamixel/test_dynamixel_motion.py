"""One axis' bookkeeping, by hand-made samples: settling, approach, stuck axes, replies from other moments."""

from __future__ import annotations

import math
from typing import Any

import pytest

from drivers.dynamixel.models import MODELS, dynamixel_settings
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
    assert bench.motion.stuck_fault(bench.now_s) == ""
    bench.be(goal - 30, status=0, for_s=1.0)
    assert bench.motion.stuck_fault(bench.now_s) == (
        f"pan stands still {30 * COUNT_RAD:.4f} rad from its goal: something holds it"
    )


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


def test_a_short_way_on_the_right_side_takes_the_long_one() -> None:
    bench = Bench(approach="positive", approach_rad=0.03)
    goal = bench.plan(0.4)
    bench.be(goal, for_s=0.3)
    assert bench.plan(0.41) < goal


@pytest.mark.parametrize(("goal_rad", "side"), [(0.2, 1), (1.0, -1)])
def test_gravity_decides_the_side(goal_rad: float, side: int) -> None:
    # Below the turnover the weight pulls the head down: coming up keeps gears and weight on one flank.
    settings = dynamixel_settings(
        options(approach="gravity", approach_rad=0.03, gravity_turnover_rad=0.6)
    ).pan
    assert settings.approach_sign(goal_rad) == side


def test_the_report_says_what_the_counts_leave() -> None:
    bench = Bench()
    angle_rad = 100.25 * COUNT_RAD
    goal = bench.plan(angle_rad)
    bench.be(goal, for_s=0.3)
    report = bench.motion.report()
    assert report is not None
    assert report.measured_counts - 2048 == 100
    assert report.left_rad == pytest.approx(-0.25 * 2 * math.pi / 4096)


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
        ({"id": 2}, "2, as tilt.id; two ids are expected"),
        ({"limits_rad": [-3.2, 2.0]}, "does not cross the seam"),
        ({"approach": "positive", "approach_rad": 0.004}, "does not take up the backlash"),
        ({"model": "XW540-T260-R"}, "another needs a row in dynamixel/models.py"),
        ({"model": "MX-28", "current_limit_A": 1.0}, "has no current limit"),
        ({"current_limit_A": 3.3}, "0.00269 to 3.209 A for a XM430-W350 is expected"),
        ({"limits_rad": [0.1, 0.1012]}, "hold no two counts of a XM430-W350, whose count is 0.0015 rad"),
    ],
)
def test_options_that_cannot_be_are_refused_in_words(change: dict[str, Any], words: str) -> None:
    with pytest.raises(BadOptions, match=r"options\.pan") as caught:
        dynamixel_settings(options(**change))
    assert words in str(caught.value)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"baud": 57600}, "too long for poll_hz 50"),
        ({"watchdog_s": 0.3}, "braking from 1 rad/s at 4 rad/s2 takes 0.25 s"),
        ({"reply_timeout_s": 0.2}, "one lost reply would stop the head; 0.18 s or less is expected"),
        ({"reply_timeout_s": 0.185, "watchdog_s": 0.23}, "which the servos count as 0.22 s"),
        ({"speed_rad_s": 1}, "the nearest known is 'speed_rad_per_s'"),
    ],
)
def test_options_of_the_head_that_cannot_be_are_refused(change: dict[str, Any], words: str) -> None:
    with pytest.raises(BadOptions) as caught:
        dynamixel_settings({**options(), **change})
    assert words in str(caught.value)
