"""The lens of `calib.lens` on arrays: cache-sized rows of points and slopes, with derivatives.

The caller cuts its points into chunks and silences numpy's floating-point warnings; rows without a result
come back with ``valid`` False and any number at all.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from calib.lens import Lens
from calib.rigid import FloatArray

TINY = 1e-150
"""Stands for zero in divisions by a distance from the axis: its square is still a number."""

SETTLED = 1e-9
"""Newton stops after a step below this; it doubles its digits, so the result is good to rounding."""

_SMALL_TURN_RAD = 0.1
"""Up to here a sine by its series to the ninth power is exact to rounding."""

NEAREST_M = 1e-9
"""A point this near the entrance point has no direction from it."""

_NODES = 257
"""Angles at which the slow search for a ray looks for a change of sign."""


class Bent(NamedTuple):
    """What the lens does to points: slopes (u, v) = (a, b) m, and which points it reaches.

    With derivatives: dm = n (a da + b db) + k dw.
    """

    m: FloatArray
    valid: np.ndarray
    n: FloatArray | None = None
    k: FloatArray | None = None


class Unbent(NamedTuple):
    """The rays of distorted slopes: direction (u p, v p, q) in the lens frame, entrance point at C + shift O.

    With derivatives to g = u du + v dv: dp = p_rate g, dq = q_rate g, dshift = shift_rate g.
    """

    p: FloatArray
    q: FloatArray
    shift: FloatArray | None
    valid: np.ndarray
    p_rate: FloatArray | None = None
    q_rate: FloatArray | None = None
    shift_rate: FloatArray | None = None


def bend(lens: Lens, a: FloatArray, b: FloatArray, w: FloatArray, derivatives: bool = False) -> Bent:
    """Return the slopes at which points (a, b, w) of the lens frame, metres, are seen."""
    lambda2 = a * a
    lambda2 += b * b
    if lens.curved:
        return _bend_curved(lens, np.maximum(np.sqrt(lambda2), TINY), w, derivatives)
    r0, r1, r2 = lens.r
    per_w = 1.0 / w
    tau = lambda2
    tau *= per_w
    tau *= per_w
    valid = w > 0.0
    valid &= tau < lens.chi_limit * lens.chi_limit
    scale = tau * r2
    scale += r1
    scale *= tau
    scale += 1.0 + r0
    m = scale * per_w
    if not derivatives:
        return Bent(m, valid)
    twice_rate = (4.0 * r2) * tau
    twice_rate += 2.0 * r1  # 2 d scale / d tau
    k = (scale + twice_rate * tau) * (-per_w * per_w)
    return Bent(m, valid, twice_rate * (per_w * per_w * per_w), k)


def _bend_curved(lens: Lens, lam: FloatArray, w: FloatArray, derivatives: bool) -> Bent:
    """CAHVORE: the ray's angle first, then its slope."""
    r0, r1, r2 = lens.r
    line = lens.linearity
    theta, sine, cosine, slope, valid = ray_angle(lens, lam, w, derivatives)
    if line > 0.0:
        chi = np.tan(line * theta) / line
    elif line < 0.0:
        chi = np.sin(line * theta) / line
    else:
        chi = theta
    valid &= theta > 0.0
    valid &= theta < lens.theta_limit_rad
    valid &= chi < lens.chi_limit
    chi2 = chi * chi
    m = chi * (1.0 + r0 + chi2 * (r1 + chi2 * r2)) / lam
    if not derivatives:
        return Bent(m, valid)
    rate = 1.0 + r0 + chi2 * (3.0 * r1 + chi2 * (5.0 * r2))  # d chi' / d chi, then times d chi / d theta
    if line > 0.0:
        rate *= 1.0 + line * line * chi2
    elif line < 0.0:
        rate *= np.cos(line * theta)
    rate /= slope
    return Bent(m, valid, (rate * cosine - m) / (lam * lam), -rate * sine / lam)


def ray_angle(
    lens: Lens, lam: FloatArray, w: FloatArray, polish: bool
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray, np.ndarray]:
    """Return theta of the ray through points, its sine and cosine, f'(theta), and where that is right.

    Newton from the direction as seen from C, whose sine and cosine need no trigonometry; those of the
    later angles follow by a small turn. ``polish`` brings sine, cosine and f' to the last theta.
    """
    rho = np.sqrt(lam * lam + w * w)
    start = np.arctan2(lam, w)
    sine_start, cosine_start = lam / rho, w / rho
    if not lens.moving:
        return start, sine_start, cosine_start, rho, (rho > NEAREST_M) & (rho < np.inf)
    e0, e1, e2 = lens.e
    theta, sine, cosine, turn = start, sine_start, cosine_start, np.zeros_like(start)
    for _ in range(8):
        y = theta * theta
        e = e0 + y * (e1 + y * e2)
        lag = theta - sine
        slope = w * cosine + lam * sine - (1.0 - cosine) * e - lag * theta * (2.0 * e1 + (4.0 * e2) * y)
        step = (w * sine - lam * cosine - lag * e) / slope
        turn = turn - step
        theta = start + turn
        settled = np.abs(step) < SETTLED
        done = bool(settled.all())
        if done and not polish:
            break
        sine, cosine = _turned(sine_start, cosine_start, turn, theta)
        if done:
            break
    settled &= slope > 0.0
    settled &= lam > NEAREST_M * sine

    # With f(theta_image) > 0 the ray is inside the image; what Newton did not find there, or may have
    # found twice because rays cross so near the lens, is searched for.
    edge = lens.theta_image_rad
    edge_lag = (edge - np.sin(edge)) * (e0 + edge**2 * (e1 + edge**2 * e2))
    unsure = w * np.sin(edge) - lam * np.cos(edge) > edge_lag
    unsure &= ~(settled & (theta > 0.0) & (theta <= edge))
    unsure |= rho <= lens.near_m
    if unsure.any():
        found = angle_by_search(lens, lam[unsure], w[unsure])
        theta[unsure] = found
        settled[unsure] = found > 0.0  # not a number where none was found
        if polish:
            sine, cosine = np.sin(theta), np.cos(theta)
    if polish:
        y = theta * theta
        slope = w * cosine + lam * sine - (1.0 - cosine) * (e0 + y * (e1 + y * e2))
        slope -= (theta - sine) * theta * (2.0 * e1 + (4.0 * e2) * y)
    return theta, sine, cosine, slope, settled


