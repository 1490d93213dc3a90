"""From points to pixels and back, for a camera whose vectors are given in its lens frame.

A point is turned into the lens frame (origin C, z along O), bent into slopes (`calib.geometry.lens_rays`),
and a plane projection by H, V and A makes pixels of slopes; a ray goes the same way back. Nothing here
changes when the camera moves: its place comes with each call as C and the lens frame's axes.

Labels print six digits, so A and O are not unit vectors to the last; they are normalised on load. The plain
formulas of JPL's library, which takes them as they are (`project_as_published`), serve only to say by how
much that moves a pixel.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from math import inf, isfinite, nan
from typing import Protocol

import numpy as np

from calib.geometry.lens import Lens
from calib.geometry.lens_rays import bend, bend_point, unbend, unbend_point
from calib.geometry.rigid import FloatArray, ReadOnlyArrays

CHUNK = 4096
"""Points at a time: some thirty rows of them stay in a core's own cache."""

Triple = tuple[float, float, float]
Place = tuple[list[float], list[float], list[float], list[float]]
"""C and the lens frame's x, y and z = O as plain floats."""

Rays = tuple[FloatArray, FloatArray, np.ndarray, FloatArray, FloatArray]


class PixelMap(Protocol):
    """The functions that a camera needs of a lens with the plane behind it, wherever the camera stands.

    `Projection` is that of the CAHV family, `calib.geometry.lenses.projection.FreeProjection` that of lenses
    which are not round about O.
    """

    @property
    def moving(self) -> bool:
        """Whether the entrance point moves with a ray's angle."""
        ...

    @property
    def limit_words(self) -> str:
        """Where the lens ends, as the end of a sentence; empty if it ends nowhere."""
        ...

    def project(
        self, points: FloatArray, center: FloatArray, frame: FloatArray, derivatives: bool
    ) -> tuple[FloatArray, FloatArray, np.ndarray]:
        """Return pixels (n, 2), Jacobians (n, 2, 3) if asked for, and which are valid (n,).

        ``points`` (n, 3) metres, ``center`` (3,) and ``frame`` (4, 3) are in one frame; the rows of the last
        are A and the lens frame's axes.
        """
        ...

    def rays(self, pixels: FloatArray, center: FloatArray, axes: FloatArray, derivatives: bool) -> Rays:
        """Return origins (n, 3), directions (n, 3) and validity (n,) of the rays of pixels (n, 2).

        Then d direction / d pixel and d origin / d pixel, (n, 3, 2) each if asked for, else with no rows.
        """
        ...

    def project_point(self, x: float, y: float, z: float, place: Place) -> tuple[float, float]:
        """Return the pixel of one point, not-a-number if it has none."""
        ...

    def ray_of_pixel(self, x_px: float, y_px: float, place: Place) -> tuple[Triple, Triple] | None:
        """Return origin and direction of one pixel's ray, None if it has none."""
        ...


