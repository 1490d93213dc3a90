"""Triangulation against known points, SciPy's minimum, cases worked by hand and Monte Carlo noise."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from calib.errors import NoStereoPoint
from calib.geometry.cahvor import CameraModel
from calib.geometry.stereo import triangulate

FORWARD, RIGHT, DOWN = np.eye(3)
FOCAL_PX = 1000.0
BASELINE_M = 0.2


def pinhole(y_m: float) -> CameraModel:
    """A 1001 x 801 camera of 1000 px looking ahead, y_m to the right of the origin."""
    H, V = FOCAL_PX * RIGHT + 500.0 * FORWARD, FOCAL_PX * DOWN + 400.0 * FORWARD
    return CameraModel("CAHV", (1001, 801), y_m * RIGHT, FORWARD, H, V)


LEFT, RIGHT_EYE = pinhole(-BASELINE_M / 2), pinhole(BASELINE_M / 2)


def wide_eye(y_m: float, turn_rad: float, kind: str) -> CameraModel:
    """A distorted camera that looks inwards and down; the entrance point of a CAHVORE one moves."""
    axes = Rotation.from_rotvec([0.0, -0.5, turn_rad]).as_matrix().T
    forward, right, down = axes
    lens_axis = forward + 0.004 * right - 0.003 * down
    return CameraModel(
        kind,  # type: ignore[arg-type]
        (640, 480),
        C=np.array([0.3, y_m, -0.6]),
        A=forward,
        H=309.0 * (right + 0.002 * down) + 322.0 * forward,
        V=310.0 * down + 236.0 * forward,
        O=lens_axis / np.linalg.norm(lens_axis),
        R=np.array([0.0, -0.02, 0.003]),
        E=np.array([0.004, 0.001, 0.0]),
        cahvore_type=2 if kind == "CAHVORE" else 0,
    )


KINDS = ("CAHV", "CAHVOR", "CAHVORE")


@pytest.mark.parametrize("kind", KINDS)
def test_projected_points_come_back(kind: str) -> None:
    left, right = wide_eye(-0.05, 0.02, kind), wide_eye(0.05, -0.03, kind)
    for point in ([1.5, 0.2, 0.5], [3.0, -1.0, 0.7], [10.0, 1.0, 0.3]):
        (left_px, _), (right_px, _) = left.project(point), right.project(point)
        seen = triangulate(left, right, left_px, right_px)
        np.testing.assert_allclose(seen.position_m, point, rtol=1e-9, atol=1e-9)
        assert seen.ray_gap_m < 1e-10
        # The range runs from the ray's own origin, which is not C for a moving entrance point.
        origin = left.ray(left_px).origins_m
        assert seen.ranges_m[0] == pytest.approx(np.linalg.norm(np.array(point) - origin), rel=1e-9)


def test_depth_worked_by_hand() -> None:
    # f B / disparity = 1000 * 0.2 / 40 = 5 m; the pair's middle is the origin.
    seen = triangulate(LEFT, RIGHT_EYE, [520.0, 400.0], [480.0, 400.0])
    np.testing.assert_allclose(seen.position_m, [5.0, 0.0, 0.0], atol=1e-12)


def test_range_sigma_worked_by_hand() -> None:
    # Z² sqrt(2) sigma / (f B), the paper's eq. (1) with the disparity of two pixels of sigma 0.2.
    seen = triangulate(LEFT, RIGHT_EYE, [520.0, 400.0], [480.0, 400.0], sigma_px=0.2)
    expected = 25.0 * math.sqrt(2.0) * 0.2 / (FOCAL_PX * BASELINE_M)
    assert math.sqrt(seen.covariance_m2[0, 0]) == pytest.approx(expected, rel=1e-3)
    # Down the image the two eyes average.
    assert math.sqrt(seen.covariance_m2[2, 2]) == pytest.approx(
        5.0 / FOCAL_PX * 0.2 / math.sqrt(2.0), rel=1e-3
    )


def test_ray_gap_of_pixels_on_different_rows() -> None:
    # One row apart at 5 m: rays pass each other by 5 m / 1000.
    seen = triangulate(LEFT, RIGHT_EYE, [520.0, 400.5], [480.0, 399.5])
    assert seen.ray_gap_m == pytest.approx(0.005, rel=1e-3)
    assert seen.position_m[2] == pytest.approx(0.0, abs=1e-6)


@pytest.mark.parametrize("kind", KINDS)
def test_midpoint_is_the_point_nearest_to_both_rays(kind: str) -> None:
    left, right = wide_eye(-0.05, 0.02, kind), wide_eye(0.05, -0.03, kind)
    left_px, right_px = np.array([330.0, 220.0]), np.array([290.0, 226.0])
    rays = left.ray(left_px), right.ray(right_px)

    def distances(point: np.ndarray) -> np.ndarray:
        return np.concatenate([np.cross(point - ray.origins_m, ray.directions) for ray in rays])

    seen = triangulate(left, right, left_px, right_px)
    best = least_squares(distances, seen.position_m + 0.1 * FORWARD, xtol=1e-15, ftol=1e-15, gtol=1e-15)
    np.testing.assert_allclose(seen.position_m, best.x, atol=1e-6)
    assert seen.ray_gap_m == pytest.approx(math.sqrt(2.0) * float(np.linalg.norm(best.fun)), rel=1e-6)


@pytest.mark.parametrize("kind", KINDS)
def test_covariance_agrees_with_monte_carlo(kind: str) -> None:
    seed, draws, sigma_px = 7, 2000, 0.05
    left, right = wide_eye(-0.05, 0.02, kind), wide_eye(0.05, -0.03, kind)
    point = np.array([2.0, 0.3, 0.6])
    left_px, right_px = (
        left.project(point)[0],
        right.project(point)[0] + [0.0, 1.0],
    )  # rays that miss each other
    noise = sigma_px * np.random.default_rng(seed).normal(size=(draws, 4))
    points = np.array([triangulate(left, right, left_px + n[:2], right_px + n[2:]).position_m for n in noise])
    told = triangulate(left, right, left_px, right_px, sigma_px).covariance_m2
    # In units of the told ellipsoid the spread is the unit matrix, to the scatter of a sample covariance.
    root = np.linalg.inv(np.linalg.cholesky(told))
    np.testing.assert_allclose(
        root @ np.cov(points.T) @ root.T, np.eye(3), atol=5.0 / math.sqrt(draws), err_msg=f"seed {seed}"
    )


@pytest.mark.parametrize("kind", KINDS)
def test_covariance_is_the_numeric_derivative(kind: str) -> None:
    left, right = wide_eye(-0.05, 0.02, kind), wide_eye(0.05, -0.03, kind)
    at = np.array([330.0, 220.0, 290.0, 226.0])

    def position(px: np.ndarray) -> np.ndarray:
        return triangulate(left, right, px[:2], px[2:]).position_m

    step = 1e-4
    numeric = np.array(
        [(position(at + step * e) - position(at - step * e)) / (2 * step) for e in np.eye(4)]
    ).T
    told = triangulate(left, right, at[:2], at[2:], sigma_px=0.3).covariance_m2
    np.testing.assert_allclose(told, 0.09 * numeric @ numeric.T, rtol=1e-5, atol=1e-8 * np.abs(told).max())


@pytest.mark.parametrize("kind", KINDS)
def test_rates_of_the_gap_are_those_of_the_rays(kind: str) -> None:
    eyes = wide_eye(-0.05, 0.02, kind), wide_eye(0.05, -0.03, kind)
    px = np.concatenate([eye.project([1.5, 0.2, 0.5])[0] for eye in eyes])

    def gap_m(px: np.ndarray) -> float:
        one, two = eyes[0].ray(px[:2]), eyes[1].ray(px[2:])
        normal = np.cross(one.directions, two.directions)
        return float((one.origins_m - two.origins_m) @ normal / np.linalg.norm(normal))

    steps = 1e-3 * np.eye(4)
    expected = [(gap_m(px + step) - gap_m(px - step)) / 2e-3 for step in steps]
    told = triangulate(*eyes, px[:2], px[2:]).gap_m_per_px
    np.testing.assert_allclose(told, expected, rtol=1e-5, atol=1e-10)


def test_parallel_rays_are_refused() -> None:
    with pytest.raises(NoStereoPoint) as refusal:
        triangulate(LEFT, RIGHT_EYE, [500.0, 400.0], [500.0, 400.0])
    assert refusal.value.code == "parallel_rays"


def test_diverging_rays_are_refused() -> None:
    with pytest.raises(NoStereoPoint) as refusal:
        triangulate(LEFT, RIGHT_EYE, [499.0, 400.0], [501.0, 400.0])
    assert refusal.value.code == "behind_camera"
    assert "-100 m along the left" in str(refusal.value)


@pytest.mark.parametrize("pixel", [[np.nan, 400.0], [520.0, np.inf], [520.0], 520.0])
def test_bad_pixels_are_refused_by_side(pixel: list[float]) -> None:
    with pytest.raises(NoStereoPoint, match="left pixel") as refusal:
        triangulate(LEFT, RIGHT_EYE, pixel, [480.0, 400.0])
    assert refusal.value.code == "bad_pixel"
    with pytest.raises(NoStereoPoint, match="right pixel"):
        triangulate(LEFT, RIGHT_EYE, [520.0, 400.0], pixel)


def test_pixel_without_a_ray_is_refused() -> None:
    with pytest.raises(NoStereoPoint, match="has no ray in this CAHVORE camera"):
        triangulate(wide_eye(-0.05, 0.0, "CAHVORE"), RIGHT_EYE, [5000.0, 240.0], [480.0, 400.0])
