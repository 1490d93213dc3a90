"""Least squares of the images that agree: how every start leaves out images of another board."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from calib.adjust.adjustment import Adjustment
from calib.adjust.gross import gross_limit
from calib.adjust.solver import Minimum, minimise
from calib.adjust.terms import ImageTerm
from calib.adjust.unknowns import Estimate
from calib.geometry.rigid import FloatArray
from calib.geometry.significance import MEDIAN_OF_TWO

LONE = 3.0
"""A point so many times farther off than an image may be is left out by itself."""

ROUNDS = (20, 10, 8)
"""Steps between changes of the weights."""

LAST_STEPS = 500
"""Steps at most of the last fit, which must settle: a narrow field hardly shows the lens, and took 170."""

POINTS = 25
"""Points of an image that show whether it agrees."""


@dataclass(frozen=True, eq=False)
class Agreed:
    """A fit, its images (points that took no part are not kept), and how far the typical image is off (of a
    coordinate, pixels)."""

    fit: Minimum[Estimate]
    images: tuple[ImageTerm, ...]
    typical_px: float


def fit_agreeing(
    problem: Adjustment, start: Estimate, expected_px: float, *, keep_all: bool = False
) -> Agreed | None:
    """Fit with pulls that shrink with the size of a residual (Cauchy), then without on what agrees.

    None if too little agrees, or the last fit does not settle. ``expected_px`` is the residual to expect of a
    coordinate; ``keep_all`` leaves out no image.
    """
    state, images = start, problem.images
    few = [thinned(t, POINTS) for t in images]
    for steps in ROUNDS:
        offs = distances_px(problem, state, few)
        every = np.concatenate([np.zeros(0), *offs])
        seen = every[np.isfinite(every)]
        if len(seen) < 8:
            return None
        typical = max(float(np.median(seen)), expected_px)
        weighted = [_bounded(t, off, typical) for t, off in zip(few, offs, strict=True)]
        several = problem.with_terms(weighted, ())
        state = minimise(several, state, weak=problem.weak, steps=steps, gain=1e-4).state
    offs = distances_px(problem, state, images)
    sizes = typical_sizes(offs)
    limit_px = gross_limit(sizes, expected_px)
    agrees = (sizes < limit_px) | keep_all
    kept: tuple[ImageTerm, ...] = ()
    for _ in range(2):  # a point that only an unfinished lens puts elsewhere comes back
        before = kept
        kept = tuple(
            t.kept((off < LONE * limit_px) & good) for t, off, good in zip(images, offs, agrees, strict=True)
        )
        if sum(t.keep.any() for t in kept) < min(2, len(images)) or sum(t.keep.sum() for t in kept) < 8:
            return None
        if before and all((one.keep == other.keep).all() for one, other in zip(before, kept, strict=True)):
            break
        fit = minimise(problem.with_terms(kept, ()), state, weak=problem.weak, steps=LAST_STEPS, gain=1e-13)
        if not fit.settled:
            return None
        state, offs = fit.state, distances_px(problem, fit.state, images)
    return Agreed(fit, tuple(kept), float(np.median(typical_sizes(offs))))


def best_agreeing(
    starts: Iterable[tuple[Adjustment, Estimate]], expected_px: float, *, keep_all: bool = False
) -> Agreed | None:
    """Return the best of the fits from several starts, or the first that leaves what is expected."""
    best: Agreed | None = None
    for problem, start in starts:
        fit = fit_agreeing(problem, start, expected_px, keep_all=keep_all)
        if fit is not None and (best is None or fit.typical_px < best.typical_px):
            best = fit
        if best is not None and best.typical_px < 3 * expected_px:
            break
    return best


def distances_px(problem: Adjustment, state: Estimate, images: Sequence[ImageTerm]) -> list[FloatArray]:
    """Return how far the points of each image that count are from where they should be (n,), pixels."""
    residuals = problem.residuals(state, images)
    return [
        np.linalg.norm(off.reshape(-1, 2), axis=1) * t.sigma_px[t.keep]
        for t, off in zip(images, residuals, strict=True)
    ]


def typical_sizes(distances: Sequence[FloatArray]) -> FloatArray:
    """Return by image the sigma of a coordinate (k,) that the median distance gives.

    Infinite where most points have no pixel. An image is judged by its median point: some may be wrong.
    """
    medians = [np.median(np.nan_to_num(off, nan=np.inf)) if len(off) else np.inf for off in distances]
    return np.asarray(np.array(medians) / np.sqrt(MEDIAN_OF_TWO))


def thinned(image: ImageTerm, points: int) -> ImageTerm:
    """Return the image with some of its points, spread over all."""
    kept = np.flatnonzero(image.keep)
    few = np.zeros_like(image.keep)
    few[kept[np.linspace(0, len(kept) - 1, min(points, len(kept))).astype(int)]] = True
    return replace(image, keep=few)


def _bounded(image: ImageTerm, distance_px: FloatArray, typical_px: float) -> ImageTerm:
    """The image with the sigma of each point as large as its distance asks."""
    sigma = image.sigma_px.copy()
    sigma[image.keep] = np.maximum(np.hypot(typical_px, distance_px / 2), sigma[image.keep])
    return replace(image.kept(np.isfinite(distance_px)), sigma_px=sigma)
