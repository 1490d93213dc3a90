"""Hand-off refined by image: the geometric hand-off's pixels, looked up in the destination's pictures.

The source pair gives the surface around the target (`calib.matching.partner`); the source patch is warped
over it into each destination camera and correlated inside the ellipse that the geometric hand-off leaves
(`calib.matching.patch`). What is found there counts only if it is the one thing that fits, and if the
destination's two cameras and the source's range mean the same point.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from calib.geometry.handoff import Handoff, PredictedPixel
from calib.geometry.rigid import FloatArray
from calib.matching.partner import find_partner
from calib.matching.patch import match_patch
from calib.matching.verdict import MatchSettings, PatchMatch
from calib.matching.warp import Plane, PosedImage

RefinedVerdict = Literal["accepted", "ambiguous", "flat", "occluded", "unseen"]

_WORDS: Mapping[str, RefinedVerdict] = {
    "good": "accepted",
    "ambiguous": "ambiguous",
    "flat": "flat",
    "weak": "occluded",
    "border": "unseen",
}


@dataclass(frozen=True)
class RefineSettings:
    """Thresholds of the refinement, with the reasons for their values.

    Attributes
    ----------
    sigmas
        Half axes of the search ellipse in standard deviations.
    least_px, most_px
        Bounds of the search window's half side; below, the ellipse would be smaller than what the warp can
        be wrong by.
    model_px
        One sigma of what camera models are wrong by, for comparing what cameras see. Flight cameras: 0.2 to
        0.5.
    click_px
        How far the second click may lie from where the pair's pictures put the first, beyond four sigma.
    worst_chi2
        Of four degrees of freedom: 1 in 1000 good pairs is above 18.5.
    """

    sigmas: float = 3.0
    least_px: float = 3.0
    most_px: float = 60.0
    model_px: float = 0.4
    click_px: float = 2.0
    worst_chi2: float = 18.5


@dataclass(frozen=True, eq=False)
class RefinedPixel:
    """Where a destination camera sees the target, by its picture.

    Attributes
    ----------
    verdict, reason
        Only ``accepted`` is a measurement; the reason is one sentence, empty for ``accepted``.
    pixel_px, covariance_px2
        (2,) and (2, 2); not-a-number unless accepted.
    off_px
        (2,) from the geometric hand-off's pixel to the found one.
    correlation, second
        At the best place and at the second best.
    """

    verdict: RefinedVerdict
    reason: str
    pixel_px: FloatArray
    covariance_px2: FloatArray
    off_px: FloatArray
    correlation: float = 0.0
    second: float = 0.0


def refine_handoff(
    handoff: Handoff,
    source: tuple[PosedImage, PosedImage],
    clicks_px: FloatArray,
    destinations: Mapping[str, PosedImage],
    settings: RefineSettings | None = None,
    match_settings: MatchSettings | None = None,
) -> dict[str, RefinedPixel]:
    """Look a handed-over target up in the destination's pictures.

    Parameters
    ----------
    handoff
        The geometric hand-off of the same target.
    source
        Left and right camera of the pair that sees the target.
    clicks_px
        (2, 2) the target in both.
    destinations
        By name as in ``handoff.pixels``; all those there that see the target.

    Returns
    -------
    refined
        By destination camera.
    """
    settings = settings or RefineSettings()
    sizes = match_settings or MatchSettings()
    surface = _surface(source, np.asarray(clicks_px, dtype=np.float64), sizes, settings)
    refined: dict[str, RefinedPixel] = {}
    for name, eye in destinations.items():
        predicted = handoff.pixels.get(name)
        if predicted is None:
            refined[name] = _none("unseen", handoff.reasons.get(name, "the hand-off has no such camera"))
        elif not isinstance(surface, Plane):
            refined[name] = surface
        else:
            refined[name] = _looked_up(source[0], clicks_px[0], surface, eye, predicted, settings, sizes)
    return _agreeing(refined, handoff, settings)


def _surface(
    source: tuple[PosedImage, PosedImage],
    clicks_px: FloatArray,
    sizes: MatchSettings,
    settings: RefineSettings,
) -> Plane | RefinedPixel:
    """The surface around the target from the source pair, or why there is none."""
    left, right = source
    found = find_partner(left, clicks_px[0], right, settings=sizes)
    if found.match.verdict != "good" or found.plane is None:
        return _none(_WORDS[found.match.verdict], f"in the source pair: {found.match.reason}")
    apart = found.match.pixel_px - clicks_px[1]
    worst = settings.click_px + 4.0 * math.sqrt(float(np.linalg.eigvalsh(found.match.covariance_px2)[-1]))
    if np.linalg.norm(apart) > worst:
        return _none(
            "ambiguous",
            f"in the source pair: the right camera's pixel lies {np.linalg.norm(apart):.1f} px from where "
            f"the pictures put the left camera's target, at most {worst:.1f} px is expected",
        )
    return found.plane


def _looked_up(
    source: PosedImage,
    pixel_px: FloatArray,
    surface: Plane,
    eye: PosedImage,
    predicted: PredictedPixel,
    settings: RefineSettings,
    sizes: MatchSettings,
) -> RefinedPixel:
    """Search one destination picture."""
    search = settings.sigmas * math.sqrt(float(np.linalg.eigvalsh(predicted.search_px2)[-1]))
    search = min(max(search, settings.least_px), settings.most_px)
    found: PatchMatch = match_patch(source, pixel_px, surface, eye, search, sizes)
    scores = (found.correlation, found.second)
    if not _whole_window(found, eye, search):
        edge = f"part of the {search:.0f} px around the hand-off's pixel where it may be lies at the border"
        words = found.reason if found.verdict == "border" else f"{edge} of the picture"
        return _none("unseen", words, *scores)
    if found.verdict == "border":
        # All of the window could be searched: what it holds best is not the target.
        return _none("occluded", found.reason, *scores)
    if found.verdict != "good":
        return _none(_WORDS[found.verdict], found.reason, *scores)
    off = found.pixel_px - predicted.pixel_px
    allowed = predicted.search_px2 + found.covariance_px2 + settings.model_px**2 * np.eye(2)
    distance = math.sqrt(float(off @ np.linalg.solve(allowed, off)))
    if distance > settings.sigmas + 1.0:
        return _none(
            "occluded",
            f"the best match lies {np.linalg.norm(off):.1f} px from the geometric hand-off, {distance:.1f} "
            "of its standard deviations: something else, or a wrong calibration",
            *scores,
        )
    return RefinedPixel("accepted", "", found.pixel_px, found.covariance_px2, off, *scores)


def _whole_window(found: PatchMatch, eye: PosedImage, search_px: float) -> bool:
    """Return whether the patch fits into the picture wherever in the window the target is."""
    reach = search_px + found.half_px
    size = np.array(eye.camera.size_px)
    return bool((found.predicted_px >= reach).all() and (found.predicted_px <= size - 1 - reach).all())


def _agreeing(
    refined: dict[str, RefinedPixel],
    handoff: Handoff,
    settings: RefineSettings,
) -> dict[str, RefinedPixel]:
    """Take back what the other destination cameras, or the source's range, do not confirm."""
    accepted = {name: one for name, one in refined.items() if one.verdict == "accepted"}
    doubting = [name for name, one in refined.items() if one.verdict in ("ambiguous", "occluded", "flat")]
    if not accepted:
        return refined
    if doubting:
        words = f"{doubting[0]} does not confirm it: {refined[doubting[0]].reason}"
        return {**refined, **{name: _taken_back(one, words) for name, one in accepted.items()}}
    chi2 = _misfit(accepted, handoff, settings)
    if chi2 > settings.worst_chi2:
        words = (
            f"{' and '.join(accepted)} and the source pair do not mean one point: weighted misfit "
            f"{chi2:.0f}, at most {settings.worst_chi2:g} is expected"
        )
        return {**refined, **{name: _taken_back(one, words) for name, one in accepted.items()}}
    return refined


