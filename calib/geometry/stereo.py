"""Triangulation of a stereo pair, with the covariance that pixel noise gives.

The paper's section V, steps 1 and 2: a ray through each picked pixel, then the rays' intersection or the
middle of their common normal.

The paper's Table I, the error budget of a target approach, follows from its equations (1) to (4). All errors
are 3 sigma. The printed cells come from a pixel of 4.65 µm for all three cameras, with 1024 x 768 pixels for
the Hazcam as for the others. The text's 4.69 µm does not give them.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from calib.errors import NoStereoPoint
from calib.geometry.cahvor import CameraModel
from calib.geometry.rigid import FloatArray, ReadOnlyArrays, crossed, finite_float

PARALLEL_RAD = 1e-9
"""Rays that meet under a smaller angle are parallel: rounding alone would place the point."""

SIDES = ("left", "right")


@dataclass(frozen=True, eq=False)
class Triangulation(ReadOnlyArrays):
    """A point seen by two cameras, or many (...) of them, in the frame of their models; read-only.

    ``position_m`` (..., 3) is the middle of the common normal of the two rays, with its covariance
    (..., 3, 3) from the pixel noise alone, to first order, and ``rates_m_per_px`` (..., 3, 4) to (left x,
    left y, right x, right y). ``ranges_m`` (..., 2) go from each ray's origin to the normal's foot on it.
    ``ray_gap_m`` (...) is the normal's length. Large beside what the pixel noise explains, it says that the
    two pixels are not of one point, or that the models are off (`calib.geometry.covariance`).

    ``gap_m_per_px`` (..., 4) are the gap's rates where the rays meet. The gap is the triple product of both
    directions and what lies between the origins, over the sine of their angle; the rates are those of the
    product. It is linear in each direction, so they are right for pixels far off each other's lines too.

    ``refused`` (...) is empty where there is a point, else the code of `calib.errors.NoStereoPoint`;
    position, covariance, gap and ranges are then not-a-number.
    """

    position_m: FloatArray
    covariance_m2: FloatArray
    ray_gap_m: Any
    ranges_m: FloatArray
    rates_m_per_px: FloatArray
    gap_m_per_px: FloatArray
    refused: NDArray[np.str_]


def triangulate(
    left: CameraModel, right: CameraModel, left_px: ArrayLike, right_px: ArrayLike, sigma_px: float = 0.2
) -> Triangulation:
    """Return the point seen at one pixel (2,) in each of two cameras, which are in one common frame.

    Many pixels (..., 2) are broadcast; a pair of them without a point stops no other, and ``refused`` has its
    code. ``sigma_px`` is the noise of each pixel coordinate, independent in both axes and both images.

    Raises
    ------
    NoStereoPoint
        ``bad_pixel``: a pixel is not two finite numbers or has no ray; or arrays of another shape, or that do
        not go together. ``parallel_rays``: the rays meet under less than 1e-9 rad. ``behind_camera``: they
        meet behind a camera, that is they diverge ahead.
    ValueError
        If the sigma is negative or not finite.

    Examples
    --------
    >>> import numpy as np
    >>> from calib.geometry.cahvor import CameraModel
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
    pixels = [np.asarray(pixel, dtype=np.float64) for pixel in (left_px, right_px)]
    single = max(xy.ndim for xy in pixels) == 1
    for side, xy in zip(SIDES, pixels, strict=True):
        if single and (xy.shape != (2,) or not np.isfinite(xy).all()):
            raise NoStereoPoint("bad_pixel", f"{side} pixel {xy.tolist()} is not two finite numbers")
        if xy.ndim == 0 or xy.shape[-1] != 2:
            raise NoStereoPoint("bad_pixel", f"{side} pixels of shape {xy.shape} where (..., 2) is expected")
    try:
        both = np.broadcast_arrays(*pixels)
    except ValueError:
        raise NoStereoPoint(
            "bad_pixel",
            f"left pixels of shape {pixels[0].shape} and right pixels of shape {pixels[1].shape} "
            "do not go together",
        ) from None
    has_ray, sines, ranges_m, gaps_m, positions_m, rates, gap_rates = _meeting(
        left, right, *(xy.reshape(-1, 2) for xy in both)
    )
    refused = np.select(
        [~has_ray.all(axis=0), sines < PARALLEL_RAD, ~(ranges_m > 0.0).all(axis=1)],
        ["bad_pixel", "parallel_rays", "behind_camera"],
        "",
    )
    if single and refused[0]:
        raise _refusal(str(refused[0]), (left, right), pixels, float(sines[0]), ranges_m[0])
    covariance = sigma_px * sigma_px * (rates @ rates.transpose(0, 2, 1))
    arrays: list[Any] = [
        np.where((refused == "").reshape(-1, *[1] * (one.ndim - 1)), one, np.nan)
        for one in (positions_m, covariance, np.sqrt(_dot(gaps_m, gaps_m)), ranges_m)
    ]
    arrays += [rates, gap_rates, refused]
    arrays = [one.reshape((*both[0].shape[:-1], *one.shape[1:]))[()] for one in arrays]
    for one in arrays:
        if isinstance(one, np.ndarray):
            one.setflags(write=False)
    return Triangulation(*arrays)


