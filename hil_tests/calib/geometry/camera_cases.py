"""Cameras for the tests of the camera models: a plain one with hand-worked numbers, and random ones."""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from calib.geometry.cahvor import CameraModel

SIZE = (640, 480)
H = [500.0, 0.0, 319.5]
V = [0.0, 500.0, 239.5]
CENTER_PX = [319.5, 239.5]


def plain(kind: str, **other: Any) -> CameraModel:
    """A camera at the origin that looks along z, x right, y down, 500 px to the radian."""
    arguments = {"size_px": SIZE, "C": [0, 0, 0], "A": [0, 0, 1], "H": H, "V": V} | other
    if kind == "CAHVORE":
        arguments = {"cahvore_type": 2} | arguments
    return CameraModel(kind, **arguments)


def at_angle(theta_rad: float, range_m: float = 5.0, around_rad: float = 0.4) -> np.ndarray:
    """A point this far from the z axis in angle."""
    across = np.sin(theta_rad) * np.array([np.cos(around_rad), np.sin(around_rad)])
    return range_m * np.array([*across, np.cos(theta_rad)])


def random_model(rng: np.random.Generator, kind: str) -> CameraModel:
    """A camera anywhere: skewed H and V, off-centre, lens axis off A, strong lens terms of both signs."""
    cahvore_type = int(rng.integers(1, 4)) if kind == "CAHVORE" else 0
    right, down, ahead = Rotation.random(random_state=rng).as_matrix()
    axis = ahead + 0.03 * (rng.normal() * right + rng.normal() * down)
    focal = rng.uniform(300.0, 3000.0)
    return CameraModel(
        kind,
        SIZE,
        C=rng.normal(size=3),
        A=ahead,
        H=focal * (right + 0.01 * rng.normal() * down) + (319.5 + 20 * rng.normal()) * ahead,
        V=focal * rng.choice([-1.0, 1.0]) * down + (239.5 + 20 * rng.normal()) * ahead,
        O=axis / np.linalg.norm(axis),
        R=rng.normal(size=3) * [1e-3, 0.2, 0.1],
        E=rng.normal(size=3) * 10.0 ** rng.uniform(-5.0, -1.5),
        cahvore_type=cahvore_type,
        linearity=float(rng.uniform(-1.2, 1.2)),
    )


KINDS = ("CAHV", "CAHVOR", "CAHVORE")
