"""Cameras of OpenCV's families against OpenCV itself, and the nearest cameras of one family to another."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from calib.files.opencv_camera import OpencvCamera
from calib.files.twin import nearest_cahvor, nearest_opencv, nearest_square, twin_error
from calib.geometry.cahvor import CameraModel
from calib.geometry.rigid import Rigid
from hil_tests.calib.geometry.camera_cases import plain

NUMERICAL_PX = 1e-9
PINHOLE = {
    "none": [],
    "radtan": [-0.31, 0.12, 0.001, -0.0007],
    "plumb_bob": [-0.31, 0.12, 0.001, -0.0007, 0.02],
    "rational": [0.4, 0.05, 0.001, -0.0007, 0.002, 0.75, 0.1, 0.005],
    "thin prism": [0.4, 0.05, 0.001, -0.0007, 0.002, 0.75, 0.1, 0.005, 0.001, -0.0002, -0.0008, 0.0003],
    "turned image": [-0.31, 0.12, 0.001, -0.0007, 0.02, *[0.0] * 7, 0.02, -0.03],
}
FISHEYE = [-0.03, 0.012, -0.004, 0.0006]


def camera(lens: Any, distortion: list[float], focal: float = 600.0) -> OpencvCamera:
    pose = Rigid(Rotation.from_rotvec([0.3, -1.1, 0.4]).as_matrix(), np.array([0.3, -0.2, 1.1]))
    return OpencvCamera(
        lens, (640, 480), np.array([focal, focal + 1.5]), np.array([317.0, 244.5]), np.array(distortion), pose
    )


def points_before(one: OpencvCamera, half_rad: float) -> np.ndarray:
    """Points (200, 3) in the frame, up to this far from the camera's z."""
    rng = np.random.default_rng(4)
    theta, phi, far = rng.uniform(0, half_rad, 200), rng.uniform(0, 2 * np.pi, 200), rng.uniform(0.5, 30, 200)
    across = np.sin(theta) * far
    return one.frame_from_camera.points(
        np.stack([across * np.cos(phi), across * np.sin(phi), np.cos(theta) * far], axis=1)
    )


def opencv_pixels(one: OpencvCamera, points: np.ndarray) -> np.ndarray:
    pose = one.frame_from_camera.inverse
    turn, move = cv2.Rodrigues(pose.rotation)[0], pose.translation_m
    if one.lens == "equidistant":
        seen, _ = cv2.fisheye.projectPoints(points[:, None], turn, move, one.matrix_px, one.distortion)
    else:
        seen, _ = cv2.projectPoints(points, turn, move, one.matrix_px, one.distortion)
    return np.asarray(seen).reshape(-1, 2)


@pytest.mark.parametrize("name", PINHOLE)
def test_a_pinhole_lens_projects_as_opencv_does(name: str) -> None:
    one = camera("pinhole", PINHOLE[name])
    points = points_before(one, 0.45)
    pixels, valid = one.project(points)
    assert valid.all()
    np.testing.assert_allclose(pixels, opencv_pixels(one, points), atol=NUMERICAL_PX)


def test_an_equidistant_lens_projects_as_opencvs_fisheye_does() -> None:
    one = camera("equidistant", FISHEYE, 250.0)
    points = points_before(one, 1.4)
    pixels, valid = one.project(points)
    assert valid.all()
    np.testing.assert_allclose(pixels, opencv_pixels(one, points), atol=NUMERICAL_PX)


@pytest.mark.parametrize("name", [*PINHOLE, "fisheye"])
def test_a_ray_goes_where_its_pixel_came_from(name: str) -> None:
    """The way back of OpenCV is an iteration that ends early; so the way there is turned round."""
    one = camera("equidistant", FISHEYE, 300.0) if name == "fisheye" else camera("pinhole", PINHOLE[name])
    x, y = np.meshgrid(np.linspace(-0.5, 639.5, 20), np.linspace(-0.5, 479.5, 15))
    pixels = np.stack([x.ravel(), y.ravel()], axis=1)
    rays = one.ray(pixels)
    assert rays.valid.all()
    np.testing.assert_allclose(np.linalg.norm(rays.directions, axis=1), 1.0)
    np.testing.assert_allclose(
        opencv_pixels(one, rays.origins_m + 3.0 * rays.directions), pixels, atol=NUMERICAL_PX
    )


