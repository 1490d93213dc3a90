"""Tests some measurements against all others, as if they had not been there: an image, a board.

Taken out of the normal equations, the dots of an image leave the others with another minimum and the
covariance C = (N - JᵀJ)⁻¹. The error of that prediction moves the dots together: their residuals r have
the covariance I + J C Jᵀ, and with A = J L, L Lᵀ = C, Woodbury's identity gives

    rᵀ (I + A Aᵀ)⁻¹ r = rᵀr - bᵀ (I + AᵀA)⁻¹ b,    b = Aᵀr.

That is chi-square, and what the sum of squares falls by if the image is left out. It is the same number
whether the image was fitted or not.

A whole placement L (dots of its images, its tapes) leaves the others with a minimum M⁻¹ g away, with M = N -
J_LᵀJ_L and g = J_Lᵀr_L. The board adds r_Lᵀr_L + gᵀ M⁻¹ g to the sum of squares, as a fit without it would
find: chi-square with as many degrees of freedom as it has numbers beyond its own pose. Cameras, mast and
set-ups come from the others alone; only the board's pose is its own. Dots that scatter in their images more
than their sigma says contradict nothing: the chance is by what they scatter (`calib.adjust.scatter`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from calib.adjust.adjustment import Adjustment, bounded_weights
from calib.adjust.scatter import Scatter, scattering
from calib.adjust.solver import Minimum
from calib.adjust.terms import ImageTerm, StationTerm
from calib.adjust.unknowns import Estimate, Known, ResidualBlock
from calib.geometry.rigid import FloatArray
from calib.geometry.significance import chance

REDUNDANT = 0.02
"""Directions of a residual with less than this part of the noise left in them cannot be tested."""

SOLE = 1e-6
"""Part of what is known of an unknown that the others are taken to contribute at least: it is inverted."""

DETERMINES = 1e-3
"""A direction of whose variance some measurements take away less than this part is not determined by them."""

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
            rates = self.rates[rows]
            spread = np.linalg.inv(np.eye(rates.shape[1]) + rates.T @ rates)
            residual = self.residual - self.rates @ (spread @ (rates.T @ self.residual[rows]))
            statistic = dot_statistics(residual, self.rates, spread, good)
            if (statistic[good] <= limit).all():
                break
            good = good & (statistic <= limit)
        return good


def left_out(block: ResidualBlock, covariance: FloatArray, keep: np.ndarray, huber: float | None) -> LeftOut:
    """Return an image as the others predict it.

    Parameters
    ----------
    block
        All its dots at the minimum.
    covariance
        (k, k) of the unknowns that it touches.
    keep, huber
        Which dots (n,) were fitted, and from what length in sigmas on with bounded pulls.
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


def dot_statistics(
    residual: FloatArray, jacobian: FloatArray, covariance: FloatArray, fitted: np.ndarray
) -> FloatArray:
    """Return chi-square of each dot by itself (n,), infinite where it has no pixel.

    Parameters
    ----------
    residual, jacobian
        (2n,) and (2n, k), in sigmas.
    covariance
        (k, k) of the unknowns.
    fitted
        Which dots (n,) were.
    """
    rates = jacobian.reshape(len(fitted), 2, -1)
    spread = np.einsum("nik,nkj->nij", rates @ covariance, rates.transpose(0, 2, 1))
    sign = np.where(fitted, -1.0, 1.0)[:, None, None]
    values, vectors = np.linalg.eigh(np.eye(2) + sign * np.nan_to_num(spread))
    along = np.einsum("nji,nj->ni", vectors, residual.reshape(-1, 2))
    return np.asarray(np.nan_to_num((along**2 / np.maximum(values, REDUNDANT)).sum(axis=1), nan=np.inf))


@dataclass(frozen=True, eq=False)
class LeftOutBoard:
    """A board as the others predict it.

    Attributes
    ----------
    board
        Set-up, or a bench's board, and placement.
    dots
        How many were fitted.
    fitted_px, predicted_px
        Rms per coordinate of its dots in the fit, and with all but its pose from the others; not-a-number
        without dots, or where the others leave something open that its images need.
    chi2, freedom, chance
        Its part of the sum of squares, of how many numbers, and the chance of more if all is right.
    pull_sigmas
        How far the compared numbers would be elsewhere without it, the length of the step in the fit's
        sigmas.
    pull, pull_freedom, pull_chance
        Chi-square of that step, in directions that both the board and the others determine, of how many
        numbers; and the chance of more. It has the covariance of the fit without the board less that with it.
    """

    board: tuple[str, str]
    dots: int
    fitted_px: float = float("nan")
    predicted_px: float = float("nan")
    chi2: float = float("nan")
    freedom: int = 0
    chance: float = 1.0
    pull_sigmas: float = float("nan")
    pull: float = 0.0
    pull_freedom: int = 0
    pull_chance: float = 1.0

    @property
    def least_chance(self) -> float:
        """The chance that neither its residuals nor its pull on the numbers would be larger."""
        return min(1.0, 2 * min(self.chance, self.pull_chance))

    @property
    def sentence(self) -> str:
        """The contradiction to the others, and the remedy."""
        return (
            f"placement {self.board[1]} of board {self.board[0]} contradicts the others: its pictures say "
            f"something else of cameras, axes and joints (chi-square {self.pull:.0f} for {self.pull_freedom} "
            "numbers). Check that it is the same board and that nothing changed in between, and put it up "
            "there once more"
        )


