"""Find the corners of a board in an image.

Markers say which corners are where to a pixel or two (`markers`), each corner is fitted to its grey levels
(`saddles`), corners beside those that were found are looked for where these say they are, and what does not
fit the smooth map of the others is dropped. Dots are left to `calib.dots`.
"""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from calib.boards import AnyBoard, AprilGrid, Charuco, Checkerboard, Corners, DotBoard
from calib.boards.pattern import Cells, pattern_of
from calib.corners.chessboard import chessboard_corners
from calib.corners.lattice import Known, predicted
from calib.corners.markers import Image, MarkerBoard, Standing, detect, standing
from calib.corners.reasons import doubled, why_not_this_board, why_nothing
from calib.corners.saddle_pixels import Crossings, Levels
from calib.corners.saddles import Saddles, fit_saddles
from calib.dots.find import DotsFound, find_dots
from calib.dots.plane_map import fit_plane_map
from calib.rigid import FloatArray
from calib.survey import Board

LEAST_SIGMA_PX = 0.001
"""What aliasing and whole grey levels leave at best."""

FARTHEST_PX = 4.0
"""A corner is looked for so far from where the markers say that it is."""

WORST_SIGMA_PX = 0.3
UNSURE = 6.0
"""A corner is dropped if it is so much less sure than the others: half covered."""

BESIDE_RIM = 2.0
"""Standard deviations of the blur that a corner is away from the picture's rim at least."""

CONTRAST = 0.35
"""Of the others' median, at least; a corner half behind something has less."""

WIDEST = 1.7
"""Of the others' median, what blurs an edge at most: something that lies across it makes it wider."""

LEFT_OVER = 0.12
"""Of its contrast, at most, or three times what is usual in the image."""

FAR_OFF = 6.0
"""Sigmas from the map of all corners, beyond which a corner is dropped."""

FEWEST = 4
ROUNDS = 6


class CornersNotFound(NamedTuple):
    """Why there are no corners: one plain sentence."""

    reason: str


def find_corners(board: AnyBoard, image: Levels) -> Corners | CornersNotFound:
    """Return the corners of a board that an image shows, or why there are none.

    Part of a board is enough where its markers say which part; chessboards and dots must be seen whole, their
    upper side up in the image where the print does not tell.

    Parameters
    ----------
    board
        What is printed.
    image
        (h, w) or (h, w, 3) levels of 8 or 16 bits; the centre of the top-left pixel is (0, 0).

    Returns
    -------
    Corners | CornersNotFound
        sigma_px is what noise, blur and slant leave of each corner, by what the fit of its grey levels left
        over: errors that neighbours share, as of the print, are not in it.

    Raises
    ------
    ValueError
        If the image is none of these.
    """
    levels = _grey(image)
    eight = _in_8_bits(levels)
    if isinstance(board, DotBoard):
        return _dots(board, levels)
    pattern = pattern_of(board)
    assert isinstance(pattern, Cells)
    if isinstance(board, Checkerboard):
        start = chessboard_corners(board, eight)
        if start is None:
            return CornersNotFound(why_nothing(board, eight))
    else:
        stands = _standing(board, eight)
        if isinstance(stands, CornersNotFound):
            return stands
        start = _beside(board, stands)
    found = _inside(_fitted(board, levels, pattern, start), levels.shape)
    if len(found.ids) < FEWEST:
        return CornersNotFound(
            "markers of the board are seen, but its corners are covered, blurred or too small"
        )
    return _agreeing(board, found)


class _Found(NamedTuple):
    """Corners that were fitted: ids (n,), and what `fit_saddles` says of them."""

    ids: NDArray[np.int64]
    saddles: Saddles


def _standing(board: MarkerBoard, image: Image) -> Standing | CornersNotFound:
    """The markers that stand as on the board, or what is wrong."""
    markers = detect(image, board)
    stands = standing(markers, board)
    twice = doubled(board, markers, stands)
    if twice:
        return CornersNotFound(twice)
    another = why_not_this_board(board, markers, stands)
    if another:
        return CornersNotFound(another)
    if stands is None:
        return CornersNotFound(why_nothing(board, image))
    return stands


def _beside(board: MarkerBoard, stands: Standing) -> Known:
    """The corners next to markers, predicted from these."""
    known = Known(stands.corners_m.reshape(-1, 2), stands.corners_px.reshape(-1, 2))
    ids = board.ids
    places = board.in_board_m(ids)[:, :2]
    away = np.linalg.norm(places[:, None] - known.points_m[None], axis=-1).min(axis=1)
    reach = 0.5 * (board.gap_m if isinstance(board, AprilGrid) else board.square_m)
    near = away < reach
    return predicted(known, ids[near], places[near])