def test_what_lies_behind_the_camera_or_beyond_the_fold_has_no_pixel_and_no_ray() -> None:
    one = camera("pinhole", [-0.4, 0.0, 0.0, 0.0])  # grows until 1 - 3 * 0.4 rho^2 = 0
    fold = np.sqrt(1.0 / 1.2)
    assert one.reach == pytest.approx(fold, abs=1e-3)
    ahead = np.array([[0.99 * fold, 0.0, 1.0], [1.02 * fold, 0.0, 1.0], [0.1, 0.0, -1.0]])
    _, valid = one.project(one.frame_from_camera.points(ahead))
    assert valid.tolist() == [True, False, False]
    edge = fold * (1.0 - 0.4 * fold**2) * 600.0
    rays = one.ray(np.array([[317.0 + 0.99 * edge, 244.5], [317.0 + 1.01 * edge, 244.5]]))
    assert rays.valid.tolist() == [True, False]
    assert np.isnan(rays.directions[1]).all()


@pytest.mark.parametrize("count", [1, 3, 6, 9, 20])
def test_a_lens_of_a_number_of_coefficients_that_opencv_has_not_is_refused(count: int) -> None:
    with pytest.raises(ValueError, match=f"{count} coefficients"):
        camera("pinhole", [0.0] * count)


def test_a_round_lens_has_an_exact_twin_both_ways() -> None:
    model = plain("CAHVOR", R=[0.0, -0.2, 0.05])
    there = nearest_opencv(model, "pinhole", [True] * 4)
    assert there.distortion.tolist() == pytest.approx([-0.2, 0.05, 0.0, 0.0], abs=1e-12)
    assert twin_error(model, there).worst_px < NUMERICAL_PX
    assert twin_error(there, nearest_cahvor(there)).worst_px < NUMERICAL_PX
    fisheye = plain("CAHVORE", R=[0.0, -0.02, 0.003])
    there = nearest_opencv(fisheye, "equidistant", [True] * 4)
    assert twin_error(fisheye, there).worst_px < NUMERICAL_PX
    back = nearest_cahvor(there)
    assert (back.kind, back.cahvore_type) == ("CAHVORE", 2)
    assert twin_error(there, back).worst_px < NUMERICAL_PX


@pytest.mark.parametrize(
    ("name", "within_px"),
    [("none", 1e-9), ("radtan", 0.5), ("plumb_bob", 0.5), ("rational", 0.5), ("turned image", 0.5)],
)
@pytest.mark.parametrize("decentred", [False, True])
def test_the_error_of_a_twin_of_the_cahv_family_is_what_is_told(
    name: str, within_px: float, decentred: bool
) -> None:
    """p1 and p2 have no place in it but O beside A; without them it comes within 0.05 px."""
    numbers = np.array(PINHOLE[name])
    if not decentred:
        numbers[2:4], within_px = 0.0, min(within_px, 0.05)
    one = camera("pinhole", numbers.tolist())
    twin = nearest_cahvor(one)
    error = twin_error(one, twin)
    assert error.worst_px < within_px
    # measured here again, at other pixels, with OpenCV in between
    rng = np.random.default_rng(1)
    pixels = rng.uniform([-0.5, -0.5], [639.5, 479.5], (300, 2))
    rays = twin.ray(pixels)
    seen = opencv_pixels(one, rays.origins_m + 50.0 * rays.directions)
    off = np.linalg.norm(seen - pixels, axis=1).max()
    assert off < 1.1 * error.worst_px + NUMERICAL_PX
    assert off > 0.2 * error.worst_px - NUMERICAL_PX


def test_a_skew_of_h_and_v_is_what_a_square_twin_misses_by() -> None:
    skew = 1e-3
    model = plain("CAHV", H=[500.0, 500.0 * skew, 319.5])
    square = nearest_square(model)
    across = square.H - (square.H @ square.A) * square.A
    down = square.V - (square.V @ square.A) * square.A
    assert abs(across @ down) < 1e-6
    # a turn by half the skew shares it out: x errs by skew y / 2, y by skew x / 2
    expected = 0.5 * skew * np.hypot(239.5 + 0.5, 319.5 + 0.5)
    assert twin_error(model, square).worst_px == pytest.approx(expected, rel=0.05)


def test_an_error_knows_of_a_camera_that_does_not_see_all_of_the_image() -> None:
    folding = camera("pinhole", [-0.4, 0.0, 0.0, 0.0], focal=300.0)
    error = twin_error(
        folding, CameraModel("CAHV", (640, 480), C=[0, 0, 0], A=[0, 0, 1], H=[9, 0, 1], V=[0, 9, 1])
    )
    assert 0.1 < error.blind < 0.9
    assert twin_error(plain("CAHV"), folding).worst_px == np.inf
