"""Where in an image the board is looked for, and for dots of which size, from what is known beforehand."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from calib.camera.cahvor import CameraModel
from calib.dots.candidates import UNEVEN, UNEVEN_AT_MOST, Image
from calib.dots.order import expected_steps_px
from calib.rigid import FloatArray, Rigid
from calib.survey import Board

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
    """Only that the camera stands upright.

    ``camera`` is a rough one in its own frame (x right, y down, z along A); ``down_in_board`` (3,) the
    direction in the board's frame that is down in an upright camera's image.
    """

    camera: CameraModel
    down_in_board: FloatArray


class Search(NamedTuple):
    box_px: tuple[int, int, int, int]  # left, top, right, bottom; the last two exclusive
    size_px: tuple[float, tuple[float, float]]  # diameter, and least and most area
    uneven: float


def hopeless(expected: PredictedBoard) -> str:
    """Say why the board cannot be seen where it is predicted, or nothing."""
    in_board = expected.frame_from_board.inverse
    eye = in_board.points(expected.camera.C)
    away = float(np.arctan2(-eye[2], np.hypot(eye[0], eye[1])))
    if away < -PREDICTED_WITHIN_RAD:
        return "by the survey the camera sees the back of the board"
    if expected_steps_px(expected.camera, expected.frame_from_board) is None:
        return "by the survey the board is outside what the camera's lens can see"
    return ""


def searches(image: Image, board: Board, expected: PredictedBoard | Upright | None) -> Iterator[Search]:
    """Where to look and for what, the likeliest first."""
    height, width = image.shape
    whole = (0, 0, width, height)
    if isinstance(expected, PredictedBoard):
        box, size = _predicted_search(board, expected, width, height)
        if size is not None:
            yield Search(box, size, UNEVEN)
            diameter, (least, most) = size
            yield Search(whole, (1.25 * diameter, (0.5 * least, 2.0 * most)), UNEVEN_AT_MOST)
    for diameter in DIAMETERS_PX:
        yield Search(whole, (diameter, (0.12 * diameter**2, 1.2 * diameter**2)), UNEVEN)


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