def _fitted(
    board: Charuco | AprilGrid | Checkerboard, levels: Levels, pattern: Cells, start: Known
) -> _Found:
    """The corners that the start names, and those that lie beside what was found."""
    places = board.in_board_m(board.ids)[:, :2]
    printed = Crossings(pattern, places, _insets_m(board))
    ids, found = start.ids, None
    tried = set(map(int, ids))
    while len(ids):
        new = fit_saddles(levels, printed.some(ids), start.pixels_px, start.jacobians, FARTHEST_PX)
        both = (
            new
            if found is None
            else Saddles(*(np.concatenate(two) for two in zip(found.saddles, new, strict=True)))
        )
        every = ids if found is None else np.concatenate([found.ids, ids])
        good = _good(both)
        found = _Found(every[good], Saddles(*(part[good] for part in both)))
        if len(found.ids) < FEWEST:
            break
        rest = np.array([one for one in board.ids if int(one) not in tried], dtype=np.int64)
        if not len(rest):
            break
        known = Known(places[found.ids], found.saddles.pixels_px)
        ids = known.next_to(rest, places, board.lines_m)
        tried |= set(map(int, ids))
        start = predicted(known, ids, places[ids])
        ids = start.ids  # less where the corners found lie too badly to say where the next one is
    if found is None:
        return _Found(ids, fit_saddles(levels, printed.some(ids), start.pixels_px, start.jacobians, 0.0))
    return found


def _insets_m(board: Charuco | AprilGrid | Checkerboard) -> FloatArray:
    """How far from a corner, across and down, markers begin in the white squares; infinite if there are
    none.
    """
    if not isinstance(board, Charuco):
        return np.full(2, np.inf)
    return (board.square_m - board.marker_m) / 2 * np.array([1.0, board.aspect])


def _inside(found: _Found, shape: tuple[int, ...]) -> _Found:
    """Leave out what is nearer to the image's rim than the blur reaches, or beside it."""
    rim = BESIDE_RIM * found.saddles.wide_px.max(axis=1, initial=0.0) - 0.5
    x, y = found.saddles.pixels_px.T
    kept = (x > rim) & (y > rim) & (x < shape[1] - 1 - rim) & (y < shape[0] - 1 - rim)
    return _Found(found.ids[kept], Saddles(*(part[kept] for part in found.saddles)))


def _good(saddles: Saddles) -> NDArray[np.bool_]:
    """Which corners look like the others."""
    fitted = np.isfinite(saddles.sigma_px)
    if not fitted.any():
        return fitted
    with np.errstate(invalid="ignore", divide="ignore"):
        left_over = saddles.noise / saddles.contrast
        good = fitted & (
            saddles.sigma_px < min(WORST_SIGMA_PX, UNSURE * float(np.nanmedian(saddles.sigma_px)))
        )
        good &= saddles.contrast > CONTRAST * np.nanmedian(saddles.contrast)
        good &= (saddles.wide_px < WIDEST * np.nanmedian(saddles.wide_px, axis=0)).all(axis=1)
        return np.asarray(good & (left_over < max(LEFT_OVER, 3.0 * float(np.nanmedian(left_over)))))


def _agreeing(board: AnyBoard, found: _Found) -> Corners | CornersNotFound:
    """The corners that fit a smooth map of all."""
    points = board.in_board_m(found.ids)[:, :2]
    pixels = found.saddles.pixels_px
    sigma = np.hypot(found.saddles.sigma_px, LEAST_SIGMA_PX)
    good = np.ones(len(points), dtype=bool)
    for _ in range(ROUNDS):
        plane_map = fit_plane_map(points[good], pixels[good])
        if plane_map is None or 2 * int(good.sum()) - plane_map.parameters < 6:
            break
        # what the map has no room for, a lens near by or a bent board, is in all of them
        least = np.maximum(sigma, float(np.median(sigma[good])))
        off = np.linalg.norm(plane_map.pixels(points) - pixels, axis=-1) / least
        # by the median: a corner far off does not excuse itself
        usual = float(np.median(off[good])) / 1.177
        far = good & (off > FAR_OFF * max(1.0, usual))
        if not far.any() or good.sum() - far.sum() < FEWEST:
            break
        good &= ~far
    order = np.argsort(found.ids[good])
    return Corners(found.ids[good][order], pixels[good][order], sigma[good][order])


def _dots(board: DotBoard, levels: Levels) -> Corners | CornersNotFound:
    """The dots, rows to the right in the image."""
    found = find_dots(levels, Board(board.rows, board.columns, board.spacing_m, board.dot_diameter_m, {}))
    if not isinstance(found, DotsFound):
        return CornersNotFound(found.reason)
    return Corners(found.rows * board.columns + found.columns, found.pixels_px, found.sigma_px)


def _grey(image: Levels) -> Levels:
    if (
        image.dtype not in (np.uint8, np.uint16)
        or image.ndim not in (2, 3)
        or (image.ndim == 3 and image.shape[2] != 3)
    ):
        raise ValueError(
            f"an image of {image.shape} {image.dtype} where (h, w) or (h, w, 3) uint8 or uint16 is expected"
        )
    if image.ndim == 2:
        return image
    grey = np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY))
    return grey.astype(np.uint8) if image.dtype == np.uint8 else grey.astype(np.uint16)


def _in_8_bits(levels: Levels) -> Image:
    """The image in 8 bits: all levels but the darkest and the brightest thousandth, spread over them."""
    if levels.dtype == np.uint8:
        return levels.astype(np.uint8, copy=False)
    dark, bright = np.percentile(levels, (0.1, 99.9))
    spread = (levels - dark) * (255.0 / max(bright - dark, 1.0))
    return np.asarray(np.clip(np.rint(spread), 0, 255), dtype=np.uint8)