@dataclass(frozen=True, eq=False)
class Projection(ReadOnlyArrays):
    """A lens with the plane behind it.

    Attributes
    ----------
    lens
        Distortion, entrance point and reach.
    pixel_from_slope
        (3, 3): H, V and A in the lens frame, as rows.
    slope_from_pixel
        (3, 3): its inverse.
    """

    lens: Lens
    pixel_from_slope: FloatArray
    slope_from_pixel: FloatArray

    @property
    def moving(self) -> bool:
        """Whether the entrance point moves with a ray's angle."""
        return self.lens.moving

    @property
    def limit_words(self) -> str:
        """Where the lens ends, as the end of a sentence; empty if it ends nowhere."""
        return self.lens.limit_words

    def project(
        self, points: FloatArray, center: FloatArray, frame: FloatArray, derivatives: bool
    ) -> tuple[FloatArray, FloatArray, np.ndarray]:
        """Return pixels (n, 2), the Jacobians (n, 2, 3) if asked for, else none, and which are valid (n,).

        ``points`` (n, 3) metres, ``center`` (3,) and ``frame`` (4, 3) are in one frame; the rows of the last
        are A and the lens frame's axes.
        """
        count = len(points)
        pixels, valid = np.empty((count, 2)), np.empty(count, dtype=bool)
        jacobian = np.empty((count if derivatives else 0, 2, 3))
        with np.errstate(all="ignore"):
            if 0 < count <= CHUNK:
                self._project(points, center, frame, pixels, jacobian, valid)
            else:
                for part in chunks(count):
                    self._project(points[part], center, frame, pixels[part], jacobian[part], valid[part])
        return pixels, jacobian, valid

    def _project(
        self,
        points: FloatArray,
        center: FloatArray,
        frame: FloatArray,
        pixels: FloatArray,
        jacobian: FloatArray,
        valid: np.ndarray,
    ) -> None:
        """Fill pixels and validity of one chunk, and the Jacobian if it has rows."""
        lens, k = self.lens, self.pixel_from_slope
        along_a_and_local = frame @ np.subtract(points.T, center[:, None], order="C")
        local = along_a_and_local[1:]
        bent = bend(lens, local, len(jacobian) > 0)
        seen = k @ bent.slopes
        depth = seen[2]
        if lens.curved:
            np.greater(depth, 0.0, out=valid)
        else:
            np.greater(np.minimum(depth, along_a_and_local[0]), 0.0, out=valid)
        valid &= bent.valid
        per_depth = np.divide(1.0, depth, out=depth)
        np.multiply(seen[:2], per_depth, out=pixels.T)
        if not isfinite(np.vdot(pixels, pixels)):
            valid &= np.isfinite(pixels).all(axis=1)
        if bent.derivatives is not None:
            m, n, along_w, across = bent.derivatives
            # d pixel / d slope (2 pixel, 2 slope, n), then by the lens to (a, b, w), then turned
            per_slope = k[:2, :2, None] - k[2, :2, None] * pixels.T[:, None]
            per_slope *= per_depth
            rows = np.empty((2, 3, len(points)))
            np.multiply(per_slope, m, out=rows[:, :2])
            per_slope *= across
            along = per_slope[:, 0] + per_slope[:, 1]
            np.multiply(along, along_w, out=rows[:, 2])
            along *= n
            rows[:, :2] += np.multiply(along[:, None], across, out=per_slope)
            jacobian[...] = (frame[1:].T @ rows).transpose(2, 0, 1)
        if not valid.all():
            pixels[~valid] = nan
            jacobian[~valid[: len(jacobian)]] = nan

    def rays(self, pixels: FloatArray, center: FloatArray, axes: FloatArray, derivatives: bool) -> Rays:
        """Return origins (n, 3), directions (n, 3) and validity (n,) of the rays of pixels (n, 2).

        Then d direction / d pixel and d origin / d pixel, (n, 3, 2) each if asked for, else with no rows.
        """
        count = len(pixels)
        origins, directions, valid = np.empty((count, 3)), np.empty((count, 3)), np.empty(count, dtype=bool)
        rows = count if derivatives else 0
        d_directions, d_origins = np.empty((rows, 3, 2)), np.zeros((rows, 3, 2))
        filled = (origins, directions, valid, d_directions, d_origins)
        with np.errstate(all="ignore"):
            if 0 < count <= CHUNK:
                self._rays(pixels, center, axes, *filled)
            else:
                for part in chunks(count):
                    self._rays(pixels[part], center, axes, *(array[part] for array in filled))
        return filled

    def _rays(
        self,
        pixels: FloatArray,
        center: FloatArray,
        axes: FloatArray,
        origins: FloatArray,
        directions: FloatArray,
        valid: np.ndarray,
        d_directions: FloatArray,
        d_origins: FloatArray,
    ) -> None:
        """Fill the rays of one chunk, and their derivatives if these have rows."""
        lens, k = self.lens, self.slope_from_pixel
        seen = k[:, :2] @ pixels.T
        seen += k[:, 2:]
        slopes, per_w = seen[:2], seen[2]
        np.greater(per_w, 0.0, out=valid)
        np.divide(1.0, per_w, out=per_w)
        slopes *= per_w
        ray = unbend(lens, slopes, len(d_directions) > 0)
        local = np.empty_like(seen)
        np.multiply(slopes, ray.p, out=local[:2])
        local[2] = ray.q
        valid &= ray.valid
        if not lens.curved:
            valid &= self.pixel_from_slope[2] @ local > 0.0
        if not isfinite(np.vdot(local, local)):
            valid &= np.isfinite(local).all(axis=0)
        np.matmul(local.T, axes, out=directions)
        origins[...] = center
        if ray.shift is not None:
            origins += ray.shift[:, None] * axes[2]
        if ray.p_rate is not None and ray.q_rate is not None:
            for column in range(2):
                d_slopes = k[:2, column, None] - k[2, column] * slopes
                d_slopes *= per_w
                g = slopes * d_slopes
                g = np.add(g[0], g[1], out=g[0])
                np.multiply(ray.p, d_slopes, out=local[:2])
                local[:2] += slopes * (ray.p_rate * g)
                np.multiply(ray.q_rate, g, out=local[2])
                d_directions[:, :, column] = (axes.T @ local).T
                if ray.shift_rate is not None:
                    d_origins[:, :, column] = (ray.shift_rate * g)[:, None] * axes[2]
        if not valid.all():
            lost = ~valid
            origins[lost] = nan
            directions[lost] = nan
            if len(d_directions):
                d_directions[lost] = nan
                d_origins[lost] = nan

    @cached_property
    def _floats(self) -> tuple[list[list[float]], list[list[float]]]:
        """Both matrices as plain floats."""
        return self.pixel_from_slope.tolist(), self.slope_from_pixel.tolist()

    def project_point(self, x: float, y: float, z: float, place: Place) -> tuple[float, float]:
        """Return the pixel of one point, not-a-number if it has none."""
        (cx, cy, cz), (xx, xy, xz), (yx, yy, yz), (ox, oy, oz) = place
        (hx, hy, hz), (vx, vy, vz), (ax, ay, az) = self._floats[0]
        x, y, z = x - cx, y - cy, z - cz
        a, b, w = xx * x + xy * y + xz * z, yx * x + yy * y + yz * z, ox * x + oy * y + oz * z
        m = bend_point(self.lens, a, b, w)
        if not self.lens.curved and not ax * a + ay * b + az * w > 0.0:
            return nan, nan
        u, v = a * m, b * m
        depth = ax * u + ay * v + az
        if not depth > 0.0 or (per_depth := 1.0 / depth) == inf:
            return nan, nan
        x, y = (hx * u + hy * v + hz) * per_depth, (vx * u + vy * v + vz) * per_depth
        return (x, y) if isfinite(x + y) else (nan, nan)

    def ray_of_pixel(self, x_px: float, y_px: float, place: Place) -> tuple[Triple, Triple] | None:
        """Return origin and direction of one pixel's ray, None if it has none."""
        (ux, uy, uz), (vx, vy, vz), (wx, wy, wz) = self._floats[1]
        w = wx * x_px + wy * y_px + wz
        if not w > 0.0 or not w < inf or (per_w := 1.0 / w) == inf:
            return None
        u, v = (ux * x_px + uy * y_px + uz) * per_w, (vx * x_px + vy * y_px + vz) * per_w
        ray = unbend_point(self.lens, u, v)
        if ray is None:
            return None
        p, q, shift = ray
        a, b = u * p, v * p
        ax, ay, az = self._floats[0][2]
        if not self.lens.curved and not ax * a + ay * b + az * q > 0.0:
            return None
        (cx, cy, cz), (xx, xy, xz), (yx, yy, yz), (ox, oy, oz) = place
        return (
            (cx + shift * ox, cy + shift * oy, cz + shift * oz),
            (a * xx + b * yx + q * ox, a * xy + b * yy + q * oy, a * xz + b * yz + q * oz),
        )


