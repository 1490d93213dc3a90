"""Which measurements cannot belong to the rest: explicit tests of standardised residuals.

A measurement with residual r (in sigmas) and Jacobian J has, if all is right, cov(r) = I - J C Jᵀ (I + J C Jᵀ
where it was not fitted), C being the covariance of the unknowns; rᵀ cov(r)⁻¹ r is chi-square. Limits are set
so that one survey in a hundred without blunders loses any dot, or any tape or prism, and one in ten thousand
any image.

A whole image is judged by all its dots at once, against what the other measurements predict of it: the error
of that prediction moves the dots together, and counts once. The statistic is what the sum of squares falls by
if the image is left out, whether it was fitted or not, so that every image is tested again whenever the fit
has changed. The station's stated sigma may be too small: its typical point then says by how much, and limits
widen with it. Blunders hide one another, so the worst goes first and the fit is done
again.

Taken out of the normal equations, the dots of an image leave the others with another minimum and the
covariance C = (N - JᵀJ)⁻¹. The error of that prediction moves the dots together: their residuals r have
the covariance I + J C Jᵀ, and with A = J L, L Lᵀ = C, Woodbury's identity gives

    rᵀ (I + A Aᵀ)⁻¹ r = rᵀr - bᵀ (I + AᵀA)⁻¹ b,    b = Aᵀr.

That is chi-square, and what the sum of squares falls by if the image is left out. It is the same number
whether the image was fitted or not.

A dot counts by its image's own sigma (`calib.adjust.noise`), so that a noisy image fails nothing. A whole
image fails by a coherent shift alone: what its dots scatter about a smooth map widens its limit, for some of
them may be noisier than others, as corners whose edges run along rows of pixels are. Where a camera's typical
dot is off by more than that, as with a lens that its model does not fit or a camera that changed, its limits
widen by as much, up to a bound: it is not single images that are wrong there, and the tests of wider models
say what is.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from calib.adjust.adjustment import Adjustment, bounded_weights
from calib.adjust.gross import GROSS, MANY, Outlier, at_least_stated, chance_limit
from calib.adjust.noise import scatter
from calib.adjust.terms import ImageTerm, StationTerm
from calib.adjust.unknowns import Estimate, ResidualBlock
from calib.geometry.rigid import FloatArray
from calib.geometry.significance import Level, typical_scale

REDUNDANT = 0.02
"""Directions of a residual with less than this part of the noise left in them cannot be tested."""

SOLE = 1e-6
"""Part of what is known of an unknown that the others are taken to contribute at least: it is inverted."""

REPEATS = 3
"""Times that the dots of an image are judged by one another."""

TELL_APART = 8
"""With more images of a board than this, the rest says which of two is wrong."""

PRISMS_LEFT = 3
"""A set-up keeps at least so many prisms: with fewer nothing says which of them is wrong."""


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


class _Tests:
    """Every image and every station point at a fitted state, tested by the rest.

    Where the typical measurement is farther off than its sigma says, limits are wider by as much.
    """

    def __init__(
        self, problem: Adjustment, state: Estimate, covariance: FloatArray, all_images: Sequence[ImageTerm]
    ) -> None:
        self.images = problem.images
        self.dots: list[FloatArray] = []
        self.predicted: list[LeftOut] = []
        fitted: dict[str, list[FloatArray]] = {term.camera: [np.zeros(0)] for term in problem.images}
        for block, term in zip(problem.blocks_of(state, all_images), problem.images, strict=True):
            mine = covariance[np.ix_(block.columns, block.columns)]
            self.dots.append(statistics(block.residual, block.jacobian, mine, term.keep)[0])
            self.predicted.append(left_out(block, mine, term.keep, problem.huber))
            fitted[term.camera].append(self.dots[-1][term.keep])
        self.points: list[tuple[float, int]] = []
        for block, point in zip(problem.blocks_of(state, problem.station), problem.station, strict=True):
            mine = covariance[np.ix_(block.columns, block.columns)]
            one, freedom = statistics(block.residual, block.jacobian, mine, np.array([point.keep]))
            self.points.append((float(one[0]), int(freedom[0])))
        typical = {camera: np.concatenate(mine) for camera, mine in fitted.items()}
        whole = at_least_stated(np.concatenate([np.zeros(0), *typical.values()]))
        self._dot_scales = {
            camera: max(whole, min(typical_scale(mine), GROSS**2)) for camera, mine in typical.items()
        }
        kept = zip(self.points, problem.station, strict=True)
        self._point_scale = at_least_stated(np.array([s for (s, n), p in kept if p.keep and n == 3]), 3)

    def dot_limit(self, camera: str) -> float:
        """Beyond what a dot fails."""
        return chance_limit(Level.MEASUREMENT, sum(map(len, self.dots))) * self._dot_scales[camera]

    def point_limit(self, freedom: int) -> float:
        """Beyond what a prism or tape fails of which so many numbers are checked."""
        return chance_limit(Level.MEASUREMENT, len(self.points), freedom) * self._point_scale

    def image(self, index: int) -> tuple[np.ndarray, float, float, bool]:
        """Which dots (n,) are good; chi-square of these together, or of all if too many are not, and its
        limit; and whether the image fails."""
        term, predicted = self.images[index], self.predicted[index]
        most = self.dot_limit(term.camera)
        good = self.dots[index] <= most
        if not term.keep.any():
            good = predicted.agreeing(good, most)
        many_bad = bool(good.mean() < 1 - MANY)
        statistic, freedom = predicted.statistic(np.isfinite(self.dots[index]) if many_bad else good)
        own = scatter(term, predicted.residual, good)
        scale = max(self._dot_scales[term.camera], min(own.square, GROSS**2) if own else 1.0)
        limit = chance_limit(Level.WHOLE, len(self.images), max(freedom, 1)) * scale
        return good, statistic, limit, many_bad or statistic > limit


def judge(
    problem: Adjustment, state: Estimate, covariance: FloatArray, all_images: Sequence[ImageTerm]
) -> tuple[list[ImageTerm], list[StationTerm]]:
    """Return the terms at a fitted state with the worst left out and what passes readmitted.

    What the fit's terms keep was not left out so far. ``all_images`` are the problem's in its order, with
    every dot that was measured.
    """
    tests = _Tests(problem, state, covariance, all_images)
    images, station = list(problem.images), list(problem.station)
    suspect, excess = None, 0.0
    for index, term in enumerate(problem.images):
        good, statistic, limit, fails = tests.image(index)
        if not fails:
            images[index] = replace(term, keep=good)
        elif term.keep.any() and (suspect is None or statistic - limit > excess):
            # The sum of squares falls by that much without it: most without the one that pulls others along.
            suspect, excess = index, statistic - limit
    if suspect is not None:
        suspect = _culprit(problem, state, suspect)
        images[suspect] = replace(images[suspect], keep=np.zeros_like(images[suspect].keep))
    worst, worst_ratio = None, 1.0
    for index, (point, (statistic, freedom)) in enumerate(zip(problem.station, tests.points, strict=True)):
        ratio = statistic / tests.point_limit(freedom) if freedom else np.inf
        if not point.keep and ratio <= 1.0:
            station[index] = replace(point, keep=True)
        # A tape or prism cannot pull hundreds of dots along: where an image fails, it goes first.
        if point.keep and freedom and suspect is None and ratio > worst_ratio and _may_go(problem, point):
            worst, worst_ratio = index, ratio
    if worst is not None:
        station[worst] = replace(station[worst], keep=False)
    return images, station


def name_outliers(
    problem: Adjustment, state: Estimate, all_images: Sequence[ImageTerm]
) -> tuple[Outlier, ...]:
    """Return everything that the problem leaves out, and how far off it is."""
    found: list[Outlier] = []
    for whole, term in zip(all_images, problem.images, strict=True):
        if term.keep.all():
            continue
        off_px = problem.residuals(state, [whole])[0].reshape(-1, 2) * whole.sigma_px[:, None]
        if not term.keep.any():
            size = float(np.sqrt(np.mean(np.sum(off_px**2, axis=1))))
            found.append(Outlier("image", f"image {term.name}", size))
            continue
        for row in np.flatnonzero(~term.keep):
            size = float(np.linalg.norm(off_px[row]))
            found.append(Outlier("dot", f"image {term.name} {term.part(int(row))}", size))
    for point in problem.station:
        if not point.keep:
            size = float(np.linalg.norm(problem.residuals(state, [point])[0]) * point.sigma_m)
            found.append(Outlier("prism" if point.board is None else "tape", point.name, size))
    return tuple(found)


def _culprit(problem: Adjustment, state: Estimate, suspect: int) -> int:
    """Which image of the suspect's board is to blame: the one without which the others and the tapes agree.

    Two images that contradict each other look equally bad where the fit has ended between them. A tape may be
    the wrong one as well: without it the sum of squares counts, and what a good tape may be off by.
    """
    board = problem.images[suspect].board
    together = [i for i, t in enumerate(problem.images) if t.board == board and t.keep.any()]
    if not 2 <= len(together) <= TELL_APART:
        return suspect
    tapes = [p for p in problem.station if p.board == board and p.keep]
    blocks = problem.blocks_of(state, [*(problem.images[i] for i in together), *tapes])
    rates = [block.rates(("board", board)) for block in blocks]
    matrices = np.array([r.T @ r for r in rates])
    pulls = np.array([r.T @ block.residual for r, block in zip(rates, blocks, strict=True)])
    squares = np.array([block.residual @ block.residual for block in blocks])
    allowed = chance_limit(Level.MEASUREMENT, len(problem.station), 3)

    def misfit(left_out: list[int]) -> float:
        """Sum of squares of the others with the board's pose fitted to them alone."""
        used = np.setdiff1d(np.arange(len(blocks)), left_out)
        pull = pulls[used].sum(axis=0)
        step = np.linalg.lstsq(matrices[used].sum(axis=0), pull, rcond=None)[0]
        return float(squares[used].sum() - pull @ step)

    misfits = {
        image: min(
            misfit([at]),
            *(misfit([at, tape]) + allowed for tape in range(len(together), len(blocks))),
            np.inf,
        )
        for at, image in enumerate(together)
    }
    best = min(misfits, key=lambda image: misfits[image])
    return best if misfits[best] < misfits[suspect] else suspect


def _may_go(problem: Adjustment, point: StationTerm) -> bool:
    """Whether a set-up has prisms enough without this one; tapes may always go.

    Prisms are all that contradicts a mast taken as upright (four parameters): there they stay.
    """
    if point.board is not None:
        return True
    kept = sum(p.setup == point.setup and p.board is None and p.keep for p in problem.station)
    return kept > PRISMS_LEFT and not problem.upright
