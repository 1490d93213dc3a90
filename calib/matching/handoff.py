"""Hand-off refined by image: the geometric hand-off's pixels, searched in the destination's pictures.

The source pair gives the surface around the target (`calib.matching.partner`); the source patch is warped
over it into each destination camera and correlated inside the ellipse that the geometric hand-off leaves
(`calib.matching.patch`). What is found there is accepted only if it is the one thing that fits, and if the
destination's two cameras and the source's range mean the same point.

A record of one hand-off and what came of it (`MatchedHandoff`) has all that is needed to judge it again
later, with any mast file. Many of these show whether the two sets of cameras mean the same rover frame
(`calib.calibrate.body`). The constant offset that they leave in each destination camera is the mast's
self-check in service: nothing is fitted but a mean of what is found less what the source pair predicts. One
that stands out says that the two cameras do not mean the same rover frame (the paper saw 1.5 and 2 px).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from calib.adjust.gross import at_least_stated, chance_limit
from calib.geometry.handoff import Handoff, Joints, PredictedPixel
from calib.geometry.rigid import FloatArray
from calib.geometry.significance import Level, chance, sigmas
from calib.matching.partner import find_partner
from calib.matching.patch import match_patch, worst_px2
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
    """Thresholds of the refinement, with the reasons for their values."""

    sigmas: float = 3.0  # half axes of the search ellipse in standard deviations
    least_px: float = (
        3.0  # of the window's half side: below, it would be smaller than what the warp is wrong by
    )
    most_px: float = 60.0
    model_px: float = 0.4
    """One sigma of what camera models are wrong by, for comparing what cameras see. Flight cameras: 0.2 to
    0.5."""
    click_px: float = 2.0
    """How far the second click may lie from where the pair's pictures put the first, beyond four sigma."""
    worst_chi2: float = 18.5  # of four degrees of freedom: 1 in 1000 good pairs is above


