"""The constant offset that hand-offs leave in each destination camera: the mast's self-check in service.

Nothing is fitted but a mean: what is found less what the source pair predicts, by camera. An offset that
stands out says that the two cameras do not mean the same rover frame (the paper saw 1.5 and 2 px);
`calib.handoff.fit_body_pose` then tells by which motion.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from calib.fit.significance import THREE_SIGMAS, chance, sigmas
from calib.handoff.matched import MODEL_PX, MatchedHandoff
from calib.rigid import FloatArray

FALSE_ALARMS = 0.01
"""Chance that a camera's offsets without a blunder lose one."""


@dataclass(frozen=True, eq=False)
class HandoffBias:
    """The mean offset of one camera.

    Attributes
    ----------
    source, camera
        The pair that handed over, and the camera that looked.
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
        return self.chance < THREE_SIGMAS

    @property
    def sentence(self) -> str:
        """The offset in words."""
        sigma = np.sqrt(np.diag(self.covariance_px2))
        x, y = (
            f"{abs(off):.2f} +- {s:.2f} px {words[int(off < 0)]}"
            for off, s, words in zip(
                self.offset_px, sigma, (("right", "left"), ("lower", "higher")), strict=True
            )
        )
        return (
            f"{self.camera} sees targets {x} and {y} of where {self.source} puts them "
            f"({self.sigmas:.1f} sigma, {self.handoffs} hand-offs)"
        )


def handoff_bias(handoffs: Sequence[MatchedHandoff], model_px: float = MODEL_PX) -> tuple[HandoffBias, ...]:
    """Return the mean offset of each destination camera with at least two accepted matches.

    Parameters
    ----------
    handoffs
        Of one mast file: an offset is against what that file predicts.
    model_px
        One sigma, each axis, of what a match is wrong by beyond its own covariance.
    """
    groups: dict[tuple[str, str], list[tuple[FloatArray, FloatArray]]] = {}
    for one in handoffs:
        source = one.pair[0].rpartition("_")[0]
        for camera, landed in one.found.items():
            assert landed.found_px is not None and landed.found_covariance_px2 is not None
            covariance = landed.geometric_covariance_px2 + landed.found_covariance_px2
            groups.setdefault((source, camera), []).append(
                (landed.found_px - landed.geometric_px, covariance + model_px**2 * np.eye(2))
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
    # Chi-square of two degrees of freedom is beyond -2 ln p with the chance p.
    typical = max(1.0, float(np.median(statistics)) / (-2.0 * math.log(0.5)))
    keep = statistics <= typical * (-2.0 * math.log(FALSE_ALARMS / len(off_px)))
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
