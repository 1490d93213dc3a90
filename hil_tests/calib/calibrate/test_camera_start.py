"""Where the fit of one camera starts, against points that OpenCV projects."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from calib.calibrate.starts.camera import pinhole
from calib.geometry.cahvor import Kind

FOCAL_PX, SIZE_PX = 400.0, (1280, 960)
MATRIX = np.array([[FOCAL_PX, 0, 639.5], [0, FOCAL_PX, 479.5], [0, 0, 1]])
TURN, SHIFT_M = np.array([0.3, -0.4, 1.1]), np.array([0.2, -0.1, 0.4])


def points_m() -> np.ndarray:
    """Points (n, 3) all around the camera's axis, up to 65 degrees from it."""
    rng = np.random.default_rng(3)
    theta, phi = np.radians(rng.uniform(0.0, 65.0, 40)), rng.uniform(-np.pi, np.pi, 40)
    rays = np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)], axis=1)
    return (rays * rng.uniform(1.0, 4.0, (40, 1)) - SHIFT_M) @ cv2.Rodrigues(TURN)[0]


@pytest.mark.parametrize(
    ("kind", "cahvore_type", "round_eye"),
    [("OPENCV_FISHEYE", 0, True), ("CAHVORE", 2, True), ("OPENCV5", 0, False), ("CAHV", 0, False)],
)
def test_a_start_without_noise_is_the_camera(kind: Kind, cahvore_type: int, round_eye: bool) -> None:
    points = points_m()
    project = cv2.fisheye.projectPoints if round_eye else cv2.projectPoints
    pixels = project(points[:, None], TURN, SHIFT_M, MATRIX, np.zeros(4))[0].reshape(-1, 2)
    found = pinhole(points, pixels, kind, SIZE_PX, FOCAL_PX, cahvore_type)
    assert found is not None
    np.testing.assert_allclose(found.C, -cv2.Rodrigues(TURN)[0].T @ SHIFT_M, atol=1e-6)
    np.testing.assert_allclose(found.project(points)[0], pixels, atol=1e-3)
