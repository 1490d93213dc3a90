"""How large misfits are, and how unlikely by chance; and the levels at which all tests decide."""

from __future__ import annotations

import math
from enum import Enum

import numpy as np

from calib.geometry.rigid import FloatArray

MOST_SIGMAS = 37.0
"""Beyond this the probability is no number that a computer holds."""


class Level(float, Enum):
    """Chances by which tests decide; ``meaning`` says how often a test of that level errs.

    A test of several measurements, hypotheses or boards shares its level among them.
    """

    meaning: str

    def __new__(cls, chance: float, meaning: str) -> Level:
        level = float.__new__(cls, chance)
        level._value_ = chance
        level.meaning = meaning
        return level

    MEASUREMENT = 0.01, "of a hundred records without a blunder, one loses a measurement or doubts a drawing"
    THREE_SIGMAS = 0.0027, "of 370 single numbers that are nothing, one is beyond three sigma"
    STATED = 0.001, "of a thousand right statements, as of a sigma or of one pose, one is called wrong"
    HYPOTHESIS = 0.0003, "of 3000 surveys that are as modelled, one asks for another hypothesis"
    WHOLE = 1e-4, "of 10,000 right images, set-ups or boards, one is doubted: noise is not quite normal"
    PREDICTED = 3e-5, "of 30,000 right cameras, one is said not to predict its check images"
    CHANGED = 1e-7, "of ten million right fits, one is said to have changed half-way"
    GROSS = 1e-9, "of a hundred placements whose stated sigma is twice too small, one fails"


MEDIAN_OF_TWO = 2 * np.log(2.0)
"""Median of chi-square with two degrees of freedom."""


def chance(chi2: float, freedom: int, scale: float = 1.0, scale_freedom: float = math.inf) -> float:
    """Return the chance of a larger chi-square, of so many numbers, without any effect.

    ``scale`` is the residuals' own chi-square over its degrees of freedom. Above one it says that the stated
    sigmas are too small; chi2 is then divided by it, and the F distribution allows for how well the scale
    itself is known. Below one it is not used: luck makes no sigma smaller.
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


def chance_of_sum(total: float, weights: FloatArray) -> float:
    """Return the chance of a larger sum of squares of independent unit normals with positive weights (n,).

    Lugannani and Rice's saddle point as in Kuonen, Biometrika 86 (1999). A chi-square of the same mean and
    variance is wrong by orders of magnitude far out, where the largest weight decides.
    """
    from scipy.optimize import brentq  # slow to load, and a daemon that starts does not need it
    from scipy.special import ndtr

    if total <= 0.0:
        return 1.0
    w = weights / weights.max()
    t = total / float(weights.max())
    if 0.25 * t - 0.5 * len(w) > MOST_SIGMAS**2:  # Chernoff's bound, beyond what a computer holds
        return 0.0

    def slope(at: float) -> float:
        return float(np.sum(w / (1.0 - 2.0 * at * w))) - t

    # One square alone, and all of them with the largest weight, have their saddle points to either side.
    at = float(brentq(slope, -0.5 * len(w) / t - 1e-9, 0.5 - 0.5 / t + 1e-9 / t, xtol=1e-15))
    rise = w / (1.0 - 2.0 * at * w)
    deviance = at * t + 0.5 * float(np.sum(np.log1p(-2.0 * at * w)))
    r = math.copysign(math.sqrt(2.0 * max(deviance, 0.0)), at)
    if abs(r) < 1e-4:  # at the mean the formula is a quotient of noughts, whose limit is this
        return float(ndtr(-(r + math.sqrt(2.0) / 3.0 * float(np.sum(w**3) / np.sum(w**2) ** 1.5))))
    return float(ndtr(-(r + math.log(at * math.sqrt(2.0 * float(np.sum(rise**2))) / r) / r)))


def rare_sum(probability: float, weights: FloatArray) -> float:
    """Return what such a weighted sum of squares (`chance_of_sum`) exceeds with a probability below 0.5."""
    from scipy.optimize import brentq

    low = high = float(weights.sum())
    while chance_of_sum(high, weights) > probability:
        low, high = high, 2.0 * high
    return float(brentq(lambda total: chance_of_sum(total, weights) - probability, low, high, rtol=1e-9))


def typical_scale(squares: FloatArray, freedom: int = 2) -> float:
    """Return by how much the typical square (n,), in sigmas, is larger than chance makes it.

    Squares are chi-square with ``freedom``; their median over what that should be. 1 of none.
    """
    from scipy.special import chdtri  # slow to load, and a daemon that starts does not need it

    median = MEDIAN_OF_TWO if freedom == 2 else float(chdtri(freedom, 0.5))
    return float(np.median(squares) / median) if len(squares) else 1.0
