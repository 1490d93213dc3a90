"""From points to pixels and back, for lenses that are not round about an axis of their own.

The lens frame is the camera's: x right, y down, z along A. The lens makes slopes (u, v) of points, and a
camera matrix, whose last row is (0, 0, 1), makes pixels of slopes. As in `calib.geometry.projection` nothing
here changes when the camera moves.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from math import isfinite, nan
from typing import Protocol

import numpy as np

from calib.geometry.lenses.opencv import Bent, Unbent
from calib.geometry.projection import CHUNK, Place, Rays, Triple, chunks
from calib.geometry.rigid import FloatArray, ReadOnlyArrays


class FreeLens(Protocol):
    """A lens that makes slopes of points in the camera's own axes; see `calib.geometry.lenses`."""

    @property
    def distortion(self) -> tuple[float, ...]:
        """The coefficients."""
        ...

    @property
    def limit_words(self) -> str:
        """Where the lens ends, as the end of a sentence; empty if it ends nowhere."""
        ...

    def bend(self, local: FloatArray, derivatives: bool = False) -> Bent:
        """Return where points (3, n) are seen."""
        ...

    def unbend(self, slopes: FloatArray, derivatives: bool = False) -> Unbent:
        """Return the directions that land on slopes (2, n)."""
        ...

    def bend_point(self, a: float, b: float, w: float) -> tuple[float, float]:
        """Return the slopes at which one point is seen, not-a-number if it is not."""
        ...

    def unbend_point(self, u: float, v: float) -> tuple[float, float, float] | None:
        """Return the unit direction that lands on slopes, None if there is none."""
        ...


@dataclass(frozen=True, eq=False)
class FreeProjection(ReadOnlyArrays):
    """A lens with a camera matrix behind it; a `calib.geometry.projection.PixelMap`.

    Attributes
    ----------
    lens
        Its map of points.
    pixel_from_slope, slope_from_pixel
        (3, 3): the camera matrix [[fx, skew, cx], [0, fy, cy], [0, 0, 1]], and its inverse.
    """

    lens: FreeLens
    pixel_from_slope: FloatArray
    slope_from_pixel: FloatArray
    moving = False

    @property
    def limit_words(self) -> str:
        """Where the lens ends, as the end of a sentence; empty if it ends nowhere."""
        return self.lens.limit_words

    def project(
        self, points: FloatArray, center: FloatArray, frame: FloatArray, derivatives: bool
    ) -> tuple[FloatArray, FloatArray, np.ndarray]:
        """Return pixels (n, 2), Jacobians (n, 2, 3) if asked for, and which are valid (n,), as `PixelMap`."""
        count, axes = len(points), frame[1:]
        pixels, valid = np.empty((count, 2)), np.empty(count, dtype=bool)
        jacobian = np.empty((count if derivatives else 0, 2, 3))
        with np.errstate(all="ignore"):
            for part in chunks(count) if count > CHUNK else (slice(None),):
                self._project(points[part], center, axes, pixels[part], jacobian[part], valid[part])
        return pixels, jacobian, valid

    def _project(
        self,
        points: FloatArray,
        center: FloatArray,
        axes: FloatArray,
        pixels: FloatArray,
        jacobian: FloatArray,
        valid: np.ndarray,
    ) -> None:
        """Fill pixels and validity of one chunk, and the Jacobian if it has rows."""
        k = self.pixel_from_slope
        local = axes @ np.subtract(points.T, center[:, None], order="C")
        bent = self.lens.bend(local, len(jacobian) > 0)
        np.matmul(bent.slopes.T, k[:2, :2].T, out=pixels)
        pixels += k[:2, 2]
        valid[...] = bent.valid
        if not isfinite(np.vdot(pixels, pixels)):
            valid &= np.isfinite(pixels).all(axis=1)
        if bent.rates is not None:
            # d slope / d local, by the matrix from the left and the axes from the right, as one product
            both = (k[:2, :2].T[:, None, :, None] * axes[:, None]).reshape(6, 6)
            np.matmul(bent.rates.reshape(6, -1).T, both, out=jacobian.reshape(-1, 6))
        if not valid.all():
            pixels[~valid] = nan
            jacobian[~valid[: len(jacobian)]] = nan

    def rays(self, pixels: FloatArray, center: FloatArray, axes: FloatArray, derivatives: bool) -> Rays:
        """Return origins, directions, validity and both derivatives of pixels (n, 2), as `PixelMap`."""
        count = len(pixels)
        origins, directions, valid = np.empty((count, 3)), np.empty((count, 3)), np.empty(count, dtype=bool)
        rows = count if derivatives else 0
        d_directions, d_origins = np.empty((rows, 3, 2)), np.zeros((rows, 3, 2))
        origins[...] = center
        with np.errstate(all="ignore"):
            for part in chunks(count) if count > CHUNK else (slice(None),):
                self._rays(pixels[part], axes, directions[part], valid[part], d_directions[part])
        if not valid.all():
            lost = ~valid
            origins[lost] = nan
            directions[lost] = nan
            if derivatives:
                d_directions[lost] = nan
                d_origins[lost] = nan
        return origins, directions, valid, d_directions, d_origins

    def _rays(
        self,
        pixels: FloatArray,
        axes: FloatArray,
        directions: FloatArray,
        valid: np.ndarray,
        d_directions: FloatArray,
    ) -> None:
        """Fill the directions of one chunk, and their derivatives if these have rows."""
        k = self.slope_from_pixel
        slopes = k[:2, :2] @ pixels.T
        slopes += k[:2, 2:]
        ray = self.lens.unbend(slopes, len(d_directions) > 0)
        local = ray.directions
        valid[...] = ray.valid
        if not isfinite(np.vdot(local, local)):
            valid &= np.isfinite(local).all(axis=0)
        np.matmul(local.T, axes, out=directions)
        if ray.rates is not None:
            turned = np.tensordot(axes.T, ray.rates, axes=1)  # (3, 2, n) by slopes
            d_directions[...] = np.tensordot(turned, k[:2, :2], axes=(1, 0)).transpose(1, 0, 2)

    @cached_property
    def _floats(self) -> tuple[list[list[float]], list[list[float]]]:
        """Both matrices as plain floats."""
        return self.pixel_from_slope.tolist(), self.slope_from_pixel.tolist()

    def project_point(self, x: float, y: float, z: float, place: Place) -> tuple[float, float]:
        """Return the pixel of one point, not-a-number if it has none."""
        (cx, cy, cz), (xx, xy, xz), (yx, yy, yz), (ox, oy, oz) = place
        (fx, skew, px), (_, fy, py), _ = self._floats[0]
        x, y, z = x - cx, y - cy, z - cz
        u, v = self.lens.bend_point(
            xx * x + xy * y + xz * z, yx * x + yy * y + yz * z, ox * x + oy * y + oz * z
        )
        x, y = fx * u + skew * v + px, fy * v + py
        return (x, y) if isfinite(x + y) else (nan, nan)

    def ray_of_pixel(self, x_px: float, y_px: float, place: Place) -> tuple[Triple, Triple] | None:
        """Return origin and direction of one pixel's ray, None if it has none."""
        (ux, uy, uz), (_, vy, vz), _ = self._floats[1]
        found = self.lens.unbend_point(ux * x_px + uy * y_px + uz, vy * y_px + vz)
        if found is None:
            return None
        a, b, q = found
        (cx, cy, cz), (xx, xy, xz), (yx, yy, yz), (ox, oy, oz) = place
        return (
            (cx, cy, cz),
            (a * xx + b * yx + q * ox, a * xy + b * yy + q * oy, a * xz + b * yz + q * oz),
        )
