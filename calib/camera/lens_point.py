"""The lens of `calib.camera.lens` for one point or one slope, in plain floats: no array to set up.

A pointing solution needs one ray; numpy would take ten times as long to begin. Every branch and tolerance
is that of `calib.camera.lens_arrays` and `calib.camera.entrance`, and a test holds the two together.
"""

from __future__ import annotations

from math import asin, atan, atan2, cos, inf, isfinite, nan, sin, sqrt, tan

import numpy as np

from calib.camera.entrance import angle_by_search
from calib.camera.lens import NEAREST_M, SETTLED, TINY, Lens


def bend_point(lens: Lens, a: float, b: float, w: float) -> float:
    """Return m such that the point (a, b, w) is seen at the slopes (a m, b m); not-a-number if unseen."""
    if not isfinite(a + b + w):
        return nan
    r0, r1, r2 = lens.r
    if not lens.curved:
        if not w > 0.0 or (per_w := 1.0 / w) == inf:
            return nan
        u, v = a * per_w, b * per_w
        tau = u * u + v * v
        if not tau < lens.chi_limit * lens.chi_limit:
            return nan
        return (1.0 + r0 + tau * (r1 + tau * r2)) * per_w
    lam = max(sqrt(a * a + b * b), TINY)
    theta = _ray_angle(lens, lam, w)
    if not 0.0 < theta < lens.theta_limit_rad:
        return nan
    line = lens.linearity
    chi = tan(line * theta) / line if line > 0.0 else sin(line * theta) / line if line < 0.0 else theta
    if not chi < lens.chi_limit:
        return nan
    chi2 = chi * chi
    return chi * (1.0 + r0 + chi2 * (r1 + chi2 * r2)) / lam


def _ray_angle(lens: Lens, lam: float, w: float) -> float:
    """Return theta of the ray through a point, not-a-number if there is none or more than one."""
    rho = sqrt(lam * lam + w * w)
    if not NEAREST_M < rho < inf:
        return nan
    start = atan2(lam, w)
    if not lens.moving:
        return start
    e0, e1, e2 = lens.e
    theta, sine, cosine, turn, settled = start, lam / rho, w / rho, 0.0, False
    for newton in range(9):
        y = theta * theta
        e = (e0 + y * (e1 + y * e2)) / rho
        lag = theta - sine
        rise = (1.0 - cosine) * e + lag * theta * (2.0 * e1 + 4.0 * e2 * y) / rho
        slope = cos(turn) - rise
        if slope == 0.0:
            break
        step = (sin(turn) - lag * e) / slope
        turn -= step
        theta = start + turn
        if not abs(theta) < inf:
            break
        if newton > 0 and abs(step) < SETTLED:
            settled = slope > 0.0 and lam > NEAREST_M * sine
            break
        sine, cosine = sin(theta), cos(theta)
    edge = lens.theta_image_rad
    in_image = settled and 0.0 < theta <= edge
    edge_lag = (edge - sin(edge)) * (e0 + edge * edge * (e1 + edge * edge * e2))
    if rho <= lens.near_m or (not in_image and w * sin(edge) - lam * cos(edge) > edge_lag):
        with np.errstate(all="ignore"):
            return float(angle_by_search(lens, np.array([lam]), np.array([w]))[0])
    return theta if settled else nan


def unbend_point(lens: Lens, u: float, v: float) -> tuple[float, float, float] | None:
    """Return (p, q, shift): direction (u p, v p, q) in the lens frame, entrance point at C + shift O."""
    t2 = u * u + v * v
    if not t2 < lens.distorted_limit * lens.distorted_limit:
        return None
    t = max(sqrt(t2), TINY)
    chi = lens.undistorted(t)
    if chi is None:
        return None
    if not lens.curved:
        q = 1.0 / sqrt(1.0 + chi * chi)
        return chi / t * q, q, 0.0
    if not chi < lens.chi_limit:
        return None
    line = lens.linearity
    theta = atan(line * chi) / line if line > 0.0 else asin(line * chi) / line if line < 0.0 else chi
    if not theta < lens.theta_limit_rad:
        return None
    sine = sin(theta)
    shift = 0.0
    if lens.moving:
        e0, e1, e2 = lens.e
        y = theta * theta
        shift = (theta / sine - 1.0) * (e0 + y * (e1 + y * e2))
    return sine / t, cos(theta), shift
