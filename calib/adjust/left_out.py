"""Tests an image against all other measurements, as if it had not been there.

Taken out of the normal equations, the dots of an image leave the others with another minimum and the
covariance C = (N - JᵀJ)⁻¹. The error of that prediction moves the dots together: their residuals r have
the covariance I + J C Jᵀ, and with A = J L, L Lᵀ = C, Woodbury's identity gives

    rᵀ (I + A Aᵀ)⁻¹ r = rᵀr - bᵀ (I + AᵀA)⁻¹ b,    b = Aᵀr.

That is chi-square, and what the sum of squares falls by if the image is left out. It is the same number
whether the image was fitted or not.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from calib.adjust.adjustment import bounded_weights
from calib.adjust.unknowns import ResidualBlock
from calib.geometry.rigid import FloatArray

REDUNDANT = 0.02
"""Directions of a residual with less than this part of the noise left in them cannot be tested."""

SOLE = 1e-6
"""Part of what is known of an unknown that the others are taken to contribute at least: it is inverted."""

REPEATS = 3
"""Times that the dots of an image are judged by one another."""


@dataclass(frozen=True, eq=False)
class LeftOut:
    """An image's residuals (2n,) as the others predict it, in sigmas, and their rates A (2n, k) by k
    independent unit errors of that prediction; not-a-number where a dot has no pixel."""

    residual: FloatArray
    rates: FloatArray

    def statistic(self, good: np.ndarray) -> tuple[float, int]:
        """Return chi-square of some of the dots (n,) taken together, and its degrees of freedom.

        Directions that the image itself determines and the others hardly do cannot be tested, and count as
        free.
        """
        rows = np.repeat(good, 2)
        rates, residual = self.rates[rows], self.residual[rows]
        values, along = np.linalg.eigh(rates.T @ rates)
        values = np.maximum(values, 0.0)
        free = REDUNDANT * (1.0 + values) > 1.0
        taken = (along.T @ (rates.T @ residual)) ** 2 / np.where(free, values, 1.0 + values)
        return float(residual @ residual - taken.sum()), int(rows.sum() - free.sum())

    def agreeing(self, good: np.ndarray, limit: float) -> np.ndarray:
        """Return which of the good dots (n,) stay so beside one another: of those the others' error cannot be
        the cause."""
        for _ in range(REPEATS):
            rows = np.repeat(good, 2)
            unit = np.eye(self.rates.shape[1])
            # Not (I + AᵀA)⁻¹ itself: of a board that stands anywhere, the rates are as large as they like.
            rates = self.rates @ np.linalg.inv(np.linalg.qr(np.vstack([self.rates[rows], unit]), mode="r"))
            residual = self.residual - rates @ (rates[rows].T @ self.residual[rows])
            statistic, _ = statistics(residual, rates, unit, good)
            if (statistic[good] <= limit).all():
                break
            good = good & (statistic <= limit)
        return good


def left_out(block: ResidualBlock, covariance: FloatArray, keep: np.ndarray, huber: float | None) -> LeftOut:
    """Return an image as the others predict it.

    ``block`` are all its dots at the minimum, ``covariance`` (k, k) is of the unknowns that it touches,
    ``keep`` (n,) says which dots were fitted, from a length of ``huber`` sigmas on with bounded pulls.
    """
    scale = np.sqrt(np.diag(covariance))
    values, vectors = np.linalg.eigh(covariance / np.outer(scale, scale))
    rates = (block.jacobian * scale) @ (vectors * np.sqrt(np.maximum(values, 0.0)))
    fitted = np.repeat(keep, 2)
    own, residual = rates[fitted], block.residual[fitted]
    weighed = own * bounded_weights(residual, 2, huber)[:, None]
    left, turned = np.linalg.eigh(np.eye(len(scale)) - weighed.T @ own)
    rates = rates @ turned
    known = left > REDUNDANT
    step = (turned.T @ (weighed.T @ residual))[known] / left[known]
    return LeftOut(block.residual + rates[:, known] @ step, rates / np.sqrt(np.maximum(left, SOLE)))


def statistics(
    residual: FloatArray, jacobian: FloatArray, covariance: FloatArray, fitted: np.ndarray
) -> tuple[FloatArray, np.ndarray]:
    """Return chi-square of each measurement by itself (n,), infinite where a dot has no pixel, and how many
    numbers of it the others check (n,).

    ``residual`` (wn,) and ``jacobian`` (wn, k), in sigmas, are of measurements of w numbers each, of which
    some were ``fitted`` (n,); ``covariance`` (k, k) is of the unknowns.
    """
    rates = jacobian.reshape(len(fitted), -1, jacobian.shape[1])
    spread = np.einsum("nik,nkj->nij", rates @ covariance, rates.transpose(0, 2, 1))
    sign = np.where(fitted, -1.0, 1.0)[:, None, None]
    values, vectors = np.linalg.eigh(np.eye(rates.shape[1]) + sign * np.nan_to_num(spread))
    along = np.einsum("nji,nj->ni", vectors, residual.reshape(len(fitted), -1))
    squares = (along**2 / np.maximum(values, REDUNDANT)).sum(axis=1)
    return np.nan_to_num(squares, nan=np.inf), (values > REDUNDANT).sum(axis=1)
