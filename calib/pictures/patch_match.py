"""Find the target of one picture in another: warped template, correlation, sub-pixel place, verdict.

The verdict is part of the measurement: only a ``good`` match is one. What the other words say:

- ``flat``: too little texture (or only along one direction) to hold a position;
- ``ambiguous``: a second place fits nearly as well;
- ``weak``: no place fits well enough: hidden, changed, wrong range, or not in the window;
- ``border``: the patch, or the best place, lies at the border of a picture or of the window.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Literal

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from calib.camera.cahvor import CameraModel
from calib.pictures.least_squares_matching import NARROW, LeastSquaresMatch, match_least_squares
from calib.pictures.warp import SIDES, Grey, Plane, Template, blurred_to, carry, warp_patch
from calib.rigid import FloatArray

MOST_ASPECT = 5.0  # of a weight that is round on a surface seen flat
COUNTS_TO = 2.2  # sigmas of that weight, beyond which pixels are left out

MatchVerdict = Literal["good", "flat", "ambiguous", "weak", "border"]


@dataclass(frozen=True)
class MatchSettings:
    """Sizes and thresholds of the matching, with the reasons for their values.

    Attributes
    ----------
    half_px
        Half of the patch's side in the coarser of the two pictures. 20 (41 px) holds 0.02 px with usual
        texture and is still nearly plane on a rock (facts: 41 and 61 px differ by a quarter only). With
        ``near_px`` a match's patch is as large as its Gaussian; this says how far an enlarged one may shrink.
    smallest_half_px
        How far the patch may shrink at the border of a picture.
    most_half_px
        How far it may grow in an enlarged picture.
    noise_dn
        Grey noise of one picture, one sigma; used to tell texture from noise and what correlation to expect.
    flat_sigma_px
        A patch whose gradient cannot hold this sigma in its worst direction is flat. Edges fail here too.
    least_correlation
        Of what noise alone allows. Unrelated patches of 41 px reach 0.3-0.5 somewhere in a window.
    least_lead, worst_ratio
        A second place is ambiguous if its correlation is nearer than ``least_lead``, or if the best leaves
        more than ``worst_ratio`` of what the second leaves unexplained: (1 - best)/(1 - second).
    apart_px
        Peaks nearer than this are one peak.
    worst_sigma_px
        A position less certain than this is no measurement.
    roughness
        How far the target may lie off the patch's plane, one sigma, as a part of the patch's half extent on
        it. It counts as far as the two cameras stand apart. 0 for what is known to be plane; the default
        is what makes sigmas true on the simulated rover's ground and rocks.
    near_px
        By how much nearer pixels count more in the refinement: one sigma of a Gaussian that is round on the
        surface and as large as a circle of this radius in the destination. 0: all of the patch alike.
    relief
        ``roughness`` grows by its own size for each such part of the correlation that neither noise nor the
        warp explains: what is no plane correlates worse from elsewhere. 0: it does not grow.
    """

    half_px: int = 20
    smallest_half_px: int = 9
    most_half_px: int = 90
    noise_dn: float = 2.0
    flat_sigma_px: float = 0.15
    least_correlation: float = 0.7
    least_lead: float = 0.08
    worst_ratio: float = 0.6
    apart_px: int = 5
    worst_sigma_px: float = 0.5
    roughness: float = 0.01
    near_px: float = 0.0
    relief: float = 0.0


@dataclass(frozen=True, eq=False)
class PatchMatch:
    """Where the target is in the other picture.

    Attributes
    ----------
    verdict, reason
        See the module; the reason is one plain sentence, empty for ``good``.
    predicted_px
        (2,) where geometry alone puts the target; not-a-number if it cannot be seen.
    pixel_px, covariance_px2
        (2,) and (2, 2) of the found place; not-a-number unless the verdict is ``good``.
    correlation, second
        Normalised correlation at the best place and at the second best one apart from it, -1..1.
    deformation
        (2, 2) what the warp did not foresee, as a map of offsets from the target.
    half_px
        Half side of the patch that was used, pixels of the destination; 0 if there was none.
    """

    verdict: MatchVerdict
    reason: str
    predicted_px: FloatArray
    pixel_px: FloatArray
    covariance_px2: FloatArray
    correlation: float = 0.0
    second: float = 0.0
    deformation: FloatArray | None = None
    half_px: int = 0

    @property
    def sigma_px(self) -> FloatArray:
        """(2,) one sigma of x and y."""
        return np.sqrt(np.diag(self.covariance_px2))


def no_match(
    verdict: MatchVerdict,
    reason: str,
    predicted_px: FloatArray | None = None,
    correlation: float = 0.0,
    second: float = 0.0,
    half_px: int = 0,
) -> PatchMatch:
    """Return a match that is none."""
    nowhere = np.full(2, np.nan)
    return PatchMatch(
        verdict,
        reason,
        nowhere if predicted_px is None else predicted_px,
        nowhere,
        np.full((2, 2), np.nan),
        correlation,
        second,
        half_px=half_px,
    )


def match_patch(
    source_image: Grey,
    source: CameraModel,
    source_px: ArrayLike,
    plane: Plane,
    destination_image: Grey,
    destination: CameraModel,
    search_px: float,
    settings: MatchSettings | None = None,
) -> PatchMatch:
    """Find the target at ``source_px`` of one picture in another.

    Parameters
    ----------
    source_image, destination_image
        (h, w) float32 grey, 0..255 (`calib.pictures.warp.grey`).
    source, destination
        The cameras at the moments of the pictures, in one common frame.
    source_px
        (2,) the target, sub-pixel.
    plane
        The scene around the target, in the common frame.
    search_px
        Half side of the window around the predicted place, destination pixels.

    Raises
    ------
    ValueError
        If the window has no finite size.
    """
    if not 0.0 <= search_px < math.inf:
        raise ValueError(f"search_px is {search_px} where a finite number, 0 or more, is expected")
    settings = settings or MatchSettings()
    target = np.asarray(source_px, dtype=np.float64)
    seen, valid = carry(target, source, plane, destination)
    if not bool(valid):
        return no_match("border", "the target cannot be seen by the other camera by its position")
    width, height = destination.size_px
    if not (
        -search_px <= seen[0] <= width - 1 + search_px and -search_px <= seen[1] <= height - 1 + search_px
    ):
        return no_match("border", f"the target is expected at {_at(seen)}, outside the picture", seen)
    cut = _template(source_image, source, target, plane, destination, seen, settings)
    if cut is None:
        return no_match("border", f"the patch around {_at(target)} is cut by the picture's border", seen)
    template, near_px2 = cut
    half = min(template.values.shape) // 2
    lacking = texture_lacks(template.values, settings)
    if lacking:
        return no_match("flat", lacking, seen, half_px=half)
    found = _search(template, destination_image, search_px, settings, near_px2)
    if isinstance(found, PatchMatch):
        return found
    roughness = settings.roughness
    if settings.relief > 0:
        explained = found.refined.correlation / expected_correlation(template.values, settings)
        roughness *= 1.0 + max(0.0, 1.0 - explained) / settings.relief
    surface = _surface_term(source, target, plane, destination, template, near_px2, roughness)
    middle = found.refined.middle
    if middle is not None:
        # The middle is noisier, but the target is nearer to its plane.
        nearer = NARROW**2 * surface
        if _worst(middle.covariance_px2 + nearer) < _worst(found.refined.covariance_px2 + surface):
            found, surface = (
                replace(found, refined=replace(middle, correlation=found.refined.correlation)),
                nearer,
            )
    return judged(template, found, surface, settings)


def _worst(covariance_px2: FloatArray) -> float:
    """The variance in the worst direction."""
    return float(np.linalg.eigvalsh(covariance_px2)[-1])


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


def expected_correlation(values: Grey, settings: MatchSettings) -> float:
    """Return what correlation noise alone would leave between two pictures of this patch."""
    variance = float(values.var())
    return float(np.clip(1.0 - settings.noise_dn**2 / max(variance, 1e-9), 0.3, 1.0))


def peaks(
    scores: NDArray[np.float32], apart_px: int
) -> tuple[tuple[int, int], float, float, tuple[int, int] | None]:
    """Return the best place (x, y) of a score surface, its score, the second peak's score and place.

    A second peak is a local maximum more than ``apart_px`` from the best; -1 and None if there is none.
    """
    scores = np.where(np.isfinite(scores), scores, np.float32(-1.0))
    y, x = (int(v) for v in np.unravel_index(int(np.argmax(scores)), scores.shape))
    local = (scores >= cv2.dilate(scores, np.ones((3, 3), np.uint8))) & (scores < 2.0)
    local[max(0, y - apart_px) : y + apart_px + 1, max(0, x - apart_px) : x + apart_px + 1] = False
    others = np.where(local, scores, np.float32(-1.0))
    v, u = (int(w) for w in np.unravel_index(int(np.argmax(others)), others.shape))
    second = float(others[v, u])
    return (x, y), float(scores[y, x]), second, (u, v) if second > -1.0 else None


def rivalled(best: float, second: float, settings: MatchSettings) -> bool:
    """Tell whether a second place fits nearly as well as the best."""
    return best - second < settings.least_lead or (1.0 - best) > settings.worst_ratio * (1.0 - second)


@dataclass(frozen=True, eq=False)
class PatchFound:
    """A refined place, and what the unrefined correlation says there and at the second best place."""

    refined: LeastSquaresMatch
    best: float
    second: float


def judged(
    template: Template, found: PatchFound, surface_px2: FloatArray, settings: MatchSettings
) -> PatchMatch:
    """Return the match with its verdict, from correlation, rival and certainty."""
    refined, half = found.refined, min(template.values.shape) // 2
    facts = (refined.correlation, found.second, half)
    least = settings.least_correlation * expected_correlation(template.values, settings)
    if refined.correlation < least:
        words = f"the best place correlates by {refined.correlation:.2f}, at least {least:.2f} is expected"
        return no_match("weak", words, template.target_px, *facts)
    # Both as correlated: only the best place has been deformed to fit.
    if rivalled(found.best, found.second, settings):
        words = f"a second place fits nearly as well: {found.second:.2f} beside {found.best:.2f}"
        return no_match("ambiguous", words, template.target_px, *facts)
    worst_px = math.sqrt(_worst(refined.covariance_px2))
    if worst_px > settings.worst_sigma_px:
        words = f"the place is certain to {worst_px:.2f} px only, {settings.worst_sigma_px} px is expected"
        return no_match("weak", words, template.target_px, *facts)
    return PatchMatch(
        "good",
        "",
        template.target_px,
        refined.pixel_px,
        refined.covariance_px2 + surface_px2,
        refined.correlation,
        found.second,
        refined.deformation,
        half,
    )


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

    The patch tells where its plane is; the target itself lies off it by ``roughness`` of the patch's half
    extent on the plane, hence 1 / sine of the viewing angle as much along the source's ray.
    """
    ray, half = source.ray(target), np.array(template.values.shape[::-1]) // 2
    if near_px2 is not None:
        half = np.sqrt(3.0 * np.diag(near_px2))  # a box of this half side spreads as much
    sides = template.target_px + half * SIDES
    rays = destination.ray(sides)
    with np.errstate(invalid="ignore", divide="ignore"):
        ranges = ((plane.point_m - rays.origins_m) @ plane.normal) / (rays.directions @ plane.normal)
        slope = float(ray.directions @ plane.normal)
        range_m = float((plane.point_m - ray.origins_m) @ plane.normal) / slope
    here = ray.origins_m + range_m * ray.directions
    reach_m = float(np.linalg.norm(rays.origins_m + ranges[:, None] * rays.directions - here, axis=1).max())
    off_m = min(roughness * reach_m / abs(slope), 0.2 * range_m)
    places, valid = destination.project(np.array([here, here + off_m * ray.directions]))
    if not (np.isfinite(off_m) and valid.all()):
        return np.zeros((2, 2))
    parallax = places[1] - places[0]
    return np.outer(parallax, parallax)


