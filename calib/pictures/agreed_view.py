"""The view on which patches agree: each found patch is a vote for pan and tilt, most of them are right."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from calib.rigid import FloatArray

AGREEING = {"told": (5, 0.25), "any": (6, 0.4)}
"""How many patches, and which share of those that a view should show, must agree on it: the told view needs
fewer, since a large thing may have moved in the picture, than one that is looked for everywhere."""
AGREE = 1.2
"""Patches agree whose places differ by no more, reduced pixels: relief, shape, and the search itself."""
SEARCH_SIGMA = 0.15
"""Of one patch's place, reduced pixels; a smaller scatter of few patches is luck."""


@dataclass(frozen=True, eq=False)
class AgreedView:
    """A view by the patches that agree on it.

    Attributes
    ----------
    angles_rad, sigma_rad
        (2,) pan and tilt with one sigma.
    parallax_rad
        (2,) the largest error by ranges that are not known.
    rate_px_per_rad
        (n, 2, 2) of the agreeing patches.
    agreeing, expected
        Patches that agree, and that the view should show.
    correlation
        Mean of the agreeing ones.
    """

    angles_rad: FloatArray
    sigma_rad: FloatArray
    parallax_rad: FloatArray
    rate_px_per_rad: FloatArray
    agreeing: int
    expected: int
    correlation: float

    def holds(self, view: Literal["told", "any"]) -> bool:
        """Tell whether enough patches agree."""
        least, share = AGREEING[view]
        return self.agreeing >= max(least, share * self.expected)


def agreed_view(
    view: FloatArray,
    off_px: FloatArray,
    rates: FloatArray,
    open_px: FloatArray,
    scores: FloatArray,
    step: int,
    expected: int,
) -> AgreedView | None:
    """Return the view on which most patches agree, None for fewer than two.

    Parameters
    ----------
    view
        (2,) pan and tilt, radians, from which the patches were looked for.
    off_px
        (n, 2) where they were found, from where that view has them.
    rates
        (n, 2, 2) how they move with pan and tilt, px/rad.
    open_px
        (n, 2) half of the way along which they may lie, since their ranges are not known.
    scores
        (n,) correlations.
    step
        Pixels of the full picture in one of the reduced.
    expected
        How many patches the view should show.
    """
    if len(off_px) < 2:
        return None
    votes = (np.linalg.pinv(rates) @ off_px[..., None])[..., 0]  # near the pan axis one patch tells no pan
    rest = off_px[None] - np.einsum("nij,mj->mni", rates, votes)
    length2 = np.maximum((open_px**2).sum(axis=1), 1e-12)
    along = np.clip(np.einsum("mni,ni->mn", rest, open_px) / length2, -1.0, 1.0)
    apart = np.linalg.norm(rest - along[..., None] * open_px, axis=2)
    agree = apart <= AGREE * step
    best = int(np.argmax(agree.sum(axis=1) - 1e-3 * np.where(agree, apart / step, 0.0).sum(axis=1)))
    which = agree[best]
    # What has a range says more than what has none.
    weights = 1.0 / (1.0 + length2[which] / (SEARCH_SIGMA * step) ** 2)
    weights /= weights.max()
    weighted = rates[which] * weights[:, None, None]
    inverse = np.linalg.pinv(np.einsum("nij,nik->jk", weighted, rates[which]))
    change = inverse @ np.einsum("nij,ni->j", weighted, off_px[which])
    left = off_px[which] - rates[which] @ change
    freedom = max(2.0 * float(weights.sum()) - 2.0, 1.0)
    variance_px2 = float(weights @ (left**2).sum(axis=1)) / freedom
    covariance = inverse * max(variance_px2, (SEARCH_SIGMA * step) ** 2)
    parallax = np.abs(np.einsum("jk,nik,ni->nj", inverse, weighted, open_px[which])).sum(axis=0)
    return AgreedView(
        view + change,
        np.sqrt(np.diag(covariance)),
        parallax,
        rates[which],
        int(which.sum()),
        expected,
        float(scores[which].mean()),
    )
