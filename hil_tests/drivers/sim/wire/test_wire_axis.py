"""The physical axis: motion by hand-worked numbers, and every fault of the mechanism."""

from __future__ import annotations

import math

import pytest

from drivers.clock import ManualClock
from drivers.faults import PAN_TILT, FaultPanel
from drivers.sim.axis import AxisSettings
from drivers.sim.wire.axis import WARM_C, WireAxis

SETTINGS = AxisSettings(
    count_rad=0.001,
    backlash_rad=0.004,
    low_rad=-2.0,
    high_rad=2.0,
    speed_rad_per_s=1.0,
    acceleration_rad_per_s2=2.0,
    sag_rad=0.01,
)


class Bench:
    def __init__(self, **options: object) -> None:
        self.clock = ManualClock()
        self.panel = FaultPanel(self.clock.now_s, ())
        self.axis = WireAxis(SETTINGS, self.panel, number=1, **options)  # type: ignore[arg-type]

    def at(self, time_s: float) -> float:
        self.clock.advance(time_s - self.clock.now_s())
        return self.axis.angle_rad(time_s)


@pytest.fixture
def bench() -> Bench:
    return Bench()


def test_a_goal_is_reached_by_a_trapezoid(bench: Bench) -> None:
    bench.axis.goal(0.0, 1.0, 0.5, 2.0)  # 0.25 s of ramp over 0.0625 rad, then 0.5 rad/s
    assert bench.at(0.25) == pytest.approx(0.0625)
    assert bench.at(1.25) == pytest.approx(0.5625)
    assert bench.axis.velocity_rad_per_s(1.25) == pytest.approx(0.5)
    assert bench.axis.under_way(2.24) and not bench.axis.under_way(2.26)
    assert bench.at(3.0) == 1.0


def test_the_cameras_ride_behind_backlash_and_sag(bench: Bench) -> None:
    bench.axis.goal(0.0, 0.5, 1.0, 2.0)
    bench.at(5.0)
    load = 0.5 - 0.002
    assert bench.axis.mechanical_rad(5.0) == pytest.approx(load - 0.01 * math.cos(load))


def test_velocity_turns_for_ever_until_it_is_halted(bench: Bench) -> None:
    bench.axis.velocity(0.0, -0.5, 2.0)
    assert bench.at(10.25) == pytest.approx(-0.0625 - 5.0)
    bench.axis.halt(10.25)
    assert bench.at(11.0) == pytest.approx(-0.0625 - 5.0 - 0.0625)
    assert not bench.axis.under_way(11.0)


def test_limp_friction_holds_or_it_falls() -> None:
    held, falling = Bench(), Bench(falls_to_rad=-1.0)
    for bench in (held, falling):
        bench.axis.goal(0.0, 0.5, 1.0, 2.0)
        bench.at(2.0)
        bench.axis.limp(2.0)
    assert held.at(10.0) == 0.5
    assert falling.at(10.0) == -1.0


def test_stuck_stays_then_goes_on_to_where_it_was_sent(bench: Bench) -> None:
    bench.panel.set(PAN_TILT, "stuck", after_s=1.0, for_s=3.0)
    bench.axis.goal(0.0, 1.0, 0.5, 2.0)
    assert bench.at(2.0) == pytest.approx(0.4375), "where it was after a second"
    assert bench.axis.seized(2.0) and bench.axis.blocked(2.0)
    bench.axis.goal(2.0, -1.0, 0.5, 2.0)
    assert bench.at(3.9) == pytest.approx(0.4375)
    bench.at(4.1)
    assert bench.at(9.0) == -1.0


def test_a_fault_of_the_other_axis_does_nothing(bench: Bench) -> None:
    bench.panel.set(PAN_TILT, "stuck", axis=0)
    bench.axis.goal(0.0, 1.0, 0.5, 2.0)
    assert bench.at(5.0) == 1.0


