"""Find a pixel's partner in the other camera, and the surface that two cameras see there.

A plane is swept along the pixel's ray, from near to infinity: at each inverse range the patch is laid on
planes of a few slopes and searched in the other picture, so slope and scale do not spoil the correlation; the
line it follows is as curved as the lenses make it. Around the best place the surface is seen pixel by pixel
(`calib.matching.relief`); carried over it, the patch is matched freely in both directions
(`calib.matching.patch`), so the offset across the epipolar line is measured, not assumed: cameras that
disagree there are out of calibration, or a picture is not what it claims to be.

The common frame has z down (rover, site): level ground is one of the planes tried.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from calib.errors import NoStereoPoint
from calib.geometry.cahvor import CameraModel, Rays
from calib.geometry.rigid import FloatArray
from calib.geometry.stereo import triangulate
from calib.matching.patch import (
    MatchSettings,
    PatchMatch,
    expected_correlation,
    match_patch,
    rivalled,
    texture_lacks,
    worst_px2,
)
from calib.matching.relief import surface_seen
from calib.matching.warp import (
    FARTHEST_M,
    GRAZING,
    SIDES,
    Plane,
    PosedImage,
    Relief,
    carry,
    quadratic,
    sample,
    square_grid,
)

UP = np.array([0.0, 0.0, -1.0])

COARSE = 2  # the first sweep uses every second pixel of half-size pictures


FINE_STEPS = np.arange(-3.0, 3.5, 0.5)  # px around each of the best coarse places


@dataclass(frozen=True, eq=False)
class StereoMatch:
    """The partner of a pixel, and the surface there; nothing but ``match`` is valid unless that is ``good``.

    ``plane`` fits what both cameras see near the pixel, ``relief`` is what stands off it. ``across_px`` is
    the distance of the partner from the epipolar line, signed, with one sigma of the matching alone.
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

    Their common frame has z down. The sweep starts at ``nearest_m``.
    """
    settings = settings or MatchSettings()
    pixel = np.asarray(pixel_px, dtype=np.float64)
    # Most of the patch may lie on something nearer or farther than the target: then a smaller one is tried.
    halves = (settings.half_px // part for part in (2, 3))
    sizes = [settings, *(replace(settings, half_px=half, smallest_half_px=half) for half in halves)]
    refused: PatchMatch | None = None
    for size in sizes:
        surface = _surface(own, pixel, partner, _sweep(own, pixel, partner, nearest_m, size), settings)
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
        return StereoMatch(
            PatchMatch("weak", f"the two cameras see no common point: {error}", found.pixel_px)
        )
    across, sigma = _across(own.camera, pixel, partner.camera, plane, found)
    # 2.0: the search back is not refined: half a pixel of the sweep, and slope.
    allowed = 2.0 + abs(across) + math.sqrt(worst_px2(found.covariance_px2))
    apart = math.inf
    for size in sizes:
        back = _sweep(partner, found.pixel_px, own, nearest_m, size)
        if not isinstance(back, PatchMatch):
            apart = min(apart, float(np.linalg.norm(back.pixel_px - pixel)))
        if apart <= allowed:
            return StereoMatch(replace(found, second=max(found.second, second)), plane, across, sigma, relief)
    place = "nowhere" if math.isinf(apart) else f"{apart:.0f} px from where it came"
    reason = f"matched back from the other camera it lands {place}: probably hidden from one camera"
    return StereoMatch(PatchMatch("weak", reason, found.predicted_px, found.correlation, second))


def _surface(
    own: PosedImage,
    pixel: FloatArray,
    partner: PosedImage,
    swept: _Swept | PatchMatch,
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
        return PatchMatch("ambiguous", reason, *facts)
    # 3: the surface is seen as far beyond the patch: another view turns and slants it.
    half = settings.half_px + 3
    seen = surface_seen(own, pixel, partner, swept.plane, half, settings.noise_dn)
    if seen is None:
        reason = "the two cameras see no common surface there: an edge, or hidden from one of them"
        return PatchMatch("weak", reason, *facts)
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


@dataclass(frozen=True, eq=False)
class _Swept:
    """The best place of a sweep, to half a pixel along the line."""

    plane: Plane
    pixel_px: FloatArray
    score: float
    second: float


_Patch = tuple[NDArray[np.float32], Rays, NDArray[np.float32]]
"""The values of a source patch (n,), the rays of its nine knots, and each pixel's weights of these (n, 9)."""


