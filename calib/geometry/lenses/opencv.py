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

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from math import atan, degrees, inf, isfinite, nan, sqrt
from typing import Any, NamedTuple

import numpy as np

from calib.geometry.lens import SETTLED, TINY
from calib.geometry.rigid import FloatArray

COUNTS = (4, 5, 8, 12, 14)
NAMES = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6", "s1", "s2", "s3", "s4", "tau_x", "tau_y")

MOST_TURN_RAD = 1.5
"""The image plane is turned by less than this about either axis."""

_DIRECTIONS, _RADII, _STEEPEST = 48, 256, 100.0
"""Where the fold of a lens that is not round is looked for: directions, radii, and the largest slope."""

_KNOTS, _NARROWINGS = 8192, 8
"""Knots of the table that an inverse begins with; its range is narrowed so often at most."""

_SAME_RATES = 1e-4
"""After a step below this the derivatives of the step before are good enough."""

_LEFT = 1e-14
"""A pixel's slopes are settled with a residual this small. Others take Newton's way by themselves."""

_ROUNDING, _NEWTON = 1e-15, 40
"""Newton's way ends with a residual this small beside its numbers, after so many steps at most."""

_PATH = 48
"""Steps from the axis out to a pixel where Newton's own way does not lead to it."""


class Bent(NamedTuple):
    """Slopes (2, n) at which a lens shows points, which it reaches (n,), and d slope / d point (2, 3, n)."""

    slopes: FloatArray
    valid: np.ndarray
    rates: FloatArray | None = None


class Unbent(NamedTuple):
    """Unit directions (3, n) that land on slopes, which exist (n,), and d direction / d slope (3, 2, n)."""

    directions: FloatArray
    valid: np.ndarray
    rates: FloatArray | None = None


