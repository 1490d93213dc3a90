"""The map from the board's plane to the image that a grid of dots tells by itself, without any camera model.

A homography and, on top, a polynomial in the place on the board for what a lens bends. It carries dots
that were missed to where they must be, gives every dot's shape and the bias of its centre, and tells dots
that do not fit the others.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import ArrayLike

from calib.rigid import FloatArray

DEGREES = (0, 3, 5)
"""Of the polynomial; the number of dots decides which."""

DOTS_FOR_DEGREE = (0, 40, 90)
STEP = 1e-4  # of the numeric derivative, in units of the board's half size


@dataclass(frozen=True, eq=False)
class PlaneMap:
    """Places on the board, metres, to pixels.

    ``homography`` (3, 3) acts on metres; ``bend`` (terms, 2), px, on the powers of metres / ``scale_m``.
    """

    homography: FloatArray
    bend: FloatArray
    degree: int
    scale_m: float

    def pixels(self, points_m: ArrayLike) -> FloatArray:
        """Return pixels (..., 2) of points (..., 2), metres in the board's plane."""
        points = np.asarray(points_m, dtype=np.float64)
        carried = points @ self.homography[:, :2].T + self.homography[:, 2]
        pixels = carried[..., :2] / carried[..., 2:]
        if self.degree:
            pixels = pixels + _powers(points / self.scale_m, self.degree) @ self.bend
        return np.asarray(pixels)

    def jacobian(self, points_m: ArrayLike) -> FloatArray:
        """Return d pixel / d point (..., 2, 2), px/m."""
        points = np.asarray(points_m, dtype=np.float64)
        step = STEP * self.scale_m
        sides = [
            (self.pixels(points + step * axis) - self.pixels(points - step * axis)) / (2 * step)
            for axis in np.eye(2)
        ]
        return np.stack(sides, axis=-1)

    @property
    def parameters(self) -> int:
        """How many numbers were fitted."""
        return 8 + 2 * max(0, len(self.bend) - 4)


def fit_plane_map(points_m: FloatArray, pixels_px: FloatArray) -> PlaneMap | None:
    """Return the map that fits the dots (n, 2) best, or None where they do not tell one (fewer than 6)."""
    if len(points_m) < 6:
        return None
    scale = float(np.abs(points_m).max())
    middle = pixels_px.mean(axis=0)
    H, _ = cv2.findHomography(points_m / scale, pixels_px - middle, 0)
    if H is None or not np.isfinite(H).all():
        return None
    back = np.array([[1.0, 0.0, middle[0]], [0.0, 1.0, middle[1]], [0.0, 0.0, 1.0]])
    homography = np.asarray(back @ H @ np.diag([1 / scale, 1 / scale, 1.0]), dtype=np.float64)
    degree = max(d for d, least in zip(DEGREES, DOTS_FOR_DEGREE, strict=True) if len(points_m) >= least)
    flat = PlaneMap(homography, np.empty((0, 2)), 0, scale)
    if not degree:
        return flat
    powers = _powers(points_m / scale, degree)
    bend, _, rank, _ = np.linalg.lstsq(powers, pixels_px - flat.pixels(points_m), rcond=1e-9)
    if rank < powers.shape[1]:
        return flat
    return PlaneMap(homography, np.asarray(bend, dtype=np.float64), degree, scale)


def _powers(points: FloatArray, degree: int) -> FloatArray:
    """x**i y**j for i + j up to the degree, along the last axis."""
    x, y = points[..., 0], points[..., 1]
    return np.stack([x**i * y**j for i in range(degree + 1) for j in range(degree + 1 - i)], axis=-1)
