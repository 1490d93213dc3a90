"""Where corners are that have not been measured yet, by those nearby that have."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from calib.rigid import FloatArray

IntArray = NDArray[np.int64]

NEIGHBOURS = 16
FEWEST = 4
LEAST_TOLD = 1e-9
NEXT = 1.3
"""A corner lies next to a known one if it is no farther than so many of the widest steps of the grid."""


@dataclass(frozen=True, eq=False)
class Known:
    """Points of a board, and where they are in the image.

    points_m, pixels_px (n, 2); where they were predicted as corners, ids (n,) and jacobians (n, 2, 2) px/m.
    """

    points_m: FloatArray
    pixels_px: FloatArray
    ids: IntArray = field(default_factory=lambda: np.empty(0, np.int64))
    jacobians: FloatArray = field(default_factory=lambda: np.empty((0, 2, 2)))

    def next_to(
        self, ids: IntArray, places_m: FloatArray, lines_m: tuple[FloatArray, FloatArray]
    ) -> IntArray:
        """Return those of ``ids`` (their places on the board by id) that lie next to a known point."""
        step_m = NEXT * max(float(np.diff(line).max()) for line in lines_m)
        away = np.linalg.norm(places_m[ids][:, None] - self.points_m[None], axis=-1).min(axis=1)
        return np.asarray(ids[away < step_m])


def predicted(known: Known, ids: IntArray, places_m: FloatArray) -> Known:
    """Return corners where the known points nearest to each say that they are.

    A homography of the neighbourhood: what the lens bends within it is below a pixel. Left out are corners
    whose neighbours do not tell one.
    """
    count = min(NEIGHBOURS, len(known.points_m))
    if not len(ids) or count < FEWEST:
        return Known(np.empty((0, 2)), np.empty((0, 2)))
    away = np.linalg.norm(known.points_m - places_m[:, None], axis=2)
    near = np.argpartition(away, count - 1, axis=1)[:, :count]
    scale = np.maximum(np.take_along_axis(away, near, axis=1).max(axis=1), 1e-6)
    points = (known.points_m[near] - places_m[:, None]) / scale[:, None, None]
    middles = known.pixels_px[near].mean(axis=1)
    pixels = known.pixels_px[near] - middles[:, None]
    reach = np.maximum(np.abs(pixels).max(axis=(1, 2)), 1e-6)
    H, told = _homographies(points, pixels / reach[:, None, None])
    at = H[:, :2, 2] * reach[:, None]
    # of (H x) / (h x) at 0
    jacobians = (reach / scale)[:, None, None] * (H[:, :2, :2] - H[:, :2, 2:] * H[:, 2:, :2])
    kept = told & np.isfinite(at).all(axis=1) & (np.linalg.det(jacobians) > 0.0)
    return Known(np.empty((0, 2)), (at + middles)[kept], np.asarray(ids)[kept], jacobians[kept])


def _homographies(points: FloatArray, pixels: FloatArray) -> tuple[FloatArray, NDArray[np.bool_]]:
    """Return the homographies (n, 3, 3), lower right 1, of points (n, k, 2) to pixels (n, k, 2), by two
    rounds of least squares, and which are told; what a point is divided by weighs its equation in the second.
    """
    n, k, _ = points.shape
    ones, none = np.ones((n, k)), np.zeros((n, k, 3))
    whole = np.dstack([points, ones])
    rows = np.stack(
        [
            np.concatenate([whole, none, -pixels[..., :1] * points], axis=2),
            np.concatenate([none, whole, -pixels[..., 1:] * points], axis=2),
        ],
        axis=2,
    )
    weights = ones
    for _ in range(2):
        weighted = rows * weights[..., None, None]
        A = weighted.reshape(n, 2 * k, 8)
        b = (pixels * weights[..., None]).reshape(n, 2 * k, 1)
        normal = A.transpose(0, 2, 1) @ A
        values = np.linalg.eigvalsh(normal)
        told = values[:, 0] > LEAST_TOLD * values[:, -1]
        normal[~told] = np.eye(8)
        h = np.linalg.solve(normal, A.transpose(0, 2, 1) @ b)[..., 0]
        below = np.einsum("nki,ni->nk", points, h[:, 6:]) + 1.0
        told &= (below > 0.1).all(axis=1)
        weights = 1.0 / np.maximum(below, 0.1)
    return np.concatenate([h, np.ones((n, 1))], axis=1).reshape(n, 3, 3), told
