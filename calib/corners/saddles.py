"""Corners where black and white meet crosswise, to a few hundredths of a pixel, fitted to the grey levels.

Model, in pixels u from the corner: light p0 + p·u, plus c times erf(d1 / s1) erf(d2 / s2), with d1 and d2 the
distances from two edges that cross there. Place, both slants, both blurs, light and contrast are fitted, for
all corners at once. Whatever is symmetric about the corner (blur, a pixel's own width, motion during the
exposure) moves nothing. Pixels where the board shows something else than two crossing edges (a marker nearby)
do not count.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import erf

from calib.boards.pattern import Cells
from calib.rigid import FloatArray

Levels = NDArray[np.uint8] | NDArray[np.uint16]

HALF_PX = 8
"""The window reaches so far from a corner, or half-way to the next one where that is nearer."""

LEAST_PIXELS = 24
MARGIN_PX = 1.6
"""A pixel counts if the board shows crossing edges up to so far around it."""

ITERATIONS = 25
SETTLED_PX = 1e-3
START_BLUR_PX, BLUR_PX = 1.0, (0.5, 8.0)
PARAMETERS = 10


class Saddles(NamedTuple):
    """Fitted corners, not-a-number where the fit found none.

    pixels_px (n, 2); sigma_px (n,) one standard deviation per axis, from the noise that the fit left;
    blur_px (n, 2) across the board's columns and rows; contrast (n,) half of white less black; noise (n,)
    root mean square of what the fit left over, in grey levels.
    """

    pixels_px: FloatArray
    sigma_px: FloatArray
    blur_px: FloatArray
    contrast: FloatArray
    noise: FloatArray


def fit_saddles(
    image: Levels,
    pattern: Cells,
    points_m: FloatArray,
    pixels_px: FloatArray,
    jacobians: FloatArray,
    farthest_px: float,
) -> Saddles:
    """Fit corners whose places are known to a pixel or two.

    Parameters
    ----------
    image
        (h, w) grey levels.
    pattern
        What is printed; the corners are crossings in it.
    points_m
        (n, 2) the corners on the board.
    pixels_px
        (n, 2) about where they are.
    jacobians
        (n, 2, 2) d pixel / d metre there.
    farthest_px
        A fit that moves farther has found another corner, and counts as none.
    """
    count = len(points_m)
    nothing = np.full(count, np.nan)
    if count == 0:
        return Saddles(np.empty((0, 2)), nothing, np.empty((0, 2)), nothing, nothing)
    u, levels, weights, sign = _windows(image, pattern, points_m, pixels_px, jacobians)
    state = _start(u, levels, weights, sign, jacobians)
    square, normal, settled = _minimised(state, u, levels, weights)
    freedom = weights.sum(axis=1) - PARAMETERS
    noise = np.sqrt(square / np.maximum(freedom, 1.0))
    covariance = np.linalg.inv(normal + 1e-9 * _diagonals(normal) + 1e-9 * np.eye(PARAMETERS))
    sigma = noise * np.sqrt(np.abs(covariance[:, 0, 0] + covariance[:, 1, 1]) / 2)
    contrast = state[:, 9] * sign
    moved = np.linalg.norm(state[:, :2], axis=1)
    good = settled & (freedom > LEAST_PIXELS) & (moved < farthest_px) & (contrast > 0.0)
    out = Saddles(pixels_px + state[:, :2], sigma, state[:, 4:6].copy(), contrast, noise)
    for values in out:
        values[~good] = np.nan
    return out


def _windows(
    image: Levels, pattern: Cells, points_m: FloatArray, pixels_px: FloatArray, jacobians: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Return u (n, p, 2), pixels from the places; levels (n, p); weights (n, p), 0 or 1; sign (n,).

    The sign is +1 where the lower right of a corner is white.
    """
    offsets = np.arange(-HALF_PX, HALF_PX + 1)
    dx, dy = (part.ravel() for part in np.meshgrid(offsets, offsets))
    whole = np.rint(pixels_px).astype(int)
    columns, rows = whole[:, :1] + dx, whole[:, 1:] + dy
    height, width = image.shape
    inside = (columns >= 0) & (rows >= 0) & (columns < width) & (rows < height)
    levels = image[np.clip(rows, 0, height - 1), np.clip(columns, 0, width - 1)].astype(np.float64)
    u = np.stack([columns - pixels_px[:, :1], rows - pixels_px[:, 1:]], axis=-1)
    undo = np.linalg.inv(jacobians)
    nearby = MARGIN_PX * np.array(
        [[0, 0], [1, 0], [-1, 0], [0, 1], [0, -1], [0.7, 0.7], [0.7, -0.7], [-0.7, 0.7], [-0.7, -0.7]]
    )
    from_corner = np.einsum("nij,npj->npi", undo, u)
    around = np.einsum("nij,kj->nki", undo, nearby)
    places = from_corner[:, :, None] + around[:, None]
    black = pattern.is_black(*np.moveaxis(places + points_m[:, None, None], -1, 0))
    step = 1e-3 * np.sqrt(np.abs(np.linalg.det(undo)))
    sign = np.where(pattern.is_black(points_m[:, 0] + step, points_m[:, 1] + step), -1.0, 1.0)
    crossing = (places[..., 0] > 0) == (places[..., 1] > 0)  # the colour of the lower right
    as_saddle = (black == (crossing == (sign < 0)[:, None, None])).all(axis=2)
    return u, levels, (inside & as_saddle).astype(np.float64), sign


