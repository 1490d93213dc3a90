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
"""

from __future__ import annotations

from dataclasses import dataclass, field
from math import asin, atan, inf, isfinite, pi, sin, sqrt, tan

import numpy as np

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