def chunks(count: int) -> Iterator[slice]:
    """Cut ``count`` rows into slices that fit the cache."""
    return (slice(start, min(start + CHUNK, count)) for start in range(0, count, CHUNK))


def project_as_published(
    points_m: FloatArray,
    C: FloatArray,
    A: FloatArray,
    H: FloatArray,
    V: FloatArray,
    O: FloatArray,  # noqa: E741  the model's own letter
    R: FloatArray,
    E: FloatArray,
    linearity: float | None,
) -> FloatArray:
    """Return pixels (n, 2) of points (n, 3) by the vectors as they are; ``linearity`` None means CAHVOR.

    Source: ``cmod_cahvor_3d_to_2d`` and ``cmod_cahvore_3d_to_2d_general``; here nothing is refused.
    """
    with np.errstate(all="ignore"):
        p = points_m - C
        zeta = p @ O
        across = p - zeta[:, None] * O
        lam = np.maximum(np.linalg.norm(across, axis=1), 1e-12)
        if linearity is None:
            chi = lam / zeta
        else:
            theta = np.arctan2(lam, zeta)
            for _ in range(20):
                sine, cosine, lag = np.sin(theta), np.cos(theta), theta - np.sin(theta)
                e = E[0] + E[1] * theta**2 + E[2] * theta**4
                e_rate = 2.0 * E[1] * theta + 4.0 * E[2] * theta**3
                rate = zeta * cosine + lam * sine - (1.0 - cosine) * e - lag * e_rate
                step = (zeta * sine - lam * cosine - lag * e) / rate
                theta = theta - step
            theta[~(np.abs(step) < 1e-9)] = np.nan  # no ray was found, or none that is sure
            angle = linearity * theta
            chi = theta if linearity == 0.0 else (np.tan if linearity > 0.0 else np.sin)(angle) / linearity
        mu = R[0] + R[1] * chi**2 + R[2] * chi**4
        bent = (lam / chi)[:, None] * O + (1.0 + mu)[:, None] * across
        return np.asarray(np.stack([bent @ H, bent @ V], axis=-1) / (bent @ A)[:, None])