def _template(
    image: Grey,
    source: CameraModel,
    target: FloatArray,
    plane: Plane,
    destination: CameraModel,
    seen: FloatArray,
    settings: MatchSettings,
) -> tuple[Template, FloatArray | None] | None:
    """Warp the largest patch that both pictures hold, sized by the coarser of the two; with its weight."""
    around, ok = carry(seen + SIDES, destination, plane, source)
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
        template = warp_patch(image, source, target, plane, destination, (int(half[0]), int(half[1])))
        if template is not None:
            return template, near_px2
        if (half == least).all():
            return None
        half = np.maximum(half - 3, least)


def near_covariance(plane: Plane, camera: CameraModel, pixel: FloatArray, near_px: float) -> FloatArray:
    """Return the covariance (2, 2) px² of a Gaussian that is round on the plane, of the area of a circle."""
    ray = camera.ray(pixel)
    range_m = float((plane.point_m - ray.origins_m) @ plane.normal) / float(ray.directions @ plane.normal)
    _, rate, _ = camera.project_jacobian(ray.origins_m + range_m * ray.directions)
    seen = rate @ plane.axes
    values, vectors = np.linalg.eigh(seen @ seen.T)
    aspect = min(float(np.sqrt(values[1] / max(values[0], 1e-12 * values[1]))), MOST_ASPECT)
    return np.asarray((vectors * np.array([near_px**2 / aspect, near_px**2 * aspect])) @ vectors.T)


