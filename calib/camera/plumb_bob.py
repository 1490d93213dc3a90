"""The nearest ``plumb_bob`` camera (OpenCV, ROS, Foxglove) of a CAHVOR one and its kin, and how far it is.

The model is OpenCV's: x' = x r + 2 p1 x y + p2 (ρ² + 2 x²), y' = y r + p1 (ρ² + 2 y²) + 2 p2 x y with
r = 1 + k1 ρ² + k2 ρ⁴ + k3 ρ⁶ and ρ² = x² + y²; then u = fx x' + cx, v = fy y' + cy
(https://docs.opencv.org/4.x/d9/d0c/group__calib3d.html). It has no exact twin of O beside A, nor of a moving
entrance; what is left is told.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from calib.camera.cahvor import CameraModel
from calib.rigid import FloatArray, ReadOnlyArrays, frozen_array

GRID = (25, 19)
"""Columns and rows of the pixels that the two are compared at, from edge to edge."""
EXACT_PX = 1e-9


@dataclass(frozen=True, eq=False)
class PlumbBob(ReadOnlyArrays):
    """A camera as OpenCV has it.

    Attributes
    ----------
    size_px
        (width, height).
    matrix_px
        (3, 3) K: fx, 0, cx; 0, fy, cy; 0, 0, 1.
    distortion
        (5,) k1, k2, p1, p2, k3.
    frame_from_camera
        (3, 3) rotation: columns are the camera's x (right), y (down) and z (along A) in the model's frame.
        Its origin is C.
    rms_px, worst_px
        How far its pixels are from the model's, over the whole image, points far away.
    """

    size_px: tuple[int, int]
    matrix_px: FloatArray
    distortion: FloatArray
    frame_from_camera: FloatArray
    rms_px: float
    worst_px: float

    def project(self, points: FloatArray) -> FloatArray:
        """Return pixels (n, 2) of points (n, 3) in the camera's own frame, any unit of length."""
        return _pixels(_numbers(self.matrix_px, self.distortion), points)


def camera_axes(model: CameraModel) -> FloatArray:
    """Return (3, 3): columns are the camera's x, y, z in the model's frame; z along A, x as H and V say."""
    z = model.A
    right = model.H - (model.H @ z) * z
    down = model.V - (model.V @ z) * z
    x = right / np.linalg.norm(right) + np.cross(down / np.linalg.norm(down), z)  # each has half a say
    x /= np.linalg.norm(x)
    return np.stack([x, np.cross(z, x), z], axis=1)


def nearest_plumb_bob(model: CameraModel) -> PlumbBob:
    """Return the ``plumb_bob`` camera whose pixels come nearest to a model's, over its whole image.

    Raises
    ------
    ValueError
        If fewer than half of the image's pixels have a ray in front of the camera.
    """
    width, height = model.size_px
    columns, rows = np.linspace(0.0, width - 1.0, GRID[0]), np.linspace(0.0, height - 1.0, GRID[1])
    pixels = np.stack(np.meshgrid(columns, rows), axis=-1).reshape(-1, 2)
    axes = camera_axes(model)
    rays = model.ray(pixels)
    directions = rays.directions @ axes
    seen = rays.valid & (directions[:, 2] > 0.05)
    if np.count_nonzero(seen) < len(pixels) // 2:
        raise ValueError("more than half of the image looks sideways or backwards; plumb_bob cannot say that")
    pixels, directions = pixels[seen], directions[seen]
    focal = [float(np.linalg.norm(np.cross(model.A, letter))) for letter in (model.H, model.V)]
    start = np.array([*focal, model.A @ model.H, model.A @ model.V, 0.0, 0.0, 0.0, 0.0, 0.0])
    scale = np.array([focal[0], focal[1], width, height, 1.0, 1.0, 0.1, 0.1, 1.0])

    def off_px(numbers: FloatArray) -> FloatArray:
        return (_pixels(numbers, directions) - pixels).ravel()

    numbers = start
    if np.abs(off_px(start)).max() > EXACT_PX:
        from scipy.optimize import least_squares  # slow to load, and a camera without a lens needs no fit

        numbers = least_squares(off_px, start, x_scale=scale, method="lm").x
    off = np.linalg.norm(_pixels(numbers, directions) - pixels, axis=1)
    fx, fy, cx, cy = numbers[:4]
    return PlumbBob(
        (width, height),
        frozen_array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]], (3, 3)),
        frozen_array(numbers[4:], (5,)),
        frozen_array(axes, (3, 3)),
        float(np.sqrt(np.mean(off**2))),
        float(off.max()),
    )


def _numbers(matrix_px: FloatArray, distortion: FloatArray) -> FloatArray:
    places = [matrix_px[0, 0], matrix_px[1, 1], matrix_px[0, 2], matrix_px[1, 2]]
    return np.array([*places, *distortion])


def _pixels(numbers: FloatArray, points: FloatArray) -> FloatArray:
    fx, fy, cx, cy, k1, k2, p1, p2, k3 = numbers
    x, y = points[:, 0] / points[:, 2], points[:, 1] / points[:, 2]
    square = x * x + y * y
    radial = 1.0 + square * (k1 + square * (k2 + square * k3))
    u = x * radial + 2.0 * p1 * x * y + p2 * (square + 2.0 * x * x)
    v = y * radial + p1 * (square + 2.0 * y * y) + 2.0 * p2 * x * y
    return np.stack([fx * u + cx, fy * v + cy], axis=1)
