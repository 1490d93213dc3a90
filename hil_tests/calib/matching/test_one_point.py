"""The one point of a position and several pixels, against SciPy's least squares."""

from __future__ import annotations

import numpy as np
from scipy.optimize import least_squares

from calib.matching.search import one_point
from hil_tests.calib.matching.textured_planes import Pinhole

CAMERAS = [
    Pinhole(np.array([0.0, y, -1.0]), 0.02 * y, -0.3, 700.0, (801, 601), roll)
    for y, roll in ((-0.1, 0.0), (0.2, 0.1))
]
BELIEVED = np.array([3.0, 0.1, 0.0])
SPREAD = np.diag([0.02, 0.01, 0.03]) ** 2


def test_point_covariance_and_misfit_are_those_of_least_squares() -> None:
    rng = np.random.default_rng(1)
    pixels = [c.pixel(BELIEVED + np.array([0.03, -0.01, 0.02])) + rng.normal(0.0, 0.7, 2) for c in CAMERAS]
    noise = [np.array([[0.5, 0.1], [0.1, 0.3]]), np.array([[0.2, 0.0], [0.0, 0.4]])]
    seen = [(c.model, p, n) for c, p, n in zip(CAMERAS, pixels, noise, strict=True)]
    found = one_point(BELIEVED, SPREAD, seen, 0.3)
    assert found is not None
    roots = [np.linalg.inv(np.linalg.cholesky(n + 0.09 * np.eye(2))) for n in noise]

    def rest(point: np.ndarray) -> np.ndarray:
        off = [root @ (c.pixel(point) - p) for root, c, p in zip(roots, CAMERAS, pixels, strict=True)]
        return np.concatenate([(point - BELIEVED) / np.sqrt(np.diag(SPREAD)), *off])

    fit = least_squares(rest, BELIEVED, jac="3-point", xtol=1e-14, ftol=1e-14)
    np.testing.assert_allclose(found.position_m, fit.x, atol=1e-8)
    np.testing.assert_allclose(found.covariance_m2, np.linalg.inv(fit.jac.T @ fit.jac), rtol=1e-4, atol=1e-9)  # type: ignore[operator]
    assert np.isclose(found.chi2, 2 * fit.cost, rtol=1e-6)


def test_a_point_behind_a_camera_is_none() -> None:
    seen = [(CAMERAS[0].model, np.array([400.0, 300.0]), np.eye(2))]
    assert one_point(np.array([-3.0, 0.0, 0.0]), 1e-6 * np.eye(3), seen, 0.3) is None
