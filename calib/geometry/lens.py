"""The round part of a CAHV(OR)(E) lens: what it does to a slope or an angle, and how far it reaches.

Everything here is in the lens frame: origin at C, z along O, x and y any two directions across it. A point
(a, b, w) is seen at the *slopes* (u, v) = (a, b) m: those of the straight ray that a pinhole would need to
land on the same pixel. Letters as in JPL's camera-model library: chi is the undistorted slope,
chi' = chi (1 + r0 + r1 chi^2 + r2 chi^4) the distorted one, theta the ray's angle to O, lambda and zeta the
point's distance from O and along it, and for CAHVORE

    chi = tan(l theta)/l | theta | sin(l theta)/l        for linearity l above, at, below 0
    s(theta) = (theta/sin theta - 1) (e0 + e1 theta^2 + e2 theta^4)     entrance point at C + s O
    f(theta) = zeta sin theta - lambda cos theta - s sin theta = 0      the ray through the point

Two things fold, and beyond a fold a point would appear a second time, inside the image. The polynomial
folds where chi' stops growing. The entrance point makes rays cross: along the ray at theta, points nearer
than s'(theta) sin(theta) lie before the crossing (f' < 0 there).

The ray through a point, where the entrance point moves along O with the ray's angle, is the theta with
f(theta) = 0 on the side where f grows, and only if no second ray of the image passes through the point.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from math import asin, atan, degrees, inf, isfinite, pi, sin, sqrt, tan

import numpy as np

from calib.geometry.rigid import FloatArray

TINY = 1e-150
"""Stands for zero in divisions by a distance from the axis: its square is still a number."""

SETTLED = 1e-9
"""Newton stops after a step below this; it doubles its digits, so the result is good to rounding."""

NEAREST_M = 1e-9
"""A point this near the entrance point has no direction from it."""

Coefficients = tuple[float, float, float]


def first_fold(r: Coefficients) -> float:
    """Return the first chi > 0 where chi (1 + r0 + r1 chi^2 + r2 chi^4) stops growing; infinite if none."""
    c, b, a = 1.0 + r[0], 3.0 * r[1], 5.0 * r[2]  # the derivative is a y^2 + b y + c, with y = chi^2
    largest = max(abs(a), abs(b), c)
    a, b, c = a / largest, b / largest, c / largest
    discriminant = b * b - 4.0 * a * c
    if discriminant < 0.0:
        return inf
    q = -0.5 * (b + (sqrt(discriminant) if b >= 0.0 else -sqrt(discriminant)))
    roots = [y for y in (q / a if a else 0.0, c / q if q else 0.0) if 0.0 < y < inf]
    return sqrt(min(roots)) if roots else inf


@dataclass(frozen=True)
class Lens:
    """Distortion, entrance point and reach of one lens; shared by all copies of a camera that is moved.

    Attributes
    ----------
    r, e
        R and E of the model; ``e`` counts only if ``curved``.
    curved
        True for CAHVORE: the slope follows the angle by ``linearity``, and the entrance point moves.
    linearity
        1 perspective, 0 fisheye.
    image_slope
        The largest distorted slope chi' inside the image; infinite if part of the image has no ray.
    moving
        True if the entrance point moves at all.
    chi_limit, distorted_limit, theta_limit_rad
        First chi, chi' and theta that the lens does not reach.
    theta_image_rad
        The largest theta inside the image.
    near_m
        Farther than this from C no two rays of the image meet.
    """

    r: Coefficients
    e: Coefficients = (0.0, 0.0, 0.0)
    curved: bool = False
    linearity: float = 1.0
    image_slope: float = inf
    moving: bool = field(init=False)
    chi_limit: float = field(init=False)
    distorted_limit: float = field(init=False)
    theta_limit_rad: float = field(init=False)
    theta_image_rad: float = field(init=False)
    near_m: float = field(init=False)

    def __post_init__(self) -> None:
        chi = first_fold(self.r)
        theta = self.theta_of(chi)
        if self.curved:
            chi = min(chi, self.chi_of(theta))
        for name, value in (
            ("moving", self.curved and any(self.e)),
            ("chi_limit", chi),
            ("distorted_limit", self.distorted(chi)),
            ("theta_limit_rad", theta),
        ):
            object.__setattr__(self, name, value)
        in_image = self.undistorted(self.image_slope)
        object.__setattr__(self, "theta_image_rad", theta if in_image is None else self.theta_of(in_image))
        object.__setattr__(self, "near_m", self._farthest_crossing() if self.moving else 0.0)

    @property
    def limit_words(self) -> str:
        """Where the lens ends, as the end of a sentence; empty if that is where its family ends."""
        end = self.theta_of(self.chi_limit)
        if self.chi_limit == inf or end >= self.theta_of(inf):
            return ""
        return f"the lens folds at {degrees(end):.1f} degrees from its axis"

    def distorted(self, chi: float) -> float:
        """Return chi' of chi."""
        if chi == inf:
            return inf
        y = chi * chi
        return chi * (1.0 + self.r[0] + y * (self.r[1] + y * self.r[2]))

    def undistorted(self, distorted: float) -> float | None:
        """Return chi of chi' on the branch from zero to the first fold, None beyond it."""
        if not 0.0 <= distorted < self.distorted_limit:
            return None
        r0, r1, r2 = self.r
        chi = distorted / (1.0 + r0)
        for _ in range(12):
            y = chi * chi
            rate = 1.0 + r0 + y * (3.0 * r1 + y * 5.0 * r2)
            if not rate > 0.0:
                break
            step = (chi * (1.0 + r0 + y * (r1 + y * r2)) - distorted) / rate
            chi -= step
            if abs(step) <= 1e-9 * chi and 0.0 <= chi < self.chi_limit:
                return chi
        if chi == 0.0 or not isfinite(distorted):
            return chi if chi == 0.0 else None
        low, high = 0.0, self.chi_limit
        if high == inf:
            high = 1.0
            while self.distorted(high) <= distorted:
                low, high = high, 2.0 * high
        while low < (middle := 0.5 * (low + high)) < high:
            low, high = (middle, high) if self.distorted(middle) <= distorted else (low, middle)
        return low

    def theta_of(self, chi: float) -> float:
        """Return the angle of slope ``chi``, at most what the linearity and half a turn allow."""
        line = self.linearity if self.curved else 1.0
        if line > 0.0:
            return min(pi, atan(line * chi) / line)
        if line < 0.0:
            return min(pi, asin(min(1.0, -line * chi)) / -line)
        return min(pi, chi)

    def chi_of(self, theta_rad: float) -> float:
        """Return the slope of an angle within the reach."""
        line = self.linearity if self.curved else 1.0
        if line > 0.0:
            return inf if line * theta_rad >= pi / 2 else tan(line * theta_rad) / line
        return sin(line * theta_rad) / line if line < 0.0 else theta_rad

    def _farthest_crossing(self) -> float:
        """Return how far from C two neighbouring rays of the image cross at most, with 2 % to spare."""
        theta = np.linspace(0.0, min(self.theta_image_rad, 0.999 * pi), 513)[1:]
        e0, e1, e2 = self.e
        y = theta * theta
        e, e_rate = e0 + y * (e1 + y * e2), theta * (2.0 * e1 + 4.0 * y * e2)
        shift = (theta / np.sin(theta) - 1.0) * e
        # s'(theta) sin(theta): the distance along the ray, from its entrance point, of the crossing
        crossing = e * (1.0 - theta / np.tan(theta)) + (theta - np.sin(theta)) * e_rate
        ahead = crossing > 0.0
        if not ahead.any():
            return 0.0
        ends = np.hypot(shift + crossing * np.cos(theta), crossing * np.sin(theta))
        return float(1.02 * np.maximum(np.abs(shift), ends)[ahead].max())


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