def _refusal(
    code: str, models: Sequence[CameraModel], pixels: Sequence[FloatArray], sine: float, ranges_m: FloatArray
) -> NoStereoPoint:
    """Why two single pixels show no point, in numbers."""
    if code == "bad_pixel":
        k = int(bool(models[0].ray(pixels[0]).valid))  # the left one's fault if it has no ray
        camera = f"{models[k].kind} camera{models[k].why_no_ray}"
        return NoStereoPoint(code, f"{SIDES[k]} pixel {pixels[k].tolist()} has no ray in this {camera}")
    if code == "parallel_rays":
        return NoStereoPoint(code, f"the two rays are parallel to {sine:.2g} rad: no point where they meet")
    s1, s2 = ranges_m
    return NoStereoPoint(
        code,
        f"the two rays diverge: they come nearest {s1:.4g} m along the left and {s2:.4g} m along the right "
        "one, and both must be ahead",
    )


def _meeting(
    left: CameraModel, right: CameraModel, left_px: FloatArray, right_px: FloatArray
) -> tuple[FloatArray, ...]:
    """Where the rays of pixels (n, 2) of both cameras come nearest: which have a ray (2, n), sines (n,) of
    the rays' angles, ranges (n, 2), gaps (n, 3), positions (n, 3) with rates (n, 3, 4) to (left x, left y,
    right x, right y), and the gaps' rates (n, 4). Rows of parallel or missing rays mean nothing."""
    with np.errstate(all="ignore"):
        rays1, turn1, shift1 = left.ray_jacobian(left_px)
        rays2, turn2, shift2 = right.ray_jacobian(right_px)
        d1, d2, between = rays1.directions, rays2.directions, rays1.origins_m - rays2.origins_m
        # The common normal's feet o1 + s1 d1 and o2 + s2 d2: the gap between them is perpendicular to both.
        cosines, normals = _dot(d1, d2)[:, None], crossed(d1, d2)
        sines = np.sqrt(_dot(normals, normals))
        per_sine2 = (1.0 / (sines * sines))[:, None]
        along1, along2 = _dot(d1, between)[:, None], _dot(d2, between)[:, None]
        s1 = per_sine2 * (cosines * along2 - along1)
        s2 = per_sine2 * (along2 - cosines * along1)
        foot1, foot2 = rays1.origins_m + s1 * d1, rays2.origins_m + s2 * d2
        gaps = foot1 - foot2

        # Derivatives to the four pixel coordinates (left x, y, right x, y): the feet with s1, s2 fixed, then
        # s1, s2 from d1·gap = d2·gap = 0, which the turned directions disturb as well.
        d_feet = np.concatenate([shift1 + s1[..., None] * turn1, shift2 + s2[..., None] * turn2], axis=2)
        d_gap = d_feet * [1.0, 1.0, -1.0, -1.0]
        r1, r2 = _times(d1, d_gap), _times(d2, d_gap)
        r1[:, :2] += _times(gaps, turn1)
        r2[:, 2:] += _times(gaps, turn2)
        d_s1 = per_sine2 * (cosines * r2 - r1)
        d_s2 = per_sine2 * (r2 - cosines * r1)
        d_feet += d1[:, :, None] * d_s1[:, None]
        d_feet += d2[:, :, None] * d_s2[:, None]
        d_product = np.concatenate(
            [
                _times(normals, shift1) + _times(crossed(d2, between), turn1),
                _times(crossed(between, d1), turn2) - _times(normals, shift2),
            ],
            axis=1,
        )
        return (
            np.array([rays1.valid, rays2.valid]),
            sines,
            np.concatenate([s1, s2], axis=1),
            gaps,
            0.5 * (foot1 + foot2),
            0.5 * d_feet,
            d_product / sines[:, None],
        )


