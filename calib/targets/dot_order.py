"""Where a grid of dots is looked for, and which row and column is its first: all four sides look the same.

The direction of the rows in the image decides, against the board's predicted pose, or against a camera taken
as upright. Whether rows and columns are mirrored is known from the side that the board is seen from.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from calib.geometry.cahvor import CameraModel
from calib.geometry.rigid import FloatArray, IntArray, Rigid
from calib.targets.boards import Board, Grey8
from calib.targets.dot_grid import homography
from calib.targets.dot_spots import UNEVEN, UNEVEN_AT_MOST

SURE_RAD = np.radians(32.0)
"""The nearest order is taken if it is off by less than this; the next is then 58 degrees off or more."""

STEEPEST = 0.3
"""A camera that looks down so steeply that less than this of the vertical is in its image shows nothing."""


class Ordered(NamedTuple):
    """columns, rows (n,) of dots whose places were given, and by how much the grid is turned, rad."""

    columns: IntArray
    rows: IntArray
    turned_rad: float


def order_by_steps(
    places: IntArray, counts: tuple[int, int], steps_px: FloatArray, board: Board, expected_px: FloatArray
) -> Ordered | None:
    """Count rows and columns so that their directions in the image are nearest to the expected ones.

    ``places`` (n, 2) are i and j of each dot, 0 to ``counts`` - 1; ``steps_px`` (2, 2) the steps of i and j
    in the image, as columns; ``expected_px`` (2, 2) where the steps of columns and rows should point, as
    columns. None if no way to count fits within ``SURE_RAD``.
    """
    orders: list[Ordered] = []
    for columns, rows, c_from_ij in _countings(places, counts, board):
        found = steps_px @ np.linalg.inv(c_from_ij)
        if np.linalg.det(found) * np.linalg.det(expected_px) <= 0.0:
            continue
        turned = _turn_of(found @ np.linalg.inv(expected_px))
        orders.append(Ordered(columns, rows, turned))
    return _surest(orders)


def order_by_gravity(
    places: IntArray,
    counts: tuple[int, int],
    middles_px: FloatArray,
    board: Board,
    camera: CameraModel,
    down_in_board: FloatArray,
) -> Ordered | None:
    """Count rows and columns so that the camera that took the picture stands upright.

    ``camera`` is a rough one in its own frame (x right, y down, z along A); ``down_in_board`` (3,) is the
    direction in the board's frame that is down in an upright camera's image. Other arguments and the result
    as ``order_by_steps``. None also if the camera looks down so steeply that its uprightness shows nothing.
    """
    from_places = _camera_from_places(camera, places, middles_px)
    if from_places is None:
        return None
    orders: list[Ordered] = []
    for columns, rows, c_from_ij in _countings(places, counts, board):
        affine = np.eye(3)  # from metres on the board to (i, j)
        shift = np.array([columns[0], rows[0]]) - c_from_ij @ places[0]
        middle = np.array([board.columns - 1, board.rows - 1]) / 2
        affine[:2, :2] = np.linalg.inv(c_from_ij) / board.spacing_m
        affine[:2, 2] = np.linalg.inv(c_from_ij) @ (middle - shift)
        H = from_places @ affine
        H = H / np.linalg.norm(H[:, 0])
        if np.linalg.det(H) <= 0.0:  # seen from behind
            continue
        U, _, Vt = np.linalg.svd(np.column_stack([H[:, 0], H[:, 1], np.cross(H[:, 0], H[:, 1])]))
        down = U @ Vt @ down_in_board
        if np.hypot(down[0], down[1]) < STEEPEST:
            continue
        turned = float(np.arctan2(-down[0], down[1]))
        orders.append(Ordered(columns, rows, turned))
    return _surest(orders)


def _surest(orders: list[Ordered]) -> Ordered | None:
    """The order that is turned least, if it is near enough."""
    best = min(orders, key=lambda one: abs(one.turned_rad), default=None)
    return best if best is not None and abs(best.turned_rad) < SURE_RAD else None


def _camera_from_places(camera: CameraModel, places: IntArray, middles_px: FloatArray) -> FloatArray | None:
    """(3, 3) that carries (i, j, 1) to points ahead of the camera, up to one positive factor."""
    rays = camera.ray(middles_px)
    if not rays.valid.all():
        return None
    ahead = rays.directions.mean(axis=0)
    # Slopes are taken about the board's own direction, so that a board far aside is as good as one in front.
    across = np.linalg.svd(ahead[None])[2][1:]
    frame = np.array([*across, ahead / np.linalg.norm(ahead)])
    turned = rays.directions @ frame.T
    H = homography(places.astype(np.float64), turned[:, :2] / turned[:, 2:])
    if H is None:
        return None
    depth = places.mean(axis=0) @ H[2, :2] + H[2, 2]
    return np.asarray(frame.T @ H * np.sign(depth), dtype=np.float64)


def expected_steps_px(camera: CameraModel, frame_from_board: Rigid) -> FloatArray | None:
    """Return the predicted steps of columns and rows at the board's middle, px/m, as columns of (2, 2)."""
    _, jacobian, valid = camera.project_jacobian(frame_from_board.translation_m)
    return np.asarray(jacobian @ frame_from_board.rotation[:, :2]) if valid else None


