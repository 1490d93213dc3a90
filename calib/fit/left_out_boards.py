"""Cross-validation: what the rest of a survey says of each board, had it not been there.

Everything that was measured of one placement L (dots of its images, its tapes) is taken out of the normal
equations; the others then have another minimum, M⁻¹ g away, with M = N - J_LᵀJ_L and g = J_Lᵀr_L. The board
adds r_Lᵀr_L + gᵀ M⁻¹ g to the sum of squares, as a fit without it would find: chi-square with as many degrees
of freedom as it has numbers beyond its own pose. Cameras, mast and set-ups come from the others alone; only
the board's pose is its own.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from calib.fit.adjustment import MAST, Adjustment, Block, Estimate
from calib.fit.least_squares import Minimum
from calib.fit.significance import chance
from calib.fit.terms import ImageTerm, StationTerm
from calib.rigid import FloatArray

TOLD = 1e-3
"""A direction of the mast of whose variance a board takes away less than this part is not its to pull."""

POSE = 6
"""Numbers of a board's pose: the last unknowns of its images and of its tapes."""


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
        What it adds to the sum of squares, of how many numbers, and the chance of more if all is right.
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
    groups: dict[tuple[str, str], list[tuple[ImageTerm | StationTerm, Block]]] = {}
    for what, block in problem.blocks(fit.state):
        if not isinstance(what, str) and what.board is not None:
            groups.setdefault(what.board, []).append((what, block))
    mast = problem.at(MAST)
    of_mast = covariance[np.ix_(mast, mast)]
    whole = fit.normal.matrix + np.diag(problem.weak)
    found = [
        _left_out(board, group, whole, problem.at(("board", board)), of_mast, mast)
        for board, group in groups.items()
    ]
    return tuple(sorted(found, key=lambda one: one.least_chance))


def _left_out(
    board: tuple[str, str],
    group: list[tuple[ImageTerm | StationTerm, Block]],
    whole: FloatArray,
    own: np.ndarray,
    of_mast: FloatArray,
    mast: np.ndarray,
) -> LeftOutBoard:
    """One board by the others."""
    rest, pull, squares, count = whole.copy(), np.zeros(len(whole)), 0.0, 0
    for _, block in group:
        rest[np.ix_(block.columns, block.columns)] -= block.jacobian.T @ block.jacobian
        pull[block.columns] += block.jacobian.T @ block.residual
        squares += float(block.residual @ block.residual)
        count += len(block.residual)
    dots = sum(int(what.keep.sum()) for what, _ in group if isinstance(what, ImageTerm))
    others = np.setdiff1d(np.arange(len(whole)), own)
    scale = 1.0 / np.sqrt(np.maximum(np.diag(rest)[others], 1e-300))
    step = np.zeros(len(whole))
    try:
        factor = cho_factor(rest[np.ix_(others, others)] * np.outer(scale, scale), check_finite=False)
        step[others] = scale * cho_solve(factor, scale * pull[others], check_finite=False)
        to_mast = np.zeros((len(others), len(mast)))
        to_mast[np.searchsorted(others, mast), np.arange(len(mast))] = 1.0
        without = scale[:, None] * cho_solve(factor, scale[:, None] * to_mast, check_finite=False)
    except np.linalg.LinAlgError:  # the others leave open what this board alone tells
        nan = float("nan")
        return LeftOutBoard(board, dots, nan, nan, nan, 0, 1.0, nan, 1.0)
    chi2, freedom = squares + float(pull @ step), max(count - POSE, 1)
    fitted, predicted = _dots(group, step)
    moved, by_luck = _pull(step[mast], without.T @ to_mast, of_mast)
    return LeftOutBoard(board, dots, fitted, predicted, chi2, freedom, chance(chi2, freedom), moved, by_luck)


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


def _dots(group: list[tuple[ImageTerm | StationTerm, Block]], step: FloatArray) -> tuple[float, float]:
    """Rms of a board's dots as fitted, and by the others with its pose fitted again, pixels."""
    ahead = [block.residual + block.jacobian @ step[block.columns] for _, block in group]
    poses = [block.jacobian[:, -POSE:] for _, block in group]
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
