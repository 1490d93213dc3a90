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

from dataclasses import dataclass

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from calib.adjust.adjustment import Adjustment, bounded_weights
from calib.adjust.goodness import goodness
from calib.adjust.scatter import Scatter, scattering
from calib.adjust.significance import chance
from calib.adjust.solver import Minimum, covariance_of
from calib.adjust.terms import ImageTerm, StationTerm
from calib.adjust.unknowns import MAST, Estimate, Known, ResidualBlock
from calib.geometry.rigid import FloatArray

REDUNDANT = 0.02
"""Directions of a residual with less than this part of the noise left in them cannot be tested."""

SOLE = 1e-6
"""Part of what is known of an unknown that the others are taken to contribute at least: it is inverted."""

TOLD = 1e-3
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
        told, along = np.linalg.eigh(rates.T @ rates)
        told = np.maximum(told, 0.0)
        free = REDUNDANT * (1.0 + told) > 1.0
        taken = (along.T @ (rates.T @ residual)) ** 2 / np.where(free, told, 1.0 + told)
        return float(residual @ residual - taken.sum()), int(rows.sum() - free.sum())

    def pull(self) -> tuple[float, int]:
        """Return chi-square of what these dots say of the unknowns against what the others say, and of how
        many numbers; those that either hardly determines are not compared."""
        told, along = np.linalg.eigh(self.rates.T @ self.rates)
        compared = (told > TOLD) & (REDUNDANT * (1.0 + told) <= 1.0)
        told, gradient = told[compared], along[:, compared].T @ (self.rates.T @ self.residual)
        return float(np.sum(gradient**2 / (told * (1.0 + told)))), int(compared.sum())

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
        Set-up and placement.
    dots
        How many were fitted.
    fitted_px, predicted_px
        Rms per coordinate of its dots in the fit, and with all but its pose from the others; not-a-number
        without dots, or where the others leave something open that its images need.
    chi2, freedom, chance
        Its part of the sum of squares, of how many numbers, and the chance of more if all is right.
    mast_sigmas, mast_chance
        How far the mast would be elsewhere without it, the length of the step in sigmas of the fit's mast;
        and the chance of such a step, which has the covariance of the fit without it less that with it.
    """

    board: tuple[str, str]
    dots: int
    fitted_px: float
    predicted_px: float
    chi2: float
    freedom: int
    chance: float
    mast_sigmas: float
    mast_chance: float

    @property
    def least_chance(self) -> float:
        """The chance that neither its residuals nor its pull on the mast would be larger."""
        return min(1.0, 2 * min(self.chance, self.mast_chance))


def left_out_boards(
    problem: Adjustment, fit: Minimum[Estimate], covariance: FloatArray
) -> tuple[LeftOutBoard, ...]:
    """Return what the rest says of each board, the least likely first.

    Parameters
    ----------
    problem, fit, covariance
        A fit at its minimum, and the covariance (p, p) of its unknowns.
    """
    groups: dict[tuple[str, str], list[tuple[ImageTerm | StationTerm, ResidualBlock]]] = {}
    for what, block in problem.blocks(fit.state):
        if not isinstance(what, Known) and what.board is not None:
            groups.setdefault(what.board, []).append((what, block))
    mast = problem.at(MAST)
    of_mast = covariance[np.ix_(mast, mast)]
    whole = fit.normal.matrix + np.diag(problem.weak)
    noise = scattering(problem, fit.state, [t for t in problem.images if t.keep.any()]).values()
    found = [
        _left_out(
            board, group, whole, problem.at(("board", board)), of_mast, mast,
            [one for image, one in noise if image.board == board],
        )
        for board, group in groups.items()
    ]  # fmt: skip
    return tuple(sorted(found, key=lambda one: one.least_chance))


def _left_out(
    board: tuple[str, str],
    group: list[tuple[ImageTerm | StationTerm, ResidualBlock]],
    whole: FloatArray,
    own: np.ndarray,
    of_mast: FloatArray,
    mast: np.ndarray,
    noise: list[Scatter],
) -> LeftOutBoard:
    """One board by the others; its images scatter by ``noise``."""
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
        step[others] = size * cho_solve(factor, size * pull[others], check_finite=False)
        to_mast = np.zeros((len(others), len(mast)))
        to_mast[np.searchsorted(others, mast), np.arange(len(mast))] = 1.0
        without = size[:, None] * cho_solve(factor, size[:, None] * to_mast, check_finite=False)
    except np.linalg.LinAlgError:  # the others leave open what this board alone tells
        nan = float("nan")
        return LeftOutBoard(board, dots, nan, nan, nan, 0, 1.0, nan, 1.0)
    chi2, freedom = squares + float(pull @ step), max(count - len(own), 1)
    fitted, predicted = _dots(board, group, step)
    moved, by_luck = _pull(step[mast], without.T @ to_mast, of_mast)
    scale = float(np.average([n.square for n in noise], weights=[n.freedom for n in noise])) if noise else 1.0
    likely = chance(chi2, freedom, scale)
    return LeftOutBoard(board, dots, fitted, predicted, chi2, freedom, likely, moved, by_luck)


def _pull(step: FloatArray, without: FloatArray, of_mast: FloatArray) -> tuple[float, float]:
    """How far a board moves the mast, in sigmas, and the chance of it; covariances without and with it."""
    if not len(step):
        return 0.0, 1.0
    root = np.linalg.inv(np.linalg.cholesky(of_mast))
    values, vectors = np.linalg.eigh(root @ without @ root.T - np.eye(len(step)))
    along = vectors.T @ root @ step
    told = values > TOLD
    chi2 = float(np.sum(along[told] ** 2 / values[told]))
    return float(np.linalg.norm(along)), chance(chi2, int(told.sum()))


def _dots(
    board: tuple[str, str], group: list[tuple[ImageTerm | StationTerm, ResidualBlock]], step: FloatArray
) -> tuple[float, float]:
    """Rms of a board's dots as fitted, and by the others with its pose fitted again, pixels."""
    ahead = [block.residual + block.jacobian @ step[block.columns] for _, block in group]
    poses = [block.rates(("board", board)) for _, block in group]
    pose = np.linalg.lstsq(np.concatenate(poses), -np.concatenate(ahead), rcond=None)[0]
    fitted, predicted = [], []
    for (what, block), residual, rates in zip(group, ahead, poses, strict=True):
        if isinstance(what, ImageTerm):
            sigma = np.repeat(what.sigma_px[what.keep], 2)
            fitted.append(block.residual * sigma)
            predicted.append((residual + rates @ pose) * sigma)
    if not fitted:
        return float("nan"), float("nan")
    return _rms(fitted), _rms(predicted)


