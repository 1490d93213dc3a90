"""The gain of numbers beside those that were fitted, from the fit's own normal equations.

Rao's score test: with the Jacobian E of the further numbers beside J of those that were fitted, the residual
r at the minimum and C = (JᵀJ)⁻¹, the sum of squares would fall by gᵀ S⁻¹ g to first order, where

    g = Eᵀr,    S = EᵀE - EᵀJ C JᵀE.

Without such an effect that is chi-square with as many degrees of freedom as there are numbers that J cannot
make up for. Nothing is fitted again, so that hundreds of wider models cost as much as one step of the fit.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from calib.adjust.unknowns import ResidualBlock
from calib.geometry.rigid import FloatArray

MADE_UP = 1e-7
"""A further number is made up for by those that were fitted if so little of its information is left."""


@dataclass(frozen=True, eq=False)
class Gain:
    """The gain of further numbers.

    ``chi2`` by how much the sum of squares would fall, ``freedom`` how many of the numbers count, ``values``
    (k,) of each number and ``sigma`` (k,), not-a-number where it cannot be told by itself. ``rms`` is by how
    much they move the residuals that depend on them, in sigmas, before the others give way.
    """

    chi2: float
    freedom: int
    values: FloatArray
    sigma: FloatArray
    rms: float


class Score:
    """Normal equations of ``count`` further numbers beside ``fitted`` ones."""

    def __init__(self, count: int, fitted: int) -> None:
        self.own = np.zeros((count, count))
        self.cross = np.zeros((count, fitted))
        self.pull = np.zeros(count)
        self.touched = np.zeros(count)

    def add(self, block: ResidualBlock, columns: FloatArray, at: np.ndarray | None = None) -> None:
        """Add residuals (m,) with their Jacobian ``columns`` (m, k) on the numbers ``at`` (k,), or on all."""
        at = np.arange(len(self.pull)) if at is None else at
        self.own[np.ix_(at, at)] += columns.T @ columns
        self.cross[np.ix_(at, block.columns)] += columns.T @ block.jacobian
        self.pull[at] += columns.T @ block.residual
        self.touched[at] += len(block.residual)

    def beside(self, covariance: FloatArray, gradient: FloatArray) -> Beside:
        """Return the equations with the fitted numbers giving way: C (p, p), and Jᵀr (p,), all but 0."""
        by_cross = self.cross @ covariance
        return Beside(
            self.own, self.own - by_cross @ self.cross.T, self.pull - by_cross @ gradient, self.touched
        )


@dataclass(frozen=True, eq=False)
class Beside:
    """Further numbers with the fitted ones giving way: EᵀE and S (k, k), g (k,), how many residuals (k,)."""

    own: FloatArray
    left: FloatArray
    pull: FloatArray
    touched: FloatArray

    def gain(self, combined: FloatArray | None = None, least: float = MADE_UP) -> Gain:
        """Return what the numbers, or ``combined`` (k, c) of them, would gain.

        A direction of which the fitted numbers leave less than the part ``least`` is not looked at. Where
        something is not finite, nothing is gained.
        """
        t = np.eye(len(self.pull)) if combined is None else combined
        own, left, pull = t.T @ self.own @ t, t.T @ self.left @ t, t.T @ self.pull
        scale = np.sqrt(np.maximum(np.diag(own), 1e-300))
        if not (np.isfinite(left).all() and np.isfinite(pull).all()):
            return Gain(0.0, 0, np.zeros(len(pull)), np.full(len(pull), np.nan), 0.0)
        values, vectors = np.linalg.eigh(left / np.outer(scale, scale))
        count = values > least
        along = vectors[:, count].T @ (pull / scale)
        found = -vectors[:, count] @ (along / values[count]) / scale
        spread = np.sqrt(np.sum(vectors[:, count] ** 2 / values[count], axis=1)) / scale
        free = np.sum(vectors[:, ~count] ** 2, axis=1) < 1e-3
        touched = float(self.touched[(t != 0).any(axis=1)].max(initial=1.0))
        return Gain(
            float(np.sum(along**2 / values[count])),
            int(count.sum()),
            found,
            np.where(free, spread, np.nan),
            float(np.sqrt(found @ own @ found / touched)),
        )


def scored(
    parts: Iterable[tuple[ResidualBlock, FloatArray]], covariance: FloatArray, gradient: FloatArray
) -> Beside:
    """Return the equations of numbers (k,) that some residuals depend on, all at rates (m, k)."""
    score: Score | None = None
    for block, rates in parts:
        score = score or Score(rates.shape[1], len(gradient))
        score.add(block, rates)
    assert score is not None
    return score.beside(covariance, gradient)
