"""How far rests of the head scatter, and how significant a term is beside that.

What a joint repeats to decides which misfit is common to all pictures and which is each rest's own. It is
estimated with the numbers (a variance component: squares of the rests' errors over how many of them the
pictures tell). What was told counts like `TOLD_COUNTS` such errors, and is the least.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from calib.fit.least_squares import covariance_of
from calib.fit.significance import chance
from calib.rigid import FloatArray

_ROUNDS, _SETTLED = 60, 3e-3

TOLD_COUNTS = 10
"""Few rests tell little of how they scatter: what was told then stands."""


@dataclass(frozen=True, eq=False)
class Fitted:
    """The least of a quadratic cost.

    ``numbers`` (f,) and ``covariance`` (f, f) of the free ones; ``joint_sigma_rad`` as it was found, from
    ``freedom`` numbers of the rests' errors, infinite where it is as it was told.
    """

    numbers: FloatArray
    covariance: FloatArray
    cost: float
    joint_sigma_rad: float
    freedom: float


@dataclass(frozen=True, eq=False)
class Quadratic:
    """Cost x' M x + 2 b' x of numbers that are terms first, the rests' errors last.

    Attributes
    ----------
    matrix, linear
        M (p + 2k, p + 2k) and b (p + 2k,) of the pictures alone.
    held
        (p,) sigma beforehand of each term's number.
    told_rad
        What a rest of the head is off by at least, one sigma.
    """

    matrix: FloatArray
    linear: FloatArray
    held: FloatArray
    told_rad: float

    def fitted(self, free: np.ndarray) -> Fitted:
        """Return the least with those terms (p,) that are free, and how far rests then scatter."""
        sigma, freedom = self.told_rad, math.inf
        for _ in range(_ROUNDS):
            found = self.at(free, sigma)
            count = int(free.sum())
            rests = found.numbers[count:]
            told = len(rests) - float(np.diag(found.covariance)[count:].sum()) / sigma**2
            freedom = TOLD_COUNTS + told
            square = (TOLD_COUNTS * self.told_rad**2 + float(rests @ rests)) / freedom
            wider = math.sqrt(square)
            if wider <= self.told_rad:
                wider, freedom = self.told_rad, math.inf
            if abs(wider - sigma) <= _SETTLED * sigma:
                break
            sigma = wider
        return Fitted(found.numbers, found.covariance, found.cost, sigma, freedom)

    def at(self, free: np.ndarray, joint_sigma_rad: float) -> Fitted:
        """Return the least with those terms (p,) that are free, for rests of this scatter."""
        rests = len(self.linear) - len(self.held)
        which = np.concatenate([np.flatnonzero(free), np.arange(len(self.held), len(self.linear))])
        prior = np.concatenate([self.held[free], np.full(rests, joint_sigma_rad)])
        covariance = covariance_of(self.matrix[np.ix_(which, which)] + np.diag(prior**-2))
        numbers = -covariance @ self.linear[which]
        return Fitted(numbers, covariance, float(self.linear[which] @ numbers), joint_sigma_rad, math.inf)

    def chance(self, free: np.ndarray, further: np.ndarray) -> tuple[float, Fitted]:
        """Return the chance of what further terms (p,) gain, were they nothing; and the fit with them.

        The gain is by the scatter that is left with them, which is known as well as its freedom says.
        """
        with_them = self.fitted(free | further)
        gain = self.at(free, with_them.joint_sigma_rad).cost - with_them.cost
        scale = 1.0 + 1e-9 if math.isfinite(with_them.freedom) else 1.0
        by_chance = chance(max(gain, 0.0), int(further.sum()), scale, with_them.freedom)
        return by_chance, with_them
