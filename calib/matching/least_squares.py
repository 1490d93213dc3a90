"""Least-squares matching: the last step to sub-pixel, with the covariance of the found position.

Model (Gruen 1985, Foerstner 1982): I(p + (1 + D) q) = g T(q) + b over the patch's offsets q from the target,
with the position p (2), the small deformation D (2x2), the gain g and the offset b free. Gauss-Newton on the
grey differences r, with the template's gradient for the image's: step = -(WᵀJ)⁻¹ Wᵀ r. J (n, 8) holds the
model's derivatives; W the same of the slightly smoothed template (instrumental variables: the template's own
noise is in r too, and must not weigh it).

Covariance, by leaving out one block b of pixels at a time (the jackknife of Tukey 1958; over groups, Bell and
McCaffrey 2002), with N = WᵀJ:

    cov = (B - 1) / B · Σ_b d_b d_bᵀ,     d_b = (N - N_b)⁻¹ Σ_{i in b} W_i r_i.

Differences of neighbours are not independent: interpolation, blur and colour filters spread noise over two or
three pixels, relief and a wrong plane over more, and all along an edge alike. The usual σ²N⁻¹ would call such
a position too good. So would the sum of W_i r_i (W_k r_k)ᵀ over near pairs (White 1980, Newey and West 1987)
where few strong edges fix the place, since these are what the fit has fitted.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from itertools import pairwise, product

import numpy as np
from numpy.typing import NDArray

from calib.geometry.rigid import FloatArray
from calib.matching.warp import Grey, Surface, patch_grid

STEP_ENOUGH_PX = 1e-4
NARROW = 0.35  # of the Gaussian's sigma: slope and scale come from all of it, the place from its middle
LEAST_COUNT = 0.01  # of a Gaussian weight that is worth computing
_RIGID = [0, 1, 6, 7]  # the columns of place, gain and offset


@dataclass(frozen=True, eq=False)
class LeastSquaresMatch:
    """Where the target is (2,) in the destination image, and how well the patch fits there.

    ``deformation`` (2, 2) is D: what the warp did not foresee, as a linear map of offsets from the target.
    ``correlation`` of template and image, -1..1, is weighted by ``counts`` and ``near_px2`` alone. ``middle``
    is the place that the patch's middle alone shows, `NARROW` as wide, the deformation kept.
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
    block_px: float,
    near_px2: FloatArray | None = None,
    counts: FloatArray | None = None,
) -> LeastSquaresMatch | None:
    """Find where the image (h, w) shows the template, from a start (2,) good to about a pixel.

    None if it did not settle, left the image, or found nothing to fix a place by. The middle of the template
    (h, w) is on the whole pixel ``centre_px`` (2,), the target at ``target_px`` (2,) of its own pixel grid.
    ``block_px`` is the side of the blocks of pixels: over how many grey differences may depend on each other.
    Pixels are weighted by a Gaussian around the target of covariance ``near_px2`` (2, 2), and by ``counts``
    (h, w), 0 to 1; all alike by default.
    """
    from scipy import ndimage  # slow to load, and a daemon that starts does not need it

    height, width = template.shape
    # q: from the target to each patch pixel
    offsets = patch_grid((width // 2, height // 2)) + (centre_px - target_px)
    values = template.astype(np.float64)
    inner = (slice(2, -2), slice(2, -2))  # the border has no two-sided gradient
    q, t = offsets[inner], values[inner]
    jacobian = _columns(_gradient(values)[inner], q, t)
    # The template is smoothed before its derivative.
    weights = _columns(_gradient(ndimage.gaussian_filter(values, 0.8))[inner], q, t)
    start = np.asarray(start_px, dtype=np.float64)
    surface = Surface.around(image, start + q.min(axis=(0, 1)), start + q.max(axis=(0, 1)), margin_px=3)

    def settled(fit: _PatchFit, counts: FloatArray, deforms: bool, enough_px: float) -> _PatchFit | None:
        heavy = np.asarray(counts > LEAST_COUNT)
        rows, columns = (np.flatnonzero(heavy.any(axis=axis)) for axis in (1, 0))
        if not len(rows):
            return None
        part = slice(int(rows[0]), int(rows[-1]) + 1), slice(int(columns[0]), int(columns[-1]) + 1)
        free = slice(None) if deforms else _RIGID
        rates, steps = (one[part][..., free].reshape(-1, 8 if deforms else 4) for one in (jacobian, weights))
        return _settled(fit, surface, q[part], t[part], rates, steps, counts[part], enough_px)

    first = _PatchFit(start, np.zeros((2, 2)))
    own = np.ones(t.shape) if counts is None else np.asarray(counts, dtype=np.float64)[inner]
    wide = own if near_px2 is None else own * gaussian(q, near_px2)
    if near_px2 is None and counts is None:
        whole = settled(first, wide, True, STEP_ENOUGH_PX)
    else:
        begun = settled(first, wide, False, 0.05)
        # What bends and hides more than the deformation can follow still has a place.
        whole = (settled(begun, wide, True, 10 * STEP_ENOUGH_PX) or begun) if begun else None
    if whole is None:
        return None
    if near_px2 is None:
        alike = wide * _alike(whole, surface, q, t, wide)
        refined = _refined(settled(whole, alike, True, 10 * STEP_ENOUGH_PX) or whole, block_px)
        # What looks different moves the place less, but it must not make a false place look right.
        return replace(refined, correlation=whole.correlation) if refined else None
    refined = _refined(whole, block_px)
    if refined is None:
        return None
    middle = settled(whole, own * gaussian(q, NARROW**2 * near_px2), False, 10 * STEP_ENOUGH_PX)
    return replace(refined, middle=_refined(middle, block_px) if middle else None)


def _alike(fit: _PatchFit, surface: Surface, q: FloatArray, t: FloatArray, counts: FloatArray) -> FloatArray:
    """Weights (h, w) of pixels: less where the picture shows something else all around them.

    Dust on the lens, a reflection, a shadow's edge: smooth and as wide as some blocks, so that leaving out
    single blocks does not show what they shift.
    """
    from scipy import ndimage  # slow to load, and a daemon that starts does not need it

    seen = surface.at(fit.position + q + q @ fit.deformation.T)
    gain, offset = _photometry(t, counts)(seen)
    # One sigma of the Gaussian by which neighbours say together that a place shows something else.
    total, rest = (
        ndimage.gaussian_filter(values, 4.0, mode="constant")
        for values in (counts, counts * (seen - gain * t - offset))
    )
    mean = rest / np.maximum(total, LEAST_COUNT)
    usual = 1.4826 * float(np.median(np.abs(mean[counts > LEAST_COUNT])))
    # At 2.5 times what is usual a place is weighted by a quarter.
    return np.asarray(1.0 / (1.0 + (mean / max(2.5 * usual, 1e-6)) ** 2) ** 2)


def gaussian(q: FloatArray, covariance_px2: FloatArray) -> FloatArray:
    """Return the weights (h, w) of offsets (h, w, 2), px, by a Gaussian of this (2, 2) covariance: 1 at 0."""
    weights, (x, y) = np.linalg.inv(covariance_px2), (q[..., 0], q[..., 1])
    squares = weights[0, 0] * x * x + (weights[0, 1] + weights[1, 0]) * x * y + weights[1, 1] * y * y
    return np.asarray(np.exp(-0.5 * squares), dtype=np.float64)


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
    rates: FloatArray = field(default_factory=lambda: np.empty((0, 0)))

    @property
    def correlation(self) -> float:
        """Normalized correlation of template and image, pixels weighted as in the fit."""
        t, counts = self.template.reshape(-1), self.counts.reshape(-1)
        a, b = (one - float(counts @ one) / float(counts.sum()) for one in (t, self.rest + self.gain * t))
        weighted = counts * a
        return float(weighted @ b) / math.sqrt(max(float(weighted @ a) * float((counts * b) @ b), 1e-12))


def _refined(fit: _PatchFit, block_px: float) -> LeastSquaresMatch | None:
    """The place of a settled fit with its covariance; None if that is not finite."""
    t = fit.template
    rows, columns = (np.linspace(0, side, max(2, round(side / block_px)) + 1).astype(int) for side in t.shape)
    weights, rates = (one.reshape(*t.shape, -1) for one in (fit.weights, fit.rates))
    rest, terms = fit.rest.reshape(t.shape), weights.shape[-1]
    normals, pulls = [], []
    for y, x in product(pairwise(rows), pairwise(columns)):
        block = slice(*y), slice(*x)
        own = weights[block].reshape(-1, terms)
        normals.append(own.T @ rates[block].reshape(-1, terms))
        pulls.append(own.T @ rest[block].reshape(-1))
    try:
        others = np.sum(normals, axis=0) - np.array(normals)
        moved = np.linalg.solve(others, np.array(pulls)[..., None])[..., 0]
    except np.linalg.LinAlgError:
        return None
    place = moved[:, :2] / fit.gain
    # 0.002: what cubic interpolation itself leaves, measured without noise.
    covariance = (1.0 - 1.0 / len(place)) * place.T @ place + 0.002**2 * np.eye(2)
    correlation = fit.correlation
    if not np.isfinite(covariance).all() or not np.isfinite(correlation):
        return None
    return LeastSquaresMatch(fit.position, covariance, fit.deformation, correlation)


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
    if not float(np.abs(normal).max() * np.abs(inverse).max()) < 1e15:
        return None
    position, deformation = fit.position, fit.deformation
    photometry = _photometry(t, counts)
    for _ in range(12):
        places = position + q + q @ deformation.T
        if not surface.inside(places[[0, 0, -1, -1], [0, -1, 0, -1]]):  # the corners
            return None
        seen = surface.at(places)
        gain, offset = photometry(seen)
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
        # 0.5: beyond it the patch is not the same thing any more.
        if np.linalg.norm(deformation) > 0.5:
            return None
        if length < enough_px:
            return _PatchFit(position, deformation, gain, t, rest, counts, weighted, jacobian)
    return None


def _gradient(values: FloatArray) -> FloatArray:
    """Return the derivatives (h, w, 2) along x and y, per pixel, of fourth order."""
    from scipy import ndimage  # slow to load, and a daemon that starts does not need it

    taps = np.array([1.0, -8.0, 0.0, 8.0, -1.0]) / 12.0
    both = [ndimage.correlate1d(values, taps, axis=axis, mode="nearest") for axis in (1, 0)]
    return np.stack(both, axis=-1)


def _columns(gradient: FloatArray, q: FloatArray, t: FloatArray) -> FloatArray:
    """Return the derivatives (h, w, 8) of image minus model: position, deformation by rows, gain, offset."""
    deformed = (gradient[..., :, None] * q[..., None, :]).reshape(*t.shape, 4)
    return np.concatenate([gradient, deformed, -t[..., None], -np.ones_like(t)[..., None]], axis=-1)


def _photometry(template: FloatArray, counts: FloatArray) -> Callable[[FloatArray], tuple[float, float]]:
    """Return what gives gain and offset that bring a weighted template (h, w) nearest to what is seen."""
    shares, t = counts.reshape(-1) / float(counts.sum()), template.reshape(-1)
    mean = float(shares @ t)
    weights = shares * (t - mean)
    variance = max(float(weights @ t), 1e-12)

    def brought(seen: FloatArray) -> tuple[float, float]:
        gain = float(weights @ seen.reshape(-1)) / variance
        return gain, float(shares @ seen.reshape(-1)) - gain * mean

    return brought
