"""Which corners of a board are where in an image, to a pixel or two: by markers, or as a plain chessboard.

OpenCV finds both. This module decides which markers stand as on the board, predicts corners that have not
been measured yet, and turns a chessboard as its colours say.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import lru_cache
from typing import Any, NamedTuple

import cv2
import numpy as np

from calib.geometry.rigid import FloatArray, IntArray
from calib.targets.board_file import FAMILIES
from calib.targets.boards import AprilGrid, Charuco, Checkerboard, Grey8
from calib.targets.dot_grid import carried, homography


@dataclass(frozen=True, eq=False)
class MeasuredCorners:
    """Points of a board (n, 2), metres, and where they are in the image, pixels (n, 2).

    Where they were predicted as corners: ids (n,) and jacobians (n, 2, 2) px/m.
    """

    points_m: FloatArray
    pixels_px: FloatArray
    ids: IntArray = field(default_factory=lambda: np.empty(0, np.int64))
    jacobians: FloatArray = field(default_factory=lambda: np.empty((0, 2, 2)))


def predicted(known: MeasuredCorners, ids: IntArray, places_m: FloatArray) -> MeasuredCorners:
    """Return corners where the known points nearest to each say that they are.

    A homography of the neighbourhood: what the lens bends within it is below a pixel. Left out are corners
    whose neighbours do not determine one.
    """
    count = min(16, len(known.points_m))
    at, jacobians, kept = [np.empty((0, 2))], [np.empty((0, 2, 2))], []
    for number, place in zip(ids, places_m, strict=True) if count >= 4 else ():
        away = np.linalg.norm(known.points_m - place, axis=1)
        near = np.argpartition(away, count - 1)[:count]
        points = known.points_m[near] - place
        spread = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
        H = homography(points, known.pixels_px[near]) if spread[1] > 1e-3 * spread[0] else None
        if H is None or (points @ H[2, :2] + 1.0).min() < 0.1:
            continue
        jacobian = H[:2, :2] - np.outer(H[:2, 2], H[2, :2])  # of (H x) / (h x) at 0
        if np.linalg.det(jacobian) > 0.0:
            kept.append(number)
            at.append(H[None, :2, 2])
            jacobians.append(jacobian[None])
    found = np.array(kept, dtype=np.int64)
    return MeasuredCorners(np.empty((0, 2)), np.concatenate(at), found, np.concatenate(jacobians))


MarkerBoard = Charuco | AprilGrid

FEWEST = 2
STANDS_WITHIN = 0.35
"""A marker stands as on the board if its corners are within so much of its side from there (a lens bends)."""


class Markers(NamedTuple):
    """OpenCV's markers: ids (n,); corners_px (n, 4, 2) in the order of the markers' own upright pictures."""

    ids: IntArray
    corners_px: FloatArray


@dataclass(frozen=True, eq=False)
class PlacedMarkers:
    """Markers that stand as on the board, each id once: ids (n,), corners (n, 4, 2) in pixels and metres."""

    ids: IntArray
    corners_px: FloatArray
    corners_m: FloatArray


def detect(image: Grey8, board: MarkerBoard) -> Markers:
    """Return all markers of the board's dictionary in an image."""
    dictionary = board.dictionary if isinstance(board, Charuco) else FAMILIES[board.family]
    border = board.border if isinstance(board, AprilGrid) else 1
    found = search(image, dictionary, border)
    if len(found.ids) < 0.5 * count_of(board) and max(image.shape) < 5000:  # again, twice as large
        large = cv2.resize(image, None, fx=2.0, fy=2.0, interpolation=cv2.INTER_CUBIC)
        again = search(np.asarray(large, dtype=np.uint8), dictionary, border)
        if len(again.ids) > len(found.ids):
            # the centre of the upper left pixel is (0, 0) in both
            return Markers(again.ids, (again.corners_px + 0.5) / 2.0 - 0.5)
    return found


def search(image: Grey8, dictionary: str, border: int) -> Markers:
    """Return all markers of a dictionary by OpenCV's name."""
    corners, ids, _ = _detector(dictionary, border).detectMarkers(image)
    if ids is None or len(ids) == 0:
        return Markers(np.empty(0, np.int64), np.empty((0, 4, 2)))
    return Markers(
        np.asarray(ids, dtype=np.int64).ravel(), np.array(corners, dtype=np.float64).reshape(-1, 4, 2)
    )


@lru_cache(maxsize=32)
def _detector(dictionary: str, border: int) -> Any:
    parameters = cv2.aruco.DetectorParameters()
    parameters.markerBorderBits = border
    parameters.minMarkerPerimeterRate = 0.01  # OpenCV's 0.03 loses a far board in a large picture
    known = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, dictionary))
    return cv2.aruco.ArucoDetector(known, parameters)


def count_of(board: MarkerBoard) -> int:
    """Return how many markers a board has."""
    return board.rows * board.columns if isinstance(board, AprilGrid) else board.rows * board.columns // 2