def near_half_px(near_px2: FloatArray) -> NDArray[np.intp]:
    """Return the half sides (x, y) of the patch that such a Gaussian weighs."""
    return np.asarray(np.ceil(COUNTS_TO * np.sqrt(np.diag(near_px2))).astype(np.intp) + 2)


def _search(
    template: Template, image: Grey, search_px: float, settings: MatchSettings, near_px2: FloatArray | None
) -> PatchFound | PatchMatch:
    """Correlate over the window, then refine at the best place."""
    half, reach = np.array(template.values.shape[::-1]) // 2, int(np.ceil(search_px))
    window = template.centre_px - reach - half, template.centre_px + reach + half
    low, high = np.maximum(window[0], 0), np.minimum(window[1], np.array(image.shape[::-1]) - 1)
    if (high - low < 2 * half + 4).any():
        words = f"the target is expected at {_at(template.target_px)}, too near the picture's border"
        return no_match("border", words, template.target_px, half_px=int(half.min()))
    margin = int(np.ceil(4 * max(template.magnification, 1.0))) + 16
    cut_low = np.maximum(low - margin, 0)
    cut = image[cut_low[1] : high[1] + 1 + margin, cut_low[0] : high[0] + 1 + margin]
    cut = np.ascontiguousarray(blurred_to(cut, template.magnification))
    inner = low - cut_low
    searched = cut[inner[1] : inner[1] + high[1] - low[1] + 1, inner[0] : inner[0] + high[0] - low[0] + 1]
    scores = cv2.matchTemplate(searched, template.values, cv2.TM_CCOEFF_NORMED).astype(np.float32)
    (x, y), best, second, _ = peaks(
        scores, max(settings.apart_px, round(settings.apart_px * template.magnification))
    )
    facts = (best, second, int(half.min()))
    least = 0.8 * settings.least_correlation * expected_correlation(template.values, settings)
    if best < least:
        words = f"no place in the window of {reach} px correlates by more than {best:.2f}"
        return no_match("weak", words, template.target_px, *facts)
    best_at = np.array([x, y])
    begins, ends = best_at == 0, best_at == np.array(scores.shape[::-1]) - 1
    if begins.any() or ends.any():
        words = f"the best place is at the border of the window of {reach} px"
        # Where the picture cut the window, the target may be outside; else the window shows something else.
        outside = (begins & (low > window[0])).any() or (ends & (high < window[1])).any()
        return no_match("border" if outside else "weak", words, template.target_px, *facts)
    shift = low + half + np.array([x, y]) + _summit(scores, x, y) - template.centre_px
    start = template.target_px + shift - cut_low
    refined = match_least_squares(
        template.values,
        template.centre_px - cut_low,
        template.target_px - cut_low,
        cut,
        start,
        correlated_px=correlated_px(template.magnification),
        near_px2=near_px2,
    )
    if refined is None or float(np.abs(refined.pixel_px - start).max()) > 2.0 * max(
        1.0, template.magnification
    ):
        words = f"the best place (correlation {best:.2f}) does not settle to a sub-pixel position"
        return no_match("weak", words, template.target_px, *facts)
    middle = refined.middle and replace(refined.middle, pixel_px=refined.middle.pixel_px + cut_low)
    return PatchFound(replace(refined, pixel_px=refined.pixel_px + cut_low, middle=middle), best, second)


def _summit(scores: NDArray[np.float32], x: int, y: int) -> FloatArray:
    """Return how far (2,) the summit of a score surface lies from its highest pixel, by parabolas."""
    around = np.array([scores[y, x - 1 : x + 2], scores[y - 1 : y + 2, x]], dtype=np.float64)
    bend = 2.0 * around[:, 1] - around[:, 0] - around[:, 2]
    return np.asarray(np.clip((around[:, 2] - around[:, 0]) / (2.0 * np.maximum(bend, 1e-9)), -0.5, 0.5))


def correlated_px(magnification: float) -> int:
    """Return over how many pixels grey differences hang together: three, more in an enlarged picture."""
    return round(3 * max(1.0, magnification))


def _at(pixel_px: FloatArray) -> str:
    """Write a pixel."""
    return f"({pixel_px[0]:.1f}, {pixel_px[1]:.1f}) px"
