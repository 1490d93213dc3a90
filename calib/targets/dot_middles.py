"""Where a dot's middle is in an image, to a few hundredths of a pixel.

Each dot's ellipse is fitted to the grey levels around its outline. Model of a dot, in pixels u from its
middle: lit paper b0 + b·u, times 1 less a contrast times the share of the pixel that the dot covers. For a
straight edge blurred by a normal distribution that share is Phi(-d / s), with d the distance from the
outline. The shape is given (by the board's map); middle, size, blur, light and contrast are fitted, for all
dots at once.

A camera does not carry the centre of a circle to the middle of the circle's image. The boundary is carried
over point by point and the centroid of the area inside is taken, which is exact through any lens. Its
difference to the centre's own image corrects the measurement (Song et al. 2024, arXiv 2403.04583).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import ndtr

from calib.geometry.rigid import FloatArray
from calib.targets.boards import Grey8, Levels

PARAMETERS = 8


class DotCentres(NamedTuple):
    """Fitted dots, not-a-number where the fit found none.

    middles_px (n, 2); sigma_px (n,) per axis, from the noise that the fit left; sizes (n,) fitted over given
    radius; contrast_dn (n,).
    """

    middles_px: FloatArray
    sigma_px: FloatArray
    sizes: FloatArray
    contrast_dn: FloatArray


def fit_ellipses(image: Levels, middles_px: FloatArray, shapes_px: FloatArray) -> DotCentres:
    """Fit dots whose places ``middles_px`` (n, 2) are known to a pixel.

    ``shapes_px`` (n, 2, 2) carry the unit circle to each dot's outline; only their size is corrected.
    """
    u, levels, weights = _patches(image, middles_px, shapes_px)
    undo = np.linalg.inv(shapes_px)
    form = undo.transpose(0, 2, 1) @ undo  # u' form u = 1 on the outline
    state = _start(levels, weights, u, form)
    count = len(middles_px)
    open_ = np.ones(count, dtype=bool)
    normal = np.zeros((count, PARAMETERS, PARAMETERS))
    square = np.full(count, np.nan)
    radius = np.sqrt(np.abs(np.linalg.det(shapes_px)))
    farthest = np.minimum(1.5, 0.5 * radius)  # what moves more has not found the dot that was expected
    freedom = weights.sum(axis=1) - PARAMETERS
    for _ in range(8):
        some = np.flatnonzero(open_)
        residual, J = _model(state[some], u[some], form[some], levels[some], weights[some])
        JT = J.transpose(0, 2, 1)
        normal[some] = JT @ J
        square[some] = (residual**2).sum(axis=1)
        gradient = JT @ residual[..., None]
        # The board's drawing gives the size of its dots to a tenth; a small blurred dot's own fit does not.
        weight = square[some] / np.maximum(freedom[some], 1.0) / 0.1**2
        normal[some, 2, 2] += weight
        gradient[:, 2, 0] += weight * (1.0 - state[some, 2])
        damped = normal[some] + 1e-4 * diagonals(normal[some]) + 1e-9 * np.eye(PARAMETERS)
        step = np.linalg.solve(damped, gradient)[..., 0]
        step[:, :2] = np.clip(step[:, :2], -0.5, 0.5)
        state[some] = state[some] + step
        state[some, 2] = np.clip(state[some, 2], 0.5, 2.0)
        state[some, 3] = np.clip(state[some, 3], 0.25, 6.0)
        open_[some] = np.abs(step[:, :2]).max(axis=1) > 2e-3
        if not open_.any():
            break
    noise = np.sqrt(square / np.maximum(freedom, 1.0))
    covariance = np.linalg.inv(normal + 1e-6 * diagonals(normal) + 1e-12 * np.eye(PARAMETERS))
    sigma = noise * np.sqrt((covariance[:, 0, 0] + covariance[:, 1, 1]) / 2)
    good = (freedom > 0) & ~open_ & (np.linalg.norm(state[:, :2], axis=1) < farthest)
    good &= (state[:, 7] > 0.0) & (state[:, 2] > 0.5) & (state[:, 2] < 2.0)
    out = [middles_px + state[:, :2], sigma]
    out += [state[:, 2], state[:, 4] * state[:, 7]]
    for values in out:
        values[~good] = np.nan
    return DotCentres(*out)


def centred(image: Grey8, middles_px: FloatArray, shapes_px: FloatArray) -> FloatArray:
    """Return the middles moved onto the dark spots that they are nearest to, good to some tenths of a pixel.

    Places may be off by most of a dot's radius; shapes as for ``fit_ellipses``.
    """
    middles = middles_px
    for _ in range(3):
        u, levels, weights = _patches(image, middles, shapes_px)
        inside = weights > 0.0
        low = np.where(inside, levels, np.inf).min(axis=1, keepdims=True)
        high = np.where(inside, levels, -np.inf).max(axis=1, keepdims=True)
        darkness = np.where(inside, np.clip((low + high) / 2 - levels, 0.0, None), 0.0)
        total = darkness.sum(axis=1)
        shift = np.einsum("np,npi->ni", darkness, u) / np.where(total > 0.0, total, 1.0)[:, None]
        middles = middles + shift
    return np.asarray(middles)


def windows(
    image: Levels, middles_px: FloatArray, half_px: int, stride: int = 1
) -> tuple[FloatArray, FloatArray, NDArray[np.bool_]]:
    """Return u (n, p, 2), pixels from the middles; grey levels (n, p); which pixels are in the image (n, p).

    A pixel outside has the level of the nearest one inside.
    """
    offsets = np.arange(-half_px, half_px + 1, stride)
    dx, dy = (part.ravel() for part in np.meshgrid(offsets, offsets))
    whole = np.rint(middles_px).astype(np.int64)
    columns, rows = whole[:, :1] + dx, whole[:, 1:] + dy
    height, width = image.shape
    inside = (columns >= 0) & (rows >= 0) & (columns < width) & (rows < height)
    levels = image[np.clip(rows, 0, height - 1), np.clip(columns, 0, width - 1)].astype(np.float64)
    return np.stack([columns - middles_px[:, :1], rows - middles_px[:, 1:]], axis=-1), levels, inside


def _patches(
    image: Levels, middles_px: FloatArray, shapes_px: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return u (n, p, 2), pixels from the middle; grey levels (n, p); weights (n, p), 0 or 1."""
    lengths = np.linalg.svd(shapes_px, compute_uv=False)
    # in dot radii, of which neighbours begin at 3 and are blurred; of a large dot five pixels or blurs beyond
    reach = np.minimum(2.0, 1.0 + 5.0 / lengths[:, 1])
    half = int(np.ceil((reach * lengths[:, 0]).max()))
    stride = max(1, -(-(2 * half + 1) // 60))  # of a large dot every second pixel will do, or every third
    u, levels, inside = windows(image, middles_px, half, stride)
    q = np.linalg.norm(u @ np.linalg.inv(shapes_px).transpose(0, 2, 1), axis=-1)
    return u, levels, (inside & (q < reach[:, None])).astype(np.float64)


def _start(levels: FloatArray, weights: FloatArray, u: FloatArray, form: FloatArray) -> FloatArray:
    """Parameters to begin with: x, y, size, blur, paper, its slopes, contrast."""
    q = np.sqrt(np.einsum("npi,nij,npj->np", u, form, u))
    outermost = (q * weights).max(axis=1, keepdims=True)
    paper = _mean_where(levels, weights * (q > (1.0 + 2.0 * outermost) / 3.0))
    dot = _mean_where(levels, weights * (q < 0.7))
    state = np.zeros((len(levels), PARAMETERS))
    state[:, 2], state[:, 3] = 1.0, 0.8
    state[:, 4], state[:, 7] = paper, 1.0 - dot / np.maximum(paper, 1.0)
    return state


def _mean_where(values: FloatArray, weights: FloatArray) -> FloatArray:
    return np.asarray((values * weights).sum(axis=1) / np.maximum(weights.sum(axis=1), 1.0))


def _model(
    state: FloatArray, u: FloatArray, form: FloatArray, levels: FloatArray, weights: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return what is left of the grey levels (n, p), and the model's derivatives (n, p, 8), both weighted."""
    shifted = u - state[:, None, :2]
    size, blur, contrast = (state[:, k, None] for k in (2, 3, 7))
    slope = shifted @ form
    q = np.sqrt(np.einsum("npi,npi->np", shifted, slope) + 1e-9)
    steep = np.sqrt(np.einsum("npi,npi->np", slope, slope) + 1e-12)
    # |grad q| = steep / q, so that the outline q = size is (q - size) q / steep pixels away.
    distance = (q - size) * q / steep
    z = distance / blur
    covered = ndtr(-z)
    light = state[:, 4, None] + np.einsum("npi,ni->np", u, state[:, 5:7])
    shade = 1.0 - contrast * covered
    edge = light * contrast * np.exp(-0.5 * z * z) * (1.0 / np.sqrt(2.0 * np.pi)) / blur
    J = np.empty((*levels.shape, PARAMETERS))
    J[..., :2] = -edge[..., None] * slope / steep[..., None]
    J[..., 2] = -edge * q / steep
    J[..., 3] = -edge * z
    J[..., 4] = shade
    J[..., 5:7] = u * shade[..., None]
    J[..., 7] = -light * covered
    fitted = light * shade
    J *= weights[..., None]
    return (levels - fitted) * weights, J


def diagonals(matrices: NDArray[np.float64]) -> FloatArray:
    """Return the same matrices with everything off the diagonal nil."""
    return np.asarray(matrices * np.eye(matrices.shape[-1]))


def area_centroids(boundaries_px: ArrayLike) -> FloatArray:
    """Return the centroids (n, 2) of the areas inside smooth closed curves (n, points, 2).

    By Green's theorem: with x(t), y(t) the curve, A = 1/2 int (x y' - y x') dt, and the centroid is 1/(2A)
    int (x² y', -y² x') dt. Derivatives are those of the trigonometric polynomial through the points, so few
    points do for a smooth image of a circle (a polygon of 64 sides is off by 0.16 %).
    """
    boundaries = np.asarray(boundaries_px, dtype=np.float64)
    count = boundaries.shape[1]
    middle = boundaries.mean(axis=1)
    x, y = np.moveaxis(boundaries - middle[:, None], -1, 0)
    frequency = 1j * np.fft.rfftfreq(count, 1.0 / count)
    if count % 2 == 0:
        frequency[-1] = 0.0
    dx, dy = (np.fft.irfft(frequency * np.fft.rfft(c, axis=1), count, axis=1) for c in (x, y))
    area = (x * dy - y * dx).sum(axis=1) / 2
    moments = np.stack([(x * x * dy).sum(axis=1), -(y * y * dx).sum(axis=1)], axis=-1)
    return np.asarray(middle + moments / (2 * area[:, None]))


def bias_through(
    pixel_of: Callable[[FloatArray], FloatArray], centres_m: ArrayLike, radius_m: float
) -> FloatArray:
    """Return centroid of the dot's image minus image of its centre, (n, 2) px, for any map of the plane.

    ``pixel_of`` takes points (..., 2) of the plane, metres, to pixels (..., 2); centres (n, 2) and radius are
    metres. Not-a-number where the map has no pixel for some point of the boundary.
    """
    centres = np.asarray(centres_m, dtype=np.float64)
    angle = np.arange(32) * (2.0 * np.pi / 32)
    around = radius_m * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    boundaries = pixel_of(centres[:, None, :] + around)
    return np.asarray(area_centroids(boundaries) - pixel_of(centres))
