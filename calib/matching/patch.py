"""Find the target of one picture in another: warped template, correlation, sub-pixel place, verdict.

The verdict is part of the measurement: only a ``good`` match is one. The others:

- ``flat``: too little texture (or only along one direction) to hold a position;
- ``ambiguous``: a second place fits nearly as well;
- ``weak``: no place fits well enough: hidden, changed, wrong range, or not in the window;
- ``border``: the patch, or the best place, lies at the border of a picture or of the window.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import Literal

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from calib.geometry.cahvor import CameraModel
from calib.geometry.rigid import FloatArray
from calib.matching.least_squares import NARROW, LeastSquaresMatch, match_least_squares
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

MatchVerdict = Literal["good", "flat", "ambiguous", "weak", "border"]


@dataclass(frozen=True)
class MatchSettings:
    """Sizes and thresholds of the matching, with the reasons for their values."""

    half_px: int = 20
    """Half of the patch's side in the coarser picture. 20 (41 px) fixes a place to 0.02 px with usual texture
    and is still nearly plane on a rock. With ``near_px`` a patch is as large as its Gaussian."""
    smallest_half_px: int = 9  # at a picture's border
    most_half_px: int = 90  # in an enlarged picture
    noise_dn: float = 2.0  # one sigma of one picture's grey noise
    flat_sigma_px: float = 0.15
    """A patch whose gradient cannot hold this sigma in its worst direction is flat. Edges fail here too."""
    least_correlation: float = 0.7
    """Of what noise alone allows. Unrelated patches of 41 px reach 0.3-0.5 somewhere in a window."""
    least_lead: float = 0.08  # a second place whose correlation is nearer is ambiguous,
    worst_ratio: float = 0.6  # as one of which (1 - best)/(1 - second) is more
    apart_px: int = 5  # peaks nearer than this are one peak
    worst_sigma_px: float = 0.5  # a position less certain is no measurement
    roughness: float = 0.01
    """How far the target may lie off the patch's plane, one sigma, as a part of the patch's half extent on
    it, where no two cameras saw the relief. It matters as far as the two cameras are apart. 0 for what is
    known to be plane; the default makes sigmas true on the simulated rover's ground and rocks."""
    near_px: float = 0.0
    """By how much nearer pixels count more in the refinement: one sigma of a Gaussian that is round on the
    surface and as large as a circle of this radius in the destination. 0: all of the patch alike."""
    relief: float = 0.0
    """``roughness`` grows by its own size for each such part of the correlation that neither noise nor the
    warp explains: what is no plane correlates worse from elsewhere. 0: it does not grow."""


