"""Hand-off refined by image: the geometric hand-off's pixels, searched in the destination's pictures.

The source pair gives the surface around the target (`calib.matching.partner`); the source patch is warped
over it into each destination camera and correlated inside the ellipse that the geometric hand-off leaves
(`calib.matching.patch`). What is found there is accepted only if it is the one thing that fits, and if the
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
from calib.matching.verdict import worst_px2
from calib.matching.warp import Plane, PosedImage

RefinedVerdict = Literal["accepted", "ambiguous", "flat", "occluded", "unseen"]

_VERDICTS: Mapping[str, RefinedVerdict] = {
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
    sigmas, least_px, most_px
        Half axes of the search ellipse in standard deviations, and bounds of the window's half side; below,
        the ellipse would be smaller than what the warp can be wrong by.
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
) -> dict[str, RefinedPixel]:
    """Search a handed-over target in the destination's pictures, by camera as in ``handoff.pixels``.

    ``source`` are the pictures of the pair that sees the target, left one first, ``clicks_px`` (2, 2) the
    target in both; ``destinations`` all those pictures that should show it.
    """
    settings = settings or RefineSettings()
    clicks = np.asarray(clicks_px, dtype=np.float64)
    surface = _surface(source, clicks, settings)
    refined: dict[str, RefinedPixel] = {}
    for name, image in destinations.items():
        predicted = handoff.pixels.get(name)
        if predicted is None:
            refined[name] = _none("unseen", handoff.reasons.get(name, "the hand-off has no such camera"))
        elif isinstance(surface, Plane):
            refined[name] = _searched(source[0], clicks[0], surface, image, predicted, settings)
        else:
            refined[name] = surface
    accepted = {name: one for name, one in refined.items() if one.verdict == "accepted"}
    against = _not_confirmed(refined, accepted, handoff, settings) if accepted else ""
    if not against:
        return refined
    taken_back = _none("occluded", against)
    return refined | {
        name: replace(taken_back, off_px=one.off_px, correlation=one.correlation, second=one.second)
        for name, one in accepted.items()
    }


def _surface(
    source: tuple[PosedImage, PosedImage], clicks_px: FloatArray, settings: RefineSettings
) -> Plane | RefinedPixel:
    """The surface around the target from the source pair, or why there is none."""
    left, right = source
    found = find_partner(left, clicks_px[0], right)
    if found.match.verdict != "good" or found.plane is None:
        return _none(_VERDICTS[found.match.verdict], f"in the source pair: {found.match.reason}")
    apart_px = float(np.linalg.norm(found.match.pixel_px - clicks_px[1]))
    worst = settings.click_px + 4.0 * math.sqrt(worst_px2(found.match.covariance_px2))
    if apart_px > worst:
        return _none(
            "ambiguous",
            f"in the source pair: the right camera's pixel lies {apart_px:.1f} px from where "
            f"the pictures put the left camera's target, at most {worst:.1f} px is expected",
        )
    return found.plane


def _searched(
    source: PosedImage,
    pixel_px: FloatArray,
    surface: Plane,
    image: PosedImage,
    predicted: PredictedPixel,
    settings: RefineSettings,
) -> RefinedPixel:
    """Search one destination picture."""
    search = settings.sigmas * math.sqrt(worst_px2(predicted.search_px2))
    search = min(max(search, settings.least_px), settings.most_px)
    found = match_patch(source, pixel_px, surface, image, search)
    scores = (found.correlation, found.second)
    # Whether the patch fits into the picture wherever in the window the target is.
    if not image.camera.holds(found.predicted_px, search + found.half_px + 0.5):
        edge = f"part of the {search:.0f} px around the hand-off's pixel where it may be lies at the border"
        reason = found.reason if found.verdict == "border" else f"{edge} of the picture"
        return _none("unseen", reason, *scores)
    if found.verdict == "border":
        # All of the window could be searched: what it shows best is not the target.
        return _none("occluded", found.reason, *scores)
    if found.verdict != "good":
        return _none(_VERDICTS[found.verdict], found.reason, *scores)
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


def _not_confirmed(
    refined: Mapping[str, RefinedPixel],
    accepted: Mapping[str, RefinedPixel],
    handoff: Handoff,
    settings: RefineSettings,
) -> str:
    """Return why the other destination cameras, or the source's range, do not confirm what was found."""
    for name, one in refined.items():
        if one.verdict in ("ambiguous", "occluded", "flat"):
            return f"{name} does not confirm it: {one.reason}"
    # What the cameras share (a range or a calibration that is off) may move them together as far as that is
    # uncertain; against each other they may be wrong only by what each alone can.
    order = [name for name, predicted in handoff.pixels.items() if predicted is not None]
    rows = np.concatenate([2 * order.index(name) + np.arange(2) for name in accepted])
    allowed = handoff.joint_px2[np.ix_(rows, rows)] + settings.model_px**2 * np.eye(len(rows))
    for index, one in enumerate(accepted.values()):
        part = slice(2 * index, 2 * index + 2)
        allowed[part, part] += one.covariance_px2
    off = np.concatenate([one.off_px for one in accepted.values()])
    chi2 = float(off @ np.linalg.solve(allowed, off))
    if chi2 <= settings.worst_chi2:
        return ""
    return (
        f"{' and '.join(accepted)} and the source pair do not mean one point: weighted misfit "
        f"{chi2:.0f}, at most {settings.worst_chi2:g} is expected"
    )


def _none(
    verdict: RefinedVerdict, reason: str, correlation: float = 0.0, second: float = 0.0
) -> RefinedPixel:
    nowhere = np.full(2, np.nan)
    return RefinedPixel(verdict, reason, nowhere, np.full((2, 2), np.nan), nowhere, correlation, second)
