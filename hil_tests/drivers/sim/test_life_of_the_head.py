"""What a simulated head does as life does: ringing, a wrong encoder, play that gravity takes to one side."""

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
from drivers.faults import FaultPanel
from drivers.sim.axis import AxisSettings
from drivers.sim.heads import PRESETS, HeadSettings, head_settings
from drivers.sim.motion import Motion
from drivers.sim.pan_tilt import SimulatedPanTilt
from drivers.sim.wire.axis import WireAxis
from mastctl.devices.joint_history import RestWatch
from mastctl.motion.settings import PointingSettings

AXIS = AxisSettings(1e-5, 0.0, -1.5, 1.5, 1.0, 2.0)
RINGING = replace(AXIS, ring_hz=6.0, ring_damping=0.03)
NAVCAM_PX, PANCAM_PX = 1290.0, 3440.0


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


@pytest.mark.parametrize("after_s", [0.1, 0.4, 0.9, 1.3])
def test_ringing_is_what_integration_of_the_mode_gives(after_s: float) -> None:
    axis = WireAxis(RINGING)
    axis.goal(1.0, 0.3, 1.0, 2.0)
    axis.goal(1.35, -0.1, 0.4, 3.0)  # turned round on the way: superposed, not begun again
    told = axis.mechanical_rad(1.35 + after_s) - axis.motion.at(1.35 + after_s)[0]
    expected = integrated_rad(axis.motion, 1.35 + after_s, RINGING, {})
    assert abs(expected) > 2e-5
    assert told == pytest.approx(expected, abs=2e-5)


def test_a_head_that_seizes_rings_from_the_jolt() -> None:
    faults = FaultPanel(lambda: 0.0, ())
    axis = WireAxis(RINGING, faults)
    axis.goal(1.0, 1.0, 0.5, 2.0)
    faults.set("pan_tilt", "stuck", after_s=1.6)
    told = [axis.mechanical_rad(t) - axis.motion.at(t)[0] for t in (1.62, 1.65, 1.72)]
    expected = [integrated_rad(axis.motion, t, RINGING, {1.6: -0.5}) for t in (1.62, 1.65, 1.72)]
    assert max(map(abs, expected)) > 5e-3, "half a radian a second stopped at once is far worse than braking"
    assert told == pytest.approx(expected, abs=1e-4)


def test_the_past_and_the_future_ring_as_they_did_and_rest_is_rest_to_the_last_bit() -> None:
    axis = WireAxis(RINGING)
    axis.goal(1.0, 0.3, 1.0, 2.0)
    before = [axis.mechanical_rad(t) for t in (1.1, 1.9, 2.0)]
    late = axis.mechanical_rad(40.0)
    assert late == 0.3, "a head at rest gives the same picture again"
    axis.goal(41.0, 0.0, 1.0, 2.0)
    assert [axis.mechanical_rad(t) for t in (1.1, 1.9, 2.0)] == before


def moved(head: HeadSettings, goals: list[tuple[float, float]]) -> tuple[SimulatedPanTilt, ManualClock]:
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


def test_a_picture_as_soon_as_the_encoder_stands_is_off_and_settling_makes_it_good() -> None:
    """Naive: expose when the head no longer says that it moves. What helps: settle_s and the loop's dwell."""
    ringing = {"preset": "ptu_d46_70", "ring_hz": 8.0, "ring_damping": 0.04}
    device, clock = moved(head_settings(ringing), [(0.5, -0.3)])
    begun_s = clock.now_s()
    swing = [device.true_joints(begun_s + 0.001 * k)[0] for k in range(125)]
    assert np.ptp(swing) * PANCAM_PX > 1.5
    device, clock = moved(head_settings({**ringing, "settle_s": 2.0}), [(0.5, -0.3)])
    watch = RestWatch(PointingSettings().dwell_s)
    while not watch.rests(device.read()):
        clock.advance(0.02)
    settled = [device.true_joints(clock.now_s() + 0.001 * k)[0] for k in range(125)]
    assert np.ptp(settled) * PANCAM_PX < 0.1


def test_a_head_says_that_it_moves_while_it_settles_but_not_before_it_was_ever_moved() -> None:
    clock = ManualClock(5.0)
    device = SimulatedPanTilt(head_settings({"settle_s": 0.7}), clock)
    assert not device.read().moving
    device.move(0.2, 0.0)
    clock.advance(0.25)
    device.stop()  # a quarter of a second of braking
    clock.advance(0.93)
    assert device.read().moving
    clock.advance(0.04)
    assert not device.read().moving
    device.stop()
    assert not device.read().moving, "nothing turned, so nothing rings"


def test_the_encoder_does_not_see_the_ringing() -> None:
    device, clock = moved(head_settings({"preset": "ptu_d46_70", "ring_hz": 5.0}), [(0.4, 0.1)])
    readings = set()
    for _ in range(40):
        readings.add((device.read().pan_rad, device.read().tilt_rad))
        clock.advance(0.01)
    assert len(readings) == 1


HARMONICS = [[0.002, -0.001], [0.0004, 0.0007]]


@pytest.mark.parametrize("read", [-1.2, -0.3, 0.0, 0.25, 1.0])
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