@dataclass(frozen=True, eq=False)
class RefinedPixel:
    """Where a destination camera sees the target (2,), by its picture; not-a-number unless ``accepted``.

    Only that is a measurement; the reason is one sentence, empty for ``accepted``. ``off_px`` (2,) goes from
    the geometric hand-off's pixel to the found one.
    """

    verdict: RefinedVerdict
    reason: str
    pixel_px: FloatArray = field(default_factory=lambda: np.full(2, np.nan))
    covariance_px2: FloatArray = field(default_factory=lambda: np.full((2, 2), np.nan))
    off_px: FloatArray = field(default_factory=lambda: np.full(2, np.nan))
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
            refined[name] = RefinedPixel(
                "unseen", handoff.reasons.get(name, "the hand-off has no such camera")
            )
        elif isinstance(surface, Plane):
            refined[name] = _searched(source[0], clicks[0], surface, image, predicted, settings)
        else:
            refined[name] = surface
    accepted = {name: one for name, one in refined.items() if one.verdict == "accepted"}
    against = _not_confirmed(refined, accepted, handoff, settings) if accepted else ""
    if not against:
        return refined
    taken_back = RefinedPixel("occluded", against)
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
        return RefinedPixel(_VERDICTS[found.match.verdict], f"in the source pair: {found.match.reason}")
    apart_px = float(np.linalg.norm(found.match.pixel_px - clicks_px[1]))
    worst = settings.click_px + 4.0 * math.sqrt(worst_px2(found.match.covariance_px2))
    if apart_px > worst:
        return RefinedPixel(
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

    def refused(verdict: RefinedVerdict, reason: str) -> RefinedPixel:
        return RefinedPixel(verdict, reason, correlation=found.correlation, second=found.second)

    # Whether the patch fits into the picture wherever in the window the target is.
    if not image.camera.holds(found.predicted_px, search + found.half_px + 0.5):
        edge = f"part of the {search:.0f} px around the hand-off's pixel where it may be lies at the border"
        reason = found.reason if found.verdict == "border" else f"{edge} of the picture"
        return refused("unseen", reason)
    if found.verdict == "border":
        # All of the window could be searched: what it shows best is not the target.
        return refused("occluded", found.reason)
    if found.verdict != "good":
        return refused(_VERDICTS[found.verdict], found.reason)
    off = found.pixel_px - predicted.pixel_px
    allowed = predicted.search_px2 + found.covariance_px2 + settings.model_px**2 * np.eye(2)
    distance = math.sqrt(float(off @ np.linalg.solve(allowed, off)))
    if distance > settings.sigmas + 1.0:
        return refused(
            "occluded",
            f"the best match lies {np.linalg.norm(off):.1f} px from the geometric hand-off, {distance:.1f} "
            "of its standard deviations: something else, or a wrong calibration",
        )
    return RefinedPixel(
        "accepted", "", found.pixel_px, found.covariance_px2, off, found.correlation, found.second
    )


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


MODEL_PX = RefineSettings().model_px
"""One sigma, each axis, of what a match is wrong by beyond its own covariance: relief, camera models."""


@dataclass(frozen=True, eq=False)
class Landed:
    """Where one destination camera was to see the target, and where its picture shows it.

    ``geometric_px`` (2,) with the covariance (2, 2) of the clicks alone; ``found_px`` with its own, None
    unless the match is ``accepted``.
    """

    geometric_px: FloatArray
    geometric_covariance_px2: FloatArray
    verdict: RefinedVerdict
    reason: str = ""
    found_px: FloatArray | None = None
    found_covariance_px2: FloatArray | None = None


@dataclass(frozen=True, eq=False)
class MatchedHandoff:
    """A target handed from a stereo pair to other cameras and found in their pictures.

    ``joints`` and ``to_joints`` are the readings of the source's and of the destination's pictures,
    ``clicks_px`` (2, 2) the target in the pictures of the pair, left one first, ``sigma_px`` that of each
    coordinate.
    """

    time: str  # ISO 8601, UTC
    mast_digest: str  # of the mast file that was believed
    pair: tuple[str, str]
    joints: Joints
    clicks_px: FloatArray
    sigma_px: float
    to_joints: Joints
    landed: Mapping[str, Landed]  # by destination camera that was to see it
    name: str = ""  # where it is stored, for messages; empty if nowhere

    @property
    def found(self) -> dict[str, Landed]:
        """Those destination cameras whose match was accepted."""
        return {name: one for name, one in self.landed.items() if one.verdict == "accepted"}


def matched_handoff(
    mast_digest: str,
    pair: tuple[str, str],
    joints: Joints,
    clicks_px: ArrayLike,
    sigma_px: float,
    to_joints: Joints,
    handoff: Handoff,
    refined: Mapping[str, RefinedPixel],
    time: datetime | None = None,
) -> MatchedHandoff:
    """Return the record of a geometric hand-off, with what it was made of, and its refinement.

    Destination cameras that do not see the target, or were not searched, are left out.
    """
    landed = {}
    for name, predicted in handoff.pixels.items():
        if predicted is None or name not in refined:
            continue
        one = refined[name]
        good = one.verdict == "accepted"
        landed[name] = Landed(
            predicted.pixel_px,
            predicted.covariance_px2,
            one.verdict,
            one.reason,
            one.pixel_px if good else None,
            one.covariance_px2 if good else None,
        )
    when = (time or datetime.now(UTC)).astimezone(UTC).isoformat(timespec="milliseconds")
    clicks = np.array(clicks_px, dtype=np.float64)
    return MatchedHandoff(when, mast_digest, pair, joints, clicks, sigma_px, to_joints, landed)


@dataclass(frozen=True, eq=False)
class HandoffBias:
    """The mean offset of one camera against the pair that handed over: found less predicted (2,),
    weighted."""

    source: str
    camera: str
    handoffs: int  # accepted matches that were averaged
    left_out: int  # and those too far from the median
    offset_px: FloatArray
    covariance_px2: FloatArray
    chance: float  # of such a mean without any offset
    sigmas: float  # the same

    @property
    def significant(self) -> bool:
        """Whether chance alone does so less often than three sigma."""
        return self.chance < Level.THREE_SIGMAS

    @property
    def sentence(self) -> str:
        """The offset as a sentence."""
        sigma = np.sqrt(np.diag(self.covariance_px2))
        x, y = (
            f"{abs(off):.2f} +- {s:.2f} px {sides[int(off < 0)]}"
            for off, s, sides in zip(
                self.offset_px, sigma, (("right", "left"), ("lower", "higher")), strict=True
            )
        )
        return (
            f"{self.camera} sees targets {x} and {y} of where {self.source} puts them "
            f"({self.sigmas:.1f} sigma, {self.handoffs} hand-offs)"
        )


def handoff_bias(handoffs: Sequence[MatchedHandoff]) -> tuple[HandoffBias, ...]:
    """Return the mean offset of each camera with two or more accepted matches of one mast file."""
    groups: dict[tuple[str, str], list[tuple[FloatArray, FloatArray]]] = {}
    for one in handoffs:
        source = one.pair[0].rpartition("_")[0]
        for camera, landed in one.found.items():
            assert landed.found_px is not None and landed.found_covariance_px2 is not None
            covariance = landed.geometric_covariance_px2 + landed.found_covariance_px2
            groups.setdefault((source, camera), []).append(
                (landed.found_px - landed.geometric_px, covariance + MODEL_PX**2 * np.eye(2))
            )
    return tuple(
        _mean(source, camera, np.array([o for o, _ in seen]), np.array([c for _, c in seen]))
        for (source, camera), seen in groups.items()
        if len(seen) > 1
    )


def _mean(source: str, camera: str, off_px: FloatArray, covariance_px2: FloatArray) -> HandoffBias:
    weights = np.linalg.inv(covariance_px2)
    apart = off_px - np.median(off_px, axis=0)
    statistics = np.einsum("ni,nij,nj->n", apart, weights, apart)
    keep = statistics <= at_least_stated(statistics) * chance_limit(Level.MEASUREMENT, len(off_px))
    information = weights[keep].sum(axis=0)
    mean = np.linalg.solve(information, np.einsum("nij,nj->i", weights[keep], off_px[keep]))
    rest = off_px[keep] - mean
    freedom = 2.0 * int(keep.sum()) - 2.0  # the better half is always kept, of two offsets both
    chi2 = float(np.einsum("ni,nij,nj->", rest, weights[keep], rest))
    scale = max(1.0, chi2 / freedom)
    probability = chance(float(mean @ information @ mean), 2, scale, freedom)
    return HandoffBias(
        source,
        camera,
        int(keep.sum()),
        int(np.sum(~keep)),
        mean,
        np.linalg.inv(information) * scale,
        probability,
        sigmas(probability),
    )
