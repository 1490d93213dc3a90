"""mrcal's splined stereographic lens: read and used as it is, never fitted.

A point at the angle theta to z, in the direction phi about it, has the stereographic place s = 2 tan(theta/2)
(cos phi, sin phi). A uniform B-spline of order 2 or 3 over a grid of Nx by Ny control points adds d(s), and
the slopes are s + d(s). Control points stand around the middle of the grid, ``per_knot`` apart: so that the
grid without its margin spans the field of view in x. Beyond the grid the outermost pieces go on.
Source: https://mrcal.secretsauce.net/splined-models.html.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from math import atan, degrees, isfinite, nan, radians, tan
from typing import Any

import numpy as np

from calib.geometry.lens import SETTLED
from calib.geometry.lenses.opencv import Bent, Unbent
from calib.geometry.rigid import FloatArray

_NEWTON = 30


@dataclass(frozen=True)
class SplineGrid:
    """How mrcal's control points stand.

    Attributes
    ----------
    order
        2 or 3: of the polynomials between control points.
    columns, rows
        Nx and Ny, how many control points there are; more than ``order`` each.
    fov_x_deg
        The field of view across the image that the grid is made for, degrees.

    Raises
    ------
    ValueError
        If the numbers are no grid.
    """

    order: int
    columns: int
    rows: int
    fov_x_deg: float

    def __post_init__(self) -> None:
        if self.order not in (2, 3):
            raise ValueError(f"order {self.order} where 2 or 3 is expected")
        if min(self.columns, self.rows) <= self.order or max(self.columns, self.rows) > 1000:
            raise ValueError(
                f"{self.columns} x {self.rows} control points where 4 to 1000 each way are expected"
            )
        if not 0.0 < self.fov_x_deg < 360.0:
            raise ValueError(f"a field of view of {self.fov_x_deg:g} degrees where 0 to 360 is expected")

    @property
    def per_knot(self) -> float:
        """Stereographic distance between control points."""
        inside = self.columns - (3 if self.order == 3 else 2)
        return 4.0 * tan(radians(self.fov_x_deg) / 4.0) / inside


@dataclass(frozen=True, eq=False)
class SplineLens:
    """One lens; shared by all copies of a camera that is moved.

    Attributes
    ----------
    grid
        Where the control points stand.
    distortion
        The control points' (x, y), row after row: 2 Nx Ny numbers.
    image_slope
        The largest slope (u, v) inside the image.
    """

    grid: SplineGrid
    distortion: tuple[float, ...]
    image_slope: float = 1.0
    moving = False
    curved = True

    def __post_init__(self) -> None:
        count = 2 * self.grid.columns * self.grid.rows
        if len(self.distortion) != count:
            raise ValueError(f"{len(self.distortion)} numbers of control points where {count} are expected")
        if not isfinite(sum(self.distortion)):
            raise ValueError("a control point is not finite")

    @cached_property
    def _control(self) -> FloatArray:
        return np.array(self.distortion).reshape(self.grid.rows, self.grid.columns, 2)

    def _slopes(self, s: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Slopes (2, n) at stereographic places (2, n), and d slope / d place (2, 2, n)."""
        grid, order = self.grid, self.grid.order
        first, weights, rates = [], [], []
        for axis, count in enumerate((grid.columns, grid.rows)):
            place = s[axis] / grid.per_knot + (count - 1) / 2
            low, high = (1, count - 3) if order == 3 else (1, count - 2)
            knot = np.clip(np.floor(place if order == 3 else place + 0.5), low, high)
            knot = np.where(np.isfinite(knot), knot, low).astype(int)
            first.append(knot - 1)
            weight, rate = (_cubic if order == 3 else _quadratic)(place - knot)
            weights.append(weight)
            rates.append([one / grid.per_knot for one in rate])
        slopes = s.copy()
        jacobian = np.zeros((2, 2, s.shape[1]))
        jacobian[0, 0] = jacobian[1, 1] = 1.0
        for j in range(order + 1):
            for i in range(order + 1):
                control = self._control[first[1] + j, first[0] + i].T
                slopes += control * (weights[0][i] * weights[1][j])
                jacobian[:, 0] += control * (rates[0][i] * weights[1][j])
                jacobian[:, 1] += control * (weights[0][i] * rates[1][j])
        return slopes, jacobian

    def bend(self, local: FloatArray, derivatives: bool = False) -> Bent:
        """Return where points (3, n), rows a, b, w of the lens frame in metres, are seen."""
        a, b, w = local
        length = np.sqrt(a * a + b * b + w * w)
        scale = 2.0 / (length + w)
        s = local[:2] * scale
        slopes, jacobian = self._slopes(s)
        valid = self._reached(s, jacobian) & (length + w > 1e-12 * length) & (length > 0.0)
        if not derivatives:
            return Bent(slopes, valid)
        # d scale / d(a, b, w) = -scale^2 / 2 (a/L, b/L, w/L + 1)
        per = -0.5 * scale * scale
        d_scale = np.stack([per * a / length, per * b / length, per * (w / length + 1.0)])
        d_place = local[:2, None] * d_scale
        d_place[0, 0] += scale
        d_place[1, 1] += scale
        return Bent(slopes, valid, np.einsum("ijn,jkn->ikn", jacobian, d_place))

    def unbend(self, slopes: FloatArray, derivatives: bool = False) -> Unbent:
        """Return the directions that land on slopes (2, n)."""
        s = slopes - self._slopes(slopes)[0] + slopes
        for _ in range(_NEWTON):
            now, jacobian = self._slopes(s)
            off = slopes - now
            (a, b), (c, d) = jacobian
            per = 1.0 / (a * d - b * c)
            step = np.stack([(d * off[0] - b * off[1]) * per, (a * off[1] - c * off[0]) * per])
            size = np.abs(step).max(axis=0)
            step *= np.minimum(1.0, self.grid.per_knot / np.maximum(size, 1e-300))
            s = s + step
            if not (size > SETTLED).any():
                break
        _, jacobian = self._slopes(s)
        valid = (size <= SETTLED) & self._reached(s, jacobian)
        square = 0.25 * (s[0] * s[0] + s[1] * s[1])
        per = 1.0 / (1.0 + square)
        directions = np.stack([s[0] * per, s[1] * per, (1.0 - square) * per])
        if not derivatives:
            return Unbent(directions, valid)
        d_place = np.empty((3, 2, s.shape[1]))
        for column in range(2):
            along = 0.5 * s[column] * per
            d_place[:2, column] = -directions[:2] * along
            d_place[column, column] += per
            d_place[2, column] = -s[column] * per * per
        (a, b), (c, d) = jacobian
        inverse = np.array([[d, -b], [-c, a]]) / (a * d - b * c)
        return Unbent(directions, valid, np.einsum("ijn,jkn->ikn", d_place, inverse))

    def bend_point(self, a: float, b: float, w: float) -> tuple[float, float]:
        """Return the slopes at which one point is seen, not-a-number if it is not."""
        if not isfinite(a + b + w):
            return nan, nan
        with np.errstate(all="ignore"):
            bent = self.bend(np.array([[a], [b], [w]]))
        u, v = bent.slopes[:, 0].tolist()
        return (u, v) if bent.valid[0] else (nan, nan)

    def unbend_point(self, u: float, v: float) -> tuple[float, float, float] | None:
        """Return the unit direction that lands on slopes, None if there is none."""
        if not isfinite(u + v):
            return None
        with np.errstate(all="ignore"):
            ray = self.unbend(np.array([[u], [v]]))
        x, y, z = ray.directions[:, 0].tolist()
        return (x, y, z) if ray.valid[0] else None

    def _reached(self, s: FloatArray, jacobian: FloatArray) -> np.ndarray:
        """Where places lie within the grid, and the picture is not turned inside out."""
        (a, b), (c, d) = jacobian
        across, down = self._ends
        return np.asarray((a * d - b * c > 0.0) & (np.abs(s[0]) <= across) & (np.abs(s[1]) <= down))

    @property
    def _ends(self) -> tuple[float, float]:
        """Stereographic places up to which the splines go, in x and in y."""
        margin = 3 if self.grid.order == 3 else 2
        half = 0.5 * self.grid.per_knot
        return half * (self.grid.columns - margin), half * (self.grid.rows - margin)

    @property
    def limit_words(self) -> str:
        """Where the lens ends, as the end of a sentence."""
        across, down = (degrees(2.0 * atan(end / 2.0)) for end in self._ends)
        return f"the splines end {across:.1f} degrees from the axis across the image and {down:.1f} down it"


def _cubic(x: FloatArray) -> tuple[Any, Any]:
    """Weights of the four control points about x in [0, 1), and their rates."""
    square, cube = x * x, x * x * x
    weights = (
        (1.0 - 3.0 * x + 3.0 * square - cube) / 6.0,
        (4.0 - 6.0 * square + 3.0 * cube) / 6.0,
        (1.0 + 3.0 * x + 3.0 * square - 3.0 * cube) / 6.0,
        cube / 6.0,
    )
    rates = (
        -0.5 * (1.0 - x) ** 2,
        1.5 * square - 2.0 * x,
        0.5 + x - 1.5 * square,
        0.5 * square,
    )
    return weights, rates


def _quadratic(x: FloatArray) -> tuple[Any, Any]:
    """Weights of the three control points about x in [-1/2, 1/2), and their rates."""
    weights = (0.5 * (0.5 - x) ** 2, 0.75 - x * x, 0.5 * (0.5 + x) ** 2)
    return weights, (x - 0.5, -2.0 * x, x + 0.5)