def _sweep(
    own: PosedImage, pixel: FloatArray, partner: PosedImage, nearest_m: float, settings: MatchSettings
) -> _Swept | PatchMatch:
    """Return the best place along the line, or why there is none."""
    camera = own.camera
    edge = float(min(*(pixel - 1), *(np.array(camera.size_px) - 2 - pixel)))
    half = min(settings.half_px, math.floor(edge))  # of the largest patch that the picture holds
    if half < settings.smallest_half_px:
        return PatchMatch("border", "the patch is cut by the picture's border")
    values = sample(own.image, pixel + square_grid(half)).astype(np.float32)
    lacking = texture_lacks(values, settings)
    if lacking:
        return PatchMatch("flat", lacking, half_px=half)
    ray = camera.ray(pixel)
    if not bool(ray.valid):
        return PatchMatch("border", "the pixel has no ray in this camera")
    inverse, places = _curve(ray, partner.camera, nearest_m, settings.smallest_half_px)
    if len(inverse) == 0:
        return PatchMatch("border", "nothing that this pixel may show lies in the other camera's picture")
    normals = _normals(ray.directions)
    small, partner_small = (
        replace(one, image=np.asarray(cv2.pyrDown(one.image), np.float32)) for one in (own, partner)
    )
    coarse = _patch(small, pixel, half, COARSE)
    scores = _scores(coarse, ray, inverse, normals, partner_small, COARSE).max(axis=1)
    kept = _best_apart(scores, places, settings.apart_px)
    fine = _patch(own, pixel, half, 1)
    tries: list[tuple[float, float, int]] = []
    for index in kept:
        near = _between(inverse, places, index)
        table = _scores(fine, ray, near, normals, partner, 1)
        row, column = np.unravel_index(int(np.argmax(table)), table.shape)
        tries.append((float(table[row, column]), float(near[row]), int(column)))
    if not tries:
        return PatchMatch("weak", "no place along the epipolar line can be compared", half_px=half)
    tries.sort(reverse=True)
    score, best, which = tries[0]
    seen, _ = partner.camera.project(ray.origins_m + ray.directions / np.array([[one[1]] for one in tries]))
    apart = np.linalg.norm(seen - seen[0], axis=1) > settings.apart_px
    second = max((one[0] for one, far in zip(tries, apart, strict=True) if far), default=-1.0)
    least = 0.8 * settings.least_correlation * expected_correlation(values, settings)
    if score < least:
        reason = f"no place along the epipolar line correlates by more than {score:.2f}"
        return PatchMatch("weak", reason, correlation=score, second=second, half_px=half)
    plane = Plane(ray.origins_m + ray.directions / best, normals[which])
    return _Swept(plane, seen[0], score, second)


def _curve(
    ray: Rays, partner: CameraModel, nearest_m: float, margin_px: float
) -> tuple[FloatArray, FloatArray]:
    """Return inverse ranges (m,) and pixels (m, 2) along the epipolar line, about two pixels apart."""
    # 400: points of the ray by which the curve's length is known.
    dense = np.linspace(1.0 / FARTHEST_M, 1.0 / nearest_m, 400)
    seen, valid = partner.project(ray.origins_m + ray.directions / dense[:, None])
    size = np.array(partner.size_px)
    with np.errstate(invalid="ignore"):
        inside = valid & ((seen >= margin_px) & (seen <= size - 1 - margin_px)).all(axis=1)
    # The neighbours of an inside point count too: the line crosses the picture's border between them.
    reach = inside.copy()
    reach[1:] |= inside[:-1]
    reach[:-1] |= inside[1:]
    reach &= valid
    dense, seen = dense[reach], seen[reach]
    if len(dense) < 2:
        return np.empty(0), np.empty((0, 2))
    length = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(seen, axis=0), axis=1))])
    steps = np.linspace(0.0, length[-1], max(2, math.ceil(length[-1] / COARSE) + 1))
    inverse = np.interp(steps, length, dense)
    places, valid = partner.project(ray.origins_m + ray.directions / inverse[:, None])
    with np.errstate(invalid="ignore"):
        keep = valid & ((places >= margin_px) & (places <= size - 1 - margin_px)).all(axis=1)
    return inverse[keep], places[keep]