def _dot(a: FloatArray, b: FloatArray) -> FloatArray:
    """Dot products (n,) of vectors (n, 3)."""
    return np.asarray(np.einsum("ni,ni->n", a, b))


def _times(a: FloatArray, b: FloatArray) -> FloatArray:
    """Products (n, k) of rows (n, 3) and matrices (n, 3, k)."""
    return np.asarray((a[:, None] @ b)[:, 0])


PIXEL_M = 4.65e-6

PAPER_PAIRS = (("pancam", 16.0e-3, 0.30), ("navcam", 6.0e-3, 0.20), ("hazcam", 2.3e-3, 0.10))
"""Names, focal lengths and baselines of the paper's stereo pairs, metres, the longest focal length first."""


class BudgetRow(NamedTuple):
    """One row of Table I: 3-sigma errors in centimetres, by the pair at the start of the approach.

    Of stereo where the approach starts, eq. (1); of the target's place after the approach without visual
    tracking, eq. (3); the same with ideal tracking and hand-off down to the last camera, eq. (4).
    """

    name: str
    stereo_cm: float
    untracked_cm: float
    tracked_cm: float


def stereo_range_error_m(
    range_m: float, focal_px: float, baseline_m: float, disparity_error_px: float
) -> float:
    """Return R² Δd / (f B), the range error of a stereo pair, eq. (1); metres."""
    return range_m * range_m / (focal_px * baseline_m) * disparity_error_px


def target_approach_budget() -> tuple[BudgetRow, ...]:
    """Return the rows of Table I, one for each pair as the one the approach from 10 m to 1 m starts with.

    The last pair is the one that places the instrument. The pixel size gives focal lengths in pixels, eq.
    (2). 3 sigma are 1 pixel of stereo at the start, and 2 % of the distance there of navigation.

    While the target grows its place in the image is known no better than the first pixel was. The paper takes
    half of that growth as the disparity error at the end: ±5 pixels. A hand-off scales it by the ratio of
    focal lengths, so that the focal length of the first camera stays in eq. (4) and the baseline is the last
    camera's.
    """
    start_m, end_m, disparity_error_px, odometry_error = 10.0, 1.0, 1.0, 0.02
    grown_error_px = 0.5 * disparity_error_px * start_m / end_m
    rows = []
    for name, focal_m, baseline_m in PAPER_PAIRS:
        focal_px = focal_m / PIXEL_M
        stereo_m = stereo_range_error_m(start_m, focal_px, baseline_m, disparity_error_px)
        untracked_m = math.hypot(stereo_m, odometry_error * start_m)
        tracked_m = stereo_range_error_m(end_m, focal_px, PAPER_PAIRS[-1][2], grown_error_px)
        rows.append(BudgetRow(name, 100.0 * stereo_m, 100.0 * untracked_m, 100.0 * tracked_m))
    return tuple(rows)
