"""Maps from one camera's picture to another's.

Where a map is (map_x, map_y), pixel (x, y) of the new picture is what the old one shows at (map_x[y, x],
map_y[y, x]): what cv2.initUndistortRectifyMap makes of OpenCV's own lenses for ``cv2.remap``, here for the
whole CAHV family, ray by ray.
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
    """map_x and map_y (height, width), float32, for cv2.remap."""

    map_x: np.ndarray
    map_y: np.ndarray


class RectifiedPair(NamedTuple):
    """A pair whose rows are side by side.

    left, right
        Ideal cameras (CAHV) with one A, H, V but for C: a point has the same y in both, and x left less x
        right is focal length times baseline over its depth.
    left_maps, right_maps
        From the old pictures to theirs.
    depth
        (4, 4) OpenCV's Q: (x, y, disparity, 1) to a homogeneous point in the left ideal camera's axes,
        metres.
    """

    left: CameraModel
    right: CameraModel
    left_maps: Maps
    right_maps: Maps
    depth: FloatArray


def ideal_camera(model: CameraModel, focal_px: float | None = None) -> CameraModel:
    """Return the camera without a lens (CAHV) that stands where ``model`` does and looks along its A.

    Its image has the same size and centre, H and V are at right angles, and its focal lengths are the
    model's, or ``focal_px`` both: a smaller one shows more of a wide picture.

    Raises
    ------
    ValueError
        If the focal length is not above zero.
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


def maps_between(ideal: CameraModel, model: CameraModel, range_m: float = FAR_M) -> Maps:
    """Return the maps that make of a picture of ``model`` the one that ``ideal`` would have taken.

    Parameters
    ----------
    ideal, model
        In one frame.
    range_m
        How far the things are, if the two do not look from one point.
    """
    width, height = ideal.size_px
    x, y = np.meshgrid(np.arange(width, dtype=np.float64), np.arange(height, dtype=np.float64))
    rays = ideal.ray(np.stack([x.ravel(), y.ravel()], axis=1))
    pixels, valid = model.project(rays.origins_m + range_m * rays.directions)
    pixels[~valid] = NOWHERE
    both = pixels.T.reshape(2, height, width).astype(np.float32)
    return Maps(np.ascontiguousarray(both[0]), np.ascontiguousarray(both[1]))


def rectified_pair(left: CameraModel, right: CameraModel, focal_px: float | None = None) -> RectifiedPair:
    """Return a pair with rows side by side: x along the baseline, looking where the two look between them.

    Parameters
    ----------
    left, right
        The cameras, in one frame, of one size.
    focal_px
        Of the ideal cameras; the mean of the pair's if not given.

    Raises
    ------
    ValueError
        If the sizes differ, the cameras stand in one place, or look along their baseline.
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
    y = np.cross(z, x)
    if focal_px is None:
        sizes = [focal for one in (left, right) for focal in one.focal_px]
        focal_px = float(np.mean(sizes))
    cx, cy = left.image_center_px
    h, v = focal_px * x + cx * z, focal_px * y + cy * z
    ideal = [CameraModel("CAHV", left.size_px, one.C, z, h, v) for one in (left, right)]
    depth = np.array(
        [
            [1.0, 0.0, 0.0, -cx],
            [0.0, 1.0, 0.0, -cy],
            [0.0, 0.0, 0.0, focal_px],
            [0.0, 0.0, 1.0 / length_m, 0.0],
        ]
    )
    return RectifiedPair(
        ideal[0],
        ideal[1],
        maps_between(ideal[0], left),
        maps_between(ideal[1], right),
        frozen_array(depth, (4, 4)),
    )
