"""How far a camera model reaches: both sides of every bound, folds, rays that cross, numbers that are none.

The limits are worked out by hand (where a polynomial stops growing, where a tangent ends); whether a pixel is
right is asked of its ray: the point must lie ahead on it.
"""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import brentq

from calib.geometry.cahvor import CameraModel
from calib.geometry.lenses.round import RoundLens
from hil_tests.calib.geometry.camera_cases import CENTER_PX, KINDS, SIZE, at_angle, plain, random_model

PIXEL_PX = 1e-8

CASES = {
    # name: (model, the largest angle from O with a pixel)
    "CAHV": (plain("CAHV"), np.pi / 2),
    "CAHVOR": (plain("CAHVOR", R=[0, 0.1, 0]), np.pi / 2),
    # chi (1 - 0.3 chi^2) grows to chi = 1/sqrt(0.9)
    "CAHVOR fold": (plain("CAHVOR", R=[0, -0.3, 0]), np.arctan(1 / np.sqrt(0.9))),
    # 1 - 1.8 y + 0.5 y^2 = 0 first at y = 1.8 - sqrt(1.24); after the second root chi' grows again
    "CAHVOR fold and rise": (plain("CAHVOR", R=[0, -0.6, 0.1]), np.arctan(np.sqrt(1.8 - np.sqrt(1.24)))),
    "CAHVOR R0": (plain("CAHVOR", R=[0.25, -0.1, 0]), np.arctan(np.sqrt(1.25 / 0.3))),
    "CAHVOR R2 only": (plain("CAHVOR", R=[0, 0, -0.2]), np.pi / 4),
    "type 1": (plain("CAHVORE", cahvore_type=1), np.pi / 2),
    "type 2": (plain("CAHVORE", cahvore_type=2), np.pi),
    "type 2 fold": (plain("CAHVORE", cahvore_type=2, R=[0, -0.1, 0]), np.sqrt(1 / 0.3)),
    "linearity 0.8": (plain("CAHVORE", cahvore_type=3, linearity=0.8), np.pi / 1.6),
    "linearity -0.8": (plain("CAHVORE", cahvore_type=3, linearity=-0.8), np.pi / 1.6),
    "linearity -0.8 fold": (
        plain("CAHVORE", cahvore_type=3, linearity=-0.8, R=[0, -0.3, 0]),
        np.arcsin(0.8 / np.sqrt(0.9)) / 0.8,
    ),
    "linearity 0.4 fold": (
        plain("CAHVORE", cahvore_type=3, linearity=0.4, R=[0, -0.1, 0]),
        np.arctan(0.4 * np.sqrt(1 / 0.3)) / 0.4,
    ),
}


@pytest.mark.parametrize("name", CASES)
def test_a_lens_reaches_its_limit_and_not_beyond(name: str) -> None:
    model, limit_rad = CASES[name]
    inside = np.array([at_angle(t) for t in limit_rad - np.geomspace(1e-6, 0.5, 40)])
    outside = np.array([at_angle(t) for t in np.linspace(limit_rad + 1e-6, np.pi, 200) if t <= np.pi])
    pixels, valid = model.project(inside)
    assert valid.all() and np.isfinite(pixels).all()
    # farther from the axis is farther from the centre, all the way: nothing is seen twice
    assert (np.diff(np.hypot(*(pixels - CENTER_PX).T)) < 0).all()
    for points in (outside, -at_angle(0.0)[None], np.zeros((1, 3))):
        pixels, valid = model.project(points)
        assert not valid.any() and np.isnan(pixels).all()
        pixels, jacobian, valid = model.project_jacobian(points)
        assert not valid.any() and np.isnan(pixels).all() and np.isnan(jacobian).all()
    for point in [*outside[::20], [0.0, 0.0, 0.0]]:
        pixel, seen = model.project(point)
        assert not seen and np.isnan(pixel).all()


def test_a_point_beyond_the_fold_would_have_landed_in_the_image() -> None:
    chi = 1.6  # chi (1 - 0.3 chi^2) = 0.37: the bare polynomial puts it 186 px from the centre
    naive_px = 500 * chi * (1 - 0.3 * chi**2) + 319.5
    assert 0 < naive_px < SIZE[0]
    pixel, valid = plain("CAHVOR", R=[0, -0.3, 0]).project([chi, 0.0, 1.0])
    assert not valid and np.isnan(pixel).all()


