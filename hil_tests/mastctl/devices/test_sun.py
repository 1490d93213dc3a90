"""The sun's cone as boxes: against every pose of a fine grid, turned by SciPy's rotations."""

from __future__ import annotations

import math
import random
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from calib.geometry.cahvor import CameraModel
from calib.geometry.rig import Mast, Rig, RigCamera
from mastctl.devices.judge import ROWS, direction_of, sun_boxes
from mastctl.devices.keep_out import TOUCH_RAD

TILTS = (-1.2, 1.2)


def camera(yaw_rad: float, pitch_rad: float) -> CameraModel:
    """A camera of the head that looks aside by these angles."""
    turned = Rotation.from_euler("zy", [yaw_rad, pitch_rad]).as_matrix()
    forward, right, down = turned.T
    return CameraModel(
        "CAHV", (101, 101), np.zeros(3), forward, 100 * right + 50 * forward, 100 * down + 50 * forward
    )


def rig_of(rng: random.Random) -> Rig:
    rotation = [rng.uniform(-0.3, 0.3) for _ in range(3)]
    mast = Mast(np.array([0.3, 0.0, -1.4]), np.array(rotation), 0.05, rng.uniform(-0.2, 0.2))
    cameras = {
        f"c{n}": RigCamera("head", camera(rng.uniform(-0.3, 0.3), rng.uniform(-0.3, 0.3))) for n in (1, 2)
    }
    return Rig("rig", mast, {**cameras, "hazcam": RigCamera("rover", camera(1.0, 0.0))})


def least_angles(rig: Rig, sun: np.ndarray, pans: np.ndarray, tilts: np.ndarray) -> np.ndarray:
    """The least angle between any head camera and the sun, (pans, tilts), by the contract."""
    x, y, z = rig.mast.rotation_rad
    fixed = Rotation.from_euler("x", x) * Rotation.from_euler("y", y) * Rotation.from_euler("z", z)
    angles = np.full((len(pans), len(tilts)), math.inf)
    for one in rig.cameras.values():
        if one.on != "head":
            continue
        for j, tilt in enumerate(tilts):
            moving = Rotation.from_euler("x", rig.mast.axis_twist_rad) * Rotation.from_euler("y", tilt)
            axes = (Rotation.from_euler("z", pans[:, None]) * moving).apply(np.array(one.model.A))
            cosines = np.clip(fixed.apply(axes) @ sun, -1.0, 1.0)
            angles[:, j] = np.minimum(angles[:, j], np.arccos(cosines))
    return angles


@pytest.mark.parametrize("seed", range(12))
def test_the_boxes_hold_the_cone_and_little_beyond_it(seed: int) -> None:
    rng = random.Random(seed)
    rig = rig_of(rng)
    half_angle = rng.choice((0.02, 0.1, 0.4, 1.2))
    sun = np.array(direction_of(rng.uniform(-7, 7), rng.uniform(-1.0, 1.5)))
    boxes = [copy for box in sun_boxes(rig, sun, half_angle, TILTS) for copy in box.within((-4.5, 4.5))]
    pans = np.linspace(-4.4, 4.4, 241)
    edges = [edge for box in boxes for edge in box.tilt_rad]  # no crack between two rows
    between = [(one + other) / 2 for one, other in pairwise(sorted(edges)) if other - one < 1e-4]
    between = [tilt for tilt in between if TILTS[0] < tilt < TILTS[1]]
    tilts = np.array([*np.linspace(-1.19, 1.19, 121), *between])
    angles = least_angles(rig, sun, pans, tilts)
    held = np.zeros(angles.shape, dtype=bool)
    for box in boxes:
        held |= ((pans > box.pan_rad[0]) & (pans < box.pan_rad[1]))[:, None] & (
            (tilts > box.tilt_rad[0] + TOUCH_RAD) & (tilts < box.tilt_rad[1] - TOUCH_RAD)
        )[None, :]
    assert held[angles <= half_angle].all()
    row = max(2 * half_angle / ROWS, 0.004)
    assert not held[angles > half_angle + row + 1e-5].any()


def test_a_body_camera_keeps_nothing_out() -> None:
    rig = rig_of(random.Random(1))
    body = replace(rig, cameras={"hazcam": rig.cameras["hazcam"]})
    assert sun_boxes(body, np.array([1.0, 0.0, 0.0]), 0.3, TILTS) == ()


def test_azimuth_goes_from_forward_to_the_right_and_elevation_up() -> None:
    assert direction_of(0.0, 0.0) == pytest.approx((1.0, 0.0, 0.0))
    assert direction_of(math.pi / 2, 0.0) == pytest.approx((0.0, 1.0, 0.0))
    assert direction_of(0.3, math.pi / 2) == pytest.approx((0.0, 0.0, -1.0), abs=1e-12)
