"""Corners where black and white meet crosswise, to a few thousandths of a pixel, fitted to the grey levels.

Place, both slants, both blurs, light and contrast are fitted (`saddle_model`), for all corners at once,
where the board shows two crossing edges and nothing else (`saddle_pixels`). Whatever is symmetric about the
corner (blur, a pixel's own width, motion during the exposure) moves nothing, and what the fit leaves over
is the camera's noise: sigma follows from that.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from calib.corners.saddle_model import (
    BLURS,
    CONTRAST,
    LIGHT,
    PARAMETERS,
    SLANTS,
    TOGETHER,
    residuals,
    wide_px,
)
from calib.corners.saddle_pixels import Crossings, Levels, Pixels, pixels_about, sharpness_px
from calib.rigid import FloatArray

LEAST_PIXELS = 24
ITERATIONS = 25
ROUGH_PX, SETTLED_PX, UNDAMPED = 0.05, 1e-3, 1e-2
START_PX, BLUR_PX = (0.8, 4.0), (0.14, 8.0)
MOST_TOGETHER = 0.9

WIDER = 1.25
"""Where an edge turns out so much wider than it was taken for, the pixels that count are chosen again."""


class Saddles(NamedTuple):
    """Fitted corners, not-a-number where the fit found none.

    pixels_px (n, 2); sigma_px (n,) one standard deviation per axis, from the noise that the fit left;
    wide_px (n, 2) standard deviation of what blurs the edges, pixels included, across columns and rows;
    contrast (n,) half of white less black; noise (n,) root mean square of what the fit left over, in grey
    levels.
    """

    pixels_px: FloatArray
    sigma_px: FloatArray
    wide_px: FloatArray
    contrast: FloatArray
    noise: FloatArray


def fit_saddles(
    image: Levels, crossings: Crossings, pixels_px: FloatArray, jacobians: FloatArray, farthest_px: float
) -> Saddles:
    """Fit corners whose places are known to a pixel or two.

    Parameters
    ----------
    image
        (h, w) grey levels.
    crossings
        The n corners on the print.
    pixels_px
        (n, 2) about where they are.
    jacobians
        (n, 2, 2) d pixel / d metre there.
    farthest_px
        A fit that moves farther has found another corner, and counts as none.
    """
    if not len(pixels_px):
        nothing = np.empty(0)
        return Saddles(np.empty((0, 2)), nothing, np.empty((0, 2)), nothing, nothing)
    signs = crossings.signs(jacobians)
    slopes = np.linalg.norm(np.linalg.inv(jacobians), axis=2)  # of the board's x and y, m/px
    insets = np.column_stack([crossings.inset_m / slopes, signs])
    wide = np.clip(sharpness_px(image, pixels_px), *START_PX)
    pixels = pixels_about(image, crossings, pixels_px, jacobians, wide)
    state = _start(pixels, signs, jacobians, wide)
    _minimised(state, pixels, insets, ROUGH_PX)
    # what is printed nearby reaches farther where edges are wider than they were taken for
    wider = np.flatnonzero(
        (wide_px(state).max(axis=1) > WIDER * wide) & (np.hypot(*state[:, :2].T) < farthest_px)
    )
    if len(wider):
        shift = state[wider, :2]
        chosen = pixels_about(
            image,
            crossings.some(wider),
            pixels_px[wider] + shift,
            jacobians[wider],
            wide_px(state[wider]).max(axis=1),
        )
        pixels.u[wider] = chosen.u + shift[:, None]
        pixels.levels[wider], pixels.weights[wider] = chosen.levels, chosen.weights
    square, normal, settled = _minimised(state, pixels, insets, SETTLED_PX)
    freedom = pixels.weights.sum(axis=1) - PARAMETERS
    noise = np.sqrt(square / np.maximum(freedom, 1.0))
    covariance = np.linalg.inv(normal + 1e-9 * (_diagonals(normal) + np.eye(PARAMETERS)))
    sigma = noise * np.sqrt(np.abs(covariance[:, 0, 0] + covariance[:, 1, 1]) / 2)
    contrast = state[:, CONTRAST] * signs
    moved_px = np.linalg.norm(state[:, :2], axis=1)
    good = settled & (freedom > LEAST_PIXELS) & (moved_px < farthest_px) & (contrast > 0.0)
    found = Saddles(pixels_px + state[:, :2], sigma, wide_px(state), contrast, noise)
    for values in found:
        values[~good] = np.nan
    return found


def _start(pixels: Pixels, signs: FloatArray, jacobians: FloatArray, wide: FloatArray) -> FloatArray:
    """Return parameters to begin with."""
    levels, weights = pixels.levels, pixels.weights
    total = np.maximum(weights.sum(axis=1), 1.0)
    light = (levels * weights).sum(axis=1) / total
    spread = np.sqrt((weights * (levels - light[:, None]) ** 2).sum(axis=1) / total)
    undo = np.linalg.inv(jacobians)
    state = np.zeros((len(levels), PARAMETERS))
    # distance from the edge along which x is constant grows as x on the board does
    slants = np.arctan2(undo[:, :, 1], undo[:, :, 0])
    state[:, SLANTS], state[:, BLURS] = slants, 0.9 * wide[:, None]
    state[:, LIGHT], state[:, CONTRAST] = light, signs * np.maximum(spread, 1.0)
    state[:, TOGETHER] = np.clip(np.cos(slants[:, 0] - slants[:, 1]), -MOST_TOGETHER, MOST_TOGETHER)
    return state


def _minimised(
    state: FloatArray, pixels: Pixels, insets: FloatArray, settled_px: float
) -> tuple[FloatArray, FloatArray, NDArray[np.bool_]]:
    """Improve the state in place (Levenberg and Marquardt); return squares, normal matrices, what settled."""
    count = len(state)
    damping = np.full(count, 1e-3)
    open_ = np.ones(count, dtype=bool)
    residual, J = residuals(state, *pixels, insets)
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
        step[:, SLANTS] = np.clip(step[:, SLANTS], -0.2, 0.2)
        tried = state[some] + step
        tried[:, BLURS] = np.clip(tried[:, BLURS], *BLUR_PX)
        tried[:, TOGETHER] = np.clip(tried[:, TOGETHER], -MOST_TOGETHER, MOST_TOGETHER)
        residual, J = residuals(tried, *pixels.some(some), insets[some])
        squares = (residual**2).sum(axis=1)
        better = squares < square[some]
        won = some[better]
        state[won], square[won] = tried[better], squares[better]
        JT = J[better].transpose(0, 2, 1)
        normal[won] = JT @ J[better]
        gradient[won] = (JT @ residual[better][..., None])[..., 0]
        before = damping[some]
        damping[some] = np.where(better, damping[some] * 0.2, damping[some] * 8.0)
        # a small step that gains nothing: at the bottom, unless damping made it small
        bottom = better | (before < UNDAMPED) | (damping[some] > 1.0)
        open_[some[(np.abs(step[:, :2]).max(axis=1) < settled_px) & bottom]] = False
    return square, normal, ~open_


def _diagonals(matrices: FloatArray) -> FloatArray:
    """The same matrices with everything off the diagonal nil."""
    return np.asarray(matrices * np.eye(matrices.shape[-1]))
