"""Find a pixel's partner in the other camera, and the surface that two cameras see there.

Around the best place of a sweep along the pixel's ray (`calib.matching.sweep`) the surface is seen
pixel by pixel (`calib.matching.relief`); carried over it, the patch is matched freely in both directions
(`calib.matching.patch`), so the offset across the epipolar line is measured, not assumed:
cameras that disagree there are out of calibration, or a picture is not what it claims to be.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from calib.errors import NoStereoPoint
from calib.geometry.cahvor import CameraModel
from calib.geometry.rigid import FloatArray, finite_float
from calib.geometry.stereo import triangulate
from calib.matching.patch import match_patch
from calib.matching.relief import surface_seen
from calib.matching.sweep import Swept, sweep
from calib.matching.verdict import MatchSettings, PatchMatch, no_match, rivalled, worst_px2
from calib.matching.warp import GRAZING, SIDES, Plane, PosedImage, Relief, carry


@dataclass(frozen=True, eq=False)
class StereoMatch:
    """The partner of a pixel, the surface there, and whether the cameras agree.

    Attributes
    ----------
    match
        The partner pixel with its verdict; nothing below is valid unless it is ``good``.
    plane, relief
        A plane that fits what both cameras see near the pixel, and what stands off it.
    across_px, across_sigma_px
        Distance of the partner from the epipolar line, signed, and one sigma of the matching alone.
    """

    match: PatchMatch
    plane: Plane | None = None
    across_px: float = math.nan
    across_sigma_px: float = math.nan
    relief: Relief | None = None


def find_partner(
    own: PosedImage,
    pixel_px: ArrayLike,
    partner: PosedImage,
    nearest_m: float = 0.4,
    settings: MatchSettings | None = None,
) -> StereoMatch:
    """Find where the partner shows what the own image, of the same moment, shows at a pixel (2,).

    Their common frame has z down. The sweep starts at ``nearest_m``; ValueError if that is no finite distance
    ahead.
    """
    if not finite_float("nearest_m", nearest_m) > 0.0:
        raise ValueError(f"nearest_m is {nearest_m} where a distance above 0 is expected")
    settings = settings or MatchSettings()
    pixel = np.asarray(pixel_px, dtype=np.float64)
    # Most of the patch may lie on something nearer or farther than the target: then a smaller one is tried.
    halves = (settings.half_px // part for part in (2, 3))
    sizes = [settings, *(replace(settings, half_px=half, smallest_half_px=half) for half in halves)]
    refused: PatchMatch | None = None
    for size in sizes:
        surface = _surface(own, pixel, partner, sweep(own, pixel, partner, nearest_m, size), settings)
        if not isinstance(surface, PatchMatch):
            break
        refused = refused or surface
        if surface.verdict in ("border", "flat"):
            return StereoMatch(refused)
    else:
        assert refused is not None
        return StereoMatch(refused)
    plane, relief, second = surface
    found = match_patch(own, pixel, plane, partner, 4.0, settings, relief)
    if found.verdict != "good":
        return StereoMatch(found)
    try:
        triangulate(own.camera, partner.camera, pixel, found.pixel_px)
    except NoStereoPoint as error:
        return StereoMatch(no_match("weak", f"the two cameras see no common point: {error}", found.pixel_px))
    across, sigma = _across(own.camera, pixel, partner.camera, plane, found)
    # 2.0: the search back is not refined: half a pixel of the sweep, and slope.
    allowed = 2.0 + abs(across) + math.sqrt(worst_px2(found.covariance_px2))
    apart = math.inf
    for size in sizes:
        back = sweep(partner, found.pixel_px, own, nearest_m, size)
        if not isinstance(back, PatchMatch):
            apart = min(apart, float(np.linalg.norm(back.pixel_px - pixel)))
        if apart <= allowed:
            return StereoMatch(replace(found, second=max(found.second, second)), plane, across, sigma, relief)
    place = "nowhere" if math.isinf(apart) else f"{apart:.0f} px from where it came"
    reason = f"matched back from the other camera it lands {place}: probably hidden from one camera"
    return StereoMatch(no_match("weak", reason, found.predicted_px, found.correlation, second))


def _surface(
    own: PosedImage,
    pixel: FloatArray,
    partner: PosedImage,
    swept: Swept | PatchMatch,
    settings: MatchSettings,
) -> tuple[Plane, Relief, float] | PatchMatch:
    """Return the surface at a sweep's best place and how well the next best fits, or why there is none."""
    if isinstance(swept, PatchMatch):
        return swept
    facts = (swept.pixel_px, swept.score, swept.second)
    if rivalled(swept.score, swept.second, settings):
        reason = (
            f"a second place along the epipolar line fits nearly as well: {swept.second:.2f} "
            f"beside {swept.score:.2f}"
        )
        return no_match("ambiguous", reason, *facts)
    # 3: the surface is seen as far beyond the patch: another view turns and slants it.
    half = settings.half_px + 3
    seen = surface_seen(own, pixel, partner, swept.plane, half, settings.noise_dn)
    if seen is None:
        reason = "the two cameras see no common surface there: an edge, or hidden from one of them"
        return no_match("weak", reason, *facts)
    return *seen, swept.second


def normal_seen(
    target_m: FloatArray,
    camera: CameraModel,
    partner: CameraModel,
    plane: Plane,
    found: PatchMatch,
    own: PatchMatch,
) -> FloatArray:
    """Return the unit normal (3,) of a target's surface (3,) that the deformations found by two cameras show.

    ``found`` is the match in ``partner``, ``own`` that in ``camera``, of a patch warped over ``plane``. Its
    normal is returned where the two cameras see too little of a slope.
    """

    def deformed(offsets: FloatArray, match: PatchMatch) -> FloatArray:
        return offsets if match.deformation is None else offsets + offsets @ match.deformation.T

    # Where the old plane carries neighbours of the target, and where the deformations say they really are.
    offsets = 0.7 * found.half_px * SIDES
    mine, valid = carry(found.predicted_px + offsets, partner, plane, camera)
    if not valid.all():
        return plane.normal
    mine = own.pixel_px + deformed(mine - own.predicted_px, own)
    theirs = found.pixel_px + deformed(offsets, found)
    left, right, top, bottom = triangulate(camera, partner, mine, theirs).position_m
    normal = np.cross(right - left, bottom - top)
    sight, length = target_m - camera.C, float(np.linalg.norm(normal))
    # Written so that a neighbour without a point in both cameras falls back too.
    if not abs(normal @ sight) > GRAZING * length * np.linalg.norm(sight):
        return plane.normal
    return np.asarray(normal / length)


def _across(
    camera: CameraModel, pixel: FloatArray, partner: CameraModel, plane: Plane, found: PatchMatch
) -> tuple[float, float]:
    """Return the signed distance of the partner pixel from the epipolar line, and its sigma."""
    ray = camera.ray(pixel)
    range_m = float((plane.point_m - ray.origins_m) @ ray.directions)
    place, rate, _ = partner.project_jacobian(ray.origins_m + range_m * ray.directions)
    along = rate @ ray.directions
    normal = np.array([-along[1], along[0]]) / np.linalg.norm(along)
    return float(normal @ (found.pixel_px - place)), float(np.sqrt(normal @ found.covariance_px2 @ normal))