def left_out_boards(
    problem: Adjustment, fit: Minimum[Estimate], covariance: FloatArray, kinds: Sequence[str]
) -> tuple[LeftOutBoard, ...]:
    """Return what the rest says of each board, the least likely first; nothing of a board alone.

    Parameters
    ----------
    problem, fit, covariance
        A fit at its minimum, and the covariance (p, p) of its unknowns.
    kinds
        The kinds of unknowns (`calib.adjust.unknowns`) that a board's pull is on.
    """
    groups: dict[tuple[str, str], list[tuple[ImageTerm | StationTerm, ResidualBlock]]] = {}
    for what, block in problem.blocks(fit.state):
        if not isinstance(what, Known) and what.board is not None:
            groups.setdefault(what.board, []).append((what, block))
    if len(groups) < 2:
        return ()
    compared = problem.unknowns.of_kinds(*kinds)
    whole = fit.normal.matrix + np.diag(problem.weak)
    images = [image for image in problem.images if image.keep.any()]
    noise: dict[tuple[str, str], list[Scatter]] = {}
    for image, one in scattering(problem, fit.state, images).values():
        noise.setdefault(image.board, []).append(one)
    found = []
    for board, group in groups.items():
        touched = np.unique(np.concatenate([block.columns for _, block in group]))
        numbers = np.intersect1d(compared, touched)
        own = problem.at(("board", board)) if board not in problem.fixed else np.zeros(0, dtype=int)
        spread = covariance[np.ix_(numbers, numbers)]
        found.append(_left_out(board, group, whole, own, numbers, spread, noise.get(board, [])))
    return tuple(sorted(found, key=lambda one: one.least_chance))


def _left_out(
    board: tuple[str, str],
    group: list[tuple[ImageTerm | StationTerm, ResidualBlock]],
    whole: FloatArray,
    own: np.ndarray,
    compared: np.ndarray,
    spread: FloatArray,
    noise: list[Scatter],
) -> LeftOutBoard:
    """One board by the others; the covariance of what is compared is ``spread``, its images scatter by
    ``noise``."""
    rest, pull, squares, count = whole.copy(), np.zeros(len(whole)), 0.0, 0
    for _, block in group:
        rest[np.ix_(block.columns, block.columns)] -= block.jacobian.T @ block.jacobian
        pull[block.columns] += block.jacobian.T @ block.residual
        squares += float(block.residual @ block.residual)
        count += len(block.residual)
    dots = sum(int(what.keep.sum()) for what, _ in group if isinstance(what, ImageTerm))
    others = np.setdiff1d(np.arange(len(whole)), own)
    size = 1.0 / np.sqrt(np.maximum(np.diag(rest)[others], 1e-300))
    step = np.zeros(len(whole))
    try:
        factor = cho_factor(rest[np.ix_(others, others)] * np.outer(size, size), check_finite=False)
    except np.linalg.LinAlgError:  # the others leave open what this board alone determines
        return LeftOutBoard(board, dots)
    step[others] = size * cho_solve(factor, size * pull[others], check_finite=False)
    picked = np.zeros((len(others), len(compared)))
    picked[np.searchsorted(others, compared), np.arange(len(compared))] = 1.0
    without = picked.T @ (size[:, None] * cho_solve(factor, size[:, None] * picked, check_finite=False))
    chi2, freedom = squares + float(pull @ step), max(count - len(own), 1)
    scale = float(np.average([n.square for n in noise], weights=[n.freedom for n in noise])) if noise else 1.0
    found = LeftOutBoard(board, dots, *_dots(board, group, step), chi2, freedom, chance(chi2, freedom, scale))
    return _pulled(found, step[compared], without, spread)


def _pulled(board: LeftOutBoard, step: FloatArray, without: FloatArray, spread: FloatArray) -> LeftOutBoard:
    """The board with how far it moves numbers; covariances are those without and with it."""
    if not len(step):
        return replace(board, pull_sigmas=0.0)
    scale = np.sqrt(np.diag(spread))
    root = np.linalg.inv(np.linalg.cholesky(spread / np.outer(scale, scale))) / scale
    values, vectors = np.linalg.eigh(root @ without @ root.T - np.eye(len(step)))
    along = vectors.T @ root @ step
    compared = (values > DETERMINES) & (REDUNDANT * (1.0 + values) <= 1.0)
    pull, freedom = float(np.sum(along[compared] ** 2 / values[compared])), int(compared.sum())
    length, likely = float(np.linalg.norm(along)), chance(pull, freedom)
    return replace(board, pull_sigmas=length, pull=pull, pull_freedom=freedom, pull_chance=likely)


def _dots(
    board: tuple[str, str], group: list[tuple[ImageTerm | StationTerm, ResidualBlock]], step: FloatArray
) -> tuple[float, float]:
    """Rms of a board's dots as fitted, and by the others with its pose fitted again, pixels."""
    ahead = [block.residual + block.jacobian @ step[block.columns] for _, block in group]
    poses = [
        block.rates(("board", board))
        if ("board", board) in block.parts
        else np.zeros((len(block.residual), 0))
        for _, block in group
    ]
    pose = np.linalg.lstsq(np.concatenate(poses), -np.concatenate(ahead), rcond=None)[0]
    fitted, predicted = [], []
    for (what, block), residual, rates in zip(group, ahead, poses, strict=True):
        if isinstance(what, ImageTerm):
            sigma = np.repeat(what.sigma_px[what.keep], 2)
            fitted.append(block.residual * sigma)
            predicted.append((residual + rates @ pose) * sigma)
    return _rms(fitted), _rms(predicted)


def _rms(parts: list[FloatArray]) -> float:
    return float(np.sqrt(np.mean(np.concatenate(parts) ** 2))) if parts else float("nan")