def _normals(direction: FloatArray) -> FloatArray:
    """Return the slopes to try (k, 3): facing the camera, level, and between the two."""
    facing = -direction
    between = facing + UP
    slopes = [facing]
    if abs(facing @ UP) > GRAZING:
        slopes += [between / np.linalg.norm(between), UP]
    return np.array(slopes)


def _patch(own: PosedImage, pixel: FloatArray, half: int, step: int) -> _Patch:
    """Cut the patch out of a picture reduced ``step`` times and prepare its knots."""
    count = half // step
    offsets = square_grid(count) * step
    maps = ((pixel + offsets) / step).astype(np.float32)
    values = cv2.remap(
        own.image, maps[..., 0], maps[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
    )
    values = values.reshape(-1) - values.mean()
    length = float(np.linalg.norm(values))
    knots = own.camera.ray(pixel + square_grid(1).reshape(9, 2) * (count * step))
    weights = np.einsum("yj,xi->yxji", quadratic(count), quadratic(count)).reshape(len(values), 9)
    return values / max(length, 1e-6), knots, weights.astype(np.float32)


def _scores(
    patch: _Patch,
    ray: Rays,
    inverse: FloatArray,
    normals: FloatArray,
    partner: PosedImage,
    step: int,
) -> NDArray[np.float32]:
    """Return the correlations (m, k) at inverse ranges (m,) and slopes (k, 3).

    The map of a patch is biquadratic through its nine knots, each carried exactly.
    """
    values, knots, weights = patch
    points = ray.origins_m + ray.directions / inverse[:, None]
    with np.errstate(invalid="ignore", divide="ignore"):
        slope = normals @ knots.directions.T  # (k, 9)
        ahead = np.einsum("mkjc,kc->mkj", points[:, None, None] - knots.origins_m, normals)
        ranges = ahead / slope
        ranges = np.where((ranges > 0) & (np.abs(slope) > GRAZING), ranges, np.nan)
        hits = knots.origins_m + ranges[..., None] * knots.directions
    pixels, _ = partner.camera.project(hits)  # (m, k, 9, 2)
    m, k = pixels.shape[:2]
    known = np.isfinite(pixels).all(axis=(2, 3)).reshape(m * k)
    maps = np.where(np.isfinite(pixels), pixels / step, 0.0).astype(np.float32).reshape(m * k, 9, 2)
    map_x, map_y = maps[..., 0] @ weights.T, maps[..., 1] @ weights.T
    seen = cv2.remap(partner.image, map_x, map_y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    seen -= seen.mean(axis=1, keepdims=True)
    length = np.sqrt(np.einsum("ij,ij->i", seen, seen))
    scores = (seen @ values) / np.maximum(length, 1e-3)
    return np.where(known, scores, np.float32(-1.0)).astype(np.float32).reshape(m, k)


def _best_apart(scores: NDArray[np.float32], places: FloatArray, apart_px: float) -> list[int]:
    """Return the indices of the best local maxima along the line, apart from each other, best first."""
    padded = np.concatenate([[-2.0], scores, [-2.0]])
    tops = np.flatnonzero((padded[1:-1] >= padded[:-2]) & (padded[1:-1] >= padded[2:]))
    kept: list[int] = []
    for index in tops[np.argsort(-scores[tops])]:
        if all(np.linalg.norm(places[index] - places[other]) > apart_px for other in kept):
            kept.append(int(index))
        if len(kept) == 4:
            break
    return kept


def _between(inverse: FloatArray, places: FloatArray, index: int) -> FloatArray:
    """Return inverse ranges half a pixel apart around a coarse place."""
    if len(inverse) < 2:
        return inverse
    other = index + 1 if index + 1 < len(inverse) else index - 1
    length = max(float(np.linalg.norm(places[other] - places[index])), 1e-6)
    per_px = abs(inverse[other] - inverse[index]) / length
    near: FloatArray = np.maximum(inverse[index] + FINE_STEPS * per_px, 1.0 / FARTHEST_M)
    return near
