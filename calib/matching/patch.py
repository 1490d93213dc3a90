"""Find the target of one picture in another: warped template, correlation, sub-pixel place, verdict."""

from __future__ import annotations

import math
from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from calib.geometry.cahvor import CameraModel
from calib.geometry.rigid import FloatArray
from calib.matching.least_squares import NARROW, LeastSquaresMatch, match_least_squares
from calib.matching.verdict import (
    MatchSettings,
    PatchMatch,
    expected_correlation,
    judged,
    no_match,
    texture_lacks,
    worst_px2,
)
from calib.matching.warp import (
    SIDES,
    Grey,
    Plane,
    PosedImage,
    Relief,
    Template,
    blurred_to,
    carry,
    parallax_px_m,
    summit,
    warp_patch,
)


def match_patch(
    source: PosedImage,
    source_px: ArrayLike,
    plane: Plane,
    destination: PosedImage,
    search_px: float,
    settings: MatchSettings | None = None,
    relief: Relief | None = None,
) -> PatchMatch:
    """Find the target at ``source_px`` (2,) of one picture in another.

    Parameters
    ----------
    plane
        The scene around the target, in the images' common frame.
    search_px
        Half side of the window around the predicted place, destination pixels. Raises ValueError if it has no
        finite size.
    relief
        The relief off the plane around the target, if two cameras saw it; pixels that do not belong to the
        surface are left out.
    """
    if not 0.0 <= search_px < math.inf:
        raise ValueError(f"search_px is {search_px} where a finite number, 0 or more, is expected")
    settings = settings or MatchSettings()
    target = np.asarray(source_px, dtype=np.float64)
    seen, valid = carry(target, source.camera, plane, destination.camera)
    if not bool(valid):
        return no_match("border", "the target cannot be seen by the other camera by its position")
    if not destination.camera.holds(seen, 0.5 - search_px):
        return no_match("border", f"the target is expected at {_at(seen)}, outside the picture", seen)
    cut = _template(source, target, plane, destination.camera, seen, settings, relief)
    if cut is None:
        return no_match("border", f"the patch around {_at(target)} is cut by the picture's border", seen)
    template, near_px2 = cut
    half = int(template.half_px.min())
    lacking = texture_lacks(template.values, settings, template.counts)
    if lacking:
        return no_match("flat", lacking, seen, half_px=half)
    found = _search(template, destination.image, search_px, settings, near_px2)
    if isinstance(found, PatchMatch):
        return found
    refined, best, second = found
    roughness = settings.roughness if relief is None or settings.rough_beside_relief else 0.0
    if settings.relief > 0:
        expected = expected_correlation(template.values, settings, template.counts)
        roughness *= 1.0 + max(0.0, 1.0 - refined.correlation / expected) / settings.relief
    surface = _surface_term(source.camera, target, plane, destination.camera, template, near_px2, roughness)
    if relief is not None:
        off = relief.sigma_inverse_m * parallax_px_m(source.camera, target, plane, destination.camera)
        surface += np.outer(off, off)
    middle = refined.middle
    if middle is not None:
        # The middle is noisier, but the target is nearer to its plane.
        nearer = NARROW**2 * surface
        if worst_px2(middle.covariance_px2 + nearer) < worst_px2(refined.covariance_px2 + surface):
            refined, surface = replace(middle, correlation=refined.correlation), nearer
    return judged(template, refined, best, second, surface, settings)


def _surface_term(
    source: CameraModel,
    target: FloatArray,
    plane: Plane,
    destination: CameraModel,
    template: Template,
    near_px2: FloatArray | None,
    roughness: float,
) -> FloatArray:
    """Return the covariance (2, 2) px² that a target off the patch's plane adds: e eᵀ along the parallax.

    The patch shows where its plane is; the target itself lies off it by ``roughness`` of the patch's half
    extent on the plane, hence 1 / sine of the viewing angle as much along the source's ray.
    """
    ray, half = source.ray(target), template.half_px
    if near_px2 is not None:
        half = np.sqrt(3.0 * np.diag(near_px2))  # a box of this half side spreads as much
    sides = destination.ray(template.target_px + half * SIDES)
    ranges, range_m = plane.ranges_m(sides), float(plane.ranges_m(ray))
    slope = float(ray.directions @ plane.normal)
    on_plane = ray.origins_m + range_m * ray.directions
    reach = sides.origins_m + ranges[:, None] * sides.directions - on_plane
    reach_m = float(np.linalg.norm(reach, axis=1).max())
    off_m = min(roughness * reach_m / abs(slope), 0.2 * range_m)
    places, valid = destination.project(np.array([on_plane, on_plane + off_m * ray.directions]))
    if not (np.isfinite(off_m) and valid.all()):
        return np.zeros((2, 2))
    return np.outer(places[1] - places[0], places[1] - places[0])


