"""The ROS lens nearest to a camera, as ``camera_info`` has it, and how far its pixels are off.

A camera of one of OpenCV's families that ROS has keeps its numbers. For the others, three lenses are fitted
to the rays of the whole image: ``plumb_bob``, ``rational_polynomial``, ``equidistant``; OpenCV's own
projections say what their numbers mean. The simplest one that is as good as the best is taken. Points are far
away: a moving entrance pupil has no place in any of them.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from calib.files.twin import even_axes
from calib.geometry.cahvor import CameraModel
from calib.geometry.rigid import FloatArray

COUNTS = {"plumb_bob": 5, "rational_polynomial": 8, "equidistant": 4}
KEPT = {
    "OPENCV4": "plumb_bob",
    "OPENCV5": "plumb_bob",
    "OPENCV8": "rational_polynomial",
    "OPENCV_FISHEYE": "equidistant",
}
EXACT_PX = 1e-6
STEPS = 30
GRID = (25, 19)
AS_GOOD_PX = 0.01
"""A lens of more numbers has to be nearer by this much."""
_AHEAD = 0.05


@dataclass(frozen=True, eq=False)
class RosLens:
    """A camera as ``camera_info`` has it.

    Attributes
    ----------
    name
        Of the distortion model.
    size_px
        (width, height).
    matrix_px
        (3, 3) K; the centre of the first pixel is (0, 0).
    distortion
        D, in OpenCV's order.
    worst_px
        How far a pixel of the image is off at most, pixels, over the grid of `nearest_lens`.
    """

    name: str
    size_px: tuple[int, int]
    matrix_px: FloatArray
    distortion: FloatArray
    worst_px: float


def nearest_lens(model: CameraModel) -> RosLens:
    """Return the lens that comes nearest to a camera over its whole image.

    Raises
    ------
    ValueError
        If fewer than half of the image's pixels look ahead: no ROS lens can say that.
    """
    width, height = model.size_px
    columns, rows = np.linspace(0.0, width - 1.0, GRID[0]), np.linspace(0.0, height - 1.0, GRID[1])
    pixels = np.stack(np.meshgrid(columns, rows), axis=-1).reshape(-1, 2)
    rays = model.ray(pixels)
    directions = rays.directions @ even_axes(model)
    seen = rays.valid & (directions[:, 2] > _AHEAD)
    if np.count_nonzero(seen) < len(pixels) // 2:
        raise ValueError("more than half of the image looks sideways or backwards; no ROS lens can say that")
    pixels, directions = pixels[seen], directions[seen]
    if model.kind in KEPT:
        name, (fx, fy, cx, cy) = KEPT[model.kind], model.camera_matrix[[0, 1, 0, 1], [0, 1, 2, 2]]
        numbers = np.zeros(4 + COUNTS[name])
        numbers[: 4 + len(model.distortion)] = fx, fy, cx, cy, *model.distortion
        kept = _measured(name, numbers, model.size_px, directions, pixels)
        if kept.worst_px < EXACT_PX:  # not so with a skewed image
            return kept
    start = np.array([*model.focal_px, model.A @ model.H, model.A @ model.V])
    found = [_fitted(name, start, model.size_px, directions, pixels) for name in COUNTS]
    best_px = min(one.worst_px for one in found)
    return next(one for one in found if one.worst_px <= best_px + AS_GOOD_PX)


def projected(name: str, numbers: FloatArray, directions: FloatArray) -> FloatArray:
    """Return pixels (n, 2) of points (n, 3) in the camera's frame; ``numbers`` are fx, fy, cx, cy, D."""
    fx, fy, cx, cy = numbers[:4]
    matrix = np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
    none = np.zeros(3)
    if name == "equidistant":
        # the angle is taken from slopes: points as they are, all ahead
        found, _ = cv2.fisheye.projectPoints(directions[None], none, none, matrix, numbers[4:])
    else:
        found, _ = cv2.projectPoints(directions, none, none, matrix, numbers[4:])
    return np.asarray(found, dtype=np.float64).reshape(-1, 2)


def _fitted(
    name: str, start: FloatArray, size_px: tuple[int, int], directions: FloatArray, pixels: FloatArray
) -> RosLens:
    """The lens of one kind that fits best; not finite where it bends away."""
    from scipy.optimize import least_squares  # slow to load

    def off_px(numbers: FloatArray) -> FloatArray:
        off = projected(name, numbers, directions) - pixels
        return np.nan_to_num(off, nan=1e6, posinf=1e6, neginf=-1e6).ravel()

    first = np.concatenate([start, np.zeros(COUNTS[name])])
    numbers: FloatArray = first
    if np.abs(off_px(first)).max() > 1e-9:
        scale = np.concatenate([start[:2], np.array(size_px, dtype=np.float64), np.ones(COUNTS[name])])
        most = STEPS * (1 + len(first))  # a lens that cannot bend so far would search for ever
        numbers = np.asarray(least_squares(off_px, first, x_scale=scale, method="lm", max_nfev=most).x)
    return _measured(name, numbers, size_px, directions, pixels)


def _measured(
    name: str, numbers: FloatArray, size_px: tuple[int, int], directions: FloatArray, pixels: FloatArray
) -> RosLens:
    """The lens of some numbers, with how far it is off; infinitely where it bends away."""
    off = np.nan_to_num(projected(name, numbers, directions) - pixels, nan=np.inf)
    fx, fy, cx, cy = numbers[:4].tolist()
    matrix = np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
    return RosLens(name, size_px, matrix, numbers[4:], float(np.linalg.norm(off, axis=1).max()))
