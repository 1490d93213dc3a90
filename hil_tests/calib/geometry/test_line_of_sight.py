"""What one camera knows of a range: against a pinhole's geometry, written out for the pointing tests."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from calib.errors import CalibError
from calib.geometry.covariance import RigCovariance
from calib.geometry.line_of_sight import FARTHEST_M, Sight, range_to_plane, seen_from, shown, unknown_range
from calib.geometry.rig import AxisJoint, JointErrors
from hil_tests.mastctl.motion.pointing_world import rig, true_camera

EYE = "navcam_left"
EXACT = RigCovariance((), np.zeros((0, 0)))
MATCH_PX = 0.1
HERE, THERE = (0.3, -0.4), (-0.2, -0.3)


def placed(range_m: float, pixel: tuple[float, float] = (200.0, 90.0)) -> np.ndarray:
    """A point at a range along a pixel's ray, by the test's own pinhole."""
    camera = true_camera(EYE, *HERE)
    direction = camera.rays(np.array(pixel))
    return np.asarray(camera.position_m + range_m * direction / np.linalg.norm(direction))


def test_a_told_range_says_where_another_view_shows_the_thing() -> None:
    for range_m in (1.5, 6.0, 40.0):
        sight = Sight(EYE, HERE, np.array([200.0, 90.0]), 1.0 / range_m, 0.0)
        np.testing.assert_allclose(sight.position_m(rig()), placed(range_m), atol=1e-9)
        expected = seen_from(rig(), sight, EYE, THERE, sigma_px=MATCH_PX, calibration=EXACT)
        np.testing.assert_allclose(
            expected.pixel_px, true_camera(EYE, *THERE).pixel(placed(range_m)), atol=1e-6
        )
        assert sight.range_interval_m == pytest.approx((range_m, range_m))


def test_the_line_of_an_unknown_range_ends_at_infinity() -> None:
    inverse, sigma = unknown_range(1.0)
    sight = Sight(EYE, HERE, np.array([200.0, 90.0]), inverse, sigma)
    assert sight.range_interval_m == (pytest.approx(1.0), None)
    expected = seen_from(rig(), sight, EYE, THERE, sigma_px=MATCH_PX, calibration=EXACT)
    whole = expected.whole_px2(sigma)
    for range_m in (1.05, 2.0, 5.0, 1e3):
        off = true_camera(EYE, *THERE).pixel(placed(range_m)) - expected.pixel_px
        assert off @ np.linalg.solve(whole, off) < 5.99
    off = true_camera(EYE, *THERE).pixel(placed(0.6)) - expected.pixel_px
    assert off @ np.linalg.solve(whole, off) > 5.99, "nearer than that is not likely"


def test_parallax_tells_the_range_as_surely_as_it_says() -> None:
    rng, held, sigmas, trials = np.random.default_rng(4), 0, [], 300
    for _ in range(trials):
        range_m = 1.0 / rng.normal(0.3, 0.05)
        point = placed(range_m)
        clicked = true_camera(EYE, *HERE).pixel(point) + rng.normal(0.0, MATCH_PX, 2)
        found = true_camera(EYE, *THERE).pixel(point) + rng.normal(0.0, MATCH_PX, 2)
        sight = Sight(EYE, HERE, clicked, *unknown_range(1.0))
        expected = seen_from(rig(), sight, EYE, THERE, sigma_px=MATCH_PX, calibration=EXACT)
        then = shown(rig(), sight, EYE, THERE, found, expected, MATCH_PX)
        near, far = then.range_interval_m
        from_there = float(np.linalg.norm(point - true_camera(EYE, *THERE).position_m))
        held += near <= from_there <= (far or math.inf)
        sigmas.append(then.inverse_sigma_m)
    assert 0.91 <= held / trials <= 0.985
    assert np.mean(sigmas) < 0.1 * unknown_range(1.0)[1], "it told something"


def test_a_camera_that_has_not_moved_tells_nothing_about_the_range() -> None:
    sight = Sight(EYE, HERE, np.array([200.0, 90.0]), *unknown_range(1.0))
    expected = seen_from(rig(), sight, EYE, HERE, sigma_px=MATCH_PX)
    then = shown(rig(), sight, EYE, HERE, np.array([200.05, 90.0]), expected, MATCH_PX)
    assert then.inverse_sigma_m == pytest.approx(sight.inverse_sigma_m, rel=1e-6)
    assert np.abs(expected.covariance_px2 - MATCH_PX**2 * np.eye(2)).max() < 1e-4, (
        "one pose: nothing else errs"
    )


def test_what_readings_and_mast_file_do_not_know_makes_parallax_worth_less() -> None:
    sight = Sight(EYE, HERE, np.array([200.0, 90.0]), *unknown_range(1.0))
    told = JointErrors(AxisJoint(((0.001, 0.0),)), AxisJoint())
    pan_only = RigCovariance(("joints.pan.s1",), np.array([[9e-6]]))
    sigmas = []
    for sigma_rad, known, of in (
        ((0.0, 0.0), EXACT, rig()),
        ((4e-4, 4e-4), EXACT, rig()),
        ((0.0, 0.0), None, rig()),
        ((0.0, 0.0), pan_only, replace(rig(), joints=told)),
    ):
        expected = seen_from(of, sight, EYE, THERE, sigma_px=MATCH_PX, sigma_rad=sigma_rad, calibration=known)
        found = true_camera(EYE, *THERE).pixel(placed(4.0))
        sigmas.append(shown(of, sight, EYE, THERE, found, expected, MATCH_PX).inverse_sigma_m)
    assert min(sigmas[1:]) > 1.1 * sigmas[0]


def test_a_plane_tells_the_range_and_one_that_is_missed_is_refused() -> None:
    pixel = np.array([200.0, 90.0])
    level = np.array([0.0, 0.0, 1.0])
    range_m = range_to_plane(rig(), EYE, HERE, pixel, np.zeros(3), level)
    assert placed(range_m)[2] == pytest.approx(0.0, abs=1e-9)
    with pytest.raises(CalibError, match="does not meet the plane"):
        range_to_plane(rig(), EYE, HERE, pixel, np.array([0.0, 0.0, -5.0]), level)


def test_no_range_is_told_beyond_the_farthest() -> None:
    sight = Sight(EYE, HERE, np.array([200.0, 90.0]), 0.0, 0.01)
    assert sight.range_m == pytest.approx(FARTHEST_M) and sight.range_interval_m[1] is None