@dataclass(frozen=True, eq=False)
class OpencvLens:
    """One lens; shared by all copies of a camera that is moved.

    Attributes
    ----------
    distortion
        The coefficients, 4, 5, 8, 12 or 14 of them.
    image_slope
        The largest slope (u, v) inside the image.

    A lens that folds at its axis has no image: nothing is reached.

    Raises
    ------
    ValueError
        If there are other counts of them, they are not finite, or the plane is turned by 1.5 rad or more.
    """

    distortion: tuple[float, ...]
    image_slope: float = 1.0
    moving = False
    curved = False

    def __post_init__(self) -> None:
        count = len(self.distortion)
        if count not in COUNTS:
            expected = ", ".join(map(str, COUNTS))
            raise ValueError(f"{count} coefficients of a lens where {expected} are expected")
        if not isfinite(sum(self.distortion)):
            raise ValueError(f"distortion {list(self.distortion)} holds a value that is not finite")
        if max(map(abs, self.distortion[12:]), default=0.0) >= MOST_TURN_RAD:
            raise ValueError(f"the image is turned by {MOST_TURN_RAD:g} rad or more")
        k1, k2, p1, p2, k3, k4, k5, k6, s1, s2, s3, s4, *turn = (*self.distortion, *[0.0] * (14 - count))
        told: dict[str, Any] = {
            "_above": (k1, k2, k3),
            "_below": (k4, k5, k6) if k4 or k5 or k6 else None,
            "_beside": (p1, p2, p2 + s1, s2, p1 + s3, s4) if p1 or p2 or s1 or s2 or s3 or s4 else None,
            "_tilt": tilted(*turn) if any(turn) else None,
        }
        self.__dict__.update(told)

    # What follows is written so that it holds for floats and for arrays alike.

    def _radial(self, tau: Any) -> tuple[Any, Any]:
        """r, and what r is divided by (1 if by nothing)."""
        k1, k2, k3 = self._above  # type: ignore[attr-defined]
        r = 1.0 + tau * (k1 + tau * (k2 + tau * k3)) if k3 else 1.0 + tau * (k1 + tau * k2)
        if self._below is None:  # type: ignore[attr-defined]
            return r, 1.0
        k4, k5, k6 = self._below  # type: ignore[attr-defined]
        below = 1.0 + tau * (k4 + tau * (k5 + tau * k6))
        return r / below, below

    def _flat(self, x: Any, y: Any) -> tuple[Any, Any, Any]:
        """u and v before the plane is turned, and tau."""
        tau = x * x + y * y
        r, _ = self._radial(tau)
        if self._beside is None:  # type: ignore[attr-defined]
            return x * r, y * r, tau
        p1, p2, h1, h2, j1, j2 = self._beside  # type: ignore[attr-defined]
        g = r + (2.0 * p1) * y + (2.0 * p2) * x
        h, j = (h1 + h2 * tau, j1 + j2 * tau) if h2 or j2 else (h1, j1)
        return x * g + tau * h, y * g + tau * j, tau

    def _flat_rates(self, x: Any, y: Any) -> tuple[Any, ...]:
        """u, v, tau as ``_flat``, then du/dx, du/dy, dv/dx, dv/dy."""
        k1, k2, k3 = self._above  # type: ignore[attr-defined]
        tau = x * x + y * y
        r, below = self._radial(tau)
        rate = 2.0 * k1 + tau * (4.0 * k2 + tau * (6.0 * k3)) if k3 else 2.0 * k1 + tau * (4.0 * k2)
        if self._below is not None:  # type: ignore[attr-defined]
            k4, k5, k6 = self._below  # type: ignore[attr-defined]
            rate = (rate - r * (2.0 * k4 + tau * (4.0 * k5 + tau * (6.0 * k6)))) / below
        gx, gy = x * rate, y * rate  # rate is 2 dr / d tau
        if self._beside is None:  # type: ignore[attr-defined]
            both = x * gy
            return x * r, y * r, tau, r + x * gx, both, both, r + y * gy
        p1, p2, h1, h2, j1, j2 = self._beside  # type: ignore[attr-defined]
        g = r + (2.0 * p1) * y + (2.0 * p2) * x
        gx, gy = gx + 2.0 * p2, gy + 2.0 * p1
        if h2 or j2:
            h, j = h1 + h2 * tau, j1 + j2 * tau
            two_h, two_j = 2.0 * h1 + (4.0 * h2) * tau, 2.0 * j1 + (4.0 * j2) * tau
        else:
            h, j, two_h, two_j = h1, j1, 2.0 * h1, 2.0 * j1
        return (
            x * g + tau * h,
            y * g + tau * j,
            tau,
            g + x * (gx + two_h),
            x * gy + y * two_h,
            y * gx + x * two_j,
            g + y * (gy + two_j),
        )

    def bend(self, local: FloatArray, derivatives: bool = False) -> Bent:
        """Return where points (3, n), rows a, b, w of the lens frame in metres, are seen."""
        w = local[2]
        per_w = 1.0 / w
        x, y = local[0] * per_w, local[1] * per_w
        slopes = np.empty((2, len(w)))
        if not derivatives:
            slopes[0], slopes[1], tau = self._flat(x, y)
            return Bent(self._turned(slopes)[0], self._reached(x, y, tau) & (w > 0.0))
        slopes[0], slopes[1], tau, ux, uy, vx, vy = self._flat_rates(x, y)
        valid = self._reached(x, y, tau) & (w > 0.0)
        rates = np.empty((2, 3, len(w)))
        if self._tilt is not None:  # type: ignore[attr-defined]
            slopes, turn = self._turned(slopes)
            (ux, uy), (vx, vy) = _product(turn, ((ux, uy), (vx, vy)))
        for row, (by_x, by_y) in zip(rates, ((ux, uy), (vx, vy)), strict=True):
            np.multiply(by_x, per_w, out=row[0])
            np.multiply(by_y, per_w, out=row[1])
            np.multiply(row[0], x, out=row[2])
            row[2] += row[1] * y
            np.negative(row[2], out=row[2])
        return Bent(slopes, valid, rates)

    def coefficient_rates(self, local: FloatArray) -> FloatArray:
        """Return d slope / d coefficient (2, k, n) of points (3, n), as ``bend`` has them."""
        x, y = local[:2] / local[2]
        u, v, tau = self._flat(x, y)
        r, below = self._radial(tau)
        per = 1.0 / below
        powers = (tau, tau * tau, tau * tau * tau)
        plain = [np.stack([x, y]) * (power * per) for power in powers]
        zero = np.zeros_like(x)
        beside = [np.stack([2.0 * x * y, tau + 2.0 * y * y]), np.stack([tau + 2.0 * x * x, 2.0 * x * y])]
        rows = [*plain[:2], *beside, plain[2], *(-r * one for one in plain)]
        rows += [np.stack([p, zero]) for p in powers[:2]] + [np.stack([zero, p]) for p in powers[:2]]
        count = len(self.distortion)
        rates = np.stack(rows[: min(count, 12)], axis=1)
        if self._tilt is not None:  # type: ignore[attr-defined]
            _, (first, second) = self._turned(np.stack([u, v]))
            rates = np.stack(
                [one[0] * rates[0] + one[1] * rates[1] for one in (first, second)]  # the turned plane's
            )
        if count == 14:
            turn = self.distortion[12:]
            flat = np.stack([u, v, np.ones_like(u)])
            now = tilted(*turn) @ flat
            more = []
            for axis in (0, 1):
                bit = np.zeros(2, dtype=complex)
                bit[axis] = 1e-30j
                moved = (tilted(*(np.array(turn) + bit)).imag * 1e30) @ flat
                more.append((moved[:2] - now[:2] / now[2] * moved[2]) / now[2])
            rates = np.concatenate([rates, np.stack(more, axis=1)], axis=1)
        return np.asarray(rates, dtype=np.float64)

    def unbend(self, slopes: FloatArray, derivatives: bool = False) -> Unbent:
        """Return the directions that land on slopes (2, n)."""
        flat = slopes
        if self._tilt is not None:  # type: ignore[attr-defined]
            back = self._untilt @ np.vstack([slopes, np.ones(slopes.shape[1])])
            flat = back[:2] / back[2]
        x, y, valid = self._undistorted(flat[0], flat[1])
        if self._tilt is not None:  # type: ignore[attr-defined]
            valid &= back[2] > 0.0
        directions = np.empty((3, len(x)))
        per_length = np.divide(1.0, np.sqrt(1.0 + x * x + y * y), out=directions[2])
        np.multiply(x, per_length, out=directions[0])
        np.multiply(y, per_length, out=directions[1])
        if not derivatives:
            return Unbent(directions, valid)
        u, v, _, ux, uy, vx, vy = self._flat_rates(x, y)
        if self._tilt is not None:  # type: ignore[attr-defined]
            _, turn = self._turned(np.stack([u, v]))
            (ux, uy), (vx, vy) = _product(turn, ((ux, uy), (vx, vy)))
        per = 1.0 / (ux * vy - uy * vx)
        d = directions
        rates = np.empty((3, 2, len(x)))
        for column, (dx, dy) in enumerate(((vy * per, -vx * per), (-uy * per, ux * per))):
            along = (dx * d[0] + dy * d[1]) * per_length
            for row, dz in enumerate((dx * per_length, dy * per_length, 0.0)):
                rates[row, column] = dz - d[row] * along
        return Unbent(directions, valid, rates)

    def bend_point(self, a: float, b: float, w: float) -> tuple[float, float]:
        """Return the slopes at which one point is seen, not-a-number if it is not."""
        if not w > 0.0 or not isfinite(a + b + w) or (per_w := 1.0 / w) == inf:
            return nan, nan
        x, y = a * per_w, b * per_w
        if not x * x + y * y < self.near * self.near:
            with np.errstate(all="ignore"):
                if not self._reached_far(*np.array([[x], [y], [x * x + y * y]]))[0]:
                    return nan, nan
        u, v, _ = self._flat(x, y)
        if self._tilt is None:  # type: ignore[attr-defined]
            return u, v
        p, q, s = (self._tilt @ (u, v, 1.0)).tolist()  # type: ignore[attr-defined]
        return (p / s, q / s) if s > 0.0 else (nan, nan)

    def unbend_point(self, u: float, v: float) -> tuple[float, float, float] | None:
        """Return the unit direction that lands on slopes, None if there is none."""
        if not isfinite(u + v):
            return None
        if self._tilt is not None:  # type: ignore[attr-defined]
            p, q, s = (self._untilt @ (u, v, 1.0)).tolist()
            if not s > 0.0:
                return None
            u, v = p / s, q / s
        x, y = self._begin(u, v)
        for _ in range(6):
            if not x * x + y * y < self.near * self.near:
                break
            now_u, now_v, _, ux, uy, vx, vy = self._flat_rates(x, y)
            det = ux * vy - uy * vx
            if not det > 0.0:
                break
            off_u, off_v = u - now_u, v - now_v
            step_x, step_y = (vy * off_u - uy * off_v) / det, (ux * off_v - vx * off_u) / det
            x, y = x + step_x, y + step_y
            if abs(step_x) + abs(step_y) < SETTLED:
                per = 1.0 / sqrt(1.0 + x * x + y * y)
                return x * per, y * per, per
        if not u * u + v * v < self._start[1] ** 2:
            return None
        some_x, some_y, found = self._follow(np.array([u]), np.array([v]))
        if not found[0]:
            return None
        x, y = float(some_x[0]), float(some_y[0])
        per = 1.0 / sqrt(1.0 + x * x + y * y)
        return x * per, y * per, per

    @property
    def limit_words(self) -> str:
        """Where the lens ends, as the end of a sentence."""
        edge = self._plane_edge
        if edge < self.near:
            return f"the turned image plane ends {degrees(atan(edge)):.1f} degrees from the axis, on one side"
        if self.near >= _STEEPEST:
            return "the lens ends 90 degrees from its axis"
        return (
            f"the lens folds at {degrees(atan(self.near)):.1f} degrees from its axis (slope {self.near:.3g})"
        )

    @property
    def _plane_edge(self) -> float:
        """The slope at which a turned image plane first runs along the rays; infinite if nowhere."""
        if self._tilt is None:  # type: ignore[attr-defined]
            return inf
        p, q, s = self._tilt[2].tolist()  # type: ignore[attr-defined]
        per = -s / (p * p + q * q)
        with np.errstate(all="ignore"):
            x, y, valid = self._undistorted(np.array([per * p]), np.array([per * q]))
        return float(np.hypot(x, y)[0]) if valid[0] else inf

    @property
    def near(self) -> float:
        """The slope sqrt(tau) up to which the lens folds in no direction."""
        return self._folds[0]

    @property
    def far(self) -> float:
        """The slope sqrt(tau) from which on nothing is reached."""
        return self._folds[1]

    @cached_property
    @np.errstate(all="ignore")
    def _folds(self) -> tuple[float, float]:
        round_fold = self._round_fold()
        if self._beside is None:  # type: ignore[attr-defined]
            return round_fold, round_fold
        steepest = min(1.5 * round_fold, _STEEPEST)
        rho = np.tan(np.linspace(0.0, atan(steepest), _RADII))
        around = np.linspace(0.0, 2.0 * np.pi, _DIRECTIONS, endpoint=False)
        x, y = np.cos(around)[:, None] * rho, np.sin(around)[:, None] * rho
        good = self._upright(x, y)
        first = np.where(good.all(axis=1), _RADII, good.argmin(axis=1))
        if first.min() < 2:
            return 0.0, 0.0
        ends = rho[np.minimum(first, _RADII - 1)]
        near = float(rho[first.min() - 1])
        far = float(ends.max())
        if first.max() == _RADII:
            far = inf if steepest == _STEEPEST else steepest
        later = good & (np.arange(_RADII) >= first[:, None]) & (rho < far)
        return (near, near) if later.any() else (near, far)

    def _round_fold(self) -> float:
        """The first slope where rho r stops growing, or r has a pole; infinite if none."""
        above = np.polynomial.Polynomial([1.0, *self._above])  # type: ignore[attr-defined]
        below = np.polynomial.Polynomial([1.0, *(self._below or (0.0, 0.0, 0.0))])  # type: ignore[attr-defined]
        y = np.polynomial.Polynomial([0.0, 1.0])
        growth = (above + 2.0 * y * above.deriv()) * below - 2.0 * y * above * below.deriv()
        return float(np.sqrt(min(first_root(growth), first_root(below))))

    def _upright(self, x: FloatArray, y: FloatArray) -> np.ndarray:
        """Where the picture is not turned inside out."""
        with np.errstate(all="ignore"):
            _, _, tau, ux, uy, vx, vy = self._flat_rates(x, y)
            return np.asarray((ux * vy - uy * vx > 0.0) & (self._radial(tau)[1] > 0.0))

    def _reached(self, x: FloatArray, y: FloatArray, tau: FloatArray) -> np.ndarray:
        valid = np.less(tau, self.near * self.near)
        if not valid.all():
            rows = ~valid
            valid[rows] = self._reached_far(x[rows], y[rows], tau[rows])
        return valid

    def _reached_far(self, x: Any, y: Any, tau: Any) -> Any:
        return np.less(tau, self.far * self.far) & self._upright(x, y) & (self.near < self.far)

    def _turned(self, slopes: FloatArray) -> tuple[FloatArray, Any]:
        """Slopes on the turned plane, and their rates ((,), (,)) to those before."""
        tilt = self._tilt  # type: ignore[attr-defined]
        if tilt is None:
            return slopes, None
        seen = tilt[:, :2] @ slopes + tilt[:, 2:]
        per = 1.0 / np.where(seen[2] > 0.0, seen[2], nan)
        turned = seen[:2] * per
        (a, b, _), (c, d, _), (e, f, _) = tilt.tolist()
        return turned, (
            ((a - turned[0] * e) * per, (b - turned[0] * f) * per),
            ((c - turned[1] * e) * per, (d - turned[1] * f) * per),
        )

    @cached_property
    def _untilt(self) -> FloatArray:
        return np.asarray(np.linalg.inv(self._tilt))  # type: ignore[attr-defined]

    @cached_property
    @np.errstate(all="ignore")
    def _start(self) -> tuple[Start, float]:
        """Table of chi / t, and the largest t seen."""

        def bent(angle: FloatArray) -> tuple[FloatArray, FloatArray]:
            rho = np.tan(angle)
            return rho, rho * self._radial(rho * rho)[0]

        end = atan(min(max(self.near, 1e-3), _STEEPEST))
        table = start_table(bent, end, self.image_slope)
        farthest = inf
        if self.far < inf:
            around = np.linspace(0.0, 2.0 * np.pi, 4 * _DIRECTIONS)
            farthest = 1.002 * max(
                float(np.hypot(*self._flat(rho * np.cos(around), rho * np.sin(around))[:2]).max())
                for rho in (self.near, self.far)
            )
        return table, farthest if isfinite(farthest) else inf

    def _begin(self, u: Any, v: Any) -> tuple[Any, Any]:
        """Undistorted slopes to begin with."""
        table = self._start[0]
        k = table.ratio(u * u + v * v)
        x, y = u * k, v * k
        if self._beside is None:  # type: ignore[attr-defined]
            return x, y
        p1, p2, h1, h2, j1, j2 = self._beside  # type: ignore[attr-defined]
        for _ in range(2):
            tau = x * x + y * y
            g = (2.0 * p1) * y + (2.0 * p2) * x
            h, j = (h1 + h2 * tau, j1 + j2 * tau) if h2 or j2 else (h1, j1)
            flat_u, flat_v = u - x * g - tau * h, v - y * g - tau * j
            k = table.ratio(flat_u * flat_u + flat_v * flat_v)
            x, y = flat_u * k, flat_v * k
        return x, y

    def _undistorted(self, u: FloatArray, v: FloatArray) -> tuple[FloatArray, FloatArray, np.ndarray]:
        """Undistorted slopes of distorted ones, and which exist."""
        x, y = self._begin(u, v)
        largest, before = inf, np.full_like(x, inf)
        for _ in range(6):
            if largest > _SAME_RATES:
                now_u, now_v, tau, ux, uy, vx, vy = self._flat_rates(x, y)
                per = 1.0 / (ux * vy - uy * vx)
                ux *= per
                vy *= per
                uy = uy * per
                vx = vx * per
            else:
                now_u, now_v, tau = self._flat(x, y)
            off_u, off_v = np.subtract(u, now_u, out=now_u), np.subtract(v, now_v, out=now_v)
            step_x = vy * off_u - uy * off_v
            step_y = ux * off_v - vx * off_u
            x += step_x
            y += step_y
            size = np.abs(step_x, out=step_x)
            size += np.abs(step_y, out=step_y)
            largest = float(size.max(initial=0.0))
            if largest < SETTLED:
                break
            before = size
        # Of what a step took away, about the same part again is left as the step is of the one before.
        left = np.abs(off_u, out=off_u)
        left += np.abs(off_v, out=off_v)
        left *= size
        before += TINY
        left /= before
        valid = (left < _LEFT) & (tau < min(self.near * self.near, 1e300))
        if not valid.all():
            rows = np.flatnonzero(~valid)
            rows = rows[np.hypot(u[rows], v[rows]) < self._start[1]]
            if len(rows):
                x[rows], y[rows], valid[rows] = self._newton(u[rows], v[rows], x[rows], y[rows])
            rows = rows[~valid[rows]]
            if len(rows):
                x[rows], y[rows], valid[rows] = self._follow(u[rows], v[rows])
        return x, y, valid

    def _newton(
        self, u: FloatArray, v: FloatArray, x: FloatArray, y: FloatArray
    ) -> tuple[FloatArray, FloatArray, np.ndarray]:
        """The same from slopes near by, as exactly as they can be had."""
        with np.errstate(all="ignore"):
            for _ in range(_NEWTON):
                now_u, now_v, tau, ux, uy, vx, vy = self._flat_rates(x, y)
                per = 1.0 / (ux * vy - uy * vx)
                off_u, off_v = u - now_u, v - now_v
                left = np.abs(off_u) + np.abs(off_v)
                rounding = 1.0 + np.abs(u) + np.abs(v)
                rounding += np.sqrt(tau) * (np.abs(ux) + np.abs(uy) + np.abs(vx) + np.abs(vy))
                settled = left < 0.5 * _ROUNDING * rounding
                if settled.all():
                    break
                step_x, step_y = (vy * off_u - uy * off_v) * per, (ux * off_v - vx * off_u) * per
                short = np.minimum(1.0, 0.2 * (0.05 + np.sqrt(tau)) / (np.hypot(step_x, step_y) + TINY))
                short[settled] = 0.0
                x, y = x + short * step_x, y + short * step_y
        return x, y, (left < _ROUNDING * rounding) & self._reached(x, y, tau)

    def _follow(self, u: FloatArray, v: FloatArray) -> tuple[FloatArray, FloatArray, np.ndarray]:
        """The same for pixels near a fold: step by step from the axis, never across it."""
        x, y = np.zeros_like(u), np.zeros_like(v)
        lost = ~np.isfinite(u + v)
        with np.errstate(all="ignore"):
            for part in np.arange(1, _PATH + 1) / _PATH:
                for _ in range(3):
                    now_u, now_v, tau, ux, uy, vx, vy = self._flat_rates(x, y)
                    per = 1.0 / (ux * vy - uy * vx)
                    off_u, off_v = part * u - now_u, part * v - now_v
                    step_x, step_y = (vy * off_u - uy * off_v) * per, (ux * off_v - vx * off_u) * per
                    short = np.minimum(1.0, 0.2 * (0.05 + np.sqrt(tau)) / (np.hypot(step_x, step_y) + TINY))
                    x, y = x + short * step_x, y + short * step_y
                lost |= ~(per > 0.0)
        x, y, found = self._newton(u, v, x, y)
        return x, y, found & ~lost


