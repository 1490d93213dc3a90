"""OpenCV's pinhole lenses of 4, 5, 8, 12 and 14 coefficients.

A point (a, b, w) of the lens frame (x right, y down, z ahead) has the slopes x = a/w, y = b/w, and
tau = x^2 + y^2. The coefficients are k1 k2 p1 p2 [k3 [k4 k5 k6 [s1 s2 s3 s4 [tau_x tau_y]]]], OpenCV's order:

    r = (1 + k1 tau + k2 tau^2 + k3 tau^3) / (1 + k4 tau + k5 tau^2 + k6 tau^3)
    u = x r + 2 p1 x y + p2 (tau + 2 x^2) + s1 tau + s2 tau^2
    v = y r + p1 (tau + 2 y^2) + 2 p2 x y + s3 tau + s4 tau^2

and with tau_x, tau_y the plane of the image is turned. A camera matrix then makes pixels of (u, v).
Source: https://docs.opencv.org/4.x/d9/d0c/group__calib3d.html.

The lens folds where the determinant of d(u, v) / d(x, y) reaches zero: beyond, a point would appear a second
time, inside the image. Its domain is what the axis reaches before the first fold, or the first pole of r.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from math import atan, degrees, inf, isfinite, nan
from typing import Any

import numpy as np

from calib.geometry.lenses import SETTLED, TINY, Bent, Unbent, first_root
from calib.geometry.rigid import FloatArray

COUNTS = (4, 5, 8, 12, 14)
NAMES = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6", "s1", "s2", "s3", "s4", "tau_x", "tau_y")

MOST_TURN_RAD = 1.5
"""The image plane is turned by less than this about either axis."""

_DIRECTIONS, _RADII, _STEEPEST = 48, 256, 100.0
"""Where the fold of a lens that is not round is searched for: directions, radii, and the largest slope."""


_FEW_STEPS, _MANY_STEPS = 8, 40
"""Newton's steps for all pixels together, and for those that are not settled then."""


_PATH = 48
"""Steps from the axis out to a pixel where Newton's own way does not lead to it."""

Slopes = tuple[FloatArray, FloatArray]