def _countings(
    places: IntArray, counts: tuple[int, int], board: Board
) -> list[tuple[IntArray, IntArray, FloatArray]]:
    """All ways to count: columns (n,), rows (n,) and the matrix from steps of (i, j) to (column, row)."""
    countings = []
    last = np.array(counts) - 1
    for swap in (False, True):
        if (counts[::-1] if swap else counts) != (board.columns, board.rows):
            continue
        for flips in ((0, 0), (0, 1), (1, 0), (1, 1)):
            flipped = np.where(flips, last - places, places)
            c, r = flipped.T[::-1] if swap else flipped.T
            signs = np.diag([-1.0 if f else 1.0 for f in flips])
            countings.append((c, r, signs[::-1] if swap else signs))
    return countings


def _turn_of(matrix: FloatArray) -> float:
    """The angle of the rotation nearest to a (2, 2) matrix of positive determinant."""
    return float(np.arctan2(matrix[1, 0] - matrix[0, 1], matrix[0, 0] + matrix[1, 1]))


PREDICTED_WITHIN_M = 0.25
PREDICTED_WITHIN_RAD = np.radians(12.0)
"""How wrong a prediction may be: rough cameras are good to 20 cm and 10 degrees."""

SIZE_WITHIN = 0.12
"""Relative error of the rough focal length, and what threshold and blur do to a spot's width."""

DIAMETERS_PX = (7.0, 12.0, 20.0, 34.0, 58.0, 100.0)
"""Widths of dots looked for where nothing is predicted, each good for dots down to half of it."""


@dataclass(frozen=True, eq=False)
class PredictedBoard:
    """Where the board should be: a rough camera, and the board's pose in the frame of its vectors."""

    camera: CameraModel
    frame_from_board: Rigid


@dataclass(frozen=True, eq=False)
class Upright:
    """Only that the camera stands upright; ``camera`` and ``down_in_board`` as for ``order_by_gravity``."""

    camera: CameraModel
    down_in_board: FloatArray


class DotSearch(NamedTuple):
    box_px: tuple[int, int, int, int]  # left, top, right, bottom; the last two exclusive
    size_px: tuple[float, tuple[float, float]]  # diameter, and least and most area
    uneven: float


def hopeless(expected: PredictedBoard) -> str:
    """Say why the board cannot be seen where it is predicted, or nothing."""
    in_board = expected.frame_from_board.inverse
    camera_m = in_board.points(expected.camera.C)
    away = float(np.arctan2(-camera_m[2], np.hypot(camera_m[0], camera_m[1])))
    if away < -PREDICTED_WITHIN_RAD:
        return "by the survey the camera sees the back of the board"
    if expected_steps_px(expected.camera, expected.frame_from_board) is None:
        return "by the survey the board is outside what the camera's lens can see"
    return ""


def searches(image: Grey8, board: Board, expected: PredictedBoard | Upright | None) -> Iterator[DotSearch]:
    """Where to look and for what, the likeliest first."""
    height, width = image.shape
    whole = (0, 0, width, height)
    if isinstance(expected, PredictedBoard):
        box, size = _predicted_search(board, expected, width, height)
        if size is not None:
            yield DotSearch(box, size, UNEVEN)
            diameter, (least, most) = size
            yield DotSearch(whole, (1.25 * diameter, (0.5 * least, 2.0 * most)), UNEVEN_AT_MOST)
    for diameter in DIAMETERS_PX:
        yield DotSearch(whole, (diameter, (0.12 * diameter**2, 1.2 * diameter**2)), UNEVEN)


def _predicted_search(
    board: Board, expected: PredictedBoard, width: int, height: int
) -> tuple[tuple[int, int, int, int], tuple[float, tuple[float, float]] | None]:
    """The part of the image that must hold the dots, and their size; no size where they have no image."""
    camera, pose = expected.camera, expected.frame_from_board
    rows, columns = (a.ravel() for a in np.mgrid[0 : board.rows, 0 : board.columns])
    dots = pose.points(board.dots_in_board_m(rows, columns))
    pixels, jacobian, valid = camera.project_jacobian(dots)
    whole = (0, 0, width, height)
    if not valid.any():
        return whole, None
    shapes = jacobian[valid] @ pose.rotation[:, :2] * (board.dot_diameter_m / 2)
    lengths = np.linalg.svd(shapes, compute_uv=False)
    range_m = float(np.linalg.norm(dots - camera.C, axis=-1).min())
    near = 1.0 + PREDICTED_WITHIN_M / max(range_m, 2 * PREDICTED_WITHIN_M) + SIZE_WITHIN
    tilt = 1.3  # the board's tilt against the line of sight is wrong by the angle that the camera is
    areas = np.pi * lengths[:, 0] * lengths[:, 1]
    size = (
        2.0 * float(lengths[:, 0].max()) * near,
        (float(areas.min()) / near**2 / tilt / 1.3, float(areas.max()) * near**2 * tilt + 8.0),
    )
    if not valid.all():
        return whole, size
    px_per_rad = float(lengths[:, 0].max()) / (board.dot_diameter_m / 2) * range_m
    slack = px_per_rad * (PREDICTED_WITHIN_RAD + PREDICTED_WITHIN_M / range_m) + size[0] * 2
    low = np.floor(pixels.min(axis=0) - slack).astype(int)
    high = np.ceil(pixels.max(axis=0) + slack).astype(int) + 1
    box = (max(0, low[0]), max(0, low[1]), min(width, high[0]), min(height, high[1]))
    if box[2] - box[0] < 16 or box[3] - box[1] < 16:
        return whole, size
    return (int(box[0]), int(box[1]), int(box[2]), int(box[3])), size
