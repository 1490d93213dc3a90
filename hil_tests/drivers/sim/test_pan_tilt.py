"""The simulated head: counts, backlash, sag, approach; against hand-worked numbers and a stepped model."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from drivers.clock import ManualClock
from drivers.errors import BadOptions
from drivers.sim.axis import AxisSettings
from drivers.sim.heads import HeadModel, head_settings
from drivers.sim.pan_tilt import SimulatedPanTilt

GAP = 0.004
AXIS = AxisSettings(0.001, GAP, -1.0, 1.0, 1.0, 2.0)


def head(axis: AxisSettings, **tilt: Any) -> tuple[SimulatedPanTilt, ManualClock]:
    clock = ManualClock(50.0)
    return SimulatedPanTilt(HeadModel("test head", axis, replace(axis, **tilt)), clock), clock


def settle(device: SimulatedPanTilt, clock: ManualClock) -> None:
    for _ in range(1000):
        if not device.read().moving:
            return
        clock.advance(0.01)
    raise AssertionError("the head never settled")


def test_the_load_follows_a_stepped_model_of_the_gap() -> None:
    device, clock = head(AXIS)
    without_gap = SimulatedPanTilt(HeadModel("no gap", *2 * [replace(AXIS, backlash_rad=0.0)]), clock)
    rng = np.random.default_rng(4)
    load, step_s, worst = -GAP / 2, 0.002, 0.0
    for _ in range(40):
        if rng.random() < 0.2:
            device.stop()
            without_gap.stop()
        else:
            goal = (rng.uniform(-0.2, 0.2), 0.0, rng.uniform(0.1, 1.0))
            device.move(*goal)
            without_gap.move(*goal)
        for _ in range(int(rng.integers(1, 120))):
            clock.advance(step_s)
            motor = without_gap.true_joints(clock.now_s())[0]
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


@pytest.mark.parametrize(
    ("value", "message"),
    [
        ("ptu_d46", r"preset: 'ptu_d46', .*; did you mean 'ptu_d46_70'"),
        ({"preset": "dynamixel_x", "backlash": 0.1}, r"backlash: unknown key; .* 'backlash_rad'"),
        ({"approach_rad": 1e-5}, r"does not take up the backlash"),
    ],
)
def test_a_head_that_does_not_exist_is_refused_by_name(value: object, message: str) -> None:
    with pytest.raises(BadOptions, match=message):
        head_settings(value)