def _rms(parts: list[FloatArray]) -> float:
    return float(np.sqrt(np.mean(np.concatenate(parts) ** 2)))


@dataclass(frozen=True)
class OtherPlacements:
    """A placement held against the others: chi-square of what its pictures and theirs say of ``freedom``
    numbers that they share, and its chance if all is right, all placements counted."""

    board: tuple[str, str]
    chi2: float
    freedom: int
    chance: float

    @property
    def sentence(self) -> str:
        """The contradiction to the others, and the remedy."""
        return (
            f"placement {self.board[1]} of board {self.board[0]} contradicts the others: its pictures say "
            f"something else of cameras, axes and joints (chi-square {self.chi2:.0f} for {self.freedom} "
            "numbers). Check that it is the same board and that nothing changed in between, and put it up "
            "there once more"
        )


def by_other_placements(problem: Adjustment, state: Estimate) -> tuple[OtherPlacements, ...]:
    """Return each placement held against the others, the least likely first; none if there is but one.

    Parameters
    ----------
    problem, state
        A fit at its minimum.
    """
    chi2, matrix, _ = problem.normal(state)
    covariance = covariance_of(matrix, problem.weak)
    _, freedom = goodness(problem, state, covariance)
    images = [image for image in problem.images if image.keep.any()]
    boards = list(dict.fromkeys(image.board for image in images))
    found = []
    for board in boards if len(boards) > 1 else ():
        blocks = problem.image_blocks(state, [image for image in images if image.board == board])
        columns = np.unique(np.concatenate([block.columns for block in blocks]))
        residual = np.concatenate([block.residual for block in blocks])
        jacobian = np.zeros((len(residual), len(columns)))
        first = 0
        for block in blocks:
            last = first + len(block.residual)
            jacobian[first:last, np.searchsorted(columns, block.columns)] = block.jacobian
            first = last
        every = ResidualBlock(residual, jacobian, columns, 2)
        keep = np.ones(len(jacobian) // 2, dtype=bool)
        pull, numbers = left_out(every, covariance[np.ix_(columns, columns)], keep, problem.huber).pull()
        likely = chance(pull, numbers, chi2 / max(freedom, 1.0), max(freedom, 1.0))
        found.append(OtherPlacements(board, pull, numbers, min(1.0, len(boards) * likely)))
    return tuple(sorted(found, key=lambda one: one.chance))
