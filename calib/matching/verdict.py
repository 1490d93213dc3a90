"""Whether a match of patches is a measurement, and what makes it none.

The verdict is part of the measurement: only a ``good`` match is one. The others:

- ``flat``: too little texture (or only along one direction) to hold a position;
- ``ambiguous``: a second place fits nearly as well;
- ``weak``: no place fits well enough: hidden, changed, wrong range, or not in the window;
- ``border``: the patch, or the best place, lies at the border of a picture or of the window.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import cv2
import numpy as np

from calib.geometry.rigid import FloatArray
from calib.matching.least_squares import LeastSquaresMatch
from calib.matching.warp import Grey, Template

MatchVerdict = Literal["good", "flat", "ambiguous", "weak", "border"]


@dataclass(frozen=True)
class MatchSettings:
    """Sizes and thresholds of the matching, with the reasons for their values.

    Attributes
    ----------
    half_px, smallest_half_px, most_half_px
        Half of the patch's side in the coarser picture, and how far it may shrink at a picture's border and
        grow in an enlarged one. 20 (41 px) fixes a place to 0.02 px with usual texture and is still
        nearly plane on a rock. With ``near_px`` a patch is as large as its Gaussian.
    noise_dn
        Grey noise of one picture, one sigma.
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
        it. It matters as far as the two cameras are apart. 0 for what is known to be plane; the default
        is what makes sigmas true on the simulated rover's ground and rocks.
    rough_beside_relief
        Whether ``roughness`` is added too where two cameras saw what stands off the plane.
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
    rough_beside_relief: bool = True
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
    predicted = nowhere if predicted_px is None else predicted_px
    return PatchMatch(
        verdict, reason, predicted, nowhere, np.full((2, 2), np.nan), correlation, second, half_px=half_px
    )


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
        return no_match("weak", reason, target, *facts)
    # Both as correlated: only the best place has been deformed to fit.
    if rivalled(best, second, settings):
        reason = f"a second place fits nearly as well: {second:.2f} beside {best:.2f}"
        return no_match("ambiguous", reason, target, *facts)
    worst_px = math.sqrt(worst_px2(refined.covariance_px2))
    if worst_px > settings.worst_sigma_px:
        reason = f"the place is certain to {worst_px:.2f} px only, {settings.worst_sigma_px} px is expected"
        return no_match("weak", reason, target, *facts)
    covariance = refined.covariance_px2 + surface_px2
    return PatchMatch("good", "", target, refined.pixel_px, covariance, *facts[:2], refined.deformation, half)


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