def _turned(
    sine: FloatArray, cosine: FloatArray, turn: FloatArray, theta: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return sine and cosine of theta, which is the given one plus ``turn``."""
    if not np.abs(turn).max() < _SMALL_TURN_RAD:
        return np.sin(theta), np.cos(theta)
    y = turn * turn
    s = turn * (1.0 - y / 6.0 * (1.0 - y / 20.0 * (1.0 - y / 42.0 * (1.0 - y / 72.0))))
    c = 1.0 - y / 2.0 * (1.0 - y / 12.0 * (1.0 - y / 30.0 * (1.0 - y / 56.0)))
    return sine * c + cosine * s, cosine * c - sine * s


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


def unbend(lens: Lens, u: FloatArray, v: FloatArray, derivatives: bool = False) -> Unbent:
    """Return the rays that land on distorted slopes (u, v)."""
    t2 = u * u
    t2 += v * v
    valid = t2 < lens.distorted_limit * lens.distorted_limit
    if not valid.all():
        t2 = np.where(valid, t2, 0.0)
    k = _shrink(lens, t2)
    if lens.curved:
        return _unbend_curved(lens, np.maximum(np.sqrt(t2), TINY), k, valid, derivatives)
    chi2 = k * k
    chi2 *= t2
    q = 1.0 / np.sqrt(1.0 + chi2)
    p = k * q
    if not derivatives:
        return Unbent(p, q, None, valid)
    t2 = np.maximum(t2, TINY * TINY)
    angle_rate = q * q / _growth(lens, chi2)  # d theta / d chi'
    return Unbent(p, q, None, valid, (q * angle_rate - p) / t2, -p * angle_rate)


def _unbend_curved(lens: Lens, t: FloatArray, k: FloatArray, valid: np.ndarray, derivatives: bool) -> Unbent:
    """CAHVORE: from the slope to the angle, then the entrance point."""
    line = lens.linearity
    chi = k * t
    valid &= chi < lens.chi_limit
    if line > 0.0:
        theta = np.arctan(line * chi) / line
    elif line < 0.0:
        theta = np.arcsin(line * chi) / line
    else:
        theta = chi
    valid &= theta < lens.theta_limit_rad
    sine, cosine = np.sin(theta), np.cos(theta)
    p = sine / t
    e0, e1, e2 = lens.e
    y = theta * theta
    e = e0 + y * (e1 + y * e2)
    stretch = theta / sine - 1.0
    shift = stretch * e if lens.moving else None
    if not derivatives:
        return Unbent(p, cosine, shift, valid)
    angle_rate = 1.0 / _growth(lens, chi * chi)  # d theta / d chi'
    if line > 0.0:
        angle_rate /= 1.0 + (line * line) * (chi * chi)
    elif line < 0.0:
        angle_rate /= np.cos(line * theta)
    shift_rate = None
    if lens.moving:
        # (theta/sin theta)' by its series where the closed form would cancel
        stretch_rate = np.where(
            theta < 0.1,
            theta * (1 / 3 + y * (7 / 90 + y * (31 / 2520 + y * (127 / 75600 + y * (73 / 342144))))),
            (sine - theta * cosine) / (sine * sine),
        )
        shift_rate = (stretch_rate * e + stretch * theta * (2.0 * e1 + 4.0 * e2 * y)) * angle_rate / t
    return Unbent(
        p,
        cosine,
        shift,
        valid,
        (cosine * angle_rate - p) / (t * t),
        -p * angle_rate,
        shift_rate,
    )


def _growth(lens: Lens, chi2: FloatArray) -> FloatArray:
    """Return d chi' / d chi."""
    r0, r1, r2 = lens.r
    return (1.0 + r0) + chi2 * (3.0 * r1 + chi2 * (5.0 * r2))


def _shrink(lens: Lens, t2: FloatArray) -> FloatArray:
    """Return k = chi / chi' for squared distorted slopes chi'^2 within the reach."""
    r0, r1, r2 = lens.r
    c1 = 1.0 + r0
    if r1 == 0.0 and r2 == 0.0:
        return np.full_like(t2, 1.0 / c1)
    c3 = r1 * t2
    c5 = t2 * t2
    c5 *= r2
    k = np.full_like(t2, 1.0 / c1)
    for _ in range(10):
        y = k * k
        c5y = c5 * y
        rise = y * (c5y + c3)
        step = (k * (rise + c1) - 1.0) / (y * (5.0 * c5y + 3.0 * c3) + c1)
        k -= step
        settled = np.abs(step) < SETTLED
        if settled.all():
            break
    settled &= k > 0.0
    if lens.chi_limit < np.inf:
        settled &= k * k * t2 < lens.chi_limit * lens.chi_limit
    for row in np.flatnonzero(~settled):  # close to the fold, or led astray by it
        distorted = float(np.sqrt(t2[row]))
        chi = lens.undistorted(distorted)
        k[row] = np.nan if chi is None else chi / distorted
    return k
