"""Least-squares matching: the last step to sub-pixel, with the covariance of the found position.

Model (Gruen 1985, Foerstner 1982): I(p + (1 + D) q) = g T(q) + b over the patch's offsets q from the target,
with the position p (2), the small deformation D (2x2), the gain g and the offset b free. Gauss-Newton on the
grey differences r, with the template's gradient for the image's: step = -(WᵀJ)⁻¹ Wᵀ r. J (n, 8) holds the
model's derivatives; W the same of the slightly smoothed template (instrumental variables: the template's own
noise is in r too, and must not weigh it).

Covariance, with N = WᵀJ:

    cov = N⁻¹ M N⁻ᵀ · n / (n - 8),     M = Σ_i Σ_k w(k) W_i r_i (W_{i+k} r_{i+k})ᵀ,

w a triangle over neighbouring pixels (Bartlett; White 1980, Newey and West 1987 in two dimensions).
Differences of neighbours are not independent: interpolation and blur spread noise over two or three pixels,
relief and a wrong plane over more. The usual σ²N⁻¹ would call such a position too good.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from calib.geometry.rigid import FloatArray
from calib.matching.warp import Grey, Surface, patch_grid

MOST_STEPS = 12
STEP_ENOUGH_PX = 1e-4
WORST_DEFORMATION = 0.5  # beyond it the patch is not the same thing any more
SMOOTH_PX = 0.8  # of the template before its derivative
WORST_CONDITION = 1e15
NARROW = 0.35  # of the Gaussian's sigma: slope and scale come from all of it, the place from its middle
LEAST_COUNT = 0.01  # of a Gaussian weight that is worth computing
_RIGID = [0, 1, 6, 7]  # the columns of place, gain and offset
FLOOR_PX = 0.002  # what cubic interpolation itself leaves, measured without noise


@dataclass(frozen=True, eq=False)
class LeastSquaresMatch:
    """Where the target is, and how well the patch fits there.

    Attributes
    ----------
    pixel_px
        (2,) the target in the destination image.
    covariance_px2
        (2, 2) of that position.
    deformation
        (2, 2) D: what the warp did not foresee, as a linear map of offsets from the target.
    correlation
        Normalised correlation of template and image at the found place, pixels weighted as in the fit, -1..1.
    middle
        The place that the patch's middle alone tells, `NARROW` as wide, the deformation kept.
    """

    pixel_px: FloatArray
    covariance_px2: FloatArray
    deformation: FloatArray
    correlation: float
    middle: LeastSquaresMatch | None = None


def match_least_squares(
    template: Grey,
    centre_px: NDArray[np.intp],
    target_px: FloatArray,
    image: Grey,
    start_px: FloatArray,
    deforming: bool = True,
    correlated_px: int = 3,
    near_px2: FloatArray | None = None,
    counts: FloatArray | None = None,
) -> LeastSquaresMatch | None:
    """Find where the image shows the template, from a start good to about a pixel.

    Parameters
    ----------
    template
        (h, w) grey, its middle on the whole pixel ``centre_px`` (2,).
    target_px
        (2,) the target's place in the template's own pixel grid.
    image
        (h, w) grey.
    start_px
        (2,) about where the target is in the image.
    deforming
        Whether D is free; else it stays zero.
    correlated_px
        Over how many pixels grey differences depend on each other.
    near_px2
        (2, 2) covariance of a Gaussian around the target by which pixels count; all alike if not given.
    counts
        (h, w) by how much the template's pixels count, 0 to 1, beside that; all alike if not given.

    Returns
    -------
    refined
        None if it did not settle, left the image, or found nothing to hold on to.
    """
    from scipy import ndimage  # slow to load, and a daemon that starts does not need it

    height, width = template.shape
    # q: from the target to each patch pixel
    offsets = patch_grid((width // 2, height // 2)) + (centre_px - target_px)
    values = template.astype(np.float64)
    inner = (slice(2, -2), slice(2, -2))  # the border has no two-sided gradient
    q, t = offsets[inner], values[inner]
    jacobian = _columns(_gradient(values)[inner], q, t)
    weights = _columns(_gradient(ndimage.gaussian_filter(values, SMOOTH_PX))[inner], q, t)
    start = np.asarray(start_px, dtype=np.float64)
    surface = Surface.around(image, start + q.min(axis=(0, 1)), start + q.max(axis=(0, 1)), margin_px=3)

    def settled(fit: _PatchFit, counts: FloatArray, deforms: bool, enough_px: float) -> _PatchFit | None:
        part = _counting(counts)
        if part is None:
            return None
        free = slice(None) if deforms else _RIGID
        rates, steps = (one[part][..., free].reshape(-1, 8 if deforms else 4) for one in (jacobian, weights))
        return _settled(fit, surface, q[part], t[part], rates, steps, counts[part], enough_px)

    first = _PatchFit(start, np.zeros((2, 2)))
    if near_px2 is None and counts is None:
        whole = settled(first, np.ones(t.shape), deforming, STEP_ENOUGH_PX)
        return _refined(whole, correlated_px) if whole else None
    held = np.ones(t.shape) if counts is None else np.asarray(counts, dtype=np.float64)[inner]
    wide = held if near_px2 is None else held * gaussian(q, near_px2)
    begun = settled(first, wide, False, 0.05)
    # What bends and hides more than the deformation can follow still has a place.
    whole = (settled(begun, wide, deforming, 10 * STEP_ENOUGH_PX) or begun) if begun else None
    refined = _refined(whole, correlated_px) if whole else None
    if whole is None or refined is None or near_px2 is None:
        return refined
    middle = settled(whole, held * gaussian(q, NARROW**2 * near_px2), False, 10 * STEP_ENOUGH_PX)
    return replace(refined, middle=_refined(middle, correlated_px) if middle else None)


def _counting(counts: FloatArray) -> tuple[slice, slice] | None:
    """The rows and columns of weights (h, w) that count; None if none does."""
    held = counts > LEAST_COUNT
    if not held.any():
        return None
    rows, columns = np.flatnonzero(held.any(axis=1)), np.flatnonzero(held.any(axis=0))
    return slice(int(rows[0]), int(rows[-1]) + 1), slice(int(columns[0]), int(columns[-1]) + 1)


def gaussian(q: FloatArray, covariance_px2: FloatArray) -> FloatArray:
    """Return the weights (h, w) of offsets (h, w, 2), px, by a Gaussian of this (2, 2) covariance: 1 at 0."""
    weights, (x, y) = np.linalg.inv(covariance_px2), (q[..., 0], q[..., 1])
    squares = weights[0, 0] * x * x + (weights[0, 1] + weights[1, 0]) * x * y + weights[1, 1] * y * y
    return np.asarray(np.exp(-0.5 * squares), dtype=np.float64)


def _refined(fit: _PatchFit, correlated_px: int) -> LeastSquaresMatch | None:
    """The place of a settled fit with its covariance; None if that is not finite."""
    t = fit.template
    scores = (fit.weights * fit.rest[:, None]).reshape(*t.shape, -1)
    meat = _sum_of_neighbours(scores, correlated_px)
    n = float(fit.counts.sum() ** 2 / (fit.counts**2).sum())
    parameters = fit.inverse @ meat @ fit.inverse.T * (n / max(n - len(meat), 1.0)) / fit.gain**2
    covariance = parameters[:2, :2] + FLOOR_PX**2 * np.eye(2)
    correlation = _correlation(t.reshape(-1), fit.rest + fit.gain * t.reshape(-1), fit.counts.reshape(-1))
    if not np.isfinite(covariance).all() or not np.isfinite(correlation):
        return None
    return LeastSquaresMatch(fit.position, (covariance + covariance.T) / 2, fit.deformation, correlation)


@dataclass(frozen=True, eq=False)
class _PatchFit:
    """A state of the iteration: place and deformation; once settled also what its covariance is made of."""

    position: FloatArray
    deformation: FloatArray
    gain: float = 1.0
    template: FloatArray = field(default_factory=lambda: np.empty((0, 0)))
    rest: FloatArray = field(default_factory=lambda: np.empty(0))
    counts: FloatArray = field(default_factory=lambda: np.empty(0))
    weights: FloatArray = field(default_factory=lambda: np.empty((0, 0)))
    inverse: FloatArray = field(default_factory=lambda: np.empty((0, 0)))


def _settled(
    fit: _PatchFit,
    surface: Surface,
    q: FloatArray,
    t: FloatArray,
    jacobian: FloatArray,
    weights: FloatArray,
    counts: FloatArray,
    enough_px: float,
) -> _PatchFit | None:
    """Iterate, pixels weighted by ``counts``, until a step is shorter than ``enough_px``; None if none is."""
    weighted = weights * counts.reshape(-1, 1)
    normal = weighted.T @ jacobian
    try:
        inverse = np.asarray(np.linalg.inv(normal), dtype=np.float64)
    except np.linalg.LinAlgError:
        return None
    # Largest entries for norms: within a factor of the matrix' size of the condition.
    if not float(np.abs(normal).max() * np.abs(inverse).max()) < WORST_CONDITION:
        return None
    position, deformation = fit.position, fit.deformation
    photometry = _Photometry(t, counts)
    for _ in range(MOST_STEPS):
        places = position + q + q @ deformation.T
        if not surface.inside(places[[0, 0, -1, -1], [0, -1, 0, -1]]):  # the corners
            return None
        seen = surface.at(places)
        gain, offset = photometry.of(seen)
        if gain <= 0.05:
            return None
        rest = (seen - gain * t - offset).reshape(-1)
        step = -inverse @ (weighted.T @ rest)
        move = step[:2] / gain
        length = float(np.linalg.norm(move))
        if length > 1.0:  # never further than the gradient is good for
            step *= 1.0 / length
            move = step[:2] / gain
        position = position + move
        if len(step) > 4:
            deformation = deformation + (step[2:6] / gain).reshape(2, 2)
        if np.linalg.norm(deformation) > WORST_DEFORMATION:
            return None
        if length < enough_px:
            return _PatchFit(position, deformation, gain, t, rest, counts, weighted, inverse)
    return None


def _gradient(values: FloatArray) -> FloatArray:
    """Return the derivatives (h, w, 2) along x and y, per pixel, of fourth order."""
    from scipy import ndimage  # slow to load, and a daemon that starts does not need it

    taps = np.array([1.0, -8.0, 0.0, 8.0, -1.0]) / 12.0
    return np.stack(
        [ndimage.correlate1d(values, taps, axis=axis, mode="nearest") for axis in (1, 0)], axis=-1
    )


def _columns(gradient: FloatArray, q: FloatArray, t: FloatArray) -> FloatArray:
    """Return the derivatives (h, w, 8) of image minus model: position, deformation by rows, gain, offset."""
    columns = [gradient[..., 0], gradient[..., 1]]
    columns += [gradient[..., a] * q[..., b] for a in (0, 1) for b in (0, 1)]
    return np.stack([*columns, -t, -np.ones_like(t)], axis=-1)


class _Photometry:
    """Gain and offset that bring a template (h, w), weighted by ``counts``, nearest to what is seen."""

    def __init__(self, template: FloatArray, counts: FloatArray) -> None:
        self._shares = counts.reshape(-1) / float(counts.sum())
        self._mean = float(self._shares @ template.reshape(-1))
        self._weights = self._shares * (template.reshape(-1) - self._mean)
        self._variance = max(float(self._weights @ template.reshape(-1)), 1e-12)

    def of(self, seen: FloatArray) -> tuple[float, float]:
        """Return gain and offset of a seen patch (h, w)."""
        gain = float(self._weights @ seen.reshape(-1)) / self._variance
        return gain, float(self._shares @ seen.reshape(-1)) - gain * self._mean


def _correlation(a: FloatArray, b: FloatArray, counts: FloatArray) -> float:
    """Normalised correlation of two grey vectors (n,), weighted."""
    total = float(counts.sum())
    a, b = a - float(counts @ a) / total, b - float(counts @ b) / total
    weighted = counts * a
    return float(weighted @ b) / math.sqrt(max(float(weighted @ a) * float((counts * b) @ b), 1e-12))


def _sum_of_neighbours(scores: FloatArray, reach_px: int) -> FloatArray:
    """Return Σ_i Σ_k w(k) s_i s_{i+k}ᵀ (p, p) of scores (h, w, p), w a triangle of half-width reach + 1."""
    from scipy import ndimage  # slow to load, and a daemon that starts does not need it

    triangle = 1.0 - np.abs(np.arange(-reach_px, reach_px + 1)) / (reach_px + 1.0)
    spread = scores
    for axis in (0, 1):
        spread = ndimage.correlate1d(spread, triangle, axis=axis, mode="constant", cval=0.0)
    p = scores.shape[-1]
    meat = scores.reshape(-1, p).T @ spread.reshape(-1, p)
    return np.asarray((meat + meat.T) / 2)