@pytest.mark.parametrize(
    ("model", "largest", "theta_rad"),
    [
        (plain("CAHVOR", R=[0, -0.3, 0]), 2 / 3 / np.sqrt(0.9), np.arctan(1 / np.sqrt(0.9))),
        (plain("CAHVORE", R=[0, -0.1, 0]), 2 / 3 * np.sqrt(1 / 0.3), np.sqrt(1 / 0.3)),
        (plain("CAHVORE"), np.pi, np.pi),
        (plain("CAHVORE", cahvore_type=3, linearity=-0.8), 1.25, np.pi / 1.6),
    ],
)
def test_pixels_beyond_the_largest_slope_have_no_ray(
    model: CameraModel, largest: float, theta_rad: float
) -> None:
    slopes = largest * np.array([0.5, 0.999999, 1 - 1e-9, 1 + 1e-9, 1.5])
    pixels = np.stack([500 * slopes + 319.5, np.full(5, 239.5)], axis=-1)
    rays, d_direction, d_origin = model.ray_jacobian(pixels)
    assert rays.valid.tolist() == [True, True, True, False, False]
    assert all(np.isnan(array[3:]).all() for array in (*rays[:2], d_direction, d_origin))
    theta = np.arctan2(np.hypot(*rays.directions[:3, :2].T), rays.directions[:3, 2])
    assert (theta < theta_rad).all() and theta[2] > theta_rad - 0.002  # the root before the fold
    assert [bool(model.ray(pixel).valid) for pixel in pixels] == rays.valid.tolist()


def test_the_ray_before_the_fold_is_chosen() -> None:
    model = plain("CAHVOR", R=[0, -0.3, 0])
    for slope in np.linspace(0.01, 0.7, 30):
        chi = brentq(lambda c, s=slope: c * (1 - 0.3 * c * c) - s, 0.0, 1 / np.sqrt(0.9))
        for pixels in ([500 * slope + 319.5, 239.5], [[500 * slope + 319.5, 239.5]] * 2):
            direction = model.ray(pixels).directions.reshape(-1, 3)[0]
            assert np.allclose(direction, np.array([chi, 0, 1]) / np.hypot(chi, 1), atol=1e-10, rtol=0)


def test_behind_means_behind_a_and_behind_o() -> None:
    tilt = 0.2
    model = plain("CAHVOR", O=[np.sin(tilt), 0, np.cos(tilt)])
    points = np.array([[5 * np.cos(a), 0, 5 * np.sin(a)] for a in np.linspace(-np.pi, np.pi, 721)])
    _, valid = model.project(points)
    ahead = (points[:, 2] > 1e-9) & (points @ model.O > 1e-9)
    assert np.array_equal(valid, ahead)
    rays = model.ray(np.random.default_rng(2).uniform(-1e6, 1e6, (500, 2)))
    assert (rays.directions[rays.valid] @ model.A > 0).all()
    assert (rays.directions[rays.valid] @ model.O > 0).all()


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf, 1e308, -1e308])
def test_numbers_that_are_not_finite_have_no_image(kind: str, bad: float) -> None:
    model = plain(kind, R=[0, 0.1, 0.1], E=[0.01, 0.02, 0.03])
    for place in range(3):
        point = np.array([0.1, 0.2, 1.0])
        point[place] = bad
        if kind == "CAHV" and place == 2 and bad == 1e308:
            continue  # a point far ahead
        for points in (point, point[None]):
            pixels, valid = model.project(points)
            assert np.isfinite(pixels).all() if valid.all() else np.isnan(pixels).all()
            assert not valid.any() or np.isfinite(bad)
    for pixels in ([bad, 1.0], [1.0, bad], [[bad, 1.0]], [[1.0, bad]]):  # type: ignore[assignment]
        rays = model.ray(pixels)
        assert np.isfinite(rays.directions).all() if rays.valid.all() else np.isnan(rays.directions).all()
        assert not rays.valid.any() or np.isfinite(bad)


def test_one_bad_row_spoils_no_other() -> None:
    model = plain("CAHVORE", R=[0, 0.05, 0], E=[0.01, 0.02, 0.0])
    points = np.random.default_rng(3).uniform([-1, -1, 1], [1, 1, 3], (9000, 3))
    expected, _ = model.project(points)
    points[::7] = np.nan
    points[3::7] = [0, 0, -1]
    pixels, valid = model.project(points)
    good = np.ones(9000, dtype=bool)
    good[::7] = good[3::7] = False
    assert np.array_equal(valid, good)
    assert np.allclose(pixels[good], expected[good], atol=PIXEL_PX, rtol=0)


