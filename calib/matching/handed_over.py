"""One hand-off and what came of it: all that is needed to judge it again later, with any mast file.

The geometric pixel is what the mast cameras say, the found one what the destination's picture says. Many of
these show whether the two sets of cameras mean the same rover frame (`calib.matching.handed_over`,
`calib.calibrate.body`).

The constant offset that they leave in each destination camera is the mast's self-check in service. Nothing is
fitted but a mean: what is found less what the source pair predicts, by camera. An offset that stands out says
that the two cameras do not mean the same rover frame (the paper saw 1.5 and 2 px).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime

import numpy as np
from numpy.typing import ArrayLike

from calib.adjust.gross import at_least_stated, chance_limit
from calib.geometry.handoff import Handoff, Joints
from calib.geometry.rigid import FloatArray
from calib.geometry.significance import Level, chance, sigmas
from calib.matching.handoff import RefinedPixel, RefinedVerdict, RefineSettings

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
    """A target handed from a stereo pair to other cameras and looked up in their pictures.

    Attributes
    ----------
    time
        ISO 8601, UTC.
    mast_digest
        Of the mast file that was believed.
    joints, to_joints
        Joint readings of the source's and of the destination's pictures.
    clicks_px, sigma_px
        (2, 2) the target in the pictures of the pair, left one first, and the sigma of each coordinate.
    landed
        By destination camera that was to see it.
    name
        Where it is stored, for messages; empty if nowhere.
    """

    time: str
    mast_digest: str
    pair: tuple[str, str]
    joints: Joints
    clicks_px: FloatArray
    sigma_px: float
    to_joints: Joints
    landed: Mapping[str, Landed]
    name: str = ""

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
    """The mean offset of one camera against the pair that handed over.

    Attributes
    ----------
    handoffs, left_out
        Accepted matches that were averaged, and those too far from the median.
    offset_px, covariance_px2
        (2,) found less predicted, weighted mean, and its (2, 2) covariance.
    chance, sigmas
        Of such a mean without any offset, and the same in sigmas.
    """

    source: str
    camera: str
    handoffs: int
    left_out: int
    offset_px: FloatArray
    covariance_px2: FloatArray
    chance: float
    sigmas: float

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
