"""Dots of a board in an image: spots that may be some, and where they are to a few hundredths of a pixel.

A loose blob detector finds thousands of blobs on gravel, and a grid search among them takes half a minute.
Here each spot must be a filled ellipse with an even ring of paper around it, which gravel hardly ever offers.

Then each one's ellipse is fitted to the grey levels around its outline. Model of a dot, in pixels u from its
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
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import ndtr

from calib.geometry.rigid import FloatArray

Image = NDArray[np.uint8]
Levels = NDArray[np.uint8] | NDArray[np.uint16]

WIDEST_RATIO = (
    3.5  # major to minor axis: beyond this a board is seen too flatly for its dots to be told apart
)
FILL = (0.80, 1.15)  # area over the area of the ellipse with the same second moments
UNEVEN = 0.22  # spread of the ring of paper, in units of its contrast to the dot
UNEVEN_AT_MOST = 0.4  # the same where the strict search found no grid
RING = 1.6  # of the ring, in dot radii; neighbours begin at 3
RING_POINTS = 16
LEAST_RING = 2 / 3
LEAST_CONTRAST_DN = 14.0
LEAST_AREA_PX = 6
MOST_CANDIDATES = 3000


class Candidates(NamedTuple):
    """Spots: middles (n, 2) px, and shapes (n, 2, 2) that carry the unit circle to each spot's outline."""

    middles_px: FloatArray
    shapes_px: FloatArray


def dot_candidates(
    image: Image, diameter_px: float, area_px2: tuple[float, float], uneven: float = UNEVEN
) -> Candidates:
    """Return the spots that look like dots.

    Parameters
    ----------
    image
        (h, w) grey levels.
    diameter_px
        Of the largest dot to be found, along its longer axis; sets the window in which paper is looked for.
    area_px2
        Smallest and largest area of a dot.
    uneven
        How uneven the paper around a dot may be, in units of its contrast to the dot.
    """
    smooth = np.asarray(cv2.GaussianBlur(image, (0, 0), min(0.8, 0.08 * diameter_px)), dtype=np.uint8)
    window = 2 * int(np.ceil(0.8 * diameter_px + 1)) + 1
    kernel = cv2.getStructuringElement(cv2.MORPH_RECT, (window, window))
    paper = cv2.morphologyEx(smooth, cv2.MORPH_CLOSE, kernel)
    dark = cv2.erode(smooth, kernel)
    middle = cv2.addWeighted(paper, 0.5, dark, 0.5, 0.0)
    contrast = cv2.subtract(paper, dark)
    mask = ((smooth < middle) & (contrast > LEAST_CONTRAST_DN)).astype(np.uint8)
    count, labels, stats, _ = cv2.connectedComponentsWithStats(mask, connectivity=4)
    area = stats[:, cv2.CC_STAT_AREA]
    width, height = stats[:, cv2.CC_STAT_WIDTH], stats[:, cv2.CC_STAT_HEIGHT]
    longest = np.maximum(width, height)
    good = (area >= max(LEAST_AREA_PX, area_px2[0])) & (area <= area_px2[1])
    good &= (longest <= 1.6 * diameter_px + 3) & (longest <= WIDEST_RATIO * np.minimum(width, height))
    good[0] = False
    if not good.any():
        return Candidates(np.empty((0, 2)), np.empty((0, 2, 2)))
    kept = _ellipses(np.asarray(labels, dtype=np.int32), np.flatnonzero(good), count)
    kept = _in_paper(smooth, kept, uneven)
    if len(kept.middles_px) > MOST_CANDIDATES:
        return Candidates(np.empty((0, 2)), np.empty((0, 2, 2)))
    return kept


def _ellipses(labels: NDArray[np.int32], wanted: NDArray[np.int64], count: int) -> Candidates:
    """Return the components that fill the ellipse of their second moments."""
    number = np.full(count, -1)
    number[wanted] = np.arange(len(wanted))
    y, x = np.nonzero(labels)
    which = number[labels[y, x]]
    inside = which >= 0
    which, x, y = which[inside], x[inside].astype(np.float64), y[inside].astype(np.float64)

    def mean(values: NDArray[Any]) -> FloatArray:
        return np.bincount(which, values, len(wanted)) / area

    area = np.bincount(which, minlength=len(wanted)).astype(np.float64)
    mx, my = mean(x), mean(y)
    dx, dy = x - mx[which], y - my[which]
    xx, xy, yy = mean(dx * dx) + 1 / 12, mean(dx * dy), mean(dy * dy) + 1 / 12
    root = np.sqrt(np.maximum(xx * yy - xy * xy, 1e-12))
    fill = area / (4.0 * np.pi * root)
    # The square root of a symmetric 2x2 matrix S is (S + sqrt(det S) I) / sqrt(trace S + 2 sqrt(det S)).
    scale = 2.0 / np.sqrt(xx + yy + 2.0 * root)
    shapes = scale[:, None, None] * np.stack(
        [np.stack([xx + root, xy], axis=-1), np.stack([xy, yy + root], axis=-1)], axis=-2
    )
    spread = np.sqrt(np.maximum((xx + yy) ** 2 / 4 - root**2, 0.0))
    flat = np.sqrt(((xx + yy) / 2 + spread) / np.maximum((xx + yy) / 2 - spread, 1e-9))
    good = (fill > FILL[0]) & (fill < FILL[1]) & (flat < WIDEST_RATIO)
    return Candidates(np.stack([mx, my], axis=-1)[good], shapes[good])


