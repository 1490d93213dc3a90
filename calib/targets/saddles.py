"""Corners where black and white meet crosswise, to a few thousandths of a pixel, fitted to the grey levels.

Model: light p0 + p·u, u in pixels from the corner, plus c times what is left of sign(d1) sign(d2) behind a
lens and square pixels, d1 and d2 being the distances from the two edges. A lens blurs by a normal
distribution, wider one way than the other where the camera moved; so the two distances have a correlation,
which is not nil where the edges are slanted against each other. In the white squares markers may begin not
far away.

Place, both slants, both blurs, light and contrast are fitted, for all corners at once, on the pixels about
each that show two crossing edges and nothing else. Whatever is symmetric about the corner (blur, a pixel's
own width, motion during the exposure) moves nothing, and what the fit leaves over is the camera's noise:
sigma follows from that.
"""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.special import erf

from calib.geometry.rigid import FloatArray, IntArray
from calib.targets.boards import Levels
from calib.targets.dot_middles import diagonals, windows
from calib.targets.pattern import Cells

PARAMETERS = 11
X, Y, SLANTS, BLURS, LIGHT, SLOPES, CONTRAST, TOGETHER = 0, 1, slice(2, 4), slice(4, 6), 6, slice(7, 9), 9, 10
"""Where each is among the parameters. BLURS is the lens's part, TOGETHER the correlation."""

ROOT_2 = np.sqrt(2.0)


class Edge(NamedTuple):
    """An edge through the corner, from -1 to 1.

    normal: its cosine and sine (n, 1); wide (n, 1), the standard deviation of all that blurs it; then (n, p):
    along it, pixels; z, distance over ``wide``; step, its profile; slope and by_blur, its derivatives.
    """

    normal: tuple[FloatArray, FloatArray]
    along: FloatArray
    z: FloatArray
    wide: FloatArray
    step: FloatArray
    slope: FloatArray
    by_blur: FloatArray