def _template(
    source: PosedImage,
    target: FloatArray,
    plane: Plane,
    destination: CameraModel,
    seen: FloatArray,
    settings: MatchSettings,
    relief: Relief | None,
) -> tuple[Template, FloatArray | None] | None:
    """Warp the largest patch that both pictures hold, sized by the coarser of the two; with its weight."""
    around, ok = carry(seen + SIDES, destination, plane, source.camera)
    if not ok.all():
        return None
    # Destination pixels a source pixel, by area.
    shrunk = abs(float(np.linalg.det(np.stack([around[1] - around[0], around[3] - around[2]]) / 2)))
    grown = max(1.0, 1.0 / np.sqrt(max(shrunk, 1e-6)))
    near_px2, half = None, np.full(2, min(round(settings.half_px * grown), settings.most_half_px))
    if settings.near_px > 0:
        near_px2 = near_covariance(plane, destination, seen, settings.near_px * grown)
        half = np.minimum(near_half_px(near_px2), settings.most_half_px)
    least = np.minimum(
        half, round(settings.smallest_half_px * min(grown, settings.most_half_px / settings.half_px))
    )
    edge = np.minimum(seen, np.array(destination.size_px) - 1 - seen).astype(int) - 4
    half = np.minimum(half, np.maximum(edge, least))
    while True:
        template = warp_patch(source, target, plane, destination, (int(half[0]), int(half[1])), relief)
        if template is not None:
            return template, near_px2
        if (half == least).all():
            return None
        half = np.maximum(half - 3, least)


def near_covariance(plane: Plane, camera: CameraModel, pixel: FloatArray, near_px: float) -> FloatArray:
    """Return the covariance (2, 2) px² of a Gaussian that is round on the plane, of the area of a circle."""
    ray = camera.ray(pixel)
    range_m = float(plane.ranges_m(ray))
    _, rate, _ = camera.project_jacobian(ray.origins_m + range_m * ray.directions)
    seen = rate @ plane.axes
    values, vectors = np.linalg.eigh(seen @ seen.T)
    # 5.0: of a weight that is round on a surface seen flat.
    aspect = min(float(np.sqrt(values[1] / max(values[0], 1e-12 * values[1]))), 5.0)
    return np.asarray((vectors * np.array([near_px**2 / aspect, near_px**2 * aspect])) @ vectors.T)


def near_half_px(near_px2: FloatArray) -> NDArray[np.intp]:
    """Return the half sides (x, y) of the patch that such a Gaussian weighs."""
    # 2.2: sigmas of that weight, beyond which pixels are left out.
    return np.asarray(np.ceil(2.2 * np.sqrt(np.diag(near_px2))).astype(np.intp) + 2)


