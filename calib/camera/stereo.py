"""Triangulation of a stereo pair, with the covariance that pixel noise gives.

The paper's section V, steps 1 and 2: a ray through each picked pixel, then the rays' intersection or the
middle of their common normal.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from calib.camera.cahvor import CameraModel
from calib.errors import NoStereoPoint
from calib.rigid import FloatArray, ReadOnlyArrays, finite_float, frozen_array

PARALLEL_RAD = 1e-9
"""Rays that meet under a smaller angle are parallel: rounding alone would place the point."""


@dataclass(frozen=True, eq=False)
class Triangulation(ReadOnlyArrays):
    """A point seen by two cameras, in the frame of their models.

    Attributes
    ----------
    position_m
        (3,) middle of the common normal of the two rays.
    covariance_m2
        (3, 3) from the pixel noise alone, to first order; camera and mast errors are not in it.
    ray_gap_m
        Length of the common normal: how far the rays pass each other. Large beside what the pixel noise
        explains, it says that the two pixels are not of one point, or that the models are off; whether it is,
        `calib.mast.ray_gap` says.
    ranges_m
        From the left and from the right ray's origin to the foot of the normal on that ray.
    rates_m_per_px
        (3, 4) d position / d (left x, left y, right x, right y).
    gap_m_per_px
        (4,) d gap / d (the same) where the rays meet. The gap is the triple product of both directions and
        what lies between the origins, over the sine of their angle; the rates are those of the product. It
        is linear in each direction, so that they hold for pixels far off each other's lines too.
    """

    position_m: FloatArray
    covariance_m2: FloatArray
    ray_gap_m: float
    ranges_m: tuple[float, float]
    rates_m_per_px: FloatArray
    gap_m_per_px: FloatArray


def triangulate(
    left: CameraModel,
    right: CameraModel,
    left_px: ArrayLike,
    right_px: ArrayLike,
    sigma_px: float = 0.2,
) -> Triangulation:
    """Return the point seen at one pixel in each of two cameras.

    Parameters
    ----------
    left, right
        Camera models in one common frame; the result is in that frame.
    left_px, right_px
        (2,) pixel (x, y) of the point in each image.
    sigma_px
        One-sigma noise of each pixel coordinate, independent in both axes and both images.

    Raises
    ------
    NoStereoPoint
        ``bad_pixel``: a pixel is not two finite numbers or has no ray. ``parallel_rays``: the rays meet
        under less than 1e-9 rad. ``behind_camera``: they meet behind a camera, that is they diverge ahead.
    ValueError
        If the sigma is negative or not finite.

    Examples
    --------
    >>> import numpy as np
    >>> from calib.camera.cahvor import CameraModel
    >>> forward, right_hand, down = np.eye(3)
    >>> H, V = 100 * right_hand + 50 * forward, 100 * down + 50 * forward
    >>> left = CameraModel("CAHV", (101, 101), -0.1 * right_hand, forward, H, V)
    >>> right = CameraModel("CAHV", (101, 101), 0.1 * right_hand, forward, H, V)
    >>> seen = triangulate(left, right, [52, 50], [48, 50])
    >>> round(float(seen.position_m[0]), 6), round(float(seen.covariance_m2[0, 0]) ** 0.5, 6)
    (5.0, 0.353553)
    """
    if finite_float("sigma_px", sigma_px) < 0.0:
        raise ValueError(f"sigma_px is {sigma_px} where 0 or more is expected")
    origins = np.empty((2, 3))
    directions = np.empty((2, 3))
    d_origins = np.empty((2, 3, 2))
    d_directions = np.empty((2, 3, 2))
    for eye, (side, model, pixel) in enumerate((("left", left, left_px), ("right", right, right_px))):
        xy = np.asarray(pixel, dtype=np.float64)
        if xy.shape != (2,) or not np.isfinite(xy).all():
            raise NoStereoPoint("bad_pixel", f"{side} pixel {xy.tolist()} is not two finite numbers")
        rays, d_directions[eye], d_origins[eye] = model.ray_jacobian(xy)
        if not rays.valid:
            raise NoStereoPoint(
                "bad_pixel", f"{side} pixel {xy.tolist()} has no ray in this {model.kind} camera"
            )
        origins[eye], directions[eye] = rays.origins_m, rays.directions

    # The common normal's feet o1 + s1 d1 and o2 + s2 d2: the gap between them is perpendicular to d1 and d2.
    (d1, d2), between = directions, origins[0] - origins[1]
    cosine = float(d1 @ d2)
    normal = np.cross(d1, d2)
    sine = float(np.linalg.norm(normal))
    if sine < PARALLEL_RAD:
        raise NoStereoPoint(
            "parallel_rays", f"the two rays are parallel to {sine:.2g} rad: no point where they meet"
        )
    solve_ranges = np.array([[-1.0, cosine], [-cosine, 1.0]]) / (sine * sine)
    s1, s2 = solve_ranges @ np.array([d1 @ between, d2 @ between])
    if not (s1 > 0.0 and s2 > 0.0):
        raise NoStereoPoint(
            "behind_camera",
            f"the two rays diverge: they come nearest {s1:.4g} m along the left "
            f"and {s2:.4g} m along the right one, and both must be ahead",
        )
    foot1, foot2 = origins + np.array([[s1], [s2]]) * directions
    gap = foot1 - foot2

    # Derivatives to the four pixel coordinates (left x, y, right x, y): the feet with s1, s2 held, then
    # s1, s2 from d1·gap = d2·gap = 0, which the turned directions disturb as well.
    none = np.zeros((3, 2))
    d_foot1 = np.hstack([d_origins[0] + s1 * d_directions[0], none])
    d_foot2 = np.hstack([none, d_origins[1] + s2 * d_directions[1]])
    d_gap = d_foot1 - d_foot2
    d_s1, d_s2 = solve_ranges @ np.array(
        [
            d1 @ d_gap + np.hstack([gap @ d_directions[0], [0.0, 0.0]]),
            d2 @ d_gap + np.hstack([[0.0, 0.0], gap @ d_directions[1]]),
        ]
    )
    d_product = np.concatenate(
        [
            normal @ d_origins[0] + np.cross(d2, between) @ d_directions[0],
            -normal @ d_origins[1] + np.cross(between, d1) @ d_directions[1],
        ]
    )
    jacobian = 0.5 * (d_foot1 + np.outer(d1, d_s1) + d_foot2 + np.outer(d2, d_s2))
    return Triangulation(
        position_m=frozen_array(0.5 * (foot1 + foot2), (3,)),
        covariance_m2=frozen_array(sigma_px * sigma_px * (jacobian @ jacobian.T), (3, 3)),
        ray_gap_m=math.sqrt(float(gap @ gap)),
        ranges_m=(float(s1), float(s2)),
        rates_m_per_px=frozen_array(jacobian, (3, 4)),
        gap_m_per_px=frozen_array(d_product / sine, (4,)),
    )
