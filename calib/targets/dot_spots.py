"""Dots of a board in an image: spots that may be some.

A loose blob detector finds thousands of blobs on gravel, and a grid search among them takes half a minute.
Here each spot must be a filled ellipse with an even ring of paper around it, which gravel hardly ever offers.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from calib.geometry.rigid import FloatArray
from calib.targets.boards import Grey8

WIDEST_RATIO = 3.5  # major to minor axis: a board seen more flatly has dots that cannot be distinguished
FILL = (0.80, 1.15)  # area over the area of the ellipse with the same second moments
UNEVEN = 0.22  # spread of the ring of paper, in units of its contrast to the dot
UNEVEN_AT_MOST = 0.4  # the same where the strict search found no grid
RING_POINTS = 16
LEAST_CONTRAST_DN = 14.0


class Candidates(NamedTuple):
    """Spots: middles (n, 2) px, and shapes (n, 2, 2) that carry the unit circle to each spot's outline."""

    middles_px: FloatArray
    shapes_px: FloatArray


def dot_candidates(
    image: Grey8, diameter_px: float, area_px2: tuple[float, float], uneven: float = UNEVEN
) -> Candidates:
    """Return the spots that look like dots.

    ``diameter_px`` is that of the largest dot to be found, along its longer axis; it sets the window in which
    paper is looked for. ``area_px2`` are a dot's smallest and largest area, ``uneven`` how uneven the paper
    around it may be, in units of its contrast to the dot.
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
    good = (area >= max(6, area_px2[0])) & (area <= area_px2[1])
    good &= (longest <= 1.6 * diameter_px + 3) & (longest <= WIDEST_RATIO * np.minimum(width, height))
    good[0] = False
    if not good.any():
        return Candidates(np.empty((0, 2)), np.empty((0, 2, 2)))
    kept = _ellipses(np.asarray(labels, dtype=np.int32), np.flatnonzero(good), count)
    kept = _in_paper(smooth, kept, uneven)
    if len(kept.middles_px) > 3000:  # gravel
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


def contrasts(smooth: Grey8, middles_px: FloatArray, shapes_px: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return how much darker each middle is than the ring around it, and the ring's spread, grey levels.

    Not-a-number where more than a third of the ring is outside the image.
    """
    angle = np.arange(RING_POINTS) * (2 * np.pi / RING_POINTS)
    circle = np.stack([np.cos(angle), np.sin(angle)])
    # 1.6 radii, for neighbours begin at 3, and half a pixel: the paper next to a dot is darkened by the lens
    length = np.sqrt(np.abs(np.linalg.det(shapes_px)))[:, None, None]
    ring = middles_px[:, None, :] + ((1.6 + 0.5 / length) * (shapes_px @ circle)).transpose(0, 2, 1)
    points = np.concatenate([middles_px[:, None, :], ring], axis=1)
    columns, rows = np.moveaxis(points.astype(np.float32), -1, 0)
    values = _sampled(smooth, columns, rows)
    height, width = smooth.shape
    inside = (columns >= 0) & (rows >= 0) & (columns <= width - 1) & (rows <= height - 1)
    seen = inside[:, 1:].sum(axis=1)
    paper = np.where(inside[:, 1:], values[:, 1:], 0.0)
    with np.errstate(divide="ignore", invalid="ignore"):
        mean = np.where(inside[:, 0] & (seen >= 2 / 3 * RING_POINTS), paper.sum(axis=1) / seen, np.nan)
        spread = np.where(inside[:, 1:], paper - mean[:, None], 0.0)
        return mean - values[:, 0], np.sqrt((spread**2).sum(axis=1) / seen)


def _sampled(image: Grey8, columns: NDArray[np.float32], rows: NDArray[np.float32]) -> FloatArray:
    """Bilinear values; in pieces, since OpenCV wants fewer than 32767 rows."""
    pieces = [
        cv2.remap(image.astype(np.float32), columns[k : k + 30000], rows[k : k + 30000], cv2.INTER_LINEAR)
        for k in range(0, len(columns), 30000)
    ]
    return np.concatenate(pieces).astype(np.float64)


def _in_paper(smooth: Grey8, spots: Candidates, uneven: float) -> Candidates:
    """Return the spots with an even bright ring around them."""
    if not len(spots.middles_px):
        return spots
    contrast, spread = contrasts(smooth, *spots)
    with np.errstate(invalid="ignore"):
        good = (contrast > LEAST_CONTRAST_DN) & (spread < uneven * contrast)
    return Candidates(spots.middles_px[good], spots.shapes_px[good])