def test_slow_takes_a_fraction_of_speed_and_acceleration(bench: Bench) -> None:
    bench.panel.set(PAN_TILT, "slow", factor=0.1)
    bench.axis.goal(0.0, 1.0, 0.5, 2.0)
    assert bench.at(0.25) == pytest.approx(0.00625)
    assert bench.at(10.25) == pytest.approx(0.05 * 10.25 - 0.00625)


@pytest.mark.parametrize("order", ["none", "goal", "to_count", "halt", "velocity"])
def test_slow_under_way_brakes_as_ever_and_passes_no_goal(bench: Bench, order: str) -> None:
    bench.axis.goal(0.0, 1.0, 1.0, 2.0)
    assert bench.at(0.9) == pytest.approx(0.65) and bench.axis.velocity_rad_per_s(0.9) == pytest.approx(1.0)
    bench.panel.set(PAN_TILT, "slow", factor=0.05)
    {
        "none": lambda: None,
        "goal": lambda: bench.axis.goal(0.9, 1.0, 1.0, 2.0),
        "to_count": lambda: bench.axis.to_count(0.9, 1.0, 1.0),
        "halt": lambda: bench.axis.halt(0.9),
        "velocity": lambda: bench.axis.velocity(0.9, 0.0, 2.0),
    }[order]()
    furthest = max(bench.at(0.9 + 0.1 * step) for step in range(1, 100))
    assert 0.899 < furthest <= 1.0, "1 rad/s is braked within 0.25 rad, at a twentieth of 2 rad/s2 within 5"


@pytest.mark.parametrize("goal", [1.0, -1.0])
def test_an_obstacle_is_not_passed_from_either_side_and_can_be_left(bench: Bench, goal: float) -> None:
    at_rad = goal / 2
    bench.panel.set(PAN_TILT, "overload", angle_rad=at_rad)
    bench.axis.goal(0.0, goal, 0.5, 2.0)
    assert bench.at(5.0) == pytest.approx(at_rad, abs=1e-6)
    assert abs(bench.at(5.0)) <= abs(at_rad)
    assert bench.axis.pressing(5.0) and bench.axis.blocked(5.0) and not bench.axis.under_way(5.0)
    bench.axis.goal(5.0, 0.0, 0.5, 2.0)
    assert bench.at(10.0) == 0.0 and not bench.axis.pressing(10.0)
    bench.axis.goal(10.0, goal, 0.5, 2.0)
    assert bench.at(15.0) == pytest.approx(at_rad, abs=1e-6)
    bench.panel.clear()
    bench.at(15.1)
    assert bench.at(20.0) == goal, "the obstacle is gone"


def test_the_encoder_drifts_while_the_axis_stays(bench: Bench) -> None:
    bench.axis.goal(0.0, 0.5, 1.0, 2.0)
    bench.at(3.0)
    bench.panel.set(PAN_TILT, "drifting", rate_rad_per_s=0.01)
    assert bench.at(13.0) == pytest.approx(0.6)
    assert bench.axis.motion.at(13.0)[0] == 0.5
    bench.panel.clear()
    assert bench.at(14.0) == 0.5


def test_wrong_and_garbage_are_of_the_encoder_only(bench: Bench) -> None:
    bench.panel.set(PAN_TILT, "wrong", offset_rad=0.1)
    assert bench.at(1.0) == pytest.approx(0.1)
    bench.panel.set(PAN_TILT, "garbage")
    angles = [bench.axis.angle_rad(1.0) for _ in range(50)]
    assert len(set(angles)) == 50 and max(map(abs, angles)) > math.pi
    assert bench.axis.motion.at(1.0)[0] == 0.0


def test_supply_and_temperature(bench: Bench) -> None:
    assert bench.axis.supply(0.0) == 1.0 and bench.axis.temperature_c(0.0) == WARM_C
    bench.panel.set(PAN_TILT, "voltage_dip", factor=0.6)
    bench.panel.set(PAN_TILT, "temperature_ramp", rate_c_per_s=2.0)
    assert bench.axis.supply(0.0) == 0.6 and bench.axis.temperature_c(10.0) == pytest.approx(WARM_C + 20)
    assert bench.axis.temperature_c(1000.0) == 125.0
