"""The lens of `calib.geometry.lens` at work: on arrays, with derivatives, and for one point.

The caller of `bend` and `unbend` cuts its points into cache-sized chunks and silences numpy's floating-point
warnings; rows without a result come back with ``valid`` False and any number at all. A pointing solution
needs one ray, where numpy would take ten times as long to begin: `bend_point` and `unbend_point` are in plain
floats. Every branch and tolerance of theirs is that of the arrays, and a test holds the two together.
"""

from __future__ import annotations

from math import asin, atan, atan2, cos, inf, isfinite, nan, sin, sqrt, tan
from typing import NamedTuple

import numpy as np

from calib.geometry.lens import NEAREST_M, SETTLED, TINY, Lens, angle_by_search, ray_angle
from calib.geometry.rigid import FloatArray


class Bent(NamedTuple):
    """The lens applied to points (a, b, w): slopes (3, n), rows u, v and 1, and which points it reaches.

    With derivatives: d(u, v) = m (da, db) + c (n c.(da, db) + k dw), with c (2, n) across the axis.
    """

    slopes: FloatArray
    valid: np.ndarray
    derivatives: tuple[FloatArray, FloatArray, FloatArray, FloatArray] | None = None  # m, n, k, c


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


def bend(lens: Lens, local: FloatArray, derivatives: bool = False) -> Bent:
    """Return the slopes at which points (3, n), rows a, b, w of the lens frame in metres, are seen."""
    slopes = np.empty_like(local)
    slopes[2] = 1.0
    if lens.curved:
        return _bend_curved(lens, local, slopes, derivatives)
    r0, r1, r2 = lens.r
    w = local[2]
    valid = w > 0.0
    undistorted = local[:2] / w
    squares = undistorted * undistorted
    tau = np.add(squares[0], squares[1], out=squares[0])
    if lens.chi_limit < np.inf:
        valid &= tau < lens.chi_limit * lens.chi_limit
    scale = np.multiply(tau, r2, out=squares[1])
    scale += r1
    scale *= tau
    scale += 1.0 + r0
    np.multiply(undistorted, scale, out=slopes[:2])
    if not derivatives:
        return Bent(slopes, valid)
    per_w = 1.0 / w
    twice_rate = tau * (4.0 * r2)
    twice_rate += 2.0 * r1  # 2 d scale / d tau
    n = twice_rate * per_w
    twice_rate *= tau
    twice_rate += scale
    scale *= per_w
    twice_rate *= np.negative(per_w, out=per_w)
    return Bent(slopes, valid, (scale, n, twice_rate, undistorted))


def _bend_curved(lens: Lens, local: FloatArray, slopes: FloatArray, derivatives: bool) -> Bent:
    """CAHVORE: the ray's angle first, then its slope."""
    r0, r1, r2 = lens.r
    line = lens.linearity
    a, b, w = local
    lam = a * a
    lam += b * b
    np.sqrt(lam, out=lam)
    np.maximum(lam, TINY, out=lam)
    theta, sine, cosine, slope, valid = ray_angle(lens, lam, w, derivatives)
    if line > 0.0:
        chi = np.tan(line * theta) / line
    elif line < 0.0:
        chi = np.sin(line * theta) / line
    else:
        chi = theta
    valid &= theta > 0.0
    valid &= theta < lens.theta_limit_rad
    if lens.chi_limit < np.inf:
        valid &= chi < lens.chi_limit
    chi2 = chi * chi
    m = chi2 * r2
    m += r1
    m *= chi2
    m += 1.0 + r0
    m *= chi
    m /= lam
    np.multiply(local[:2], m, out=slopes[:2])
    if not derivatives:
        return Bent(slopes, valid)
    rate = _growth(lens, chi2)  # d chi' / d chi, then times d chi / d theta
    if line > 0.0:
        rate *= 1.0 + line * line * chi2
    elif line < 0.0:
        rate *= np.cos(line * theta)
    rate /= slope
    n = rate * cosine
    n -= m
    rate *= sine
    return Bent(slopes, valid, (m, n, np.negative(rate, out=rate), local[:2] / lam))


def unbend(lens: Lens, slopes: FloatArray, derivatives: bool = False) -> Unbent:
    """Return the rays that land on distorted slopes (2, n), rows u and v."""
    squares = slopes * slopes
    t2 = np.add(squares[0], squares[1], out=squares[0])
    valid = t2 < lens.distorted_limit * lens.distorted_limit
    if not valid.all():
        t2 = np.where(valid, t2, 0.0)
    k = _shrink(lens, t2)
    if lens.curved:
        return _unbend_curved(lens, np.maximum(np.sqrt(t2), TINY), k, valid, derivatives)
    chi2 = k * k
    chi2 *= t2
    q = chi2 + 1.0
    np.sqrt(q, out=q)
    np.divide(1.0, q, out=q)
    p = np.multiply(k, q, out=k)
    if not derivatives:
        return Unbent(p, q, None, valid)
    t2 = np.maximum(t2, TINY * TINY)
    angle_rate = q * q
    angle_rate /= _growth(lens, chi2)  # d theta / d chi'
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
    growth = chi2 * (5.0 * r2)
    growth += 3.0 * r1
    growth *= chi2
    growth += 1.0 + r0
    return growth


def _shrink(lens: Lens, t2: FloatArray) -> FloatArray:
    """Return k = chi / chi' for squared distorted slopes chi'^2 within the reach."""
    r0, r1, r2 = lens.r
    c1 = 1.0 + r0
    if r1 == 0.0 and r2 == 0.0:
        return np.full_like(t2, 1.0 / c1)
    # Newton on c1 k + c3 k^3 + c5 k^5 = 1
    c3 = r1 * t2
    c5 = t2 * t2
    c5 *= r2
    k = c3 + c5
    k += c1
    np.divide(1.0, k, out=k)
    y, low, rate = np.empty_like(k), np.empty_like(k), np.empty_like(k)
    for _ in range(10):
        np.multiply(k, k, out=y)
        high = y * c5
        np.add(high, c3, out=low)
        low *= y
        high *= y
        np.multiply(low, 3.0, out=rate)  # 3 c3 k^2 + 5 c5 k^4 + c1
        high *= 2.0
        rate += high
        rate += c1
        low += c1
        low *= k
        low -= 1.0
        low /= rate
        k -= low
        step = np.abs(low, out=low)
        if step.max() < SETTLED:
            break
    found = step < SETTLED
    found &= k > 0.0
    if lens.chi_limit < np.inf:
        y *= t2
        found &= y < lens.chi_limit * lens.chi_limit
    if not found.all():
        for row in np.flatnonzero(~found):  # close to the fold, or led astray by it
            distorted = float(np.sqrt(t2[row]))
            chi = lens.undistorted(distorted)
            k[row] = np.nan if chi is None else chi / distorted
    return k


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
