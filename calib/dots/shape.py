"""The image of a circle: where a round dot's image lies when its centre's image is known.

A camera does not carry the centre of a circle to the middle of the circle's image. The boundary is carried
over point by point and the centroid of the area inside is taken, which is exact through any lens; the
difference to the centre's own image is what a measurement of dots must be corrected by.

Source: Song et al. 2024, arXiv 2403.04583 (centroid of the distorted area).
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike

from calib.rigid import FloatArray

BOUNDARY_POINTS = 32


def area_centroids(boundaries_px: ArrayLike) -> FloatArray:
    """Return the centroids (n, 2) of the areas inside smooth closed curves (n, points, 2).

    By Green's theorem: with x(t), y(t) the curve, A = 1/2 int (x y' - y x') dt, and the centroid is
    1/(2A) int (x² y', -y² x') dt. Derivatives are those of the trigonometric polynomial through the points,
    so that a curve that is an even picture of a circle needs few of them (a polygon of 64 sides is off by
    0.16 % of what is wanted).
    """
    boundaries = np.asarray(boundaries_px, dtype=np.float64)
    count = boundaries.shape[1]
    middle = boundaries.mean(axis=1)
    x, y = np.moveaxis(boundaries - middle[:, None], -1, 0)
    frequency = 1j * np.fft.rfftfreq(count, 1.0 / count)
    if count % 2 == 0:
        frequency[-1] = 0.0
    dx, dy = (np.fft.irfft(frequency * np.fft.rfft(c, axis=1), count, axis=1) for c in (x, y))
    area = (x * dy - y * dx).sum(axis=1) / 2
    moments = np.stack([(x * x * dy).sum(axis=1), -(y * y * dx).sum(axis=1)], axis=-1)
    return np.asarray(middle + moments / (2 * area[:, None]))


def outline_points_m(centres_m: ArrayLike, radius_m: float) -> FloatArray:
    """Return boundary points (n, 32, 2) of circles about ``centres_m`` (n, 2), all in the circles' plane."""
    angle = np.arange(BOUNDARY_POINTS) * (2.0 * np.pi / BOUNDARY_POINTS)
    around = radius_m * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    return np.asarray(np.asarray(centres_m, dtype=np.float64)[:, None, :] + around)


def bias_through(
    pixel_of: Callable[[FloatArray], FloatArray], centres_m: ArrayLike, radius_m: float
) -> FloatArray:
    """Return centroid of the dot's image minus image of its centre, (n, 2) px, for any map of the plane.

    ``pixel_of`` takes points (..., 2) of the plane, metres, to pixels (..., 2); centres (n, 2) and radius are
    metres. Not-a-number where the map has no pixel for some point of the boundary.
    """
    centres = np.asarray(centres_m, dtype=np.float64)
    boundaries = pixel_of(outline_points_m(centres, radius_m))
    return np.asarray(area_centroids(boundaries) - pixel_of(centres))
