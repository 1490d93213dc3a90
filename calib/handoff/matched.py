"""One hand-off and what came of it: all that is needed to judge it again later, with any mast file.

The geometric pixel is what the mast cameras say, the found one what the destination's picture says. Many of
these tell whether the two sets of cameras mean the same rover frame (`calib.handoff.bias`,
`calib.handoff.fit_body_pose`).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from datetime import UTC, datetime

import numpy as np
from numpy.typing import ArrayLike

from calib.handoff.by_image import RefinedPixel, RefinedVerdict, RefineSettings
from calib.handoff.geometric import Handoff, Joints
from calib.rigid import FloatArray

MODEL_PX = RefineSettings().model_px
"""One sigma, each axis, of what a match is wrong by beyond its own covariance: relief, camera models."""


@dataclass(frozen=True, eq=False)
class Landed:
    """Where one destination camera was to see the target, and where its picture shows it.

    Attributes
    ----------
    geometric_px, geometric_covariance_px2
        (2,) and (2, 2), of the clicks alone.
    verdict, reason
        Of the match; only ``accepted`` is a measurement.
    found_px, found_covariance_px2
        (2,) and (2, 2); None unless accepted.
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
    pair
        The source's left and right camera.
    joints, to_joints
        Joint readings of the source's and of the destination's pictures.
    clicks_px
        (2, 2) the target in the source's left and right picture.
    sigma_px
        Sigma of each coordinate of those.
    landed
        By destination camera that was to see it.
    name
        Where it is written down, for messages; empty if nowhere.
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
    """Return the record of a geometric hand-off and its refinement.

    Parameters
    ----------
    mast_digest, pair, joints, clicks_px, sigma_px, to_joints
        As in `MatchedHandoff`; what ``handoff`` was made of.
    handoff, refined
        What came of it; destination cameras that do not see the target, or were not looked at, are left out.
    time
        When; now if left out.
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
