"""Kannala and Brandt's lens, as cv2.fisheye, Kalibr (equidistant) and COLMAP (OPENCV_FISHEYE) have it.

A point (a, b, w) of the lens frame, at the angle theta to z, is seen at the slopes

    (u, v) = (a, b) / rho * theta (1 + k1 theta^2 + k2 theta^4 + k3 theta^6 + k4 theta^8),  rho = |(a, b)|.

cv2.fisheye begins with a/w and b/w, so its points are those with w > 0; here theta may go on to the fold of
the polynomial, or half a turn. Source: Kannala and Brandt, IEEE PAMI 28 (2006) 1335;
https://docs.opencv.org/4.x/db/d58/group__calib3d__fisheye.html.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from math import atan2, cos, degrees, hypot, isfinite, nan, pi, sin
from typing import Any

import numpy as np

from calib.geometry.lens import NEAREST_M, SETTLED, TINY
from calib.geometry.lenses.opencv import Bent, Start, Unbent, first_root, start_table
from calib.geometry.rigid import FloatArray

NAMES = ("k1", "k2", "k3", "k4")

_HALVINGS = 60


@dataclass(frozen=True, eq=False)
class FisheyeLens:
    """One lens; shared by all copies of a camera that is moved.

    Attributes
    ----------
    distortion
        k1, k2, k3, k4.
    image_slope
        The largest slope (u, v) inside the image.

    Raises
    ------
    ValueError
        If there are not four of them, or they are not finite.
    """

    distortion: tuple[float, ...]
    image_slope: float = 1.0
    moving = False
    curved = True

    def __post_init__(self) -> None:
        if len(self.distortion) != 4:
            raise ValueError(f"{len(self.distortion)} coefficients of a fisheye lens where 4 are expected")
        if not isfinite(sum(self.distortion)):
            raise ValueError(f"distortion {list(self.distortion)} holds a value that is not finite")

    def _bent(self, theta: Any) -> Any:
        """Slope of an angle."""
        k1, k2, k3, k4 = self.distortion
        y = theta * theta
        return theta * (1.0 + y * (k1 + y * (k2 + y * (k3 + y * k4))))

    def _growth(self, theta: Any) -> Any:
        """d slope / d angle."""
        k1, k2, k3, k4 = self.distortion
        y = theta * theta
        return 1.0 + y * (3.0 * k1 + y * (5.0 * k2 + y * (7.0 * k3 + y * (9.0 * k4))))

    def bend(self, local: FloatArray, derivatives: bool = False) -> Bent:
        """Return where points (3, n), rows a, b, w of the lens frame in metres, are seen."""
        a, b, w = local
        rho = np.sqrt(a * a + b * b)
        rho = np.maximum(rho, TINY)
        theta = np.arctan2(rho, w)
        valid = theta < self.far_rad
        m = self._bent(theta)
        m /= rho
        slopes = local[:2] * m
        square = rho * rho + w * w
        valid &= square > NEAREST_M * NEAREST_M
        if not derivatives:
            return Bent(slopes, valid)
        rate = self._growth(theta)
        rate /= square  # d slope by d theta; theta turns by w/square along the radius and -rho/square along w
        cosine, sine = a / rho, b / rho
        n = rate * w
        n -= m
        rates = np.empty((2, 3, len(w)))
        np.multiply(n, cosine, out=rates[0, 0])
        np.multiply(rates[0, 0], sine, out=rates[0, 1])
        rates[1, 0] = rates[0, 1]
        rates[0, 0] *= cosine
        rates[0, 0] += m
        np.multiply(n, sine, out=rates[1, 1])
        rates[1, 1] *= sine
        rates[1, 1] += m
        np.negative(rate, out=rate)
        np.multiply(rate, a, out=rates[0, 2])
        np.multiply(rate, b, out=rates[1, 2])
        return Bent(slopes, valid, rates)

    def coefficient_rates(self, local: FloatArray) -> FloatArray:
        """Return d slope / d coefficient (2, 4, n) of points (3, n), as ``bend`` has them."""
        a, b, w = local
        rho = np.maximum(np.hypot(a, b), TINY)
        theta = np.arctan2(rho, w)
        y = theta * theta
        powers = theta / rho * np.stack([y, y * y, y * y * y, y * y * y * y])
        return np.asarray(np.stack([a * powers, b * powers]))

    def unbend(self, slopes: FloatArray, derivatives: bool = False) -> Unbent:
        """Return the directions that land on slopes (2, n)."""
        squares = slopes * slopes
        t2 = squares[0] + squares[1]
        t = np.maximum(np.sqrt(t2), TINY)
        theta, valid = self._angle(t, t2)
        sine, cosine = np.sin(theta), np.cos(theta)
        p = sine / t
        directions = np.empty((3, len(t)))
        np.multiply(slopes, p, out=directions[:2])
        directions[2] = cosine
        if not derivatives:
            return Unbent(directions, valid)
        turn = 1.0 / self._growth(theta)
        unit = slopes / t
        rates = np.empty((3, 2, len(t)))
        n = cosine * turn - p
        rates[:2] = unit[:, None] * (unit * n)
        rates[0, 0] += p
        rates[1, 1] += p
        rates[2] = unit * (-sine * turn)
        return Unbent(directions, valid, rates)

    def _angle(self, t: FloatArray, t2: FloatArray) -> tuple[FloatArray, np.ndarray]:
        """Angles of slopes, and which exist."""
        theta = self._start.ratio(t2)
        theta *= t
        for _ in range(6):
            step = self._bent(theta)
            step -= t
            step /= self._growth(theta)
            theta -= step
            size = np.abs(step, out=step)
            if not size.max(initial=0.0) > SETTLED:
                break
        valid = (size <= SETTLED) & (theta < self.far_rad) & (theta >= 0.0)
        if not valid.all():
            edge = self._bent(self.far_rad)
            rows = np.flatnonzero(~valid & (t <= edge + 4e-15 * abs(edge)))
            low, high = np.zeros(len(rows)), np.full(len(rows), self.far_rad)
            for _ in range(_HALVINGS):
                middle = 0.5 * (low + high)
                beyond = self._bent(middle) > t[rows]
                low, high = np.where(beyond, low, middle), np.where(beyond, middle, high)
            theta[rows], valid[rows] = np.minimum(low, (1.0 - 1e-15) * self.far_rad), True
        return theta, valid

    def bend_point(self, a: float, b: float, w: float) -> tuple[float, float]:
        """Return the slopes at which one point is seen, not-a-number if it is not."""
        rho = max(hypot(a, b), TINY)
        if not isfinite(rho + w) or not hypot(rho, w) > NEAREST_M:
            return nan, nan
        theta = atan2(rho, w)
        if not theta < self.far_rad:
            return nan, nan
        m = self._bent(theta) / rho
        return a * m, b * m

    def unbend_point(self, u: float, v: float) -> tuple[float, float, float] | None:
        """Return the unit direction that lands on slopes, None if there is none."""
        t2 = u * u + v * v
        if not isfinite(t2):
            return None
        t = max(hypot(u, v), TINY)
        theta = self._start.ratio(t2) * t
        for _ in range(6):
            rate = self._growth(theta)
            if not rate > 0.0:
                break
            step = (self._bent(theta) - t) / rate
            theta -= step
            if abs(step) <= SETTLED:
                break
        if not rate > 0.0 or not abs(step) <= SETTLED or not 0.0 <= theta < self.far_rad:
            found, valid = self._angle(np.array([t]), np.array([t2]))
            if not valid[0]:
                return None
            theta = float(found[0])
        p = sin(theta) / t
        return u * p, v * p, cos(theta)

    @property
    def limit_words(self) -> str:
        """Where the lens ends, as the end of a sentence."""
        if self.far_rad >= pi:
            return "the lens ends 180 degrees from its axis"
        return f"the lens folds at {degrees(self.far_rad):.1f} degrees from its axis"

    @cached_property
    def far_rad(self) -> float:
        """The angle from which on nothing is reached: where the polynomial folds, at most half a turn."""
        k1, k2, k3, k4 = self.distortion
        growth = np.polynomial.Polynomial([1.0, 3.0 * k1, 5.0 * k2, 7.0 * k3, 9.0 * k4])
        return min(pi, float(np.sqrt(first_root(growth))))

    @cached_property
    @np.errstate(all="ignore")
    def _start(self) -> Start:
        """Table of theta / t."""
        return start_table(lambda theta: (theta, self._bent(theta)), self.far_rad, self.image_slope)
