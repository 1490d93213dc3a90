"""The gain of numbers beside those that were fitted, from the fit's own normal equations.

Rao's score test: with the Jacobian E of the further numbers beside J of those that were fitted, the residual
r at the minimum and C = (JᵀJ)⁻¹, the sum of squares would fall by gᵀ S⁻¹ g to first order, where

    g = Eᵀr,    S = EᵀE - EᵀJ C JᵀE.

Without such an effect that is chi-square with as many degrees of freedom as there are numbers that J cannot
make up for. Nothing is fitted again, so that hundreds of wider models cost as much as one step of the fit.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.linalg import block_diag

from calib.adjust.unknowns import ResidualBlock
from calib.geometry.rigid import FloatArray

MADE_UP = 1e-7
"""A further number is made up for by those that were fitted if so little of its information is left."""


class Gain(NamedTuple):
    """By how much the sum of squares would fall, how many of the further numbers count, their values (k,) and
    sigmas (k,), not-a-number where one cannot be determined by itself."""

    chi2: float
    freedom: int
    values: FloatArray
    sigma: FloatArray


@dataclass(frozen=True, eq=False)
class Score:
    """Sums over the residuals that depend on further numbers: EᵀE (k, k), EᵀJ (k, p) and Eᵀr (k,)."""

    own: FloatArray
    cross: FloatArray
    pull: FloatArray

    @classmethod
    def of(cls, measured: Iterable[tuple[ResidualBlock, FloatArray]], fitted: int) -> Score:
        """Return the sums over blocks (m,) with their rates E (m, k), beside ``fitted`` numbers."""
        every = list(measured)
        count = every[0][1].shape[1]
        own, cross, pull = np.zeros((count, count)), np.zeros((count, fitted)), np.zeros(count)
        for block, rates in every:
            own += rates.T @ rates
            cross[:, block.columns] += rates.T @ block.jacobian
            pull += rates.T @ block.residual
        return cls(own, cross, pull)

    @classmethod
    def side_by_side(cls, scores: Sequence[Score]) -> Score:
        """Return the sums of numbers that each of several groups of residuals has for itself."""
        return cls(
            block_diag(*[one.own for one in scores]),
            np.concatenate([one.cross for one in scores]),
            np.concatenate([one.pull for one in scores]),
        )

    def __add__(self, other: Score) -> Score:
        return Score(self.own + other.own, self.cross + other.cross, self.pull + other.pull)

    def gain(self, covariance: FloatArray, gradient: FloatArray, least: float = MADE_UP) -> Gain:
        """Return what the numbers would gain with the fitted ones giving way: C (p, p), and Jᵀr (p,).

        A direction of which the fitted numbers leave less than the part ``least`` is not tested. Where
        something is not finite, nothing is gained.
        """
        by_cross = self.cross @ covariance
        left, pull = self.own - by_cross @ self.cross.T, self.pull - by_cross @ gradient
        scale = np.sqrt(np.maximum(np.diag(self.own), 1e-300))
        if not (np.isfinite(left).all() and np.isfinite(pull).all()):
            return Gain(0.0, 0, np.zeros(len(pull)), np.full(len(pull), np.nan))
        values, vectors = np.linalg.eigh(left / np.outer(scale, scale))
        count = values > least
        along = vectors[:, count].T @ (pull / scale)
        found = -vectors[:, count] @ (along / values[count]) / scale
        spread = np.sqrt(np.sum(vectors[:, count] ** 2 / values[count], axis=1)) / scale
        free = np.sum(vectors[:, ~count] ** 2, axis=1) < 1e-3
        return Gain(
            float(np.sum(along**2 / values[count])), int(count.sum()), found, np.where(free, spread, np.nan)
        )