def contrasts(smooth: Image, middles_px: FloatArray, shapes_px: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return how much darker each middle is than the ring around it, and the ring's spread, grey levels.

    Not-a-number where more than a third of the ring is outside the image.
    """
    angle = np.arange(RING_POINTS) * (2 * np.pi / RING_POINTS)
    circle = np.stack([np.cos(angle), np.sin(angle)])
    # half a pixel more: the paper next to a small dot is darkened by the lens
    length = np.sqrt(np.abs(np.linalg.det(shapes_px)))[:, None, None]
    ring = middles_px[:, None, :] + ((RING + 0.5 / length) * (shapes_px @ circle)).transpose(0, 2, 1)
    points = np.concatenate([middles_px[:, None, :], ring], axis=1)
    columns, rows = np.moveaxis(points.astype(np.float32), -1, 0)
    values = _sampled(smooth, columns, rows)
    height, width = smooth.shape
    inside = (columns >= 0) & (rows >= 0) & (columns <= width - 1) & (rows <= height - 1)
    seen = inside[:, 1:].sum(axis=1)
    paper = np.where(inside[:, 1:], values[:, 1:], 0.0)
    with np.errstate(divide="ignore", invalid="ignore"):
        mean = np.where(inside[:, 0] & (seen >= LEAST_RING * RING_POINTS), paper.sum(axis=1) / seen, np.nan)
        spread = np.where(inside[:, 1:], paper - mean[:, None], 0.0)
        return mean - values[:, 0], np.sqrt((spread**2).sum(axis=1) / seen)


def _sampled(image: Image, columns: NDArray[np.float32], rows: NDArray[np.float32]) -> FloatArray:
    """Bilinear values; in pieces, since OpenCV wants fewer than 32767 rows."""
    pieces = [
        cv2.remap(image.astype(np.float32), columns[k : k + 30000], rows[k : k + 30000], cv2.INTER_LINEAR)
        for k in range(0, len(columns), 30000)
    ]
    return np.concatenate(pieces).astype(np.float64)


def _in_paper(smooth: Image, spots: Candidates, uneven: float) -> Candidates:
    """Return the spots with an even bright ring around them."""
    if not len(spots.middles_px):
        return spots
    contrast, spread = contrasts(smooth, *spots)
    with np.errstate(invalid="ignore"):
        good = (contrast > LEAST_CONTRAST_DN) & (spread < uneven * contrast)
    return Candidates(spots.middles_px[good], spots.shapes_px[good])


REACH = 2.0
"""How far the fit looks, in dot radii: neighbours begin at 3 and are blurred."""

BLURS = 5.0
"""How far beyond the outline the fit looks, in blurs or pixels, for dots large enough."""

MOST_POINTS_ACROSS = 60
"""Of the pixels across a large dot only every second (third, ...) is used beyond this."""

ITERATIONS = 8
SETTLED_PX = 2e-3
START_BLUR_PX = 0.8
BLUR_PX = (0.25, 6.0)
FARTHEST_PX = 1.5
"""A fit that moves farther than this, or than half the radius, has not found the dot that was expected."""

SIZE_SIGMA = 0.1
"""Relative, of a dot's printed size."""

PARAMETERS = 8


class DotCentres(NamedTuple):
    """Fitted dots, not-a-number where the fit found none.

    middles_px (n, 2); sigma_px (n,) per axis, from the noise that the fit left; sizes (n,) fitted over given
    radius; contrast_dn (n,); noise_dn (n,) rms of the fit's residuals.
    """

    middles_px: FloatArray
    sigma_px: FloatArray
    sizes: FloatArray
    contrast_dn: FloatArray
    noise_dn: FloatArray


def fit_ellipses(image: Levels, middles_px: FloatArray, shapes_px: FloatArray) -> DotCentres:
    """Fit dots whose places are known to a pixel.

    Parameters
    ----------
    image
        (h, w) grey levels.
    middles_px
        (n, 2) about where the dots are.
    shapes_px
        (n, 2, 2) carry the unit circle to each dot's outline; only their size is corrected.
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
    farthest = np.minimum(FARTHEST_PX, 0.5 * radius)
    freedom = weights.sum(axis=1) - PARAMETERS
    for _ in range(ITERATIONS):
        some = np.flatnonzero(open_)
        residual, J = _model(state[some], u[some], form[some], levels[some], weights[some])
        JT = J.transpose(0, 2, 1)
        normal[some] = JT @ J
        square[some] = (residual**2).sum(axis=1)
        gradient = JT @ residual[..., None]
        # The board's drawing says how large its dots are; a small blurred dot does not tell by itself.
        weight = square[some] / np.maximum(freedom[some], 1.0) / SIZE_SIGMA**2
        normal[some, 2, 2] += weight
        gradient[:, 2, 0] += weight * (1.0 - state[some, 2])
        damped = normal[some] + 1e-4 * _diagonals(normal[some]) + 1e-9 * np.eye(PARAMETERS)
        step = np.linalg.solve(damped, gradient)[..., 0]
        step[:, :2] = np.clip(step[:, :2], -0.5, 0.5)
        state[some] = state[some] + step
        state[some, 2] = np.clip(state[some, 2], 0.5, 2.0)
        state[some, 3] = np.clip(state[some, 3], *BLUR_PX)
        open_[some] = np.abs(step[:, :2]).max(axis=1) > SETTLED_PX
        if not open_.any():
            break
    noise = np.sqrt(square / np.maximum(freedom, 1.0))
    covariance = np.linalg.inv(normal + 1e-6 * _diagonals(normal) + 1e-12 * np.eye(PARAMETERS))
    sigma = noise * np.sqrt((covariance[:, 0, 0] + covariance[:, 1, 1]) / 2)
    good = (freedom > 0) & ~open_ & (np.linalg.norm(state[:, :2], axis=1) < farthest)
    good &= (state[:, 7] > 0.0) & (state[:, 2] > 0.5) & (state[:, 2] < 2.0)
    out = [middles_px + state[:, :2], sigma]
    out += [state[:, 2], state[:, 4] * state[:, 7], noise]
    for values in out:
        values[~good] = np.nan
    return DotCentres(*out)


def centred(image: Image, middles_px: FloatArray, shapes_px: FloatArray) -> FloatArray:
    """Return the middles moved onto the dark spots that they are nearest to, good to some tenths of a pixel.

    Arguments as ``fit_ellipses``, but places may be off by most of a dot's radius.
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


def _patches(
    image: Levels, middles_px: FloatArray, shapes_px: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return u (n, p, 2), pixels from the middle; grey levels (n, p); weights (n, p), 0 or 1."""
    lengths = np.linalg.svd(shapes_px, compute_uv=False)
    reach = np.minimum(REACH, 1.0 + BLURS / lengths[:, 1])
    half = int(np.ceil((reach * lengths[:, 0]).max()))
    stride = max(1, -(-(2 * half + 1) // MOST_POINTS_ACROSS))
    offsets = np.arange(-half, half + 1, stride)
    dx, dy = (a.ravel() for a in np.meshgrid(offsets, offsets))
    whole = np.rint(middles_px).astype(int)
    columns, rows = whole[:, :1] + dx, whole[:, 1:] + dy
    height, width = image.shape
    inside = (columns >= 0) & (rows >= 0) & (columns < width) & (rows < height)
    levels = image[np.clip(rows, 0, height - 1), np.clip(columns, 0, width - 1)].astype(np.float64)
    u = np.stack([columns - middles_px[:, :1], rows - middles_px[:, 1:]], axis=-1)
    q = np.linalg.norm(u @ np.linalg.inv(shapes_px).transpose(0, 2, 1), axis=-1)
    return u, levels, (inside & (q < reach[:, None])).astype(np.float64)


def _start(levels: FloatArray, weights: FloatArray, u: FloatArray, form: FloatArray) -> FloatArray:
    """Parameters to begin with: x, y, size, blur, paper, its slopes, contrast."""
    q = np.sqrt(np.einsum("npi,nij,npj->np", u, form, u))
    outermost = (q * weights).max(axis=1, keepdims=True)
    paper = _mean_where(levels, weights * (q > (1.0 + 2.0 * outermost) / 3.0))
    dot = _mean_where(levels, weights * (q < 0.7))
    state = np.zeros((len(levels), PARAMETERS))
    state[:, 2], state[:, 3] = 1.0, START_BLUR_PX
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


def _diagonals(matrices: NDArray[np.float64]) -> FloatArray:
    """The same matrices with everything off the diagonal nil."""
    return np.asarray(matrices * np.eye(matrices.shape[-1]))


BOUNDARY_POINTS = 32


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


def outline_points_m(centres_m: ArrayLike, radius_m: float) -> FloatArray:
    """Return boundary points (n, 32, 2) of circles about ``centres_m`` (n, 2), all in the circles' plane."""
    angle = np.arange(BOUNDARY_POINTS) * (2.0 * np.pi / BOUNDARY_POINTS)
    around = radius_m * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    return np.asarray(np.asarray(centres_m, dtype=np.float64)[:, None, :] + around)


def bias_through(
    pixel_of: Callable[[FloatArray], FloatArray], centres_m: ArrayLike, radius_m: float
) -> FloatArray:
    """Return centroid of the dot's image minus image of its centre, (n, 2) px, for any map of the plane.

    ``pixel_of`` takes points (..., 2) of the plane, metres, to pixels (..., 2); centres (n, 2) and radius are
    metres. Not-a-number where the map has no pixel for some point of the boundary.
    """
    centres = np.asarray(centres_m, dtype=np.float64)
    boundaries = pixel_of(outline_points_m(centres, radius_m))
    return np.asarray(area_centroids(boundaries) - pixel_of(centres))