class Start(NamedTuple):
    """A table of what is sought over t, by t^2 in even steps, which an inverse begins with.

    values, rises (n,): at the beginning of each step, and to the next; per_square: steps in t^2 of 1.
    """

    values: FloatArray
    rises: FloatArray
    per_square: float

    def ratio(self, square: Any) -> Any:
        """Return what is sought over t; the last of the table beyond its end."""
        last = len(self.values) - 1
        if isinstance(square, float):
            place = min(square * self.per_square, float(last))
            at = int(place)
            return self.values.item(at) + (place - at) * self.rises.item(at)
        places = square * self.per_square
        np.minimum(places, last, out=places)
        numbers = places.astype(np.intp)
        places -= numbers
        places *= self.rises.take(numbers, mode="clip")
        places += self.values.take(numbers, mode="clip")
        return places


def start_table(
    bent: Callable[[FloatArray], tuple[FloatArray, FloatArray]], end_rad: float, image_slope: float
) -> Start:
    """Return the table of an inverse; ``bent`` gives of angles (n,) what is sought, and the slope t."""
    for _ in range(_NARROWINGS):
        angles = np.linspace(0.0, end_rad, 2 * _KNOTS)[1:-1]
        sought, t = bent(angles)
        last = int(np.searchsorted(t, 1.1 * image_slope))
        if last >= _KNOTS // 16:
            break
        end_rad = float(angles[last])
    last = max(last, _KNOTS // 16)
    square, ratio = t[:last] ** 2, sought[:last] / t[:last]
    places = np.linspace(0.0, float(square[-1]), _KNOTS)
    values = np.interp(places, square, ratio)
    return Start(values, np.append(np.diff(values), 0.0), (_KNOTS - 1) / float(square[-1]))


def first_root(polynomial: np.polynomial.Polynomial) -> float:
    """Return the smallest real root above zero; infinite if there is none."""
    roots = np.asarray(polynomial.trim().roots(), dtype=complex)
    real = roots.real[(np.abs(roots.imag) <= 1e-9 * np.abs(roots)) & (roots.real > 0.0)]
    return float(real.min(initial=inf))


def _product(one: Any, other: Any) -> Any:
    """The product of two (2, 2) of arrays."""
    (a, b), (c, d) = one
    (e, f), (g, h) = other
    return (a * e + b * g, a * f + b * h), (c * e + d * g, c * f + d * h)


def tilted(tau_x: Any, tau_y: Any) -> Any:
    """Return (3, 3): slopes on the plane at right angles to z to those on the turned one (matTilt)."""
    cx, sx, cy, sy = np.cos(tau_x), np.sin(tau_x), np.cos(tau_y), np.sin(tau_y)
    turned = np.array([[cy, sy * sx, -sy * cx], [0.0, cx, sx], [sy, -cy * sx, cy * cx]])
    onto = np.array([[turned[2, 2], 0.0, -turned[0, 2]], [0.0, turned[2, 2], -turned[1, 2]], [0.0, 0.0, 1.0]])
    return onto @ turned