def _search(
    template: Template, image: Grey, search_px: float, settings: MatchSettings, near_px2: FloatArray | None
) -> tuple[LeastSquaresMatch, float, float] | PatchMatch:
    """Correlate over the window, then refine at the best place; with the two best correlations."""
    half, reach = template.half_px, int(np.ceil(search_px))
    window = template.centre_px - reach - half, template.centre_px + reach + half
    low, high = np.maximum(window[0], 0), np.minimum(window[1], np.array(image.shape[::-1]) - 1)
    if (high - low < 2 * half + 4).any():
        reason = f"the target is expected at {_at(template.target_px)}, too near the picture's border"
        return no_match("border", reason, template.target_px, half_px=int(half.min()))
    margin = int(np.ceil(4 * max(template.magnification, 1.0))) + 16
    cut_low = np.maximum(low - margin, 0)
    cut = image[cut_low[1] : high[1] + 1 + margin, cut_low[0] : high[0] + 1 + margin]
    cut = np.ascontiguousarray(blurred_to(cut, template.magnification))
    inner = low - cut_low
    searched = cut[inner[1] : inner[1] + high[1] - low[1] + 1, inner[0] : inner[0] + high[0] - low[0] + 1]
    scores = correlations(searched, template.values, template.counts)
    (x, y), best, second = peaks(
        scores, max(settings.apart_px, round(settings.apart_px * template.magnification))
    )
    facts = (best, second, int(half.min()))
    by_noise = expected_correlation(template.values, settings, template.counts)
    if best < 0.8 * settings.least_correlation * by_noise:
        reason = f"no place in the window of {reach} px correlates by more than {best:.2f}"
        return no_match("weak", reason, template.target_px, *facts)
    begins, ends = np.array([x, y]) == 0, np.array([x, y]) == np.array(scores.shape[::-1]) - 1
    if begins.any() or ends.any():
        reason = f"the best place is at the border of the window of {reach} px"
        # Where the picture cut the window, the target may be outside; else the window shows something else.
        outside = (begins & (low > window[0])).any() or (ends & (high < window[1])).any()
        return no_match("border" if outside else "weak", reason, template.target_px, *facts)
    before, top, after = (
        np.array([scores[y, x + d], scores[y + d, x]], dtype=np.float64) for d in (-1, 0, 1)
    )
    shift = low + half + np.array([x, y]) + summit(before, top, after) - template.centre_px
    start = template.target_px + shift - cut_low
    # JPEG's errors are shared within its blocks of 8, those of colour filters over some two; only some fifty
    # pixels matter to a Gaussian weight.
    enlarged = max(1.0, template.magnification)
    refined = match_least_squares(
        template.values,
        template.centre_px - cut_low,
        template.target_px - cut_low,
        cut,
        start,
        block_px=(10.0 if near_px2 is None else 4.0) * enlarged,
        near_px2=near_px2,
        counts=template.counts,
    )
    if refined is None or float(np.abs(refined.pixel_px - start).max()) > 2.0 * enlarged:
        reason = f"the best place (correlation {best:.2f}) does not settle to a sub-pixel position"
        return no_match("weak", reason, template.target_px, *facts)
    middle = refined.middle and replace(refined.middle, pixel_px=refined.middle.pixel_px + cut_low)
    return replace(refined, pixel_px=refined.pixel_px + cut_low, middle=middle), best, second


def correlations(image: Grey, patch: Grey, counts: FloatArray | None) -> NDArray[np.float32]:
    """Return the correlations of a patch with all places of an image, its pixels weighted by ``counts``.

    Not OpenCV's own mask, with which it may return what is no number. Where the image is one grey value
    (black, saturated) it correlates by 0.
    """
    if counts is None:
        return np.asarray(cv2.matchTemplate(image, patch, cv2.TM_CCOEFF_NORMED), dtype=np.float32)
    weights = counts.astype(np.float32)
    total, shifted = max(float(weights.sum()), 1e-6), image - image.mean()
    weighted = weights * (patch - np.float32((weights * patch).sum() / total))

    def summed(one: Grey, by: Grey) -> FloatArray:
        return cv2.matchTemplate(one, by, cv2.TM_CCORR).astype(np.float64)

    spread = summed(shifted * shifted, weights) - summed(shifted, weights) ** 2 / total
    length = np.sqrt(np.maximum(spread * float((weighted * patch).sum()), 1e-3))
    # 0.1: grey variance below which there is no noise either, and sums of single precision show none.
    scores = np.where(spread > 0.1 * total, summed(shifted, weighted) / length, 0.0)
    return scores.astype(np.float32)


def peaks(scores: NDArray[np.float32], apart_px: int) -> tuple[tuple[int, int], float, float]:
    """Return the best place (x, y) of a score surface, its score, and the second peak's.

    A second peak is a local maximum more than ``apart_px`` from the best; -1 if there is none.
    """
    scores = np.where(np.isfinite(scores), scores, np.float32(-1.0))
    y, x = (int(v) for v in np.unravel_index(int(np.argmax(scores)), scores.shape))
    local = (scores >= cv2.dilate(scores, np.ones((3, 3), np.uint8))) & (scores < 2.0)
    local[max(0, y - apart_px) : y + apart_px + 1, max(0, x - apart_px) : x + apart_px + 1] = False
    return (x, y), float(scores[y, x]), float(scores[local].max(initial=-1.0))


def _at(pixel_px: FloatArray) -> str:
    return f"({pixel_px[0]:.1f}, {pixel_px[1]:.1f}) px"
