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

_SMALL_TURN_RAD = 0.02
"""Up to here a sine by its series to the fifth power is exact to rounding."""

NEAREST_M = 1e-9
"""A point this near the entrance point has no direction from it."""

_NODES = 257
"""Angles at which the slow search for a ray looks for a change of sign."""


class Bent(NamedTuple):
    """What the lens does to points (a, b, w): slopes (3, n), rows u, v and 1, and which points it reaches.

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
    theta, sine, cosine, slope, valid = _ray_angle(lens, lam, w, derivatives)
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


def _ray_angle(
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