@dataclass(frozen=True, eq=False)
class OpencvLens:
    """One lens of 4, 5, 8, 12 or 14 coefficients; one that folds at its axis has no image.

    ValueError if the plane is turned by 1.5 rad or more.
    """

    distortion: tuple[float, ...]
    moving = False
    curved = False

    def __post_init__(self) -> None:
        if max(map(abs, self.distortion[12:]), default=0.0) >= MOST_TURN_RAD:
            raise ValueError(f"the image is turned by {MOST_TURN_RAD:g} rad or more")

    @cached_property
    def _numbers(self) -> tuple[float, ...]:
        """The first twelve coefficients, those that the lens lacks as zeros."""
        return (*self.distortion[:12], *[0.0] * (12 - len(self.distortion)))

    @cached_property
    def _tilt(self) -> FloatArray | None:
        """Slopes on the plane at right angles to z to those on the turned one; None where none is turned."""
        turn = self.distortion[12:]
        return np.asarray(_tilted(*turn)) if any(turn) else None

    def _radial(self, tau: FloatArray) -> tuple[FloatArray, FloatArray]:
        """r, and what r is divided by."""
        k1, k2, _, _, k3, k4, k5, k6, *_ = self._numbers
        above = 1.0 + tau * (k1 + tau * (k2 + tau * k3))
        if not (k4 or k5 or k6):
            return above, np.ones_like(tau)
        below = 1.0 + tau * (k4 + tau * (k5 + tau * k6))
        return above / below, below

    def _flat(self, x: FloatArray, y: FloatArray) -> tuple[FloatArray, ...]:
        """u and v before the plane is turned, tau, then du/dx, du/dy, dv/dx, dv/dy."""
        k1, k2, p1, p2, k3, k4, k5, k6, s1, s2, s3, s4 = self._numbers
        tau = x * x + y * y
        rate = 2.0 * k1 + tau * (4.0 * k2 + tau * (6.0 * k3))
        r, below = self._radial(tau)
        if k4 or k5 or k6:
            rate = (rate - r * (2.0 * k4 + tau * (4.0 * k5 + tau * (6.0 * k6)))) / below
        g = r + (2.0 * p1) * y + (2.0 * p2) * x
        gx, gy = x * rate + 2.0 * p2, y * rate + 2.0 * p1  # rate is 2 dr / d tau
        h, j = (p2 + s1) + s2 * tau, (p1 + s3) + s4 * tau
        two_h, two_j = 2.0 * h + (2.0 * s2) * tau, 2.0 * j + (2.0 * s4) * tau
        return (
            x * g + tau * h,
            y * g + tau * j,
            tau,
            g + x * (gx + two_h),
            x * gy + y * two_h,
            y * gx + x * two_j,
            g + y * (gy + two_j),
        )

    def bend(self, local_m: FloatArray, derivatives: bool = False) -> Bent:
        """Return where points (3, n), rows a, b, w of the lens frame, are seen."""
        w = local_m[2]
        per_w = 1.0 / w
        x, y = local_m[0] * per_w, local_m[1] * per_w
        u, v, tau, *flat_rates = self._flat(x, y)
        slopes, rates = self._turned(u, v, flat_rates)
        valid = self._reached(x, y, tau) & (w > 0.0)
        if not derivatives:
            return Bent(slopes, valid)
        found = np.empty((2, 3, len(w)))
        for row, by_x, by_y in zip(found, rates[::2], rates[1::2], strict=True):
            row[0], row[1] = by_x * per_w, by_y * per_w
            row[2] = -(x * row[0] + y * row[1])
        return Bent(slopes, valid, found)

    def coefficient_rates(self, local_m: FloatArray) -> FloatArray:
        """Return d slope / d coefficient (2, k, n) of points (3, n)."""
        x, y = local_m[:2] / local_m[2]
        u, v, tau, *_ = self._flat(x, y)
        r, below = self._radial(tau)
        powers = (tau, tau * tau, tau * tau * tau)
        plain = [np.stack([x, y]) * (power / below) for power in powers]
        zero = np.zeros_like(x)
        beside = [np.stack([2.0 * x * y, tau + 2.0 * y * y]), np.stack([tau + 2.0 * x * x, 2.0 * x * y])]
        rows = [*plain[:2], *beside, plain[2], *(-r * one for one in plain)]
        rows += [np.stack([p, zero]) for p in powers[:2]] + [np.stack([zero, p]) for p in powers[:2]]
        count = len(self.distortion)
        rates = np.stack(rows[: min(count, 12)], axis=1)
        _, (ux, uy, vx, vy) = self._turned(u, v, [1.0, 0.0, 0.0, 1.0])
        rates = np.stack([ux * rates[0] + uy * rates[1], vx * rates[0] + vy * rates[1]])
        if count == 14:
            turn = self.distortion[12:]
            flat = np.stack([u, v, np.ones_like(u)])
            now = _tilted(*turn) @ flat
            more = []
            for axis in (0, 1):
                bit = np.zeros(2, dtype=complex)
                bit[axis] = 1e-30j
                moved = (_tilted(*(np.array(turn) + bit)).imag * 1e30) @ flat
                more.append((moved[:2] - now[:2] / now[2] * moved[2]) / now[2])
            rates = np.concatenate([rates, np.stack(more, axis=1)], axis=1)
        return np.asarray(rates, dtype=np.float64)

    def unbend(self, slopes: FloatArray, derivatives: bool = False) -> Unbent:
        """Return the rays that land on slopes (2, n)."""
        u, v = slopes
        ahead: np.ndarray | bool = True
        if self._tilt is not None:
            back = np.linalg.inv(self._tilt) @ np.vstack([slopes, np.ones(slopes.shape[1])])
            (u, v), ahead = back[:2] / back[2], back[2] > 0.0
        x, y, valid = self._undistorted(u, v)
        valid = valid & ahead
        directions = np.empty((3, len(x)))
        per_length = np.divide(1.0, np.sqrt(1.0 + x * x + y * y), out=directions[2])
        np.multiply(x, per_length, out=directions[0])
        np.multiply(y, per_length, out=directions[1])
        if not derivatives:
            return Unbent(directions, valid)
        u, v, _, *flat_rates = self._flat(x, y)
        _, (ux, uy, vx, vy) = self._turned(u, v, flat_rates)
        per = 1.0 / (ux * vy - uy * vx)
        rates = np.empty((3, 2, len(x)))
        for column, (dx, dy) in enumerate(((vy * per, -vx * per), (-uy * per, ux * per))):
            along = (dx * directions[0] + dy * directions[1]) * per_length
            for row, dz in enumerate((dx * per_length, dy * per_length, 0.0)):
                rates[row, column] = dz - directions[row] * along
        return Unbent(directions, valid, rates)

    @property
    def limit_reason(self) -> str:
        """Where the lens ends, as the end of a sentence."""
        near, _ = self._folds
        if near >= _STEEPEST:
            return "the lens ends 90 degrees from its axis"
        return f"the lens folds at {degrees(atan(near)):.1f} degrees from its axis (slope {near:.3g})"

    @property
    def limit_rad(self) -> float:
        """The angle from the axis up to which the lens folds in no direction."""
        return atan(self._folds[0])

    @cached_property
    def _folds(self) -> tuple[float, float]:
        """Slopes sqrt(tau) up to which the lens folds in no direction, and from which on in all."""
        with np.errstate(all="ignore"):
            k1, k2, _, _, k3, k4, k5, k6, *_ = self._numbers
            above, below = (
                np.polynomial.Polynomial([1.0, k1, k2, k3]),
                np.polynomial.Polynomial([1.0, k4, k5, k6]),
            )
            y = np.polynomial.Polynomial([0.0, 1.0])
            growth = (above + 2.0 * y * above.deriv()) * below - 2.0 * y * above * below.deriv()
            # rho r stops growing, or r has a pole
            round_fold = float(np.sqrt(min(first_root(tuple(one.coef.tolist())) for one in (growth, below))))
            if not any((*self._numbers[2:4], *self._numbers[8:])):
                return round_fold, round_fold
            steepest = min(1.5 * round_fold, _STEEPEST)
            rho = np.tan(np.linspace(0.0, atan(steepest), _RADII))
            around = np.linspace(0.0, 2.0 * np.pi, _DIRECTIONS, endpoint=False)
            good = self._upright(np.cos(around)[:, None] * rho, np.sin(around)[:, None] * rho)
            first = np.where(good.all(axis=1), _RADII, good.argmin(axis=1))
            if first.min() < 2:
                return 0.0, 0.0
            near = float(rho[first.min() - 1])
            far = float(rho[np.minimum(first, _RADII - 1)].max())
            if first.max() == _RADII:
                far = inf if steepest == _STEEPEST else steepest
            later = good & (np.arange(_RADII) >= first[:, None]) & (rho < far)
            return (near, near) if later.any() else (near, far)

    def _upright(self, x: FloatArray, y: FloatArray) -> np.ndarray:
        """Where the picture is not turned inside out."""
        with np.errstate(all="ignore"):
            _, _, tau, ux, uy, vx, vy = self._flat(x, y)
            return np.asarray((ux * vy - uy * vx > 0.0) & (self._radial(tau)[1] > 0.0))

    def _reached(self, x: FloatArray, y: FloatArray, tau: FloatArray) -> np.ndarray:
        near, far = self._folds
        valid = np.less(tau, near * near)
        if not valid.all() and near < far:
            rows = np.flatnonzero(~valid & (tau < far * far))
            valid[rows] = self._upright(x[rows], y[rows])
        return valid

    def _turned(self, u: FloatArray, v: FloatArray, rates: Any) -> tuple[FloatArray, Any]:
        """Slopes (2, n) on the turned plane of those before, and their rates du/dx, du/dy, dv/dx, dv/dy."""
        slopes = np.stack([u, v])
        if self._tilt is None:
            return slopes, rates
        seen = self._tilt[:, :2] @ slopes + self._tilt[:, 2:]
        per = 1.0 / np.where(seen[2] > 0.0, seen[2], nan)
        turned = seen[:2] * per
        (a, b, _), (c, d, _), (e, f, _) = self._tilt.tolist()
        by_u = (a - turned[0] * e) * per, (c - turned[1] * e) * per
        by_v = (b - turned[0] * f) * per, (d - turned[1] * f) * per
        ux, uy, vx, vy = rates
        return turned, [
            by_u[row] * of_u + by_v[row] * of_v for row in (0, 1) for of_u, of_v in ((ux, vx), (uy, vy))
        ]

    @cached_property
    def _farthest(self) -> float:
        """The largest distorted slope that may be reached."""
        with np.errstate(all="ignore"):
            if not self._folds[1] < inf:
                return inf
            around = np.linspace(0.0, 2.0 * np.pi, 4 * _DIRECTIONS)
            edges = [self._flat(rho * np.cos(around), rho * np.sin(around))[:2] for rho in self._folds]
            largest = 1.002 * max(float(np.hypot(*edge).max()) for edge in edges)
            return largest if isfinite(largest) else inf

    def _undistorted(self, u: FloatArray, v: FloatArray) -> tuple[FloatArray, FloatArray, np.ndarray]:
        """Undistorted slopes of distorted ones, and which exist."""
        # 0.2, 5.0: bounds of what all pixels' slopes are multiplied by to begin with.
        k = np.clip(1.0 / self._radial(u * u + v * v)[0], 0.2, 5.0)
        x, y = u * k, v * k
        for _ in range(_FEW_STEPS):
            now_u, now_v, tau, *rates = self._flat(x, y)
            step_x, step_y = _step(u - now_u, v - now_v, rates)
            x += step_x
            y += step_y
            size = np.abs(step_x, out=step_x)
            size += np.abs(step_y, out=step_y)
            if size.max(initial=0.0) < SETTLED:
                break
        valid = (size < SETTLED) & self._reached(x, y, tau)
        if not valid.all():
            rows = np.flatnonzero(~valid & (np.hypot(u, v) < self._farthest))
            x[rows], y[rows], valid[rows] = self._newton(u[rows], v[rows], x[rows], y[rows])
            rows = rows[~valid[rows]]
            x[rows], y[rows], valid[rows] = self._follow(u[rows], v[rows])
        return x, y, valid

    def _newton(
        self, u: FloatArray, v: FloatArray, x: FloatArray, y: FloatArray
    ) -> tuple[FloatArray, FloatArray, np.ndarray]:
        """The same from slopes near by, by short steps, as exactly as they can be had."""
        with np.errstate(all="ignore"):
            for _ in range(_MANY_STEPS):
                now_u, now_v, tau, *rates = self._flat(x, y)
                off_u, off_v = u - now_u, v - now_v
                left = np.abs(off_u) + np.abs(off_v)
                rounding = 1.0 + np.abs(u) + np.abs(v) + np.sqrt(tau) * sum(map(np.abs, rates))
                # 1e-15: an inverse is settled with a residual this small beside its numbers.
                rounding *= 1e-15
                settled = left < 0.5 * rounding
                if settled.all():
                    break
                step = _short(x, y, _step(off_u, off_v, rates))
                x, y = np.where(settled, x, x + step[0]), np.where(settled, y, y + step[1])
        return x, y, (left < rounding) & self._reached(x, y, tau)

    def _follow(self, u: FloatArray, v: FloatArray) -> tuple[FloatArray, FloatArray, np.ndarray]:
        """The same for pixels near a fold: step by step from the axis, never across it."""
        x, y = np.zeros_like(u), np.zeros_like(v)
        lost = ~np.isfinite(u + v)
        with np.errstate(all="ignore"):
            for part in np.arange(1, _PATH + 1) / _PATH:
                for _ in range(3):
                    now_u, now_v, _, *rates = self._flat(x, y)
                    step = _short(x, y, _step(part * u - now_u, part * v - now_v, rates))
                    x, y = x + step[0], y + step[1]
                lost |= ~(rates[0] * rates[3] > rates[1] * rates[2])
        x, y, found = self._newton(u, v, x, y)
        return x, y, found & ~lost