def rays_through(model: CameraModel, point: np.ndarray, theta_rad: np.ndarray) -> int:
    """How many rays of the image pass through a point, counted from the rays' own geometry."""
    pixels = np.stack([500 * theta_rad + 319.5, np.full(len(theta_rad), 239.5)], axis=-1)
    rays = model.ray(pixels)
    to_point = point - rays.origins_m
    side = rays.directions[:, 2] * to_point[:, 0] - rays.directions[:, 0] * to_point[:, 2]
    ahead = (rays.directions * to_point).sum(axis=1) > 0
    change = (side[:-1] > 0) & (side[1:] <= 0) | (side[:-1] <= 0) & (side[1:] > 0)
    return int((change & ahead[:-1] & ahead[1:]).sum())


def test_points_where_rays_cross_have_no_pixel_and_others_their_own() -> None:
    """A fisheye whose entrance point runs ahead by 25 mm at the edge: its rays cross within centimetres."""
    model = plain("CAHVORE", size_px=(1400, 480), H=[500, 0, 319.5], E=[0.02, 0.02, 0.0])
    edge_rad = (1399.5 - 319.5) / 500
    fine = np.linspace(1e-3, np.hypot(edge_rad, 240 / 500), 20001)  # to the corner: the rule is round
    crossed = kept = 0
    for theta in np.linspace(0.3, edge_rad - 0.05, 9):
        pixel = np.array([500 * theta + 319.5, 239.5])
        ray = model.ray(pixel)
        for range_m in np.geomspace(1e-3, 2.0, 30):
            point = ray.origins_m + range_m * ray.directions
            count = rays_through(model, point, fine)
            again, valid = model.project(point)
            many, many_valid = model.project(np.stack([point, point]))
            assert many_valid.tolist() == [bool(valid)] * 2
            if valid:
                assert np.abs(again - pixel).max() <= 1e-6
                assert np.abs(many - pixel).max() <= 1e-6
                assert count == 1
                kept += 1
            else:
                assert count > 1
                crossed += 1
    assert crossed > 50 and kept > 50


@pytest.mark.parametrize("kind", KINDS)
def test_a_pixel_is_only_given_to_points_on_its_ray(kind: str) -> None:
    """Points in every direction and at every range: those with a pixel lie ahead on its ray."""
    rng = np.random.default_rng(4)
    seen = 0
    for number in range(60):
        model = random_model(rng, kind)
        points = model.C + rng.normal(size=(400, 3)) * 10.0 ** rng.uniform(-2.5, 2.0, (400, 1))
        pixels, valid = model.project(points)
        assert np.isfinite(pixels[valid]).all() and np.isnan(pixels[~valid]).all()
        # Nearer to a right angle from O slopes lose their digits: up to ten images away it must hold.
        tame = valid & (np.abs(pixels) < 5e3).all(axis=1)
        rays = model.ray(pixels[tame])
        assert rays.valid.all(), f"model {number} of seed 4"
        to_point = points[tame] - rays.origins_m
        ranges = (to_point * rays.directions).sum(axis=1)
        gap = np.linalg.norm(to_point - ranges[:, None] * rays.directions, axis=1)
        assert (ranges > 0).all(), f"model {number} of seed 4"
        assert (gap <= 1e-9 * (ranges + 0.01)).all(), f"model {number} of seed 4"
        seen += int(tame.sum())
    assert seen > 4000


@pytest.mark.parametrize("kind", KINDS)
def test_every_pixel_of_the_image_sees_far_points_on_its_ray(kind: str) -> None:
    rng = np.random.default_rng(5)
    for number in range(60):
        model = random_model(rng, kind)
        pixels = rng.uniform(-0.5, np.array(SIZE) - 0.5, (300, 2))
        rays = model.ray(pixels)
        pixels, points = pixels[rays.valid], (rays.origins_m + 20.0 * rays.directions)[rays.valid]
        again, valid = model.project(points)
        assert valid.all(), f"model {number} of seed 5"
        assert (np.abs(again - pixels) <= 1e-6).all(), f"model {number} of seed 5"


def test_the_search_finds_the_ray_of_a_point_that_was_laid_on_it() -> None:
    """As published: the entrance point lies (theta / sin theta - 1) (e0 + e1 theta^2 + ...) from C."""
    for e in ((0.02, 0.0, 0.0), (0.02, -0.01, 0.004)):
        model = plain("CAHVORE", E=list(e))
        theta = np.linspace(0.02, 0.6, 30)
        entrance_m = (theta / np.sin(theta) - 1.0) * (e[0] + e[1] * theta**2 + e[2] * theta**4)
        for range_m in (0.05, 2.0):
            lam, w = range_m * np.sin(theta), entrance_m + range_m * np.cos(theta)
            assert isinstance(model.lens, RoundLens)
            found = model.lens.entrance.search(lam, w)
            assert np.abs(found - theta).max() < 1e-11, (e, range_m)
