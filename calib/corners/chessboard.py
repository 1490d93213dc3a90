"""A plain chessboard in an image, seen whole."""

from __future__ import annotations

import cv2
import numpy as np

from calib.boards import Checkerboard
from calib.corners.lattice import Known, predicted
from calib.corners.markers import Image


def chessboard_corners(board: Checkerboard, image: Image) -> Known | None:
    """Return the corners of a chessboard to a pixel; None if it is not seen whole.

    Counted so that the colours are those of the print, and if they are so both ways, upright in the image.
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
    ways = [grid, grid[::-1, ::-1], grid[:, ::-1], grid[::-1]]
    if across == down:
        ways += [way.transpose(1, 0, 2) for way in ways]
    ways = [way for way in ways if _handed(way) > 0]
    dark = [_dark_first(image, way) for way in ways]
    # both ways may be right by colour; then the one whose rows run to the right
    likely = [way for way, first in zip(ways, dark, strict=True) if first] or ways
    upright = max(likely, key=lambda way: float((way[:, -1] - way[:, 0]).sum(axis=0)[0]))
    places = board.in_board_m(board.ids)[:, :2]
    return predicted(Known(places, upright.reshape(-1, 2)), board.ids, places)


def _handed(grid: np.ndarray) -> float:
    """Above 0 where rows to the right and columns down are so in the image, not mirrored."""
    right, down = grid[0, -1] - grid[0, 0], grid[-1, 0] - grid[0, 0]
    return float(right[0] * down[1] - right[1] * down[0])


def _dark_first(image: Image, grid: np.ndarray) -> bool:
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
