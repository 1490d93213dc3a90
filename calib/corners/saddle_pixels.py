"""Which pixels about a corner show two crossing edges and nothing else."""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from calib.boards.pattern import Cells
from calib.rigid import FloatArray

IntArray = NDArray[np.int64]
Levels = NDArray[np.uint8] | NDArray[np.uint16]

HALF_PX = 8
"""A window reaches so far from its corner."""

STEEP = 97.0
"""Percentile of the slopes in a window that are those of its edges."""

NEAR, FAR = 1.3, 2.5
"""A pixel counts if it is so many standard deviations of the blur away from the nearest marker's border,
which the model has, and from all else, which it has not: at 1.3 a tenth of it is a marker's, so that a
border that is printed a little elsewhere does no harm."""


class Crossings(NamedTuple):
    """Corners on a print: points_m (n, 2); inset_m (2,): so far from a corner, across and down, markers
    begin.
    """

    pattern: Cells
    points_m: FloatArray
    inset_m: FloatArray

    def some(self, which: NDArray[np.int64]) -> Crossings:
        """Return some of them."""
        return self._replace(points_m=self.points_m[which])

    def signs(self, jacobians: FloatArray) -> FloatArray:
        """Return (n,) +1 where the square to the lower right is white, -1 where it is black."""
        a_little_m = 1e-3 / np.sqrt(np.abs(np.linalg.det(jacobians)))
        black = self.pattern.is_black(*(self.points_m + a_little_m[:, None]).T)
        return np.where(black, -1.0, 1.0)


class Pixels(NamedTuple):
    """Windows about corners: u (n, p, 2), pixels from where these are expected; levels (n, p); weights (n,
    p).
    """

    u: FloatArray
    levels: FloatArray
    weights: FloatArray

    def some(self, which: NDArray[np.int64] | NDArray[np.bool_]) -> Pixels:
        """Return some of them."""
        return Pixels(*(part[which] for part in self))


def pixels_about(
    image: Levels, crossings: Crossings, pixels_px: FloatArray, jacobians: FloatArray, wide_px: FloatArray
) -> Pixels:
    """Return the windows about corners, with weight 1 where the image shows nothing but two edges, else 0.

    ``pixels_px`` (n, 2) are the windows' middles to a fraction of a pixel, ``jacobians`` (n, 2, 2) px/m,
    ``wide_px`` (n,) the standard deviation of what blurs an edge there.
    """
    columns, rows, inside = _window(image, pixels_px)
    levels = image[rows, columns].astype(np.float64)
    u = np.stack([columns - pixels_px[:, :1], rows - pixels_px[:, 1:]], axis=-1)
    alone = _alone(crossings, np.rint(pixels_px) - pixels_px, jacobians, wide_px)
    return Pixels(u, levels, (inside & alone).astype(np.float64))


def sharpness_px(image: Levels, pixels_px: FloatArray) -> FloatArray:
    """Return about the standard deviation (n,) of what blurs edges in the windows, by how steep the
    steepest are.
    """
    columns, rows, _ = _window(image, pixels_px)
    side = 2 * HALF_PX + 1
    levels = image[rows, columns].astype(np.float64).reshape(-1, side, side)
    dark, bright = np.percentile(levels, (5.0, 95.0), axis=(1, 2))
    slopes = np.hypot(levels[:, 1:-1, 2:] - levels[:, 1:-1, :-2], levels[:, 2:, 1:-1] - levels[:, :-2, 1:-1])
    steep = np.percentile(slopes, STEEP, axis=(1, 2)) / 2.0
    return np.asarray((bright - dark) / np.sqrt(2 * np.pi) / np.maximum(steep, 1e-3))


def _window(image: Levels, pixels_px: FloatArray) -> tuple[IntArray, IntArray, NDArray[np.bool_]]:
    """Columns and rows (n, p) of windows, those outside the image moved into it, and which are inside."""
    offsets = np.arange(-HALF_PX, HALF_PX + 1)
    dx, dy = (part.ravel() for part in np.meshgrid(offsets, offsets))
    whole = np.rint(pixels_px).astype(np.int64)
    columns, rows = whole[:, :1] + dx, whole[:, 1:] + dy
    height, width = image.shape
    inside = (columns >= 0) & (rows >= 0) & (columns < width) & (rows < height)
    return np.clip(columns, 0, width - 1), np.clip(rows, 0, height - 1), inside


def _alone(
    crossings: Crossings, shift_px: FloatArray, jacobians: FloatArray, wide_px: FloatArray
) -> NDArray[np.bool_]:
    """Which pixels (n, p) are far enough from all that is printed beside the two edges.

    The print is looked up at every half pixel.
    """
    reach = HALF_PX + int(np.ceil(FAR * float(wide_px.max())))
    halves = np.arange(-2 * reach, 2 * reach + 1) / 2.0
    grid = np.stack(np.meshgrid(halves, halves), axis=-1).reshape(-1, 2)
    places = (shift_px[:, None] + grid) @ np.linalg.inv(jacobians).transpose(0, 2, 1)
    absolute = places + crossings.points_m[:, None]
    black = crossings.pattern.is_black(absolute[..., 0], absolute[..., 1])
    positive = places > 0
    as_lower_right = positive[..., 0] == positive[..., 1]
    white = as_lower_right == (crossings.signs(jacobians) > 0)[:, None]
    two_edges = black != white
    marker = white & (np.abs(places) > crossings.inset_m).all(axis=-1)
    as_modelled = two_edges ^ marker
    side = len(halves)
    window = slice(2 * (reach - HALF_PX), side - 2 * (reach - HALF_PX), 2)
    alone = np.empty((len(places), (2 * HALF_PX + 1) ** 2), dtype=bool)
    for k, wide in enumerate(wide_px):
        from_any, from_other = (
            cv2.distanceTransform(one[k].reshape(side, side).view(np.uint8), cv2.DIST_L2, 3)[window, window]
            for one in (two_edges, as_modelled)
        )
        alone[k] = ((from_any > 2 * NEAR * wide) & (from_other > 2 * FAR * wide)).ravel()
    return alone
