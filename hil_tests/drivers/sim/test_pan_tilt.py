"""The simulated head: counts, backlash, sag, approach; against hand-worked numbers and a stepped model."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from drivers.clock import ManualClock
from drivers.errors import BadOptions, DriverError, NoReply
from drivers.interfaces import PanTilt
from drivers.sim.axis import AxisSettings
from drivers.sim.heads import PRESETS, HeadSettings, head_settings
from drivers.sim.pan_tilt import SimulatedPanTilt

GAP = 0.004
AXIS = AxisSettings(0.001, GAP, -1.0, 1.0, 1.0, 2.0)


def head(axis: AxisSettings, **tilt: float) -> tuple[SimulatedPanTilt, ManualClock]:
    clock = ManualClock(50.0)
    return SimulatedPanTilt(HeadSettings("test head", axis, replace(axis, **tilt)), clock), clock


def settle(device: SimulatedPanTilt, clock: ManualClock) -> None:
    for _ in range(1000):
        if not device.read().moving:
            return
        clock.advance(0.01)
    raise AssertionError("the head never settled")


def test_presets_have_the_resolutions_of_the_devices() -> None:
    assert math.degrees(PRESETS["ptu_d46_70"].pan.count_rad) * 3600 == pytest.approx(11.57)
    assert math.degrees(PRESETS["dynamixel_x"].tilt.count_rad) == pytest.approx(0.0879, abs=5e-5)
    assert math.degrees(PRESETS["ptu_d46_70"].tilt.backlash_rad) == pytest.approx(0.01)
    assert math.degrees(PRESETS["dynamixel_x"].pan.backlash_rad) == pytest.approx(0.25)
    assert PRESETS["ptu_d46_70"].tilt.sag_rad == 5e-5
    assert PRESETS["ptu_d46_70"].pan.approach_rad > PRESETS["ptu_d46_70"].pan.backlash_rad


@pytest.mark.parametrize(("goal", "reading"), [(0.2004, 0.200), (0.2006, 0.201), (-0.2004, -0.200)])
def test_goal_is_rounded_to_the_nearest_count(goal: float, reading: float) -> None:
    device, clock = head(AXIS)
    assert isinstance(device, PanTilt)
    device.move(goal, 0.0)
    settle(device, clock)
    assert device.read().pan_rad == pytest.approx(reading, abs=1e-12)
    assert device.read().time_s == clock.now_s()


def test_under_way_the_reading_is_in_whole_counts_of_where_it_is() -> None:
    device, clock = head(AXIS)
    device.move(0.8, 0.0)
    clock.advance(0.1)  # 2 rad/s² for 0.1 s: 0.01 rad
    assert device.read().pan_rad == pytest.approx(0.010, abs=1e-12)
    assert device.read().moving
    clock.advance(0.003)  # 0.0106 rad
    assert device.read().pan_rad == pytest.approx(0.011, abs=1e-12)


def test_backlash_leaves_the_load_half_a_gap_behind_on_the_side_it_came_from() -> None:
    device, clock = head(AXIS)
    for goal, side in ((0.3, -1), (0.5, -1), (0.4, 1), (-0.2, 1), (0.4, -1)):
        device.move(goal, 0.0)
        settle(device, clock)
        pan_rad, _ = device.true_joints(clock.now_s())
        assert pan_rad == pytest.approx(goal + side * GAP / 2, abs=1e-12)
        assert device.read().pan_rad == pytest.approx(goal, abs=1e-12), "the encoder does not see it"


def test_inside_the_gap_the_load_stays_where_it_is() -> None:
    device, clock = head(AXIS)
    device.move(0.3, 0.0)
    settle(device, clock)
    device.move(0.3 - GAP + 0.001, 0.0)  # back by less than the gap
    settle(device, clock)
    assert device.true_joints(clock.now_s())[0] == pytest.approx(0.3 - GAP / 2, abs=1e-12)


def test_the_load_follows_a_stepped_model_of_the_gap_through_random_commands() -> None:
    device, clock = head(AXIS)
    rng = np.random.default_rng(4)
    load, step_s, worst = -GAP / 2, 0.002, 0.0
    for _ in range(40):
        if rng.random() < 0.2:
            device.stop()
        else:
            device.move(rng.uniform(-0.2, 0.2), 0.0, rng.uniform(0.1, 1.0))
        for _ in range(int(rng.integers(1, 120))):
            clock.advance(step_s)
            motor = device._axes[0].motion.at(clock.now_s())[0]
            load = motor - GAP / 2 if load < motor - GAP / 2 else min(load, motor + GAP / 2)
            worst = max(worst, abs(device.true_joints(clock.now_s())[0] - load))
    # A turn between two steps is missed by the stepped model by at most a·dt²/8.
    assert worst < 40 * 2.0 * step_s**2


def test_sag_drops_a_level_load_most() -> None:
    device, clock = head(replace(AXIS, backlash_rad=0.0), sag_rad=0.003)
    for tilt in (0.0, 0.6, -0.9):
        device.move(0.0, tilt)
        settle(device, clock)
        assert device.true_joints(clock.now_s())[1] == pytest.approx(tilt - 0.003 * math.cos(tilt), abs=1e-12)
        assert device.read().tilt_rad == pytest.approx(tilt, abs=1e-12), "the encoder does not see it"


def test_every_goal_is_approached_from_one_side() -> None:
    device, clock = head(replace(AXIS, approach_rad=0.01))
    for goal in (0.3, 0.1, 0.105, 0.104, -0.5, 0.9, 1.0, -1.0):
        device.move(goal, 0.0)
        settle(device, clock)
        assert device.read().pan_rad == pytest.approx(goal, abs=1e-12)
        assert device.true_joints(clock.now_s())[0] == pytest.approx(goal - GAP / 2, abs=1e-12)


def test_moving_stays_up_until_the_approach_is_over() -> None:
    device, clock = head(replace(AXIS, approach_rad=0.01))
    device.move(0.5, 0.0)
    settle(device, clock)
    device.move(0.3, 0.0)
    readings = []
    while device.read().moving:
        readings.append(device.read().pan_rad)
        clock.advance(0.002)
    assert min(readings) == pytest.approx(0.29, abs=1e-3), "it went past the goal"
    assert readings[-1] == pytest.approx(0.3, abs=2e-3), "and was moving until it was back"


@pytest.mark.parametrize("goal", [1.0, -1.0])
def test_goals_at_the_end_of_the_range_are_taken_and_those_beyond_refused(goal: float) -> None:
    device, clock = head(AXIS)
    device.move(goal, 0.0)
    settle(device, clock)
    beyond = math.nextafter(goal, 2 * goal)
    for bad in ((beyond, 0.0), (0.0, beyond), (math.nan, 0.0), (0.0, math.inf)):
        with pytest.raises(
            DriverError, match=r"(pan|tilt) .* rad is outside the device's own range -1.0000 to 1.0000"
        ):
            device.move(*bad)
    assert device.read().pan_rad == goal and not device.read().moving


@pytest.mark.parametrize("speed", [0.0, -1.0, math.nan])
def test_a_speed_that_is_no_speed_is_refused(speed: float) -> None:
    device, _ = head(AXIS)
    with pytest.raises(DriverError, match="not a positive number"):
        device.move(0.1, 0.1, speed)
    assert not device.read().moving


def test_speed_is_bounded_by_the_request_and_by_the_axis() -> None:
    for asked, fastest in ((0.3, 0.3), (50.0, 1.0), (None, 1.0)):
        device, clock = head(AXIS)
        device.move(1.0, 0.0, asked)
        clock.advance(1.0)
        rate = device._axes[0].motion.at(clock.now_s())[1]
        assert rate == pytest.approx(fastest)


def test_stop_halts_within_the_braking_distance_and_holds() -> None:
    device, clock = head(AXIS)
    device.move(1.0, 0.0)
    clock.advance(0.7)
    before = device.read().pan_rad
    device.stop()
    settle(device, clock)
    after = device.read().pan_rad
    assert after - before == pytest.approx(1.0 / (2 * 2.0), abs=0.0011)
    clock.advance(5.0)
    assert device.read().pan_rad == after


def test_close_stops_and_further_calls_get_no_reply() -> None:
    device, clock = head(AXIS)
    device.move(1.0, 0.0)
    clock.advance(0.3)
    device.close()
    device.close()
    with pytest.raises(NoReply, match="closed"):
        device.read()
    clock.advance(3.0)
    assert device.true_joints(clock.now_s())[0] < 0.5


def test_past_joints_do_not_change_when_new_moves_come() -> None:
    device, clock = head(AXIS)
    device.move(0.5, 0.2)
    clock.advance(0.2)
    moment = clock.now_s()
    then = device.true_joints(moment)
    clock.advance(0.5)
    device.move(-0.5, 0.0)
    clock.advance(0.5)
    assert device.true_joints(moment) == then


@pytest.mark.parametrize(
    ("value", "message"),
    [
        ("ptu_d46", r"no head 'ptu_d46'; did you mean 'ptu_d46_70'"),
        (7, r"no head 7"),
        ({"preset": "dynamixel_x", "backlash": 0.1}, r"no key 'backlash'; did you mean 'backlash_rad'"),
        ({"backlash_rad": -0.1}, r"backlash_rad is -0.1, expected a positive number"),
        ({"count_rad": 0}, r"count_rad is 0, expected a positive number"),
        ({"count_rad": "fine"}, r"count_rad is 'fine', expected a positive number"),
        ({"approach_rad": 1e-5}, r"does not take up the backlash"),
    ],
)
def test_a_head_that_does_not_exist_is_refused_by_name(value: object, message: str) -> None:
    with pytest.raises(BadOptions, match=message):
        head_settings(value)


def test_a_preset_can_be_changed_in_parts() -> None:
    changed = head_settings({"preset": "dynamixel_x", "approach_rad": 0.01, "sag_rad": 0.0})
    assert changed.pan.approach_rad == changed.tilt.approach_rad == 0.01
    assert changed.tilt.sag_rad == 0.0 and changed.pan.backlash_rad == PRESETS["dynamixel_x"].pan.backlash_rad
