"""What a fit may not end as: far from the noise, or without most images of a camera."""

from __future__ import annotations

from calib.adjust.adjustment import Adjustment
from calib.adjust.robust import SurveyNotFitted, typical_length
from calib.adjust.scatter import typical_excess
from calib.adjust.unknowns import Estimate

FAR_SCATTER = 1.5
"""Dots that scatter in their images by so many times what is noise are what a far fit is far by."""


def refuse_far(
    problem: Adjustment,
    state: Estimate,
    stated_px: float,
    *,
    most: float,
    dot: str,
    disagree: str,
    scatter: str,
    coherent: str,
) -> None:
    """Raise if a camera's typical dot is far above its noise, or too many of its images were left out.

    No dot's own sigma counts as less than ``stated_px``: what neighbours share, as a print's errors, is not
    in it. The typical dot may be off ``most`` times the noise: stated sigmas are wrong by two or three, wrong
    minima by a hundred. ``disagree``, ``scatter`` and ``coherent`` say what to check where images disagree,
    where dots are off one by one, and where they are off together.

    Raises
    ------
    SurveyNotFitted
        Saying which of these it is.
    """
    for name in state.cameras:
        mine = [t for t in problem.images if t.camera == name]
        kept = [t for t in mine if t.keep.any()]
        if len(kept) < max(2, len(mine) // 2):
            raise SurveyNotFitted(
                f"camera {name}: {len(mine) - len(kept)} of its {len(mine)} images do not agree with the rest"
                f"{disagree}"
            )
        typical, noise_px = typical_length(problem, state, kept, stated_px)
        excess = typical_excess(problem, state, kept)
        if excess > FAR_SCATTER:
            raise SurveyNotFitted(
                f"camera {name}: its {dot}s are off one by one, by {excess * noise_px:.2g} px beside a "
                f"smooth map of each image, where {noise_px:.2g} px at most may count for noise "
                f"({stated_px:g} px are stated): {scatter}"
            )
        if typical > most:
            raise SurveyNotFitted(
                f"camera {name}: the fit leaves {typical:.1f} times the noise of a {dot} ({noise_px:.2g} "
                f"px), and {dot}s of an image are off together, not one by one: it ended in a wrong minimum, "
                f"the lens is not of this model, or {coherent}"
            )