def _step(off_u: FloatArray, off_v: FloatArray, rates: Sequence[FloatArray]) -> Slopes:
    """Newton's step of the undistorted slopes."""
    ux, uy, vx, vy = rates
    per = 1.0 / (ux * vy - uy * vx)
    return (vy * off_u - uy * off_v) * per, (ux * off_v - vx * off_u) * per


def _short(x: FloatArray, y: FloatArray, step: Slopes) -> Slopes:
    """A step no longer than a part of the distance from the axis."""
    part = 0.2 * (0.05 + np.hypot(x, y)) / (np.hypot(*step) + TINY)
    np.minimum(part, 1.0, out=part)
    return step[0] * part, step[1] * part


def _tilted(tau_x: Any, tau_y: Any) -> Any:
    """(3, 3): slopes on the plane at right angles to z to those on the turned one (matTilt)."""
    cx, sx, cy, sy = np.cos(tau_x), np.sin(tau_x), np.cos(tau_y), np.sin(tau_y)
    turned = np.array([[cy, sy * sx, -sy * cx], [0.0, cx, sx], [sy, -cy * sx, cy * cx]])
    onto = np.array([[turned[2, 2], 0.0, -turned[0, 2]], [0.0, turned[2, 2], -turned[1, 2]], [0.0, 0.0, 1.0]])
    return onto @ turned
