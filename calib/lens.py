"""The round part of a CAHV(OR)(E) lens: how far a ray's slope to the axis O is bent, and how far it reaches.

Everything here is in the lens frame: origin at C, z along O, x and y any two directions across it. A point
(a, b, w) is seen at the *slopes* (u, v): those of the straight ray that a pinhole would need to land on the
same pixel. Letters are Gennery's and those of JPL's camera-model library: chi is the undistorted slope,
chi' = chi (1 + r0 + r1 chi^2 + r2 chi^4) the distorted one, theta the ray's angle to O.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from math import asin, atan, inf, pi, sin, sqrt, tan

Coefficients = tuple[float, float, float]


def first_fold(r: Coefficients) -> float:
    """Return the first chi > 0 where chi (1 + r0 + r1 chi^2 + r2 chi^4) stops growing; infinite if none."""
    c, b, a = 1.0 + r[0], 3.0 * r[1], 5.0 * r[2]  # the derivative is a y^2 + b y + c, with y = chi^2
    if a == 0.0:
        return sqrt(-c / b) if b < 0.0 else inf
    discriminant = b * b - 4.0 * a * c
    if discriminant < 0.0:
        return inf
    q = -0.5 * (b + (sqrt(discriminant) if b >= 0.0 else -sqrt(discriminant)))
    roots = [y for y in (q / a, c / q if q else 0.0) if y > 0.0]
    return sqrt(min(roots)) if roots else inf


@dataclass(frozen=True)
class Lens:
    """Distortion, entrance point and reach of one lens; shared by all copies of a camera that is moved.

    Attributes
    ----------
    r, e
        R and E of the model; ``e`` counts only if ``curved``.
    curved
        True for CAHVORE: the slope is a function of the angle (by ``linearity``) and the entrance point moves.
    linearity
        1 perspective, 0 fisheye; chi = tan(l theta)/l, theta, sin(l theta)/l for l above, at, below 0.
    chi_limit, distorted_limit, theta_limit_rad
        First slope, distorted slope and angle that the lens does not reach (infinite, infinite and a right
        angle for a plain lens without fold).
    """

    r: Coefficients
    e: Coefficients = (0.0, 0.0, 0.0)
    curved: bool = False
    linearity: float = 1.0
    chi_limit: float = field(init=False)
    distorted_limit: float = field(init=False)
    theta_limit_rad: float = field(init=False)

    def __post_init__(self) -> None:
        chi = first_fold(self.r)
        theta = self.theta_of(chi) if self.curved else atan(chi)
        if self.curved:
            chi = min(chi, self.chi_of(theta))
        object.__setattr__(self, "chi_limit", chi)
        object.__setattr__(self, "distorted_limit", self.distorted(chi))
        object.__setattr__(self, "theta_limit_rad", theta)

    def distorted(self, chi: float) -> float:
        """Return chi' of chi."""
        if chi == inf:
            return inf
        y = chi * chi
        return chi * (1.0 + self.r[0] + y * (self.r[1] + y * self.r[2]))

    def theta_of(self, chi: float) -> float:
        """Return the angle of slope ``chi``, at most what the linearity and half a turn allow."""
        line = self.linearity
        if line > 0.0:
            return min(pi, atan(line * chi) / line)
        if line < 0.0:
            return min(pi, asin(min(1.0, -line * chi)) / -line)
        return min(pi, chi)

    def chi_of(self, theta_rad: float) -> float:
        """Return the slope of an angle within the reach."""
        line = self.linearity
        if line > 0.0:
            return inf if line * theta_rad >= pi / 2 else tan(line * theta_rad) / line
        if line < 0.0:
            return sin(line * theta_rad) / line
        return theta_rad