def _misfit(accepted: Mapping[str, RefinedPixel], handoff: Handoff, settings: RefineSettings) -> float:
    """Weighted square of how far the found pixels lie from the hand-off's, all together.

    What the cameras share (a range or a calibration that is off) may move them together as far as that is
    uncertain; against each other they may be wrong only by what each alone can.
    """
    order = [name for name, predicted in handoff.pixels.items() if predicted is not None]
    rows = np.concatenate([2 * order.index(name) + np.arange(2) for name in accepted])
    allowed = handoff.joint_px2[np.ix_(rows, rows)] + settings.model_px**2 * np.eye(len(rows))
    for index, one in enumerate(accepted.values()):
        part = slice(2 * index, 2 * index + 2)
        allowed[part, part] += one.covariance_px2
    off = np.concatenate([one.off_px for one in accepted.values()])
    return float(off @ np.linalg.solve(allowed, off))


def _taken_back(one: RefinedPixel, words: str) -> RefinedPixel:
    nothing = _none("occluded", words)
    return replace(nothing, off_px=one.off_px, correlation=one.correlation, second=one.second)


def _none(
    verdict: RefinedVerdict, reason: str, correlation: float = 0.0, second: float = 0.0
) -> RefinedPixel:
    nowhere = np.full(2, np.nan)
    return RefinedPixel(verdict, reason, nowhere, np.full((2, 2), np.nan), nowhere, correlation, second)
