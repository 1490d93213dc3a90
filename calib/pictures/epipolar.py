"""Find a pixel's partner in the other eye, and the surface that two eyes see there.

The best place of a sweep along the pixel's ray (`calib.pictures.epipolar_sweep`) is matched freely in both
directions (`calib.pictures.patch_match`), so the offset across the epipolar line is measured, not assumed:
eyes that disagree there are out of calibration, or a picture is not what it claims to be.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from calib.camera.cahvor import CameraModel
from calib.camera.stereo import triangulate, triangulate_many
from calib.errors import NoStereoPoint
from calib.pictures.epipolar_sweep import sweep
from calib.pictures.patch_match import match_patch
from calib.pictures.patch_verdict import (
    MatchSettings,
    PatchMatch,
    no_match,
    rivalled,
)
from calib.pictures.warp import GRAZING, SIDES, Grey, Plane, carry
from calib.rigid import FloatArray, finite_float

LAST_SEARCH_PX = 4.0

MATCHED_BACK_PX = 2.0  # the way back is not refined: half a pixel of the sweep, and slope


@dataclass(frozen=True, eq=False)
class StereoMatch:
    """The partner of a pixel, the surface there, and whether the eyes agree.

    Attributes
    ----------
    match
        The partner pixel with its verdict; nothing below counts unless it is ``good``.
    plane
        The local surface: the triangulated point and the slope that the patch's deformation tells.
    across_px, across_sigma_px
        Distance of the partner from the epipolar line, signed, and one sigma of the matching alone.
    """

    match: PatchMatch
    plane: Plane | None = None
    across_px: float = math.nan
    across_sigma_px: float = math.nan


def find_partner(
    image: Grey,
    camera: CameraModel,
    pixel_px: ArrayLike,
    partner_image: Grey,
    partner: CameraModel,
    nearest_m: float = 0.4,
    settings: MatchSettings | None = None,
) -> StereoMatch:
    """Find where the partner sees what the camera sees at a pixel.

    Parameters
    ----------
    image, partner_image
        (h, w) float32 grey of one moment.
    camera, partner
        Their models in one common frame with z down.
    pixel_px
        (2,) the target in ``image``, sub-pixel.
    nearest_m
        Where the sweep starts, metres.

    Raises
    ------
    ValueError
        If it starts at no finite distance ahead.
    """
    if not finite_float("nearest_m", nearest_m) > 0.0:
        raise ValueError(f"nearest_m is {nearest_m} where a distance above 0 is expected")
    settings = settings or MatchSettings()
    pixel = np.asarray(pixel_px, dtype=np.float64)
    swept = sweep(image, camera, pixel, partner_image, partner, nearest_m, settings)
    if isinstance(swept, PatchMatch):
        return StereoMatch(swept)
    if rivalled(swept.score, swept.second, settings):
        words = (
            f"a second place along the epipolar line fits nearly as well: {swept.second:.2f} "
            f"beside {swept.score:.2f}"
        )
        return StereoMatch(no_match("ambiguous", words, swept.pixel_px, swept.score, swept.second))
    found = match_patch(image, camera, pixel, swept.plane, partner_image, partner, LAST_SEARCH_PX, settings)
    if found.verdict != "good":
        return StereoMatch(found)
    try:
        plane = local_plane(camera, pixel, partner, swept.plane, found)
    except NoStereoPoint as error:
        return StereoMatch(no_match("weak", f"the two eyes see no point together: {error}", swept.pixel_px))
    again = match_patch(image, camera, pixel, plane, partner_image, partner, LAST_SEARCH_PX, settings)
    if again.verdict == "good":
        found = again
        plane = local_plane(camera, pixel, partner, plane, found)
    across, sigma = _across(camera, pixel, partner, plane, found)
    back = sweep(partner_image, partner, found.pixel_px, image, camera, nearest_m, settings)
    apart = math.inf if isinstance(back, PatchMatch) else float(np.linalg.norm(back.pixel_px - pixel))
    if apart > MATCHED_BACK_PX + abs(across):
        told = "nowhere" if math.isinf(apart) else f"{apart:.0f} px from where it came"
        words = f"matched back from the other eye it lands {told}: probably hidden from one eye"
        return StereoMatch(no_match("weak", words, found.predicted_px, found.correlation, swept.second))
    return StereoMatch(replace(found, second=max(found.second, swept.second)), plane, across, sigma)


def local_plane(
    camera: CameraModel, pixel: FloatArray, partner: CameraModel, plane: Plane, found: PatchMatch
) -> Plane:
    """Return the surface that two eyes tell: the target triangulated, its slope from the deformation found.

    Parameters
    ----------
    pixel
        (2,) the target in ``camera``.
    plane
        The surface over which the searched patch was warped.
    found
        What was found in ``partner``.

    Raises
    ------
    NoStereoPoint
        If the two eyes' rays have no point in common.
    """
    target = triangulate(camera, partner, pixel, found.pixel_px).position_m
    return Plane(target, normal_seen(target, camera, partner, plane, found))


def normal_seen(
    target_m: FloatArray,
    camera: CameraModel,
    partner: CameraModel,
    plane: Plane,
    found: PatchMatch,
    own: PatchMatch | None = None,
) -> FloatArray:
    """Return the surface's unit normal (3,) that the deformations found by two eyes tell.

    Parameters
    ----------
    target_m
        (3,) the target.
    plane
        The surface over which the searched patches were warped; its normal is returned where the two eyes
        see too little of a slope.
    found
        What was found in ``partner``.
    own
        What was found in ``camera``, if the patches come from a third picture and not from this one.
    """
    # Where the old plane carries neighbours of the target, and where the deformations say they really are.
    offsets = 0.7 * found.half_px * SIDES
    mine, valid = carry(found.predicted_px + offsets, partner, plane, camera)
    if not valid.all():
        return plane.normal
    if own is not None:
        mine = own.pixel_px + _deformed(mine - own.predicted_px, own)
    theirs = found.pixel_px + _deformed(offsets, found)
    left, right, top, bottom = triangulate_many(camera, partner, mine, theirs).position_m
    normal = np.cross(right - left, bottom - top)
    sight, length = target_m - camera.C, float(np.linalg.norm(normal))
    # Written so that a neighbour without a point in both eyes falls back too.
    if not abs(normal @ sight) > GRAZING * length * np.linalg.norm(sight):
        return plane.normal
    return np.asarray(normal / length)


def _deformed(offsets: FloatArray, found: PatchMatch) -> FloatArray:
    """Offsets (n, 2) from the target as a match saw them deformed."""
    return offsets if found.deformation is None else offsets + offsets @ found.deformation.T


def _across(
    camera: CameraModel, pixel: FloatArray, partner: CameraModel, plane: Plane, found: PatchMatch
) -> tuple[float, float]:
    """Return the signed distance of the partner pixel from the epipolar line, and its sigma."""
    ray = camera.ray(pixel)
    range_m = float((plane.point_m - ray.origins_m) @ ray.directions)
    ends, _ = partner.project(ray.origins_m + np.array([[0.99], [1.0], [1.01]]) * range_m * ray.directions)
    along = ends[2] - ends[0]
    normal = np.array([-along[1], along[0]]) / np.linalg.norm(along)
    return float(normal @ (found.pixel_px - ends[1])), float(np.sqrt(normal @ found.covariance_px2 @ normal))
