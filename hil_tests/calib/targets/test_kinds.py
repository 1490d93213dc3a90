"""Where corners are on a board, against OpenCV's and Kalibr's own statements."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from calib.targets.boards import AprilGrid, Charuco, Checkerboard, DotBoard
from calib.targets.pattern import pattern_of

CHARUCO = Charuco(9, 12, 0.02, 0.015)


def test_charuco_corners_are_opencvs() -> None:
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_5X5_100)
    theirs = cv2.aruco.CharucoBoard((9, 12), 0.02, 0.015, dictionary).getChessboardCorners()
    ours = CHARUCO.in_board_m(CHARUCO.ids)
    assert ours.shape == (88, 3)
    assert np.allclose(np.subtract(ours, ours[0]), np.subtract(theirs, theirs[0]), atol=1e-7)
    assert np.allclose(ours.mean(axis=0), 0.0)


def test_aprilgrid_counts_as_kalibr_does() -> None:
    """GridCalibrationTargetAprilgrid.cpp: tag 0 is the lower left one, points count row by row from there."""
    board = AprilGrid(2, 2, 0.08, 0.024)
    places = board.in_board_m(board.ids)[:, :2] * [1, -1]  # y up, as Kalibr's
    right = [0.0, 0.08, 0.104, 0.184]
    assert np.allclose(places - places[0], [(x, y) for y in right for x in right])
    assert board.size_m == pytest.approx((0.232, 0.232))


def test_a_checkerboard_and_dots_have_their_middle_in_the_origin() -> None:
    assert Checkerboard(4, 3, 0.1).in_board_m([0, 5]).tolist() == [[-0.1, -0.05, 0], [0.1, 0.05, 0]]
    dots = DotBoard(4, 3, 0.08, 0.04)
    assert np.allclose(dots.in_board_m([0, 11]), [[-0.12, -0.08, 0], [0.12, 0.08, 0]])
    assert dots.size_m == pytest.approx((0.28, 0.2))


def test_a_print_longer_down_than_across_keeps_its_width() -> None:
    places = Checkerboard(4, 3, 0.1, aspect=1.002).in_board_m([0, 5])
    assert np.allclose(places[:, :2], [[-0.1, -0.0501], [0.1, 0.0501]])


def test_a_bow_lifts_the_middle_and_leaves_the_outer_corners() -> None:
    board = Checkerboard(4, 4, 0.1)  # corners at -0.1, 0 and 0.1
    bent = board.in_board_m(board.ids, (0.002, 0.001)).reshape(3, 3, 3)
    assert np.allclose(bent[..., 2], [[0, -0.002, 0], [-0.001, -0.003, -0.001], [0, -0.002, 0]])
    assert np.allclose(bent[..., :2], board.in_board_m(board.ids).reshape(3, 3, 3)[..., :2])


def test_a_corner_that_the_board_does_not_have_is_no_place() -> None:
    with pytest.raises(ValueError, match="0 to 87 are"):
        CHARUCO.in_board_m([88])


@pytest.mark.parametrize("legacy", [False, True])
@pytest.mark.parametrize(("columns", "rows", "first_id"), [(5, 7, 0), (6, 8, 17), (7, 6, 17)])
def test_a_charuco_board_is_drawn_as_opencv_draws_it(
    columns: int, rows: int, first_id: int, legacy: bool
) -> None:
    texels, texel_m = 56, 0.001  # so many that a marker's cells are whole texels
    board = Charuco(columns, rows, 0.056, 0.042, "DICT_5X5_100", first_id, legacy)
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_5X5_100)
    ids = np.arange(columns * rows // 2) + first_id
    theirs = cv2.aruco.CharucoBoard((columns, rows), 0.056, 0.042, dictionary, ids)
    theirs.setLegacyPattern(legacy)
    drawing = theirs.generateImage((columns * texels, rows * texels), marginSize=0, borderBits=1)
    x, y = ((np.arange(n * texels) + 0.5 - n * texels / 2) * texel_m for n in (columns, rows))
    assert np.array_equal(pattern_of(board).is_black(*np.meshgrid(x, y)), drawing < 128)