def test_who_believes_the_reading_points_beside_by_pixels() -> None:
    device, clock = moved(
        head_settings({"preset": "ptu_d46_70", "pan_harmonics_rad": HARMONICS}), [(0.6, -0.2)]
    )
    off_px = (device.true_joints(clock.now_s())[0] - device.read().pan_rad) * NAVCAM_PX
    assert abs(off_px) > 2.0


def hanging(turnover_rad: float, friction: float) -> HeadSettings:
    return head_settings(
        {
            "preset": "dynamixel_x", "count_rad": 1e-6, "backlash_rad": 0.004, "sag_rad": 0.0,
            "gravity_turnover_rad": turnover_rad, "gravity_friction": friction,
        }
    )  # fmt: skip


def behind_rad(head: HeadSettings, goals: list[float]) -> float:
    """By how much the tilted load is above the reading."""
    device, clock = moved(head, [(0.0, goal) for goal in goals])
    return device.true_joints(clock.now_s())[1] - device.read().tilt_rad


@pytest.mark.parametrize(("way", "side"), [([-0.5], -1), ([0.0, -0.5], -1), ([0.5], 1), ([1.0, 0.5], 1)])
def test_gravity_takes_the_play_to_one_side_from_wherever_the_head_came(way: list[float], side: int) -> None:
    assert behind_rad(hanging(0.0, 0.1), way) == pytest.approx(side * 0.002, abs=1e-9)


@pytest.mark.parametrize(("way", "side"), [([-0.5, 0.05], -1), ([0.5, 0.05], 1)])
def test_near_the_turnover_friction_leaves_the_play_where_it_was_pushed(way: list[float], side: int) -> None:
    assert behind_rad(hanging(0.0, 0.1), way) == pytest.approx(side * 0.002, abs=1e-9)


def test_one_sided_approach_does_not_help_where_gravity_changes_sides() -> None:
    """A naive program comes from below everywhere and believes that the play is the same everywhere."""
    head = hanging(0.0, 0.1)
    head = replace(head, tilt=replace(head.tilt, approach_rad=0.01))
    below, above = behind_rad(head, [0.0, -0.4]), behind_rad(head, [0.0, 0.4])
    assert (above - below) * NAVCAM_PX == pytest.approx(0.004 * NAVCAM_PX, rel=1e-6)
    assert (above - below) * NAVCAM_PX > 5


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


@pytest.mark.parametrize("seed", range(6))
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


def test_all_of_it_at_once_with_a_fault_is_still_one_function_of_time() -> None:
    """Harmonics, gravity, ringing, a slow spell, a seizing: asked in any order, the answers are the same."""
    settings = replace(
        hanging(0.1, 0.1).tilt, harmonics_rad=((0.002, 0.001),), ring_hz=7.0, ring_damping=0.05, sag_rad=5e-5
    )

    def lived(questions: list[float]) -> list[float]:
        faults = FaultPanel(lambda: 0.0, ())
        faults.set("pan_tilt", "slow", factor=0.5, after_s=1.2, for_s=0.3)
        faults.set("pan_tilt", "stuck", after_s=2.0, for_s=1.0)
        axis = WireAxis(settings, faults, number=1)
        axis.goal(1.0, 0.5, 1.0, 2.0)
        for time_s in np.arange(1.0, 6.0, 0.01):
            axis.follow(float(time_s))
        return [axis.mechanical_rad(t) for t in questions]

    questions = list(np.linspace(0.9, 5.9, 41))
    assert lived(questions[::-1])[::-1] == lived(questions)
    assert np.isfinite(lived(questions)).all()


def test_with_nothing_set_the_head_is_what_it_was() -> None:
    for name, head in PRESETS.items():
        for axis in (head.pan, head.tilt):
            assert (axis.ring_hz, axis.harmonics_rad, axis.gravity_friction) == (0.0, (), 1.0), name


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"ring_hz": -1.0}, "ring_hz is -1.0, expected a number from 0 to 100"),
        ({"ring_hz": 1.0, "ring_damping": 0.01}, "ring_damping 0.01 at ring_hz 1 rings for .* least 0.048"),
        ({"ring_hz": math.nan}, "ring_hz is nan"),
        ({"ring_damping": 1.0}, "ring_damping is 1.0, expected a number from 0.001 to 0.9"),
        ({"pan_harmonics_rad": 0.1}, "pan_harmonics_rad is 0.1, expected up to 4 pairs"),
        ({"tilt_harmonics_rad": [[0.1, 0.0]]}, "tilt_harmonics_rad holds 0.1, expected up to 4 pairs"),
        ({"tilt_harmonics_rad": [[0.01]]}, r"tilt_harmonics_rad holds \[0.01\]"),
        ({"harmonics_rad": []}, "has no key 'harmonics_rad'"),
        ({"gravity_friction": 1.5}, "gravity_friction is 1.5, expected a number from 0 to 1"),
        ({"gravity_friction": 0.1, "gravity_turnover_rad": 3.0}, "would hang straight below the axis"),
        ({"settle_s": 6}, "settle_s is 6, expected a number from 0 to 5"),
    ],
)  # fmt: skip
def test_options_that_no_head_has_are_refused_in_words(options: dict[str, Any], words: str) -> None:
    with pytest.raises(BadOptions, match=words):
        head_settings({"preset": "ptu_d46_70", **options})
