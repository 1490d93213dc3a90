"""What a simulated head does as life does: ringing, a wrong encoder, play that gravity takes to one side."""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from drivers.clock import ManualClock
from drivers.sim.axis import AxisSettings, WireAxis
from drivers.sim.heads import HeadModel, head_settings
from drivers.sim.motion import Motion
from drivers.sim.pan_tilt import SimulatedPanTilt

AXIS = AxisSettings(1e-5, 0.0, -1.5, 1.5, 1.0, 2.0)
RINGING = replace(AXIS, ring_hz=6.0, ring_damping=0.03)


def integrated_rad(
    motion: Motion, until_s: float, settings: AxisSettings, kicks: dict[float, float]
) -> float:
    """The mode, stepped by SciPy with the motor's acceleration from differences of its velocity."""
    omega = math.tau * settings.ring_hz
    step_s = 1e-4

    def rates(time_s: float, state: np.ndarray) -> list[float]:
        faster = motion.at(time_s + step_s)[1] - motion.at(time_s - step_s)[1]
        acceleration = faster / (2 * step_s) if abs(faster) < 0.01 else 0.0  # a seizing is given as a kick
        x, v = state
        return [v, -2 * settings.ring_damping * omega * v - omega**2 * x - settings.ring_gain * acceleration]

    state, begin_s = [0.0, 0.0], motion.legs[0].start_s
    for end_s in (*sorted(kicks), until_s):
        found = solve_ivp(rates, (begin_s, end_s), state, max_step=1e-3, rtol=1e-8, atol=1e-12)
        state, begin_s = list(found.y[:, -1]), end_s
        state[1] -= settings.ring_gain * kicks.get(end_s, 0.0)
    return float(state[0])


@pytest.mark.parametrize("after_s", [0.1, 1.3])
def test_ringing_is_what_integration_of_the_mode_gives(after_s: float) -> None:
    axis = WireAxis(RINGING)
    axis.goal(1.0, 0.3, 1.0, 2.0)
    axis.goal(1.35, -0.1, 0.4, 3.0)  # turned round on the way: superposed, not begun again
    told = axis.mechanical_rad(1.35 + after_s) - axis.motion.at(1.35 + after_s)[0]
    expected = integrated_rad(axis.motion, 1.35 + after_s, RINGING, {})
    assert abs(expected) > 2e-5
    assert told == pytest.approx(expected, abs=2e-5)


def moved(head: HeadModel, goals: list[tuple[float, float]]) -> tuple[SimulatedPanTilt, ManualClock]:
    """A head that was sent somewhere and says it has arrived."""
    clock = ManualClock(100.0)
    device = SimulatedPanTilt(head, clock)
    for goal in goals:
        device.move(*goal)
        for _ in range(5000):
            if not device.read().moving:
                break
            clock.advance(0.002)
    return device, clock


HARMONICS = [[0.002, -0.001], [0.0004, 0.0007]]


@pytest.mark.parametrize("read", [-0.3, 1.0])
def test_an_encoder_reads_beside_the_truth_by_its_harmonics(read: float) -> None:
    """By the sum as the mast file's `joints` define it, written out."""
    device, clock = moved(
        head_settings({"preset": "ptu_d46_70", "pan_harmonics_rad": HARMONICS, "backlash_rad": 0.0}),
        [(read, -0.2)],
    )
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