@dataclass(frozen=True, eq=False)
class PatchMatch:
    """Where the target is in the other picture; places that are not known are not-a-number.

    ``reason`` is one plain sentence, empty for ``good``. ``predicted_px`` (2,) is where geometry alone puts
    the target, ``pixel_px`` (2,) where it was found, with its covariance (2, 2), if the match is good.
    ``correlation`` and ``second`` are those of the best place and of the second best one apart from it,
    -1..1, ``half_px`` half the side of the patch, pixels of the destination; 0 if there was none.
    ``deformation`` (2, 2) is what the warp did not foresee, as a map of offsets from the target.
    """

    verdict: MatchVerdict
    reason: str
    predicted_px: FloatArray = field(default_factory=lambda: np.full(2, np.nan))
    correlation: float = 0.0
    second: float = 0.0
    half_px: int = 0
    pixel_px: FloatArray = field(default_factory=lambda: np.full(2, np.nan))
    covariance_px2: FloatArray = field(default_factory=lambda: np.full((2, 2), np.nan))
    deformation: FloatArray | None = None

    @property
    def sigma_px(self) -> FloatArray:
        """(2,) one sigma of x and y."""
        return np.sqrt(np.diag(self.covariance_px2))


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

    ``plane`` is the scene around the target, in the images' common frame, ``search_px`` half the side of the
    window around the predicted place, destination pixels. Pixels that do not belong to the surface by the
    ``relief`` are left out.
    """
    settings = settings or MatchSettings()
    target = np.asarray(source_px, dtype=np.float64)
    seen, valid = carry(target, source.camera, plane, destination.camera)
    if not bool(valid):
        return PatchMatch("border", "the target cannot be seen by the other camera by its position")
    if not destination.camera.holds(seen, 0.5 - search_px):
        return PatchMatch("border", f"the target is expected at {_at(seen)}, outside the picture", seen)
    cut = _template(source, target, plane, destination.camera, seen, settings, relief)
    if cut is None:
        return PatchMatch("border", f"the patch around {_at(target)} is cut by the picture's border", seen)
    template, near_px2 = cut
    half = int(template.half_px.min())
    lacking = texture_lacks(template.values, settings, template.counts)
    if lacking:
        return PatchMatch("flat", lacking, seen, half_px=half)
    found = _search(template, destination.image, search_px, settings, near_px2)
    if isinstance(found, PatchMatch):
        return found
    refined, best, second = found
    roughness = settings.roughness if relief is None else 0.0
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
        return PatchMatch("border", reason, template.target_px, half_px=int(half.min()))
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
        return PatchMatch("weak", reason, template.target_px, *facts)
    begins, ends = np.array([x, y]) == 0, np.array([x, y]) == np.array(scores.shape[::-1]) - 1
    if begins.any() or ends.any():
        reason = f"the best place is at the border of the window of {reach} px"
        # Where the picture cut the window, the target may be outside; else the window shows something else.
        outside = (begins & (low > window[0])).any() or (ends & (high < window[1])).any()
        return PatchMatch("border" if outside else "weak", reason, template.target_px, *facts)
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
        return PatchMatch("weak", reason, template.target_px, *facts)
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


def judged(
    template: Template,
    refined: LeastSquaresMatch,
    best: float,
    second: float,
    surface_px2: FloatArray,
    settings: MatchSettings,
) -> PatchMatch:
    """Return a refined place with its verdict, from correlation, rival and certainty.

    ``best`` and ``second`` are the correlations there, before it was refined, and at the second best place.
    """
    half, target = int(template.half_px.min()), template.target_px
    facts = (refined.correlation, second, half)
    least = settings.least_correlation * expected_correlation(template.values, settings, template.counts)
    if refined.correlation < least:
        reason = f"the best place correlates by {refined.correlation:.2f}, at least {least:.2f} is expected"
        return PatchMatch("weak", reason, target, *facts)
    # Both as correlated: only the best place has been deformed to fit.
    if rivalled(best, second, settings):
        reason = f"a second place fits nearly as well: {second:.2f} beside {best:.2f}"
        return PatchMatch("ambiguous", reason, target, *facts)
    worst_px = math.sqrt(worst_px2(refined.covariance_px2))
    if worst_px > settings.worst_sigma_px:
        reason = f"the place is certain to {worst_px:.2f} px only, {settings.worst_sigma_px} px is expected"
        return PatchMatch("weak", reason, target, *facts)
    covariance = refined.covariance_px2 + surface_px2
    return PatchMatch("good", "", target, *facts, refined.pixel_px, covariance, refined.deformation)


def rivalled(best: float, second: float, settings: MatchSettings) -> bool:
    """Return whether a second place fits nearly as well as the best."""
    return best - second < settings.least_lead or (1.0 - best) > settings.worst_ratio * (1.0 - second)


def texture_lacks(values: Grey, settings: MatchSettings, counts: FloatArray | None = None) -> str:
    """Return why a patch (h, w) cannot hold a position, empty if it can.

    The worst sigma that noise allows is √2 noise / √λ with λ the smaller eigenvalue of Σ ∇T ∇Tᵀ, less what
    noise itself adds to it; pixels count by ``counts`` (h, w), all alike if not given.
    """
    smooth = cv2.GaussianBlur(values, (0, 0), 1.0)
    inner = smooth.astype(np.float64)
    gx = (inner[1:-1, 2:] - inner[1:-1, :-2]) / 2
    gy = (inner[2:, 1:-1] - inner[:-2, 1:-1]) / 2
    weight = np.ones(gx.shape) if counts is None else counts[1:-1, 1:-1]
    mixed = (weight * gx * gy).sum()
    structure = np.array([[(weight * gx * gx).sum(), mixed], [mixed, (weight * gy * gy).sum()]])
    # White noise after a Gaussian of 1 px and a two-sided difference keeps 0.0313 of its variance.
    smaller, larger = np.linalg.eigvalsh(structure) - 0.0313 * settings.noise_dn**2 * weight.sum()
    worst_px = float(np.sqrt(2.0) * settings.noise_dn / np.sqrt(max(smaller, 1e-9)))
    if worst_px <= settings.flat_sigma_px:
        return ""
    if np.sqrt(2.0) * settings.noise_dn / np.sqrt(max(larger, 1e-9)) <= settings.flat_sigma_px / 2:
        return "the patch has texture along one direction only, like a straight edge"
    return "the patch has too little texture to hold a position"


def expected_correlation(values: Grey, settings: MatchSettings, counts: FloatArray | None = None) -> float:
    """Return what correlation noise alone would leave between two pictures of this patch (h, w).

    Pixels count by ``counts`` (h, w), all alike if not given.
    """
    if counts is None:
        variance = float(values.var())
    else:
        shares = counts / max(float(counts.sum()), 1e-9)
        variance = float((shares * (values - (shares * values).sum()) ** 2).sum())
    return float(np.clip(1.0 - settings.noise_dn**2 / max(variance, 1e-9), 0.3, 1.0))


def worst_px2(covariance_px2: FloatArray) -> float:
    """The variance in the worst direction."""
    return float(np.linalg.eigvalsh(covariance_px2)[-1])
