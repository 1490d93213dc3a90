"""Dots found in rendered pictures: how exactly, in which order, and what is said when they are not."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from calib.geometry.cahvor import CameraModel
from calib.geometry.rigid import Rigid
from calib.targets.boards import Board, CornersNotFound, Dots
from calib.targets.dot_grid import BoardGrid, Candidates, best_grid, dot_candidates
from calib.targets.dots import PredictedBoard, Upright, find_dots
from hil_tests.calib.targets.boards import (
    BOARD,
    COLUMNS,
    NAVCAM_PX,
    PANCAM_PX,
    ROWS,
    Shot,
    camera,
    gravel,
    pose,
    shoot,
)
from hil_tests.support.sim_survey.board import BoardLook

WANTED_PX = 0.03
WANTED_FAR_PX = 0.08
NORMALISED = 1.25
"""Errors over their sigmas, rms: one picture of 100 dots scatters by some 5 %, and sigmas may be cautious."""

SIDE = camera(NAVCAM_PX, (640, 480))


def check(
    shot: Shot,
    found: Dots | CornersNotFound,
    wanted_px: float,
    least: int = 100,
    cautious: float = 0.75,
) -> None:
    """Dots are in their order, and as exact as they claim."""
    assert isinstance(found, Dots), found
    assert len(found.rows) >= least
    errors = found.pixels_px - shot.true_px(found.rows, found.columns)
    assert np.linalg.norm(errors, axis=1).max() < 1.0, "wrong order"
    assert np.sqrt(np.mean(np.sum(errors**2, axis=1))) < wanted_px
    normalised = np.sqrt(np.mean((errors / found.sigma_px[:, None]) ** 2))
    assert cautious < normalised < NORMALISED


def reason(found: Dots | CornersNotFound) -> str:
    assert isinstance(found, CornersNotFound)
    assert "\n" not in found.reason
    return found.reason


@pytest.mark.parametrize(
    ("focal_px", "range_m", "tilt_deg", "wanted_px"),
    [
        (NAVCAM_PX, 3.0, 45, WANTED_PX),
        (NAVCAM_PX, 8.0, 30, WANTED_PX),
        (NAVCAM_PX, 10.0, 45, WANTED_FAR_PX),
        (PANCAM_PX, 5.0, 45, WANTED_PX),
        (PANCAM_PX, 10.0, 30, WANTED_PX),
    ],
)
def test_dots_on_gravel_are_as_exact_as_wanted(focal_px, range_m, tilt_deg, wanted_px) -> None:
    rng = np.random.default_rng([7, int(focal_px), int(range_m)])
    shot = shoot(rng, camera(focal_px), pose(range_m, (tilt_deg, rng.uniform(0, 360)), 8, (0.05, -0.1)))
    check(shot, find_dots(shot.image, BOARD, shot.roughly(rng)), wanted_px)


@pytest.mark.parametrize("stress", ["noise", "contrast", "gradient"])
def test_bad_pictures_cost_exactness_but_not_honesty(stress: str) -> None:
    rng = np.random.default_rng(11)
    y, x = np.mgrid[0:480, 0:640]
    looks: dict[str, dict[str, Any]] = {
        "noise": {"noise_dn": 6.0},
        "contrast": {"noise_dn": 3.0, "look": BoardLook(150.0, 90.0)},
        "gradient": {"shade": 1.0 - 0.6 * (x + y) / (640 + 480)},
    }
    shot = shoot(rng, SIDE, pose(6.0, (30, 100), -6), **looks[stress])
    check(shot, find_dots(shot.image, BOARD, shot.roughly(rng)), 0.06)


def test_centres_are_corrected_for_the_shape_of_circles() -> None:
    # without noise what remains is far below the bias of 0.03 px that was not removed
    rng = np.random.default_rng(12)
    shot = shoot(rng, camera(NAVCAM_PX), pose(3.0, (45, 20)), noise_dn=0.0)
    found = find_dots(shot.image, BOARD, shot.roughly(rng))
    assert isinstance(found, Dots)
    errors = found.pixels_px - shot.true_px(found.rows, found.columns)
    assert np.sqrt(np.mean(np.sum(errors**2, axis=1))) < 0.01


@pytest.mark.parametrize("roll_deg", [0, 70, 90, 180, 250])
def test_the_predicted_pose_settles_the_order(roll_deg: float) -> None:
    rng = np.random.default_rng(13)
    shot = shoot(rng, SIDE, pose(4.0, (20, 45), roll_deg))
    check(shot, find_dots(shot.image, BOARD, shot.roughly(rng)), WANTED_PX)


@pytest.mark.parametrize("columns", [6, 7])
def test_boards_that_are_not_square(columns: int) -> None:
    rng = np.random.default_rng(14)
    board = Board(columns, 7, 0.1, 0.04, {})
    for roll_deg in (0, 95):
        shot = shoot(rng, SIDE, pose(4.0, (25, 45), roll_deg), board)
        check(shot, find_dots(shot.image, board, shot.roughly(rng)), WANTED_PX, 7 * columns)


@pytest.mark.parametrize("hidden", ["scattered", "two outer columns"])
def test_dots_that_are_no_spots_are_filled_in_from_the_grid(hidden: str) -> None:
    """Spots taken away by hand; the picture still holds the dots."""
    rng = np.random.default_rng(19)
    shot = shoot(rng, SIDE, pose(4.0, (20, 45)))
    true_px = shot.true_px(ROWS, COLUMNS)
    diameter_px = NAVCAM_PX * BOARD.dot_diameter_m / 4.0
    spots = dot_candidates(shot.image, diameter_px, (0.2 * diameter_px**2, 1.2 * diameter_px**2))
    away = np.linalg.norm(spots.middles_px[:, None] - true_px, axis=-1)
    is_dot, dot = away.min(axis=1) < 2.0, away.argmin(axis=1)
    taken = COLUMNS[dot] >= 8 if hidden == "two outer columns" else np.isin(dot, [11, 34, 37, 55, 72, 90])
    kept = ~(is_dot & taken)
    assert is_dot.sum() == 100 and (is_dot & kept).sum() == (80 if hidden == "two outer columns" else 94)
    left = Candidates(spots.middles_px[kept], spots.shapes_px[kept])
    grid, _ = best_grid(shot.image, left, BOARD)
    assert isinstance(grid, BoardGrid), grid
    assert len(grid.places) == 100
    off_px = np.linalg.norm(grid.middles_px[:, None] - true_px, axis=-1).min(axis=1)
    assert off_px.max() < 0.5


def test_without_a_prediction_rows_run_to_the_right() -> None:
    rng = np.random.default_rng(15)
    shot = shoot(rng, SIDE, pose(4.0, (30, 45), -20))
    check(shot, find_dots(shot.image, BOARD), WANTED_PX)


def test_without_a_prediction_an_aslant_board_is_not_sure() -> None:
    rng = np.random.default_rng(16)
    shot = shoot(rng, SIDE, pose(4.0, (0, 0), 45))
    assert "which corner is the first" in reason(find_dots(shot.image, BOARD))


@pytest.mark.parametrize("roll_deg", [45, 90, 135, 200])
def test_an_upright_camera_gives_the_order_of_a_rolled_board(roll_deg: float) -> None:
    rng = np.random.default_rng(17)
    shot = shoot(rng, SIDE, pose(4.0, (25, 120), roll_deg, (0.3, 0.1)))
    down_in_board = shot.camera_from_board.rotation.T @ np.array([0.1, 1.0, 0.2])
    rough = CameraModel("CAHV", SIDE.size_px, SIDE.C, SIDE.A, SIDE.H * 1.05, SIDE.V * 1.05)
    check(shot, find_dots(shot.image, BOARD, Upright(rough, down_in_board)), WANTED_PX)


def test_an_upright_camera_gives_the_order_of_a_small_board() -> None:
    rng = np.random.default_rng(28)
    small = Board(10, 10, 0.01, 0.005, {})
    shot = shoot(rng, SIDE, pose(0.5, (25, 120), 90), small)
    down_in_board = shot.camera_from_board.rotation.T @ np.array([0.0, 1.0, 0.0])
    check(shot, find_dots(shot.image, small, Upright(SIDE, down_in_board)), WANTED_PX)


def test_a_mirrored_camera_sees_a_mirrored_order() -> None:
    rng = np.random.default_rng(18)
    # through a mirror: x of the image runs to the left
    flipped = CameraModel("CAHV", SIDE.size_px, SIDE.C, SIDE.A, [-NAVCAM_PX, 0, 319.5], SIDE.V)
    shot = shoot(rng, flipped, pose(4.0, (20, 10), 30))
    predicted = PredictedBoard(flipped, shot.camera_from_board)
    check(shot, find_dots(shot.image, BOARD, predicted), WANTED_PX)


def test_a_wide_lens_bends_the_grid() -> None:
    rng = np.random.default_rng(19)
    wide = CameraModel(
        "CAHVORE",
        (640, 480),
        C=[0, 0, 0],
        A=[0, 0, 1],
        H=[309, 0, 319.5],
        V=[0, 309, 239.5],
        R=[0, -0.015, 0.002],
        E=[0.004, 0.001, 0],
        cahvore_type=2,
    )
    shot = shoot(rng, wide, pose(0.9, (20, 30), 5, (0.35, 0.1)))
    ideal = CameraModel("CAHVORE", wide.size_px, wide.C, wide.A, wide.H, wide.V, cahvore_type=2)
    check(
        shot,
        find_dots(shot.image, BOARD, PredictedBoard(ideal, shot.camera_from_board)),
        WANTED_PX,
        cautious=0.5,
    )


def test_hidden_dots_are_left_out() -> None:
    rng = np.random.default_rng(20)
    shot = shoot(rng, SIDE, pose(4.0, (15, 45)))
    image = shot.image.copy()
    hidden = shot.true_px(np.array([4, 7]), np.array([2, 8]))
    for x, y in hidden:
        cv2.circle(image, (round(x) + 4, round(y)), 7, 120, -1)
    found = find_dots(image, BOARD, shot.roughly(rng))
    assert isinstance(found, Dots)
    seen = set(zip(found.rows.tolist(), found.columns.tolist(), strict=True))
    assert len(seen) >= 96 and not seen & {(4, 2), (7, 8)}
    errors = found.pixels_px - shot.true_px(found.rows, found.columns)
    assert np.abs(errors).max() < 0.1


def test_a_board_cut_by_the_image_says_by_which_edge() -> None:
    rng = np.random.default_rng(21)
    shot = shoot(rng, SIDE, pose(4.0, aside_m=(0.9, 0.0)))
    answer = reason(find_dots(shot.image, BOARD, PredictedBoard(shot.camera, shot.camera_from_board)))
    assert "right edge" in answer and "10 x 10 are expected" in answer


@pytest.mark.parametrize("roll_deg", [0, 90])
def test_dots_that_just_stand_inside_the_picture_count_and_cut_ones_do_not(roll_deg: float) -> None:
    """Seen aslant a dot is 13 px high and 6.5 px wide, whichever way the board is turned."""
    rng = np.random.default_rng(29)
    for aside_m, whole in ((0.72, 100), (0.725, 90)):
        shot = shoot(rng, SIDE, pose(4.0, (60, 90), roll_deg, (aside_m, 0.0)))
        found = find_dots(shot.image, BOARD, PredictedBoard(shot.camera, shot.camera_from_board))
        assert isinstance(found, Dots)
        assert len(found.rows) == whole


def test_a_covered_outer_row_is_not_guessed() -> None:
    rng = np.random.default_rng(22)
    shot = shoot(rng, SIDE, pose(4.0))
    image = shot.image.copy()
    first, last = shot.true_px(np.array([0, 0]), np.array([0, 9]))
    cv2.rectangle(
        image, (int(first[0]) - 40, int(first[1]) - 40), (int(last[0]) + 40, int(last[1]) + 9), 110, -1
    )
    assert "10 x 10 are expected" in reason(find_dots(image, BOARD, shot.roughly(rng)))


def test_gravel_without_a_board_is_a_failure() -> None:
    rng = np.random.default_rng(23)
    ground = gravel(rng).astype(np.uint8)
    for expected in (None, PredictedBoard(camera(NAVCAM_PX), pose(6.0))):
        assert "stand in a grid" in reason(find_dots(ground, BOARD, expected))
    assert reason(find_dots(np.full((480, 640), 90, dtype=np.uint8), BOARD))


def test_two_boards_are_not_chosen_between() -> None:
    rng = np.random.default_rng(24)
    one = shoot(rng, camera(NAVCAM_PX), pose(4.0, aside_m=(-0.6, 0)), noise_dn=0)
    two = shoot(rng, camera(NAVCAM_PX), pose(4.0, aside_m=(0.6, 0)), ground=one.image)
    assert "2 grids" in reason(find_dots(two.image, BOARD))


def test_a_board_seen_from_behind_by_the_survey_is_said() -> None:
    turned = Rigid(Rotation.from_rotvec([0, np.radians(170), 0]).as_matrix(), np.array([0, 0, 4.0]))
    answer = reason(find_dots(np.zeros((480, 640), dtype=np.uint8), BOARD, PredictedBoard(SIDE, turned)))
    assert "back of the board" in answer


def test_images_of_another_kind_are_refused() -> None:
    for image in (np.zeros((480, 640)), np.zeros((480, 640, 3), dtype=np.uint8)):
        with pytest.raises(ValueError, match="uint8 or uint16 is expected"):
            find_dots(image, BOARD)


def test_every_row_and_column_is_there_once() -> None:
    rng = np.random.default_rng(26)
    shot = shoot(rng, SIDE, pose(4.0, (10, 10)))
    found = find_dots(shot.image, BOARD, shot.roughly(rng))
    assert isinstance(found, Dots)
    seen = sorted(zip(found.rows.tolist(), found.columns.tolist(), strict=True))
    assert seen == sorted(zip(ROWS.tolist(), COLUMNS.tolist(), strict=True))


def test_a_board_with_a_quarter_of_its_dots_covered_is_refused() -> None:
    rng = np.random.default_rng(27)
    shot = shoot(rng, SIDE, pose(4.0))
    image = shot.image.copy()
    rows, columns = (a.ravel() for a in np.mgrid[2:7, 2:7])
    for x, y in shot.true_px(rows, columns):
        cv2.circle(image, (round(x), round(y)), 11, 200, -1)
    assert "10 x 10 are expected" in reason(find_dots(image, BOARD, shot.roughly(rng)))


def test_a_spot_is_measured_as_the_ellipse_that_was_drawn() -> None:
    """An ellipse of 8 by 5 px at 0.4 rad, drawn by its share of each pixel's 16 by 16 points."""
    x, y = np.meshgrid(np.arange(0.0, 64.0, 1 / 16) - 15 / 32, np.arange(0.0, 48.0, 1 / 16) - 15 / 32)
    turn = np.array([[np.cos(0.4), -np.sin(0.4)], [np.sin(0.4), np.cos(0.4)]])
    shape = turn @ np.diag([8.0, 5.0])
    inside = (
        np.linalg.norm((np.stack([x, y], axis=-1) - [31.3, 23.8]) @ np.linalg.inv(shape).T, axis=-1) < 1.0
    )
    image = (220 - 180 * inside.reshape(48, 16, 64, 16).mean(axis=(1, 3))).astype(np.uint8)
    spots = dot_candidates(image, 16.0, (40.0, 400.0))
    np.testing.assert_allclose(spots.middles_px, [[31.3, 23.8]], atol=0.25)  # the fit begins there
    [found] = spots.shapes_px
    np.testing.assert_allclose(found @ found.T, shape @ shape.T, atol=0.05 * 64.0)
