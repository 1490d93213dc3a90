"""Markers of a board in an image, by OpenCV, and which of them stand as on the board."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from calib.boards import AprilGrid, Charuco
from calib.boards.board_file import FAMILIES
from calib.rigid import FloatArray

Image = NDArray[np.uint8]
IntArray = NDArray[np.int64]
MarkerBoard = Charuco | AprilGrid

LEAST_PERIMETER = 0.01
"""Of a marker, against the image's longer side; OpenCV's 0.03 loses a far board in a large picture."""

FEW = 0.5
"""Where fewer of the board's markers are found, the image is searched a second time, twice as large."""

FEWEST = 2
STANDS_WITHIN = 0.35
"""A marker stands as on the board if its corners are within so much of its side from there (a lens bends)."""


class Markers(NamedTuple):
    """What OpenCV found: ids (n,); corners_px (n, 4, 2) in the order of the markers' own upright pictures."""

    ids: IntArray
    corners_px: FloatArray


@dataclass(frozen=True, eq=False)
class Standing:
    """Markers that stand as on the board, each id once.

    ids (n,); corners_px (n, 4, 2); corners_m (n, 4, 2) on the board; homography (3, 3) from metres to pixels.
    """

    ids: IntArray
    corners_px: FloatArray
    corners_m: FloatArray
    homography: FloatArray


def detect(image: Image, board: MarkerBoard) -> Markers:
    """Return all markers of the board's dictionary in an image."""
    dictionary = board.dictionary if isinstance(board, Charuco) else FAMILIES[board.family]
    border = board.border if isinstance(board, AprilGrid) else 1
    found = search(image, dictionary, border)
    if len(found.ids) < FEW * count_of(board) and max(image.shape) < 5000:
        large = cv2.resize(image, None, fx=2.0, fy=2.0, interpolation=cv2.INTER_CUBIC)
        again = search(np.asarray(large, dtype=np.uint8), dictionary, border)
        if len(again.ids) > len(found.ids):
            # the centre of the upper left pixel is (0, 0) in both
            return Markers(again.ids, (again.corners_px + 0.5) / 2.0 - 0.5)
    return found


def search(image: Image, dictionary: str, border: int) -> Markers:
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
    parameters.minMarkerPerimeterRate = LEAST_PERIMETER
    known = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, dictionary))
    return cv2.aruco.ArucoDetector(known, parameters)


def count_of(board: MarkerBoard) -> int:
    """Return how many markers a board has."""
    return board.rows * board.columns if isinstance(board, AprilGrid) else board.rows * board.columns // 2


def corners_on_board_m(board: MarkerBoard) -> FloatArray:
    """Return the corners (n, 4, 2) of all markers, metres, in the order in which OpenCV tells them."""
    if isinstance(board, AprilGrid):
        step, side = board.tag_m + board.gap_m, board.tag_m
        up, column = np.divmod(np.arange(board.rows * board.columns), board.columns)
        middles = np.stack(
            [(column - (board.columns - 1) / 2) * step, ((board.rows - 1) / 2 - up) * step], axis=-1
        )
        half = -side / 2  # OpenCV's tags are upside down
    else:
        row, column = np.divmod(np.arange(board.rows * board.columns), board.columns)
        white = (row + column) % 2 == int(not _white_first(board))
        row, column = row[white], column[white]
        middles = (
            np.stack([(column - (board.columns - 1) / 2), (row - (board.rows - 1) / 2)], axis=-1)
            * board.square_m
        )
        half = board.marker_m / 2
    square = half * np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])
    return np.asarray((middles[:, None] + square) * [1.0, board.aspect], dtype=np.float64)


def standing(markers: Markers, board: MarkerBoard) -> Standing | None:
    """Return the markers that stand as on the board; None if too few do."""
    on_board = corners_on_board_m(board)
    mine = (markers.ids >= board.first_id) & (markers.ids < board.first_id + len(on_board))
    ids, pixels = markers.ids[mine] - board.first_id, markers.corners_px[mine]
    if len(ids) < FEWEST:
        return None
    metres = on_board[ids]
    sides_px = np.linalg.norm(np.diff(pixels, axis=1, append=pixels[:, :1]), axis=-1).mean(axis=1)
    H, _ = cv2.findHomography(
        metres.reshape(-1, 2),
        pixels.reshape(-1, 2),
        cv2.RANSAC,
        STANDS_WITHIN * float(np.median(sides_px)),
        maxIters=4000,
    )
    if H is None or not np.isfinite(H).all():
        return None
    off = np.linalg.norm(carried(np.asarray(H, dtype=np.float64), metres) - pixels, axis=-1).max(axis=1)
    keep = off < STANDS_WITHIN * np.maximum(sides_px, 6.0)
    nearest = np.lexsort((off, ids))
    first = nearest[np.unique(ids[nearest], return_index=True)[1]]
    keep &= np.isin(np.arange(len(ids)), first)
    if keep.sum() < FEWEST:
        return None
    return Standing(ids[keep], pixels[keep], metres[keep], np.asarray(H))


def carried(homography: FloatArray, points: FloatArray) -> FloatArray:
    """Return points (..., 2) after a homography (3, 3)."""
    whole = points @ homography[:, :2].T + homography[:, 2]
    return np.asarray(whole[..., :2] / whole[..., 2:])


def _white_first(board: Charuco) -> bool:
    """Whether the square in the upper left corner is white."""
    return board.legacy and board.rows % 2 == 0
