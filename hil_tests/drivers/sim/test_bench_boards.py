"""Boards held up before the rover: where OpenCV and hand-worked geometry say that they are."""

from __future__ import annotations

import math

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from calib.geometry.cahvor import CameraModel
from calib.geometry.rigid import Rigid
from calib.targets.boards import AprilGrid, Checkerboard
from drivers.errors import BadOptions
from drivers.sim.bench_boards import BenchBoard, BenchBoards, facing

Float32 = NDArray[np.float32]
F_PX, SIZE_PX = 900.0, (640, 480)
MATRIX = np.array([[F_PX, 0, 319.5], [0, F_PX, 239.5], [0, 0, 1]])
CAMERA = CameraModel("CAHV", SIZE_PX, C=np.zeros(3), A=MATRIX[2], H=MATRIX[0], V=MATRIX[1])
CORNER_PX = 0.04
"""What OpenCV's cornerSubPix is good to on chess corners: 0.03 px."""

"""Of 170 between ink and paper: by so much may two ways to sample a pixel differ, root mean square."""


def grey(camera: CameraModel, pose: Rigid, samples: int = 2, rows: tuple[int, int] | None = None) -> Float32:
    """A scene of nothing."""
    return np.full(camera.size_px[::-1], 100.0, dtype=np.float32)


def picture(board: BenchBoard) -> Float32:
    boards = BenchBoards(grey)
    boards.put("one", board)
    return boards.image(CAMERA, Rigid.identity())


@pytest.mark.parametrize("bow_m", [(0.0, 0.0), (0.01, 0.0), (0.0, -0.008)])
def test_corners_are_where_opencv_projects_and_finds_them(bow_m: tuple[float, float]) -> None:
    board = Checkerboard(8, 7, 0.04)
    turn = np.array(cv2.Rodrigues(np.array([0.3, -0.4, 0.1]))[0], float)
    shift = np.array([0.03, -0.02, 0.8])
    seen = picture(BenchBoard(board, Rigid(turn, shift), bow_m))
    levels = np.rint(cv2.GaussianBlur(seen, (0, 0), 0.6)).astype(np.uint8)
    found, corners = cv2.findChessboardCorners(levels, (7, 6))
    assert found
    stop = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_MAX_ITER, 50, 1e-4)
    corners = cv2.cornerSubPix(levels, corners, (6, 6), (-1, -1), stop)
    x, y = np.meshgrid((np.arange(7) - 3) * 0.04, (np.arange(6) - 2.5) * 0.04)
    z = -bow_m[0] * (1 - (x / 0.12) ** 2) - bow_m[1] * (1 - (y / 0.1) ** 2)
    points = np.stack([x, y, z], axis=-1).reshape(-1, 3)
    wanted, _ = cv2.projectPoints(points, cv2.Rodrigues(turn)[0], shift, MATRIX, None)
    off = corners.reshape(-1, 2) - wanted.reshape(-1, 2)
    if np.abs(off).max() > 1.0:  # counted from the other end
        off = corners.reshape(-1, 2)[::-1] - wanted.reshape(-1, 2)
    assert float(np.sqrt(np.mean(off**2))) < CORNER_PX


def test_the_nearer_of_two_boards_hides_the_other() -> None:
    boards = BenchBoards(grey)
    near = BenchBoard(Checkerboard(4, 4, 0.05), Rigid(np.eye(3), np.array([0.0, 0.0, 1.0])))
    far = BenchBoard(AprilGrid(6, 6, 0.08, 0.024), Rigid(np.eye(3), np.array([0.0, 0.0, 2.0])))
    boards.put("near", near)
    alone = boards.image(CAMERA, Rigid.identity())
    boards.put("far", far)
    both = boards.image(CAMERA, Rigid.identity())
    assert np.array_equal(both[180:300, 260:380], alone[180:300, 260:380])
    assert not np.array_equal(both, alone)


def test_a_board_faces_the_eye_upright_and_turns_about_itself() -> None:
    ahead = facing([0, 0, -1.5], [2.0, 0.0, -1.5])
    assert np.allclose(ahead.rotation, [[0, 0, 1], [1, 0, 0], [0, 1, 0]])
    upper = facing([0, 0, -1.5], [2.0, 0.0, -1.5], [0.3, 0.0, 0.0]).points(np.array([0.0, -1.0, 0.0]))
    assert upper[0] == pytest.approx(2.0 - math.sin(0.3))  # nearer
    right = facing([0, 0, -1.5], [2.0, 0.0, -1.5], [0.0, 0.3, 0.0]).points(np.array([1.0, 0.0, 0.0]))
    assert right[0] == pytest.approx(2.0 - math.sin(0.3))  # nearer
    with pytest.raises(BadOptions, match="over or under"):
        facing([0, 0, -1.5], [0.0, 0.0, 1.0])
