"""How large misfits are, and how unlikely by chance: as a probability and in sigmas."""

from __future__ import annotations

import math

import numpy as np

from calib.rigid import FloatArray

MOST_SIGMAS = 37.0
"""Beyond this the probability is no number that a computer holds."""

THREE_SIGMAS = 0.0027
"""The chance that a normal error is beyond three sigma, either side."""

MEDIAN_OF_TWO = 2 * np.log(2.0)
"""Median of chi-square with two degrees of freedom."""


def chance(chi2: float, freedom: int, scale: float = 1.0, scale_freedom: float = math.inf) -> float:
    """Return the chance of a larger chi-square without any effect.

    Parameters
    ----------
    chi2, freedom
        Weighted sum of squares that an effect explains, and of how many numbers.
    scale, scale_freedom
        The residuals' own chi-square over its degrees of freedom, and these. Above one it says that the
        stated sigmas are too small; chi2 is then taken by it, and the F distribution counts how well the
        scale itself is known. Below one it is not used: luck makes no sigma smaller.
    """
    from scipy.special import chdtrc, fdtrc  # slow to load, and a daemon that starts does not need it

    if freedom == 0:
        return 1.0
    if scale <= 1.0 or math.isinf(scale_freedom):
        return float(chdtrc(freedom, chi2 / max(scale, 1.0)))
    return float(fdtrc(freedom, scale_freedom, chi2 / (freedom * scale)))


def sigmas(probability: float) -> float:
    """Return how many sigmas a normal error is away whose chance (either side) this is; 37 at most."""
    from scipy.special import ndtri  # slow to load, and a daemon that starts does not need it

    if probability <= 0.0:
        return MOST_SIGMAS
    return min(float(-ndtri(min(probability, 1.0) / 2)), MOST_SIGMAS)


def typical_px(residuals_px: FloatArray) -> float:
    """Return the sigma of a coordinate that the median length of residuals (n, 2) tells, pixels."""
    square = np.nan_to_num((residuals_px**2).sum(axis=1), nan=np.inf)
    return float(np.sqrt(np.median(square) / MEDIAN_OF_TWO)) if len(square) else float("inf")
