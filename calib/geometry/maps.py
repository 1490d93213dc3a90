"""Maps from one camera's picture to another's, for ``cv2.remap``.

What cv2.initUndistortRectifyMap and cv2.stereoRectify make of OpenCV's lenses, for every model, ray by ray:
pixel (x, y) of the new picture is what the old one shows at (map_x[y, x], map_y[y, x]).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from calib.geometry.cahvor import CameraModel
from calib.geometry.rigid import FloatArray, frozen_array

FAR_M = 100.0
"""Where points along the new picture's rays are; only an entrance point that moves makes it matter."""

NOWHERE = -1.0
"""The place of a pixel that the old picture does not show: outside, where cv2.remap takes the border."""


class Maps(NamedTuple):
    """map_x and map_y (height, width), float32."""

    map_x: np.ndarray
    map_y: np.ndarray


class RectifiedPair(NamedTuple):
    """Ideal cameras (CAHV) that differ in C alone: a point has the same y in both. Maps to their pictures.

    ``depth`` (4, 4) is OpenCV's Q: (x, y, disparity, 1) to a homogeneous point in the left ideal camera's
    axes, metres.
    """

    left: CameraModel
    right: CameraModel
    left_maps: Maps
    right_maps: Maps
    depth: FloatArray


def ideal_camera(model: CameraModel, focal_px: float | None = None) -> CameraModel:
    """Return the camera without a lens (CAHV) at the same place, with the same A, image size and centre.

    H and V are at right angles. Its focal lengths are the model's, or ``focal_px`` both: a smaller one shows
    more of a wide picture. Raises ValueError if that is not above zero.
    """
    if focal_px is not None and not 0.0 < focal_px < np.inf:
        raise ValueError(f"the focal length is {focal_px:g} px where a number above 0 is expected")
    a = model.A
    cx, cy = float(model.H @ a), float(model.V @ a)
    across, down = model.H - cx * a, model.V - cy * a
    fx, fy = float(np.linalg.norm(across)), float(np.linalg.norm(down))
    x = across / fx
    y = np.cross(a, x) * np.sign(np.cross(a, x) @ down)
    if focal_px is not None:
        fx = fy = focal_px
    return CameraModel("CAHV", model.size_px, model.C, a, fx * x + cx * a, fy * y + cy * a)


def maps_between(ideal: CameraModel, model: CameraModel) -> Maps:
    """Return the maps that make of a picture of ``model`` the one that ``ideal`` would take."""
    width, height = ideal.size_px
    x, y = np.meshgrid(np.arange(width, dtype=np.float64), np.arange(height, dtype=np.float64))
    rays = ideal.ray(np.stack([x, y], axis=-1))
    pixels, valid = model.project(rays.origins_m + FAR_M * rays.directions)
    pixels[~valid] = NOWHERE
    map_x, map_y = np.ascontiguousarray(np.moveaxis(pixels, -1, 0), dtype=np.float32)
    return Maps(map_x, map_y)


def rectified_pair(left: CameraModel, right: CameraModel, focal_px: float | None = None) -> RectifiedPair:
    """Return a pair with rows side by side: x along the baseline, z between the two cameras' A.

    ``focal_px`` is that of the ideal cameras, by default the mean of the pair's. ValueError if the sizes
    differ, the cameras are at one place, or face along their baseline.
    """
    if left.size_px != right.size_px:
        raise ValueError(f"the left picture has {left.size_px} px and the right one {right.size_px}")
    baseline = right.C - left.C
    length_m = float(np.linalg.norm(baseline))
    if length_m < 1e-6:
        raise ValueError("the two cameras stand in one place: there is no baseline")
    x = baseline / length_m
    ahead = left.A + right.A
    z = ahead - (ahead @ x) * x
    if np.linalg.norm(z) < 0.2:
        raise ValueError("the two cameras look along their baseline: there are no rows to lay side by side")
    z /= np.linalg.norm(z)
    focal = float(np.mean([left.focal_px, right.focal_px])) if focal_px is None else focal_px
    cx, cy = left.image_center_px
    h, v = focal * x + cx * z, focal * np.cross(z, x) + cy * z
    ideal, other = (CameraModel("CAHV", left.size_px, one.C, z, h, v) for one in (left, right))
    depth = np.eye(4)
    depth[:, 2:] = [[0.0, -cx], [0.0, -cy], [0.0, focal], [1.0 / length_m, 0.0]]
    return RectifiedPair(
        ideal, other, maps_between(ideal, left), maps_between(other, right), frozen_array(depth, (4, 4))
    )
