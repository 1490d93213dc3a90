"""The offset between pictures and joints, from made-up motions whose truth is known; no pictures."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest

from mastctl.setup.sync_fit import CannotTell, JointMotion, OffsetFit, fit_offset


@dataclass(frozen=True)
class Rig:
    """What is made up: a trapezoid motion, its readings, and where patches are seen."""

    offset_s: float = 0.0
    play_rad: float = 0.0
    rolling_s: float = 0.0
    count_rad: float = 1e-5
    noise_px: float = 0.1
    rate_hz: float = 30.0
    seconds: float = 20.0
    scale: float = 1.0
    wild: float = 0.0
    speeds: tuple[float, ...] = (0.35, 0.14, 0.25)
    seed: int = 1


def motor(rig: Rig) -> tuple[np.ndarray, np.ndarray]:
    """Times and angles of the motor, every millisecond: ways to and fro with ramps and rests."""
    step_s, angles, velocity, angle, goal = 1e-3, [], 0.0, 0.0, 0.07
    number, rest = 0, 0
    for _ in range(int((rig.seconds + 3) / step_s)):
        speed = rig.speeds[number % len(rig.speeds)]
        left = goal - angle
        wanted = np.sign(left) * min(speed, np.sqrt(2 * abs(left)))
        velocity += np.clip(wanted - velocity, -step_s, step_s)  # 1 rad/s2
        angle += velocity * step_s
        if abs(left) < 5e-4 and abs(velocity) < 0.03:
            velocity, rest = 0.0, rest + 1
            if rest > 100:
                goal, number, rest = -goal, number + 1, 0
        angles.append(angle)
    return np.arange(len(angles)) * step_s, np.array(angles)


def geared(angles: np.ndarray, play_rad: float) -> np.ndarray:
    """What the gears make of it: the driven side is dragged along at half the play."""
    found, at = np.empty_like(angles), angles[0]
    for index, angle in enumerate(angles):
        at = min(max(at, angle - play_rad / 2), angle + play_rad / 2)
        found[index] = at
    return found


def measured(rig: Rig) -> OffsetFit:
    random = np.random.default_rng(rig.seed)
    times, angles = motor(rig)
    seen_from = geared(angles, rig.play_rad)
    read_s = np.sort(np.arange(0.0, times[-1], 0.02))
    read_s = np.sort(read_s + random.uniform(0, 0.008, len(read_s)))  # no reading comes like clockwork
    read_rad = np.round(np.interp(read_s, times, angles) / rig.count_rad) * rig.count_rad
    true_s = np.arange(1.0, rig.seconds, 1 / rig.rate_hz) + random.uniform(0, 0.033)
    rows = np.array([-0.4, -0.3, -0.1, 0.0, 0.1, 0.25, 0.35, 0.4])
    places = np.empty((len(true_s), len(rows)))
    for patch, row in enumerate(rows):
        q = np.interp(true_s + rig.rolling_s * row, times, seen_from) * rig.scale
        places[:, patch] = (700 + 40 * patch) * np.tan(q + 0.05 * patch) * (1 + 0.3 * q)
    places += random.normal(0, rig.noise_px, places.shape)
    places[random.random(places.shape) < 0.05] = np.nan
    wild = random.random(places.shape) < rig.wild
    places[wild] = random.uniform(-60, 60, int(wild.sum()))
    return fit_offset(JointMotion(read_s, read_rad), true_s - rig.offset_s, places, rows)


@pytest.mark.parametrize("offset_s", [-0.3, -0.012, 0.0, 0.0051, 0.25])
def test_the_offset_is_found_wherever_it_is(offset_s: float) -> None:
    fit = measured(Rig(offset_s=offset_s))
    assert abs(fit.offset_s - offset_s) < 3 * fit.sigma_s + 1e-5
    assert fit.sigma_s < 5e-4


@pytest.mark.parametrize(
    "rig",
    [
        Rig(offset_s=0.008, play_rad=0.00436, count_rad=0.00153),
        Rig(offset_s=0.008, rolling_s=0.030),
        Rig(offset_s=0.008, scale=1.05),
        Rig(offset_s=0.008, wild=0.1),
        Rig(offset_s=0.008, noise_px=1.0),
        Rig(offset_s=-0.020, rate_hz=4.0, seconds=60.0),
    ],
    ids=[
        "counts and play of a plain servo",
        "rolling shutter",
        "scale",
        "wild places",
        "noise",
        "few frames",
    ],
)
def test_what_a_real_head_and_camera_add_is_told_from_the_offset(rig: Rig) -> None:
    fit = measured(rig)
    assert abs(fit.offset_s - rig.offset_s) < 3 * fit.sigma_s + 5e-5
    assert fit.sigma_s < 5e-4
    assert fit.play_rad == pytest.approx(rig.play_rad, abs=4 * fit.play_sigma_rad + 1e-5)
    assert fit.rolling_s == pytest.approx(rig.rolling_s, abs=4 * (fit.rolling_sigma_s or 0.0) + 2e-4)


def test_pictures_that_do_not_move_with_the_joint_are_told() -> None:
    random = np.random.default_rng(3)
    times, angles = motor(Rig())
    stamps = np.arange(1.0, 20.0, 0.033)
    places = np.cumsum(random.normal(0, 3, (len(stamps), 4)), axis=0)
    with pytest.raises(CannotTell, match="did not move with the joint"):
        fit_offset(JointMotion(times[::20], angles[::20]), stamps, places, np.zeros(4))
