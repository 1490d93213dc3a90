"""The print on a board: black on white, in the board's frame."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from calib.geometry.rigid import FloatArray
from calib.targets.board_file import FAMILIES
from calib.targets.boards import AnyBoard, AprilGrid, Charuco, Checkerboard, DotBoard

BoolArray = NDArray[np.bool_]
Rectangle = tuple[float, float, float, float]


@dataclass(frozen=True, eq=False)
class Cells:
    """A plane cut by lines into cells, each black or white; white beyond the outermost lines.

    ``x_m`` (m + 1,) and ``y_m`` (n + 1,) are the lines, ascending, metres in the board frame; ``black`` is
    (n, m).
    """

    x_m: FloatArray
    y_m: FloatArray
    black: BoolArray

    def is_black(self, x_m: ArrayLike, y_m: ArrayLike) -> BoolArray:
        """Return whether points of the board are black; not-a-number is white."""
        column = np.searchsorted(self.x_m, x_m, side="right")
        row = np.searchsorted(self.y_m, y_m, side="right")
        return np.asarray(np.pad(self.black, 1)[row, column])

    def rectangles_m(self) -> list[Rectangle]:
        """Return the black cells as few (left, top, right, bottom), metres, that do not overlap."""
        found: list[Rectangle] = []
        going: dict[tuple[int, int], int] = {}  # columns of a rectangle that is not closed yet: its first row
        for row in range(len(self.black) + 1):
            runs = set(_runs(self.black[row])) if row < len(self.black) else set()
            for run in [run for run in going if run not in runs]:
                first = going.pop(run)
                found.append((self.x_m[run[0]], self.y_m[first], self.x_m[run[1]], self.y_m[row]))
            for run in runs:
                going.setdefault(run, row)
        return [tuple(map(float, one)) for one in sorted(found, key=lambda one: (one[1], one[0]))]  # type: ignore[misc]


@dataclass(frozen=True, eq=False)
class Spots:
    """Black dots on white, their columns and rows evenly apart, metres in the board frame; aspect is height
    over width.
    """

    x_m: FloatArray
    y_m: FloatArray
    diameter_m: float
    aspect: float

    def is_black(self, x_m: ArrayLike, y_m: ArrayLike) -> BoolArray:
        """Return whether points of the board are black; not-a-number is white."""
        off = [_off_line(self.x_m, x_m), _off_line(self.y_m, y_m) / self.aspect]
        with np.errstate(invalid="ignore"):
            return np.asarray(np.hypot(*off) < self.diameter_m / 2)


@lru_cache(maxsize=8)
def pattern_of(board: AnyBoard) -> Cells | Spots:
    """Return what is printed on a board, its white margin apart."""
    match board:
        case DotBoard():
            return Spots(*board.lines_m, board.dot_diameter_m, board.aspect)
        case AprilGrid():
            return _aprilgrid(board)
        case Charuco() | Checkerboard():
            return _squares(board)


def _squares(board: Charuco | Checkerboard) -> Cells:
    """Squares, and in the white ones of a ChArUco board its markers."""
    rows, columns = np.mgrid[: board.rows, : board.columns]
    black = (rows + columns) % 2 == int(isinstance(board, Charuco) and board.first_is_white)
    width_m, height_m = board.size_m
    half = np.array([width_m, height_m / board.aspect]) / 2
    lines = [
        -size / 2 + np.arange(n + 1) * board.square_m
        for size, n in zip(2 * half, (board.columns, board.rows), strict=True)
    ]
    if isinstance(board, Checkerboard):
        return Cells(lines[0], lines[1] * board.aspect, np.asarray(black))
    dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, board.dictionary))
    cells = dictionary.markerSize + 2
    cut = (board.square_m - board.marker_m) / 2 + np.arange(cells + 1) / cells * board.marker_m
    places = np.concatenate([[0.0], cut])
    x_m, y_m = (np.append((start[:-1, None] + places).ravel(), start[-1]) for start in lines)
    drawn = np.repeat(np.repeat(black, cells + 2, axis=0), cells + 2, axis=1)
    for k, (row, column) in enumerate(np.argwhere(~black)):
        top, left = row * (cells + 2) + 1, column * (cells + 2) + 1
        drawn[top : top + cells, left : left + cells] = _marker(dictionary, board.first_id + k, 1)
    return Cells(x_m, y_m * board.aspect, drawn)


def _aprilgrid(board: AprilGrid) -> Cells:
    """Tags, and black squares between their corners.

    OpenCV's dictionaries hold AprilTag's tags upside down (against the codes of the AprilTag library, which
    Kalibr prints too).
    """
    dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, FAMILIES[board.family]))
    cells = dictionary.markerSize + 2 * board.border
    step = board.tag_m + board.gap_m
    places = np.concatenate([[0.0], board.gap_m + np.arange(cells) / cells * board.tag_m])
    lines = [
        np.append((np.arange(count + 1)[:, None] * step + places).ravel(), (count + 1) * step)
        - (count * step + board.gap_m) / 2
        for count in (board.columns, board.rows)
    ]
    x_m, y_m = (
        line[: count * (cells + 1) + 2]
        for line, count in zip(lines, (board.columns, board.rows), strict=True)
    )
    drawn = np.zeros((len(y_m) - 1, len(x_m) - 1), dtype=bool)
    drawn[:: cells + 1, :: cells + 1] = True
    for k in range(board.rows * board.columns):
        up, column = divmod(k, board.columns)
        top, left = (board.rows - 1 - up) * (cells + 1) + 1, column * (cells + 1) + 1
        tag = _marker(dictionary, board.first_id + k, board.border)
        drawn[top : top + cells, left : left + cells] = tag[::-1, ::-1]
    return Cells(x_m, y_m * board.aspect, drawn)


def _marker(dictionary: cv2.aruco.Dictionary, number: int, border: int) -> BoolArray:
    """The black cells of a marker, its border included."""
    side = dictionary.markerSize + 2 * border
    return np.asarray(cv2.aruco.generateImageMarker(dictionary, number, side, borderBits=border) == 0)


def _runs(row: BoolArray) -> list[tuple[int, int]]:
    """First and last + 1 of each run of true values."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], row, [False]]).astype(np.int8)))
    return [(int(a), int(b)) for a, b in edges.reshape(-1, 2)]


def _off_line(lines_m: FloatArray, places_m: ArrayLike) -> FloatArray:
    """How far places are from the nearest of evenly spaced lines."""
    step = float(lines_m[1] - lines_m[0])
    index = np.clip(np.rint((np.asarray(places_m) - lines_m[0]) / step), 0, len(lines_m) - 1)
    return np.asarray(np.asarray(places_m) - lines_m[0] - index * step)