def corners_on_board_m(board: MarkerBoard) -> FloatArray:
    """Return the corners (n, 4, 2) of all markers, metres, in the order in which OpenCV gives them."""
    if isinstance(board, AprilGrid):
        step, side = board.tag_m + board.gap_m, board.tag_m
        up, column = np.divmod(np.arange(board.rows * board.columns), board.columns)
        middles = np.stack(
            [(column - (board.columns - 1) / 2) * step, ((board.rows - 1) / 2 - up) * step], axis=-1
        )
        half = -side / 2  # OpenCV's tags are upside down
    else:
        row, column = np.divmod(np.arange(board.rows * board.columns), board.columns)
        white = (row + column) % 2 == int(not board.first_is_white)
        row, column = row[white], column[white]
        middles = (
            np.stack([(column - (board.columns - 1) / 2), (row - (board.rows - 1) / 2)], axis=-1)
            * board.square_m
        )
        half = board.marker_m / 2
    square = half * np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])
    return np.asarray((middles[:, None] + square) * [1.0, board.aspect], dtype=np.float64)


def placed_markers(markers: Markers, board: MarkerBoard) -> PlacedMarkers | None:
    """Return the markers that stand as on the board; None if too few do."""
    on_board = corners_on_board_m(board)
    mine = (markers.ids >= board.first_id) & (markers.ids < board.first_id + len(on_board))
    ids, pixels = markers.ids[mine] - board.first_id, markers.corners_px[mine]
    if len(ids) < FEWEST:
        return None
    metres = on_board[ids]
    sides_px = np.linalg.norm(np.diff(pixels, axis=1, append=pixels[:, :1]), axis=-1).mean(axis=1)
    within_px = STANDS_WITHIN * float(np.median(sides_px))
    H = homography(metres.reshape(-1, 2), pixels.reshape(-1, 2), within_px)
    if H is None:
        return None
    off = np.linalg.norm(carried(H, metres) - pixels, axis=-1).max(axis=1)
    keep = off < STANDS_WITHIN * np.maximum(sides_px, 6.0)
    nearest = np.lexsort((off, ids))
    first = nearest[np.unique(ids[nearest], return_index=True)[1]]
    keep &= np.isin(np.arange(len(ids)), first)
    if keep.sum() < FEWEST:
        return None
    return PlacedMarkers(ids[keep], pixels[keep], metres[keep])


def chessboard_corners(board: Checkerboard, image: Grey8) -> MeasuredCorners | None:
    """Return the corners of a chessboard to a pixel; None if it is not seen whole.

    Counted so that the colours are those of the print; if two orders have these, upright in the image.
    """
    across, down = board.columns - 1, board.rows - 1
    flags = cv2.CALIB_CB_NORMALIZE_IMAGE | cv2.CALIB_CB_EXHAUSTIVE
    found, corners = cv2.findChessboardCornersSB(image, (across, down), flags=flags)
    if not found:
        found, corners = cv2.findChessboardCorners(
            image, (across, down), flags=cv2.CALIB_CB_ADAPTIVE_THRESH | cv2.CALIB_CB_NORMALIZE_IMAGE
        )
    if not found:
        return None
    grid = np.asarray(corners, dtype=np.float64).reshape(down, across, 2)
    orders = [grid, grid[::-1, ::-1], grid[:, ::-1], grid[::-1]]
    if across == down:
        orders += [order.transpose(1, 0, 2) for order in orders]
    # rows to the right and columns down, as in the image, not mirrored
    orders = [one for one in orders if np.linalg.det([one[0, -1] - one[0, 0], one[-1, 0] - one[0, 0]]) > 0]
    dark = [_dark_first(image, order) for order in orders]
    # two orders may be right by colour; then the one whose rows run to the right
    likely = [order for order, first in zip(orders, dark, strict=True) if first] or orders
    upright = max(likely, key=lambda order: float((order[:, -1] - order[:, 0]).sum(axis=0)[0]))
    places = board.in_board_m(board.ids)[:, :2]
    return predicted(MeasuredCorners(places, upright.reshape(-1, 2)), board.ids, places)


def _dark_first(image: Grey8, grid: np.ndarray) -> bool:
    """Whether the squares on the diagonal of the first four corners are darker than their neighbours."""
    dark: list[int] = []
    light: list[int] = []
    height, width = image.shape
    for row in range(grid.shape[0] - 1):
        for column in range(grid.shape[1] - 1):
            x, y = np.rint(grid[row : row + 2, column : column + 2].mean(axis=(0, 1))).astype(int)
            if 0 <= x < width and 0 <= y < height:
                (dark if (row + column) % 2 == 0 else light).append(int(image[y, x]))
    # the square right below and right of the first corner has the upper left one's colour
    return bool(np.mean(dark) < np.mean(light))
