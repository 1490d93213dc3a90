"""From points to pixels and back: what all lenses share, and the plane of the image behind one.

A point is turned into the lens frame (origin C), bent into slopes by the lens, and a plane projection makes
pixels of slopes; a ray goes the same way back. A point (a, b, w) of the lens frame is seen at the *slopes*
(u, v), those of the straight ray that a pinhole would need to land on the same pixel. Nothing here changes
when the camera moves: its place comes with each call as C and the lens frame's axes.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from math import isfinite
from typing import NamedTuple, Protocol

import numpy as np

from calib.geometry.rigid import FloatArray, ReadOnlyArrays

CHUNK = 8192
"""Points at a time: some ten rows of them stay in a core's own cache."""

TINY = 1e-150
"""Stands for zero in divisions by a distance from the axis: its square is still a number."""

SETTLED = 1e-8
"""Newton stops after a step below this; it doubles its digits, so the result is good to rounding."""


class Bent(NamedTuple):
    """Slopes (2, n) at which a lens shows points, which it reaches (n,), and d slope / d point (2, 3, n)."""

    slopes: FloatArray
    valid: np.ndarray
    rates: FloatArray | None = None


class Unbent(NamedTuple):
    """Unit directions (3, n) that land on slopes, which exist (n,), and d direction / d slope (3, 2, n).

    Where the entrance point moves, rays begin at C + ``shift_m`` (n,) along z; d shift / d slope is (2, n).
    """

    directions: FloatArray
    valid: np.ndarray
    rates: FloatArray | None = None
    shift_m: FloatArray | None = None
    shift_rates: FloatArray | None = None


class Lens(Protocol):
    """A lens, in its own frame.

    Callers cut their points into chunks that fit the cache and silence numpy's floating-point warnings; rows
    without a result come back with ``valid`` False and any number at all.
    """

    @property
    def curved(self) -> bool:
        """Whether slopes follow the angle: a ray may be at a right angle to the axis and more."""

    @property
    def moving(self) -> bool:
        """Whether the entrance point moves."""

    @property
    def limit_rad(self) -> float:
        """The angle from the axis up to which the lens reaches in every direction."""

    @property
    def limit_reason(self) -> str:
        """Where the lens ends, as the end of a sentence; empty if that is where its family ends."""

    def bend(self, local_m: FloatArray, derivatives: bool = False) -> Bent:
        """Return where points (3, n), rows a, b, w of the lens frame, are seen."""

    def unbend(self, slopes: FloatArray, derivatives: bool = False) -> Unbent:
        """Return the rays that land on slopes (2, n)."""

    def coefficient_rates(self, local_m: FloatArray) -> FloatArray:
        """Return d slope / d coefficient (2, k, n) of points (3, n), in the order of a camera's step."""


