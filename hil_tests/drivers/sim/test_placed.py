"""Rocks, bricks and boards where a configuration puts them: in the pictures, or refused."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from calib.files.mast_file import load_rig
from calib.geometry.cahvor import CameraModel
from calib.geometry.rigid import Rigid
from drivers.errors import BadOptions
from drivers.sim.bench_boards import BenchBoards, placed_board
from drivers.sim.placed import check_clear_of
from drivers.sim.render import Renderer
from drivers.sim.scene import Scene
from drivers.sim.settings import scene_settings
from hil_tests.drivers.sim.small_scenes import build_small_scene

FOCAL_PX, SIZE_PX = 900.0, (800, 600)
EYE_M = np.array([0.1, -0.05, -1.2])
DOTS = {
    "x_m": 3.5,
    "y_m": -0.9,
    "heading_rad": 2.8,
    "lean_rad": 0.15,
    "raised_m": 0.3,
    "rows": 6,
    "columns": 7,
}
SQUARES = {
    "kind": "charuco",
    "x_m": 3.0,
    "y_m": 0.7,
    "heading_rad": -2.9,
    "raised_m": 0.6,
    "rows": 5,
    "columns": 7,
}
PLACED: dict[str, Any] = {
    "seed": 3,
    "boards": [DOTS, SQUARES],
    "bricks": [
        {"x_m": 2.2, "y_m": 0.1, "heading_rad": 0.4, "length_m": 0.5, "width_m": 0.3, "height_m": 0.25}
    ],
    "rocks": [{"x_m": 4.5, "y_m": 0.2, "diameter_m": 0.7, "heading_rad": 1.0}],
}


@pytest.fixture(scope="module")
def placed() -> Scene:
    return build_small_scene(scene_settings(PLACED))


@pytest.fixture(scope="module")
def picture(placed: Scene) -> np.ndarray:
    """The two boards from a camera that looks level to the north, eight by eight rays a pixel."""
    (width, height), c = SIZE_PX, EYE_M
    camera = CameraModel(
        "CAHV", SIZE_PX, C=c, A=np.array([1.0, 0.0, 0.0]), H=np.array([(width - 1) / 2, FOCAL_PX, 0.0]),
        V=np.array([(height - 1) / 2, 0.0, FOCAL_PX]),
    )  # fmt: skip
    boards = [placed_board(board, placed.ground_z_m) for board in placed.settings.boards]
    renderer = Renderer(placed)
    try:
        return BenchBoards(renderer.image, boards).image(camera, Rigid.identity(), 8)
    finally:
        renderer.close()


def on_board_m(board: dict[str, Any], ground_z_m: float, flat_m: np.ndarray) -> np.ndarray:
    """Points (n, 3) of points (n, 2) of a face, right of and above its lower edge's middle; by OpenCV.

    The board lies face up with its top to the north, is raised about its lower edge, then turned.
    """
    points = np.column_stack([flat_m[:, 1], flat_m[:, 0], np.zeros(len(flat_m))])  # north, east
    up = math.pi / 2 - board.get("lean_rad", 0.0)
    points = points @ cv2.Rodrigues(np.array([0.0, up, 0.0]))[0].T  # now it looks south
    turn = board["heading_rad"] - math.pi
    points = points @ cv2.Rodrigues(np.array([0.0, 0.0, turn]))[0].T
    points += [board["x_m"], board["y_m"], ground_z_m - board["raised_m"]]
    return points


def seen_px(board: dict[str, Any], ground_z_m: float, flat_m: np.ndarray) -> np.ndarray:
    """Pixels (n, 2) of such points in ``picture``, by OpenCV."""
    points = on_board_m(board, ground_z_m, flat_m)
    in_camera = (points - EYE_M)[:, [1, 2, 0]]  # right, down, ahead
    matrix = np.array([[FOCAL_PX, 0, (SIZE_PX[0] - 1) / 2], [0, FOCAL_PX, (SIZE_PX[1] - 1) / 2], [0, 0, 1]])
    return cv2.projectPoints(in_camera, np.zeros(3), np.zeros(3), matrix, None)[0].reshape(-1, 2)


def test_a_charuco_board_is_where_exact_geometry_puts_it(placed: Scene, picture: np.ndarray) -> None:
    """OpenCV's own detector finds its corners where OpenCV's projection puts them."""
    square, margin, detector_px = 0.08, 0.02, 0.12
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_5X5_100)
    board = cv2.aruco.CharucoBoard((7, 5), square, 0.06, dictionary)
    corners, ids, _, _ = cv2.aruco.CharucoDetector(board).detectBoard(np.rint(picture).astype(np.uint8))
    assert ids is not None and len(ids) == 6 * 4
    x, y = np.array(board.getChessboardCorners(), float)[ids.ravel(), :2].T
    flat = np.column_stack([x - 3.5 * square, margin + 5 * square - y])
    wanted = seen_px(SQUARES, placed.ground_z_m(3.0, 0.7), flat)
    off = corners.reshape(-1, 2) - wanted
    assert float(np.sqrt((off**2).mean())) < detector_px, np.abs(off).max(axis=0)


def test_a_brick_is_met_where_its_numbers_put_it(placed: Scene) -> None:
    points_m = placed.world.rocks.corners_m[-1].reshape(-1, 3)
    ahead, right = (np.array([math.cos(a), math.sin(a), 0.0]) for a in (0.4, 0.4 + math.pi / 2))
    for along, across in ((1, 0), (-1, 0), (0, 1), (0, -1)):
        outwards = along * ahead + across * right
        half = 0.25 if along else 0.15
        top_m = points_m[:, 2].min()
        start = np.array([2.2, 0.1, top_m + 0.05]) + 1.0 * outwards
        assert placed.cast(start, -outwards) == pytest.approx(1.0 - half, abs=1e-9)
    assert placed.cast([2.2, 0.1, -3.0], [0.0, 0.0, 1.0]) == pytest.approx(3.0 + top_m, abs=1e-9)
    away_m = np.hypot(points_m[:, 0] - 2.2, points_m[:, 1] - 0.1)
    lowest = (points_m[:, 2] > points_m[:, 2].max() - 1e-9) & (away_m > away_m.max() - 1e-9)
    sunk_m = [z - placed.ground_z_m(x, y) for x, y, z in points_m[lowest]]
    assert min(sunk_m) == pytest.approx(0.02), "no gap under it"


@pytest.mark.parametrize(
    ("scene", "told"),
    [
        ({"boards": 3}, "simulation.scene.boards is 3, expected a list"),
        ({"rocks": [{"x_m": 30, "y_m": 0}]}, r"rocks\[0\].x_m: 30 where a number from -28 to 28 is"),
        (
            {"boards": [{"x_m": 3, "y_m": 0, "kind": "checker"}]},
            r"boards\[0\].kind: the text 'checker' where",
        ),
        (
            {"boards": [{"x_m": 3, "y_m": 0, "kind": "charuco", "dictionary": "DICT_4X4_50", "rows": 20}]},
            "needs 100 markers, and DICT_4X4_50 has 50",
        ),
        (
            {"boards": [{"x_m": 3, "y_m": 0}], "bricks": [{"x_m": 3, "y_m": 0.2}]},
            r"boards\[0\] at \(3, 0\) m stands in simulation.scene.bricks\[0\] at \(3, 0.2\) m",
        ),
    ],
)
def test_what_cannot_be_placed_is_refused_with_place_and_value(scene: dict[str, Any], told: str) -> None:
    with pytest.raises(BadOptions, match=told) as refused:
        scene_settings(scene)
    assert "\n" not in str(refused.value)


def test_nothing_is_placed_in_the_rover_or_where_a_camera_can_come(repository: Path) -> None:
    rig = load_rig(repository / "configs" / "sim" / "rocky8.yaml").rig
    for what in ({"bricks": [{"x_m": 0.3, "y_m": 0.0}]}, {"rocks": [{"x_m": 0.7, "y_m": 0.0}]}):
        with pytest.raises(
            BadOptions, match=r"comes within 0.\d\d m of the rover's origin, expected 0.\d\d m at least"
        ):
            check_clear_of(scene_settings(what).placed, rig)
    check_clear_of(scene_settings({"bricks": [{"x_m": 1.0, "y_m": 0.0}]}).placed, rig)
