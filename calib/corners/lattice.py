"""Where corners are that have not been measured yet, by those nearby that have."""

from __future__ import annotations

from dataclasses import dataclass, field

import cv2
import numpy as np
from numpy.typing import NDArray

from calib.rigid import FloatArray

IntArray = NDArray[np.int64]

NEIGHBOURS = 16
STEP = 1e-3
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

    A homography of the neighbourhood: what the lens bends within it is below a pixel.
    """
    kept, pixels, jacobians = [], [], []
    for number, place in zip(ids, places_m, strict=True):
        away = np.linalg.norm(known.points_m - place, axis=1)
        near = np.argsort(away)[:NEIGHBOURS]
        scale = max(float(away[near].max()), 1e-6)
        middle = known.pixels_px[near].mean(axis=0)
        H, _ = cv2.findHomography((known.points_m[near] - place) / scale, known.pixels_px[near] - middle, 0)
        if H is None or not np.isfinite(H).all() or abs(H[2, 2]) < 1e-9:
            continue
        H = H / H[2, 2]
        at = H[:2, 2]
        # of (H x) / (h x) at 0
        jacobian = (H[:2, :2] - np.outer(at, H[2, :2])) / scale
        if np.linalg.det(jacobian) <= 0.0:
            continue
        kept.append(number)
        pixels.append(at + middle)
        jacobians.append(jacobian)
    return Known(
        np.empty((0, 2)),
        np.array(pixels).reshape(-1, 2),
        np.array(kept, dtype=np.int64),
        np.array(jacobians).reshape(-1, 2, 2),
    )