def residuals(
    state: FloatArray, u: FloatArray, levels: FloatArray, weights: FloatArray, insets: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return what the model leaves of grey levels (n, p), and the model's derivatives (n, p, 11).

    ``state`` (n, 11) are the parameters, ``u`` (n, p, 2) pixels from where the corners were expected,
    ``weights`` (n, p) those of both answers. ``insets`` (n, 3): so far from either edge, pixels, a marker
    begins (infinite: none), and the sign of the quarter right of and below the corner, +1 where it is white.
    """
    away = u - state[:, None, :2]
    J = np.empty((*levels.shape, PARAMETERS))
    edges = [edge(away, state[:, 2 + k, None], state[:, 4 + k, None]) for k in (0, 1)]
    crossed, by_z, by_together = _crossed(edges[0].z, edges[1].z, state[:, TOGETHER, None])
    contrast = state[:, CONTRAST, None]
    for k, one in enumerate(edges):
        other = edges[1 - k].step
        by_distance = contrast * (one.slope * other + by_z[k] / one.wide)
        blur_part = state[:, 4 + k, None] / one.wide**2
        J[..., 2 + k] = by_distance * one.along
        J[..., 4 + k] = contrast * (one.by_blur * other - blur_part * by_z[k] * one.z)
        for axis, part in enumerate(one.normal):
            J[..., axis] = (J[..., axis] if k else 0.0) - by_distance * part
    J[..., LIGHT] = 1.0
    J[..., SLOPES] = away
    J[..., CONTRAST] = edges[0].step * edges[1].step + crossed
    if np.isfinite(insets).all():
        J[..., CONTRAST] -= _markers(edges, insets)
    J[..., TOGETHER] = contrast * by_together
    slopes = state[:, None, SLOPES]
    fitted = state[:, LIGHT, None] + (away * slopes).sum(axis=2) + contrast * J[..., CONTRAST]
    J[..., :2] -= slopes
    J *= weights[..., None]
    return (levels - fitted) * weights, J


def edge(away: FloatArray, slant: FloatArray, blur: FloatArray) -> Edge:
    """Return a step seen through a lens (normal distribution, ``blur``) and through square pixels.

    A pixel's square is drawn as two lines along the edge, ``apart`` from its middle, with the blur's rest;
    together they have the first four moments of the square.
    """
    cosine, sine = np.cos(slant), np.sin(slant)
    apart = _apart(slant)
    distance = cosine * away[..., 0] + sine * away[..., 1]
    near, far = (distance + apart) / blur, (distance - apart) / blur
    bells = [np.exp(-0.5 * z * z) / (np.sqrt(2.0 * np.pi) * blur) for z in (near, far)]
    step = 0.5 * (erf(near / ROOT_2) + erf(far / ROOT_2))
    wide = np.hypot(blur, apart)
    along = cosine * away[..., 1] - sine * away[..., 0]
    by_blur = -(near * bells[0] + far * bells[1])
    return Edge((cosine, sine), along, distance / wide, wide, step, bells[0] + bells[1], by_blur)


def wide_px(state: FloatArray) -> FloatArray:
    """Return the standard deviation (n, 2) of all that blurs each edge, lens and pixels."""
    return np.asarray(np.hypot(state[:, BLURS], _apart(state[:, SLANTS])))


def _apart(slant: FloatArray) -> FloatArray:
    """Half the distance of two lines whose fourth cumulant is that of a square seen at a slant."""
    return np.asarray(((np.cos(slant) ** 4 + np.sin(slant) ** 4) / 240.0) ** 0.25)


def _crossed(
    z1: FloatArray, z2: FloatArray, together: FloatArray
) -> tuple[FloatArray, tuple[FloatArray, FloatArray], FloatArray]:
    """Return what two crossing edges have on top of their product, and its derivatives by z1, z2, together.

    Four times the normal distribution of both, integrated over the correlation (Plackett, Biometrika 1954).
    """
    value, by_1, by_2 = np.zeros_like(z1), np.zeros_like(z1), np.zeros_like(z1)
    squares, product = 0.5 * (z1 * z1 + z2 * z2), z1 * z2
    for node, weight in ((0.2113248654, 0.5), (0.7886751346, 0.5)):  # Gauss and Legendre's on 0 to 1
        r = together * node
        rest = 1.0 - r * r
        part = (2.0 / np.pi * weight * together / np.sqrt(rest)) * np.exp((r * product - squares) / rest)
        value += part
        part /= rest
        by_1 += part * (r * z2 - z1)
        by_2 += part * (r * z1 - z2)
    rest = 1.0 - together * together
    by_together = (2.0 / np.pi / np.sqrt(rest)) * np.exp((together * product - squares) / rest)
    return value, (by_1, by_2), by_together


def _markers(edges: list[Edge], insets: FloatArray) -> FloatArray:
    """Return twice the part of each pixel that the corners of markers cover in the white quarters.

    They take no part in the derivatives: where they are tells nothing of the corner.
    """
    sign = insets[:, 2, None]
    covered = np.zeros_like(edges[0].z)
    for side in (1.0, -1.0):
        beyond = [
            way * one.z - insets[:, k, None] / one.wide
            for k, (one, way) in enumerate(zip(edges, (np.full_like(sign, side), side * sign), strict=True))
        ]
        covered += 0.5 * (1.0 + erf(beyond[0] / ROOT_2)) * (1.0 + erf(beyond[1] / ROOT_2))
    return np.asarray(covered * sign)


HALF_PX = 8
"""A window reaches so far from its corner."""

NEAR, FAR = 1.3, 2.5
"""A pixel counts if it is so many standard deviations of the blur away from the nearest marker's border,
which the model has, and from all else, which it has not: at 1.3 a tenth of it is a marker's, so that a
border that is printed a little elsewhere does no harm."""


class Crossings(NamedTuple):
    """Corners on a print, ids (n,) at points_m (n, 2); markers begin inset_m (2,) away, across and down."""

    pattern: Cells
    ids: IntArray
    points_m: FloatArray
    inset_m: FloatArray

    def some(self, which: NDArray[np.int64]) -> Crossings:
        """Return some of them."""
        return self._replace(ids=self.ids[which], points_m=self.points_m[which])

    def signs(self, jacobians: FloatArray) -> FloatArray:
        """Return (n,) +1 where the square to the lower right is white, -1 where it is black."""
        a_little_m = 1e-3 / np.sqrt(np.abs(np.linalg.det(jacobians)))
        black = self.pattern.is_black(*(self.points_m + a_little_m[:, None]).T)
        return np.where(black, -1.0, 1.0)


class Pixels(NamedTuple):
    """Windows about corners: u (n, p, 2), pixels from where these are expected; levels and weights (n, p)."""

    u: FloatArray
    levels: FloatArray
    weights: FloatArray

    def some(self, which: NDArray[np.int64] | NDArray[np.bool_]) -> Pixels:
        """Return some of them."""
        return Pixels(*(part[which] for part in self))


def pixels_about(
    image: Levels, crossings: Crossings, pixels_px: FloatArray, jacobians: FloatArray, wide_px: FloatArray
) -> Pixels:
    """Return the windows about corners, with weight 1 where the image shows nothing but two edges, else 0.

    ``pixels_px`` (n, 2) are the windows' middles to a fraction of a pixel, ``jacobians`` (n, 2, 2) px/m,
    ``wide_px`` (n,) the standard deviation of what blurs an edge there.
    """
    u, levels, inside = windows(image, pixels_px, HALF_PX)
    alone = _alone(crossings, np.rint(pixels_px) - pixels_px, jacobians, wide_px)
    return Pixels(u, levels, (inside & alone).astype(np.float64))


def sharpness_px(image: Levels, pixels_px: FloatArray) -> FloatArray:
    """Return about the standard deviation (n,) of what blurs edges in windows, by their steepest slopes."""
    side = 2 * HALF_PX + 1
    levels = windows(image, pixels_px, HALF_PX)[1].reshape(-1, side, side)
    dark, bright = np.percentile(levels, (5.0, 95.0), axis=(1, 2))
    slopes = np.hypot(levels[:, 1:-1, 2:] - levels[:, 1:-1, :-2], levels[:, 2:, 1:-1] - levels[:, :-2, 1:-1])
    steep = np.percentile(slopes, 97.0, axis=(1, 2)) / 2.0
    return np.asarray((bright - dark) / np.sqrt(2 * np.pi) / np.maximum(steep, 1e-3))


def _alone(
    crossings: Crossings, shift_px: FloatArray, jacobians: FloatArray, wide_px: FloatArray
) -> NDArray[np.bool_]:
    """Which pixels (n, p) are far enough from all that is printed beside the two edges.

    The print is looked up at every half pixel.
    """
    reach = HALF_PX + int(np.ceil(FAR * float(wide_px.max())))
    halves = np.arange(-2 * reach, 2 * reach + 1) / 2.0
    grid = np.stack(np.meshgrid(halves, halves), axis=-1).reshape(-1, 2)
    places = (shift_px[:, None] + grid) @ np.linalg.inv(jacobians).transpose(0, 2, 1)
    absolute = places + crossings.points_m[:, None]
    black = crossings.pattern.is_black(absolute[..., 0], absolute[..., 1])
    positive = places > 0
    as_lower_right = positive[..., 0] == positive[..., 1]
    white = as_lower_right == (crossings.signs(jacobians) > 0)[:, None]
    two_edges = black != white
    marker = white & (np.abs(places) > crossings.inset_m).all(axis=-1)
    as_modelled = two_edges ^ marker
    side = len(halves)
    window = slice(2 * (reach - HALF_PX), side - 2 * (reach - HALF_PX), 2)
    alone = np.empty((len(places), (2 * HALF_PX + 1) ** 2), dtype=bool)
    for k, wide in enumerate(wide_px):
        from_any, from_other = (
            cv2.distanceTransform(one[k].reshape(side, side).view(np.uint8), cv2.DIST_L2, 3)[window, window]
            for one in (two_edges, as_modelled)
        )
        alone[k] = ((from_any > 2 * NEAR * wide) & (from_other > 2 * FAR * wide)).ravel()
    return alone


MOST_TOGETHER = 0.9


class Saddles(NamedTuple):
    """Fitted corners, not-a-number where the fit found none.

    ids (n,) on the board; pixels_px (n, 2); sigma_px (n,) one standard deviation per axis, from the noise;
    wide_px (n, 2) standard deviation of what blurs the edges, pixels included, across columns and rows;
    contrast (n,) half of white less black; noise (n,) rms of what the fit left over, grey levels.
    """

    ids: IntArray
    pixels_px: FloatArray
    sigma_px: FloatArray
    wide_px: FloatArray
    contrast: FloatArray
    noise: FloatArray

    def some(self, good: NDArray[np.bool_]) -> Saddles:
        """Return some of them."""
        return Saddles._make(part[good] for part in self)


NO_SADDLES = Saddles(
    np.empty(0, np.int64), np.empty((0, 2)), np.empty(0), np.empty((0, 2)), np.empty(0), np.empty(0)
)


def fit_saddles(
    image: Levels, crossings: Crossings, pixels_px: FloatArray, jacobians: FloatArray, farthest_px: float
) -> Saddles:
    """Fit corners whose places ``pixels_px`` (n, 2) are known to a pixel or two, ``jacobians`` (n, 2, 2)
    px/m.

    A fit that moves farther than ``farthest_px`` has found another corner, and is none.
    """
    if not len(pixels_px):
        return NO_SADDLES
    signs = crossings.signs(jacobians)
    slopes = np.linalg.norm(np.linalg.inv(jacobians), axis=2)  # of the board's x and y, m/px
    insets = np.column_stack([crossings.inset_m / slopes, signs])
    wide = np.clip(sharpness_px(image, pixels_px), 0.8, 4.0)
    pixels = pixels_about(image, crossings, pixels_px, jacobians, wide)
    state = _start(pixels, signs, jacobians, wide)
    _minimised(state, pixels, insets, 0.05)
    # what is printed nearby reaches farther where edges are wider than was assumed
    wider = np.flatnonzero(
        (wide_px(state).max(axis=1) > 1.25 * wide) & (np.hypot(*state[:, :2].T) < farthest_px)
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
    square, normal, settled = _minimised(state, pixels, insets, 1e-3)
    freedom = pixels.weights.sum(axis=1) - PARAMETERS
    noise = np.sqrt(square / np.maximum(freedom, 1.0))
    covariance = np.linalg.inv(normal + 1e-9 * (diagonals(normal) + np.eye(PARAMETERS)))
    sigma = noise * np.sqrt(np.abs(covariance[:, 0, 0] + covariance[:, 1, 1]) / 2)
    contrast = state[:, CONTRAST] * signs
    moved_px = np.linalg.norm(state[:, :2], axis=1)
    good = settled & (freedom > 24) & (moved_px < farthest_px) & (contrast > 0.0)
    values = pixels_px + state[:, :2], sigma, wide_px(state), contrast, noise
    for one in values:
        one[~good] = np.nan
    return Saddles(crossings.ids, *values)


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
    for _ in range(25):
        some = np.flatnonzero(open_)
        if not len(some):
            break
        damped = (
            normal[some] + damping[some, None, None] * diagonals(normal[some]) + 1e-9 * np.eye(PARAMETERS)
        )
        step = np.linalg.solve(damped, gradient[some, :, None])[..., 0]
        step[:, :2] = np.clip(step[:, :2], -1.0, 1.0)
        step[:, SLANTS] = np.clip(step[:, SLANTS], -0.2, 0.2)
        tried = state[some] + step
        tried[:, BLURS] = np.clip(tried[:, BLURS], 0.14, 8.0)
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
        bottom = better | (before < 1e-2) | (damping[some] > 1.0)
        open_[some[(np.abs(step[:, :2]).max(axis=1) < settled_px) & bottom]] = False
    return square, normal, ~open_