@dataclass(frozen=True, eq=False)
class Projection(ReadOnlyArrays):
    """A lens with the plane behind it.

    ``pixel_from_slope`` (3, 3) has H, V and A in the lens frame as rows: the camera matrix where the lens
    frame's z is A; ``slope_from_pixel`` is its inverse.
    """

    lens: Lens
    pixel_from_slope: FloatArray
    slope_from_pixel: FloatArray

    def project(
        self, points: FloatArray, center: FloatArray, axes: FloatArray, derivatives: bool
    ) -> tuple[FloatArray, FloatArray, np.ndarray]:
        """Return pixels (n, 2), the Jacobians (n, 2, 3) if wanted, else none, and which are valid (n,).

        ``points`` (n, 3) metres, ``center`` (3,) and ``axes`` (3, 3), the lens frame's as rows, are in one
        frame.
        """
        count = len(points)
        pixels, valid = np.empty((count, 2)), np.empty(count, dtype=bool)
        jacobian = np.empty((count if derivatives else 0, 2, 3))
        with np.errstate(all="ignore"):
            for part in _chunks(count):
                seen, rates, valid[part] = self.forward(points[part], center, axes, derivatives)
                pixels[part] = seen.T
                if derivatives:
                    jacobian[part] = rates.transpose(2, 0, 1)
        return pixels, jacobian, valid

    def forward(
        self, points: FloatArray, center: FloatArray, axes: FloatArray, derivatives: bool
    ) -> tuple[FloatArray, FloatArray, np.ndarray]:
        """Return pixels (2, n), the Jacobian (2, 3, n) if wanted, and validity (n,); NumPy may warn."""
        k = self.pixel_from_slope
        local = axes @ np.subtract(points.T, center[:, None], order="C")
        bent = self.lens.bend(local, derivatives)
        seen = k[:, :2] @ bent.slopes
        seen += k[:, 2:]
        valid = bent.valid & ((seen[2] if self.lens.curved else np.minimum(seen[2], k[2] @ local)) > 0.0)
        per_depth = 1.0 / seen[2]
        pixels = seen[:2] * per_depth
        if not isfinite(np.vdot(pixels, pixels)):
            valid &= np.isfinite(pixels).all(axis=0)
        jacobian = np.empty((2, 3, 0))
        if bent.rates is not None:
            # Of the plane's three rows by the point, turned by the axes: one product of matrices.
            turned = np.einsum("is,jl->ijsl", k[:, :2], axes.T).reshape(9, 6)
            rows = (turned @ bent.rates.reshape(6, -1)).reshape(3, 3, -1)
            if k[2, :2].any():
                rows[:2] -= pixels[:, None] * rows[2]
            jacobian = rows[:2] * per_depth
        if not valid.all():
            pixels[:, ~valid] = np.nan
            jacobian[..., ~valid[: jacobian.shape[2]]] = np.nan
        return pixels, jacobian, valid

    def rays(
        self, pixels: FloatArray, center: FloatArray, axes: FloatArray, derivatives: bool
    ) -> tuple[FloatArray, ...]:
        """Return origins (n, 3), directions (n, 3) and validity (n,) of the rays of pixels (n, 2).

        Then d direction / d pixel and d origin / d pixel, (n, 3, 2) each if wanted, else with no rows.
        """
        count, rows = len(pixels), len(pixels) if derivatives else 0
        origins, directions, valid = np.empty((count, 3)), np.empty((count, 3)), np.empty(count, dtype=bool)
        filled = origins, directions, valid, np.empty((rows, 3, 2)), np.zeros((rows, 3, 2))
        with np.errstate(all="ignore"):
            for part in _chunks(count):
                found = self._rays(pixels[part], center, axes, derivatives)
                for whole, one in zip(filled, found, strict=False):
                    whole[part] = one
        if not valid.all():
            for array in (origins, directions, *filled[3:]):
                array[~valid[: len(array)]] = np.nan
        return filled

    def _rays(
        self, pixels: FloatArray, center: FloatArray, axes: FloatArray, derivatives: bool
    ) -> Iterator[FloatArray]:
        """Yield the same of one chunk."""
        lens, k = self.lens, self.slope_from_pixel
        seen = k[:, :2] @ pixels.T
        seen += k[:, 2:]
        per_w = 1.0 / seen[2]
        slopes = seen[:2] * per_w
        ray = lens.unbend(slopes, derivatives)
        valid = ray.valid & (seen[2] > 0.0) & np.isfinite(ray.directions).all(axis=0)
        if not lens.curved:
            valid &= self.pixel_from_slope[2] @ ray.directions > 0.0
        yield center if ray.shift_m is None else center + ray.shift_m[:, None] * axes[2]
        yield ray.directions.T @ axes
        yield valid

        def by_pixel(rates: FloatArray) -> FloatArray:
            """Rates (m, 2, n) to slopes as rates (n, m, 2) to pixels."""
            per_pixel = np.tensordot(k[:2, :2], rates, axes=(0, 1)).swapaxes(0, 1)
            per_pixel -= (rates * slopes).sum(axis=1)[:, None] * k[2, :2, None]
            per_pixel *= per_w
            return per_pixel.transpose(2, 0, 1)

        if ray.rates is not None:
            yield by_pixel((axes.T @ ray.rates.reshape(3, -1)).reshape(3, 2, -1))
        if ray.shift_rates is not None:
            yield axes[2][:, None] * by_pixel(ray.shift_rates[None])


def _chunks(count: int) -> Iterator[slice]:
    """Cut ``count`` rows into slices that fit the cache."""
    return (slice(start, min(start + CHUNK, count)) for start in range(0, count, CHUNK))


def polynomial(coefficients: tuple[float, ...], y: FloatArray) -> FloatArray:
    """Return c0 + c1 y + c2 y^2 + ... in place of few temporary arrays."""
    *lower, before, last = coefficients
    value = y * last
    value += before
    for coefficient in reversed(lower):
        value *= y
        value += coefficient
    return value


def first_root(coefficients: tuple[float, ...]) -> float:
    """Return the smallest real root above zero of c0 + c1 y + ..., c0 > 0; infinite if there is none."""
    if all(coefficient >= 0.0 for coefficient in coefficients[1:]):
        return np.inf
    scaled = np.array(coefficients) / max(map(abs, coefficients))
    inverse = np.roots(scaled)  # of 1 / y, whose leading coefficient is no rounded zero
    real = inverse.real[(np.abs(inverse.imag) <= 1e-9 * np.abs(inverse)) & (inverse.real > 0.0)]
    return float(1.0 / real.max(initial=0.0)) if len(real) else np.inf
