"""The simulated head: counts, backlash, sag, approach, ringing, a wrong encoder, play under gravity."""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from drivers.clock import ManualClock
from drivers.errors import BadOptions
from drivers.sim.axis import AxisSettings, WireAxis
from drivers.sim.heads import HeadModel, head_settings
from drivers.sim.motion import Motion
from drivers.sim.pan_tilt import SimulatedPanTilt

GAP = 0.004
AXIS = AxisSettings(0.001, GAP, -1.0, 1.0, 1.0, 2.0)
RINGING = AxisSettings(1e-5, 0.0, -1.5, 1.5, 1.0, 2.0, ring_hz=6.0, ring_damping=0.03)


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


def integrated_rad(motion: Motion, until_s: float, settings: AxisSettings) -> float:
    """The mode, stepped by SciPy with the motor's acceleration from differences of its velocity."""
    omega = math.tau * settings.ring_hz
    step_s = 1e-4

    def rates(time_s: float, state: np.ndarray) -> list[float]:
        acceleration = (motion.at(time_s + step_s)[1] - motion.at(time_s - step_s)[1]) / (2 * step_s)
        x, v = state
        return [v, -2 * settings.ring_damping * omega * v - omega**2 * x - settings.ring_gain * acceleration]

    span = motion.legs[0].start_s, until_s
    found = solve_ivp(rates, span, [0.0, 0.0], max_step=1e-3, rtol=1e-8, atol=1e-12)
    return float(found.y[0, -1])


@pytest.mark.parametrize("after_s", [0.1, 1.3])
def test_ringing_is_what_integration_of_the_mode_gives(after_s: float) -> None:
    axis = WireAxis(RINGING)
    axis.goal(1.0, 0.3, 1.0, 2.0)
    axis.goal(1.35, -0.1, 0.4, 3.0)  # turned round on the way: superposed, not begun again
    ahead = axis.mechanical_rad(1.35 + after_s) - axis.motion.at(1.35 + after_s)[0]
    expected = integrated_rad(axis.motion, 1.35 + after_s, RINGING)
    assert abs(expected) > 2e-5
    assert ahead == pytest.approx(expected, abs=2e-5)


HARMONICS = [[0.002, -0.001], [0.0004, 0.0007]]


@pytest.mark.parametrize("read", [-0.3, 1.0])
def test_an_encoder_reads_beside_the_truth_by_its_harmonics(read: float) -> None:
    """By the sum as the mast file's `joints` define it, written out."""
    clock = ManualClock(100.0)
    errs = {"preset": "ptu_d46_70", "pan_harmonics_rad": HARMONICS, "backlash_rad": 0.0}
    device = SimulatedPanTilt(head_settings(errs), clock)
    device.move(read, -0.2)
    settle(device, clock)
    said = device.read().pan_rad
    true = (
        said
        + 0.002 * math.cos(said) - 0.001 * math.sin(said)
        + 0.0004 * math.cos(2 * said) + 0.0007 * math.sin(2 * said)
    )  # fmt: skip
    assert device.true_joints(clock.now_s())[0] == pytest.approx(true, abs=1e-12)
    assert device.true_joints(clock.now_s())[1] == pytest.approx(device.read().tilt_rad, abs=6e-5)


def hanging(turnover_rad: float, friction: float) -> HeadModel:
    return head_settings(
        {
            "preset": "dynamixel_x", "count_rad": 1e-6, "backlash_rad": 0.004, "sag_rad": 0.0,
            "gravity_turnover_rad": turnover_rad, "gravity_friction": friction,
        }
    )  # fmt: skip


def stepped_load(goals: np.ndarray, gap: float, turnover: float, friction: float) -> float:
    """Play and gravity by small steps: pushed by a flank, then let go to where it is pulled."""
    load = goals[0] - gap / 2
    for shaft in goals:
        load = min(max(load, shaft - gap / 2), shaft + gap / 2)
        pull = math.sin(turnover - load)
        if pull > friction:
            load = shaft - gap / 2
        elif pull < -friction:
            load = shaft + gap / 2
    return float(load)


@pytest.mark.parametrize("seed", range(2))
def test_play_under_gravity_is_the_same_in_small_steps(seed: int) -> None:
    random = np.random.default_rng(seed)
    turnover, friction = random.uniform(-0.3, 0.3), random.uniform(0.02, 0.3)
    corners = random.uniform(-0.7, 0.7, 6)
    axis = WireAxis(hanging(turnover, friction).tilt, number=1, start_rad=corners[0])
    now_s = 0.0
    for goal in corners[1:]:
        axis.goal(now_s, goal, 1.0, 4.0)
        now_s = axis.end_s() + 0.5
    way = np.concatenate([np.linspace(a, b, 4000) for a, b in pairwise(corners)])
    expected = stepped_load(way, 0.004, turnover, friction)
    assert axis.mechanical_rad(now_s) == pytest.approx(expected, abs=1e-6), f"seed {seed}"