def _start(
    u: FloatArray, levels: FloatArray, weights: FloatArray, sign: FloatArray, jacobians: FloatArray
) -> FloatArray:
    """Parameters to begin with: x, y, two slants, two blurs, light, its slopes, contrast."""
    total = np.maximum(weights.sum(axis=1), 1.0)
    light = (levels * weights).sum(axis=1) / total
    spread = np.sqrt((weights * (levels - light[:, None]) ** 2).sum(axis=1) / total)
    undo = np.linalg.inv(jacobians)
    state = np.zeros((len(u), PARAMETERS))
    # distance from the edge along which x is constant grows as x on the board does
    state[:, 2] = np.arctan2(undo[:, 0, 1], undo[:, 0, 0])
    state[:, 3] = np.arctan2(undo[:, 1, 1], undo[:, 1, 0])
    state[:, 4:6] = START_BLUR_PX
    state[:, 6], state[:, 9] = light, sign * np.maximum(spread, 1.0)
    return state


def _minimised(
    state: FloatArray, u: FloatArray, levels: FloatArray, weights: FloatArray
) -> tuple[FloatArray, FloatArray, NDArray[np.bool_]]:
    """Improve the state in place (Levenberg and Marquardt); return squares, normal matrices, what settled."""
    count = len(state)
    damping = np.full(count, 1e-3)
    open_ = np.ones(count, dtype=bool)
    residual, J = _model(state, u, levels, weights)
    square = (residual**2).sum(axis=1)
    normal = J.transpose(0, 2, 1) @ J
    gradient = (J.transpose(0, 2, 1) @ residual[..., None])[..., 0]
    for _ in range(ITERATIONS):
        some = np.flatnonzero(open_)
        if not len(some):
            break
        damped = (
            normal[some] + damping[some, None, None] * _diagonals(normal[some]) + 1e-9 * np.eye(PARAMETERS)
        )
        step = np.linalg.solve(damped, gradient[some, :, None])[..., 0]
        step[:, :2] = np.clip(step[:, :2], -1.0, 1.0)
        step[:, 2:4] = np.clip(step[:, 2:4], -0.2, 0.2)
        tried = state[some] + step
        tried[:, 4:6] = np.clip(tried[:, 4:6], *BLUR_PX)
        residual, J = _model(tried, u[some], levels[some], weights[some])
        squares = (residual**2).sum(axis=1)
        better = squares < square[some]
        won = some[better]
        state[won], square[won] = tried[better], squares[better]
        JT = J[better].transpose(0, 2, 1)
        normal[won] = JT @ J[better]
        gradient[won] = (JT @ residual[better][..., None])[..., 0]
        damping[some] = np.where(better, damping[some] * 0.2, damping[some] * 8.0)
        small = np.abs(step[:, :2]).max(axis=1) < SETTLED_PX
        open_[some[small & (better | (damping[some] > 1.0))]] = False
    return square, normal, ~open_


def _model(
    state: FloatArray, u: FloatArray, levels: FloatArray, weights: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return what is left of the grey levels (n, p), and its derivatives (n, p, 10), both weighted."""
    away = u - state[:, None, :2]
    J = np.empty((*levels.shape, PARAMETERS))
    edges, slopes, aside = [], [], []
    for k in (0, 1):
        cosine, sine = np.cos(state[:, 2 + k, None]), np.sin(state[:, 2 + k, None])
        blur = state[:, 4 + k, None]
        z = (cosine * away[..., 0] + sine * away[..., 1]) / blur
        edges.append(erf(z / np.sqrt(2.0)))
        slopes.append(np.sqrt(2.0 / np.pi) * np.exp(-0.5 * z * z) / blur)
        aside.append((cosine, sine, -sine * away[..., 0] + cosine * away[..., 1], z))
    contrast = state[:, 9, None]
    for k in (0, 1):
        cosine, sine, along, z = aside[k]
        by_distance = contrast * slopes[k] * edges[1 - k]
        J[..., 2 + k] = by_distance * along
        J[..., 4 + k] = -by_distance * z
        for axis, part in ((0, cosine), (1, sine)):
            J[..., axis] = (J[..., axis] if k else 0.0) - by_distance * part
    J[..., 6] = 1.0
    J[..., 7:9] = away
    J[..., 9] = edges[0] * edges[1]
    fitted = state[:, 6, None] + np.einsum("npi,ni->np", away, state[:, 7:9]) + contrast * J[..., 9]
    J[..., :2] -= state[:, None, 7:9]
    J *= weights[..., None]
    return (levels - fitted) * weights, J


def _diagonals(matrices: FloatArray) -> FloatArray:
    """The same matrices with everything off the diagonal nil."""
    return np.asarray(matrices * np.eye(matrices.shape[-1]))
