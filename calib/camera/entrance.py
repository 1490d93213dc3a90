"""The ray through a point, for a CAHVORE lens whose entrance point moves along O with the ray's angle.

Letters as in `calib.camera.lens`. Given lambda and zeta of points (n,), wanted is theta with f(theta) = 0, on
the side where f grows, and only if no second ray of the image passes through the point.
"""

from __future__ import annotations

import numpy as np

from calib.camera.lens import NEAREST_M, SETTLED, Lens
from calib.rigid import FloatArray

_SMALL_TURN_RAD = 0.02
"""Up to here a sine by its series to the fifth power is exact to rounding."""

_NODES = 257
"""Angles at which the slow search for a ray looks for a change of sign."""


def ray_angle(
    lens: Lens, lam: FloatArray, w: FloatArray, derivatives: bool
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray, np.ndarray]:
    """Return theta of the ray through points, its sine and cosine, f'(theta), and where that is right.

    Newton on the turn from the direction seen from C, whose sine and cosine need no trigonometry: with
    g = s sin(theta) the condition reads f = rho sin(turn) - g = 0.
    """
    rho = np.sqrt(lam * lam + w * w)
    start = np.arctan2(lam, w)
    per_rho = 1.0 / rho
    sine_start, cosine_start = lam * per_rho, w * per_rho
    if not lens.moving:
        return start, sine_start, cosine_start, rho, (rho > NEAREST_M) & (rho < np.inf)
    theta, sine, cosine = start, sine_start, cosine_start
    rise = _lag_over_range(lens, theta, sine, cosine, per_rho)
    slope = 1.0 - rise[1]
    turn = rise[0] / slope
    for _ in range(8):
        theta = start + turn
        if np.abs(turn).max() < _SMALL_TURN_RAD:
            y = turn * turn
            sine_turn = y * (1.0 / 120.0)
            sine_turn -= 1.0 / 6.0
            sine_turn *= y
            sine_turn += 1.0
            sine_turn *= turn
            cosine_turn = np.sqrt(1.0 - sine_turn * sine_turn)
            sine = sine_start * cosine_turn
            sine += cosine_start * sine_turn
            cosine = cosine_start * cosine_turn
            cosine -= sine_start * sine_turn
        else:
            sine_turn, cosine_turn, sine, cosine = np.sin(turn), np.cos(turn), np.sin(theta), np.cos(theta)
        rise = _lag_over_range(lens, theta, sine, cosine, per_rho)
        slope = np.subtract(cosine_turn, rise[1], out=cosine_turn)
        sine_turn -= rise[0]
        step = np.divide(sine_turn, slope, out=sine_turn)
        turn -= step
        if np.abs(step, out=step).max() < SETTLED:
            break
    theta = start + turn
    settled = step < SETTLED
    settled &= slope > 0.0
    settled &= lam > NEAREST_M * sine

    # With f(theta_image) > 0 the ray is inside the image; what Newton did not find there, or may have
    # found twice because rays cross so near the lens, is searched for.
    edge = lens.theta_image_rad
    edge_lag = (edge - np.sin(edge)) * (lens.e[0] + edge**2 * (lens.e[1] + edge**2 * lens.e[2]))
    unsure = w * np.sin(edge) - lam * np.cos(edge) > edge_lag
    unsure &= ~(settled & (theta > 0.0) & (theta <= edge))
    if lens.near_m > 0.0:
        unsure |= rho <= lens.near_m
    if unsure.any():
        found = angle_by_search(lens, lam[unsure], w[unsure])
        theta[unsure] = found
        settled[unsure] = found > 0.0  # not a number where none was found
        if derivatives:
            sine, cosine = np.sin(theta), np.cos(theta)
            slope = np.cos(theta - start) - _lag_over_range(lens, theta, sine, cosine, per_rho)[1]
    slope *= rho
    return theta, sine, cosine, slope, settled


def _lag_over_range(
    lens: Lens, theta: FloatArray, sine: FloatArray, cosine: FloatArray, per_rho: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return g/rho and g'/rho, with g = (theta - sin theta) (e0 + e1 theta^2 + e2 theta^4)."""
    e0, e1, e2 = lens.e
    y = theta * theta
    e = y * e2
    rate = e * 4.0
    e += e1
    e *= y
    e += e0
    e *= per_rho
    lag = theta - sine
    rate += 2.0 * e1
    rate *= theta
    rate *= lag
    rate *= per_rho
    rate += e
    rate -= cosine * e
    e *= lag
    return e, rate


def angle_by_search(lens: Lens, lam: FloatArray, w: FloatArray) -> FloatArray:
    """Return the smallest theta of a ray through points (n,), found by its change of sign.

    Not-a-number where there is none, and where two rays of the image pass through the point.
    """
    e0, e1, e2 = lens.e

    def miss(theta: FloatArray, lam: FloatArray, w: FloatArray) -> FloatArray:
        y, sine = theta * theta, np.sin(theta)
        return np.asarray(w * sine - lam * np.cos(theta) - (theta - sine) * (e0 + y * (e1 + y * e2)))

    nodes = np.linspace(0.0, lens.theta_limit_rad, _NODES)
    positive = miss(nodes, lam[:, None], w[:, None]) > 0.0
    rising = ~positive[:, :-1] & positive[:, 1:]
    cell = rising.argmax(axis=1)
    low, high = nodes[cell], nodes[cell + 1]
    for _ in range(50):
        middle = 0.5 * (low + high)
        beyond = miss(middle, lam, w) > 0.0
        low, high = np.where(beyond, low, middle), np.where(beyond, middle, high)
    theta = 0.5 * (low + high)
    y, sine, cosine = theta * theta, np.sin(theta), np.cos(theta)
    slope = w * cosine + lam * sine - (1.0 - cosine) * (e0 + y * (e1 + y * e2))
    slope -= (theta - sine) * theta * (2.0 * e1 + (4.0 * e2) * y)
    theta -= np.clip(miss(theta, lam, w) / slope, -1e-12, 1e-12)  # the last digits of a small angle
    changes = (positive[:, :-1] != positive[:, 1:]) & (nodes[:-1] < lens.theta_image_rad)
    twice = np.count_nonzero(changes, axis=1) > 1
    lost = twice | ~rising.any(axis=1) | ~(slope > 0.0) | ~(lam > NEAREST_M * np.sin(theta))
    return np.where(lost, np.nan, theta)
