"""Rocks, bricks and boards where a configuration puts them: in the pictures, or refused."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from calib.files.mast_file import load_rig
from calib.geometry.cahvor import CameraModel, Kind
from calib.geometry.pointing import solve
from calib.geometry.rig import Mast
from calib.geometry.rigid import Rigid
from drivers.errors import BadOptions
from drivers.sim.placed import check_clear_of
from drivers.sim.quick_start import read, write
from drivers.sim.render import Renderer
from drivers.sim.scene import Scene, build_scene
from drivers.sim.settings import scene_settings
from hil_tests.drivers.sim.small_scenes import build_small_scene

FOCAL_PX, SIZE_PX = 900.0, (800, 600)
EYE_M = np.array([0.1, -0.05, -1.2])
TOLERANCE_PX = 0.02

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
    return build_small_scene(scene_settings(PLACED, Path()))


@pytest.fixture(scope="module")
def picture(placed: Scene) -> np.ndarray:
    """The two boards from a camera that looks level to the north, eight by eight rays a pixel."""
    (width, height), c = SIZE_PX, EYE_M
    camera = CameraModel(
        "CAHV", SIZE_PX, C=c, A=[1, 0, 0], H=[(width - 1) / 2, FOCAL_PX, 0], V=[(height - 1) / 2, 0, FOCAL_PX]
    )
    renderer = Renderer(placed)
    try:
        return renderer.image(camera, Rigid.identity(), 8)
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


def test_a_boards_dots_are_where_exact_geometry_puts_them(placed: Scene, picture: np.ndarray) -> None:
    """Centroids of ink against centroids of the projected rims."""
    reach = int(1.5 * RADIUS_M * FOCAL_PX / 3.7)
    rims = [seen_px(DOTS, placed.ground_z_m(3.5, -0.9), rim) for rim in dot_rims()]
    apart = dots_off(picture, rims, reach)
    assert np.abs(apart).max() < TOLERANCE_PX, np.abs(apart).max(axis=0)


ANOTHER_LENS = pytest.mark.long(3, "nine seconds a lens; OPENCV8 is drawn in the quick run")


@pytest.mark.parametrize(
    ("kind", "distortion"),
    [
        ("OPENCV8", [0.5, 0.1, 0.001, -0.0005, 0.01, 0.8, 0.2, 0.03]),
        pytest.param(
            "OPENCV14",
            [-0.3, 0.1, 0.002, -0.001, 0.0, 0.0, 0.0, 0.0, 1e-3, -2e-3, 5e-4, 1e-3, 0.02, -0.03],
            marks=ANOTHER_LENS,
        ),
        pytest.param("OPENCV_FISHEYE", [-0.02, 0.01, -0.004, 0.0005], marks=ANOTHER_LENS),
    ],
)
def test_a_head_camera_with_opencvs_lens_points_and_is_drawn_as_opencv_says(
    placed: Scene, kind: Kind, distortion: list[float]
) -> None:
    """A dot pointed onto a pixel off the middle: where cv2 projects it, and where the picture has its ink."""
    matrix = np.array([[640.0, 0.0, 405.0], [0.0, 642.0, 296.0], [0.0, 0.0, 1.0]])
    rotation = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]])
    model = CameraModel.of_matrix(kind, SIZE_PX, matrix, distortion, rotation, [0.06, -0.1, -0.05])
    mast = Mast(np.array([0.2, 0.0, -1.1]), np.array([-0.009, -0.018, 0.003]), 0.02, 0.01)
    ground_z_m = placed.ground_z_m(3.5, -0.9)
    target = on_board_m(DOTS, ground_z_m, np.array([[0.0, 0.32]]))[0]
    aim = np.array([230.0, 170.0])
    best = solve(mast, model, target, aim)[0]
    rover_from_head = mast.rover_from_head(best.pan_rad, best.tilt_rad)
    seen = model.moved(rover_from_head)
    turn, move = cv2.Rodrigues(seen.rotation)[0], -seen.rotation @ seen.C

    def by_cv2(points: np.ndarray) -> np.ndarray:
        project = cv2.fisheye.projectPoints if kind == "OPENCV_FISHEYE" else cv2.projectPoints
        return project(points[:, None], turn, move, matrix, np.array(distortion))[0].reshape(-1, 2)

    np.testing.assert_allclose(by_cv2(target[None])[0], aim, atol=1e-8)
    renderer = Renderer(placed)
    try:
        picture = renderer.image(model, rover_from_head, 8)
    finally:
        renderer.close()
    rims = [by_cv2(on_board_m(DOTS, ground_z_m, rim)) for rim in dot_rims()]
    assert all((rim > 8).all() and (rim < np.array(SIZE_PX) - 8).all() for rim in rims)
    apart = dots_off(picture, rims, int(1.5 * RADIUS_M * 640.0 / 3.7))
    assert np.abs(apart).max() < 1.5 * TOLERANCE_PX, np.abs(apart).max(axis=0)


RADIUS_M = 0.02


def dot_rims() -> list[np.ndarray]:
    """The rims (400, 2) of all dots of ``DOTS``, on its face."""
    spacing, margin = 0.08, 0.08
    row, column = (part.ravel() for part in np.mgrid[0:6, 0:7])
    flat = np.column_stack([(column - 3) * spacing, margin + (5 - row) * spacing])
    turn = np.linspace(0.0, 2 * np.pi, 400, endpoint=False)
    return [middle + RADIUS_M * np.column_stack([np.cos(turn), np.sin(turn)]) for middle in flat]


def dots_off(picture: np.ndarray, rims: list[np.ndarray], reach: int) -> np.ndarray:
    """How far the ink of each dot is from the middle of its projected rim (n, 2)."""
    apart = []
    for rim in rims:
        moments = cv2.moments(rim.astype(np.float32)[:, None])
        x, y = moments["m10"] / moments["m00"], moments["m01"] / moments["m00"]
        x0, y0 = round(x) - reach, round(y) - reach
        window = picture[y0 : y0 + 2 * reach + 1, x0 : x0 + 2 * reach + 1].astype(float)
        paper = np.median([window[0], window[-1], window[:, 0], window[:, -1]])
        ink = np.where(window < 0.98 * paper, paper - window, 0.0)
        assert ink.max() > 0.7 * paper
        v, u = np.mgrid[0 : 2 * reach + 1, 0 : 2 * reach + 1]
        apart.append([(ink * u).sum() / ink.sum() + x0 - x, (ink * v).sum() / ink.sum() + y0 - y])
    return np.array(apart)


def test_a_charuco_board_is_where_exact_geometry_puts_it(placed: Scene, picture: np.ndarray) -> None:
    """Against OpenCV's drawing, laid out by OpenCV on 8 x 8 parts of a pixel; OpenCV reads the markers."""
    square, margin = 0.08, 0.02
    width_m, height_m = 7 * square + 2 * margin, 5 * square + 2 * margin
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_5X5_100)
    board = cv2.aruco.CharucoBoard((7, 5), square, 0.06, dictionary)
    ids = cv2.aruco.CharucoDetector(board).detectBoard(np.rint(picture).astype(np.uint8))[1]
    assert ids is not None and len(ids) == 6 * 4
    texels, parts = 160, 8  # a square; a pixel
    drawn = board.generateImage((7 * texels, 5 * texels), marginSize=0, borderBits=1)
    drawn = np.pad(drawn, 40, constant_values=255)
    ends = np.array([[-width_m / 2, height_m], [width_m / 2, height_m], [width_m / 2, 0], [-width_m / 2, 0]])
    corners_px = seen_px(SQUARES, placed.ground_z_m(3.0, 0.7), ends)
    x0, y0 = np.ceil(corners_px.min(axis=0)).astype(int) + 8
    x1, y1 = np.floor(corners_px.max(axis=0)).astype(int) - 8
    height, width = drawn.shape
    of_drawing = np.array([[0, 0], [width, 0], [width, height], [0, height]]) - 0.5
    of_parts = (corners_px - [x0, y0] + 0.5) * parts - 0.5
    fine = cv2.warpPerspective(
        drawn, cv2.getPerspectiveTransform(of_drawing.astype(np.float32), of_parts.astype(np.float32)),
        (int((x1 - x0) * parts), int((y1 - y0) * parts)), flags=cv2.INTER_LINEAR,
    )  # fmt: skip
    expected = fine.reshape(y1 - y0, parts, x1 - x0, parts).mean(axis=(1, 3))
    found = picture[y0:y1, x0:x1].astype(float)
    slopes = np.gradient(expected)
    terms = np.column_stack([expected.ravel(), np.ones(expected.size), slopes[1].ravel(), slopes[0].ravel()])
    (gain, level, dx, dy), *_ = np.linalg.lstsq(terms, found.ravel(), rcond=None)
    assert abs(dx / gain) < TOLERANCE_PX and abs(dy / gain) < TOLERANCE_PX, (dx / gain, dy / gain)
    left = found.ravel() - terms @ [gain, level, dx, dy]
    assert left.std() < 0.1 * found.std()


def test_a_brick_is_met_where_its_numbers_put_it(placed: Scene) -> None:
    (brick,) = placed.bricks
    ahead, right = (np.array([math.cos(a), math.sin(a), 0.0]) for a in (0.4, 0.4 + math.pi / 2))
    for along, across in ((1, 0), (-1, 0), (0, 1), (0, -1)):
        outwards = along * ahead + across * right
        half = 0.25 if along else 0.15
        top_m = brick.corners_m[:4, 2].mean()
        start = np.array([2.2, 0.1, top_m + 0.05]) + 1.0 * outwards
        assert placed.cast(start, -outwards) == pytest.approx(1.0 - half, abs=1e-9)
    assert placed.cast([2.2, 0.1, -3.0], [0.0, 0.0, 1.0]) == pytest.approx(3.0 + top_m, abs=1e-9)
    sunk_m = [z - placed.ground_z_m(x, y) for x, y, z in brick.corners_m[4:]]
    assert min(sunk_m) == pytest.approx(0.02), "no gap under it"


def test_a_rock_is_as_wide_as_asked_for_and_at_its_place(placed: Scene) -> None:
    assert len(placed.world.rocks.spheres_m) == 4, "one rock, one brick, two boards and nothing scattered"
    corners = placed.world.rocks.corners_m[0].reshape(-1, 3)
    reach = corners.max(axis=0) - corners.min(axis=0)
    assert 0.6 < reach[:2].max() < 0.75
    assert np.linalg.norm(corners.mean(axis=0)[:2] - [4.5, 0.2]) < 0.1
    assert corners[:, 2].min() < placed.ground_z_m(4.5, 0.2) < corners[:, 2].max()


def test_a_board_hides_what_is_behind_it_and_its_back_is_blank(placed: Scene) -> None:
    board = placed.boards[0]
    middle = board.site_from_board.translation_m
    looks = -board.site_from_board.rotation[:, 2]
    assert placed.cast(middle + 0.5 * looks, -looks) == pytest.approx(0.5, abs=1e-9)
    assert placed.cast(middle - 0.5 * looks, looks) == pytest.approx(0.48, abs=1e-9)


def test_scattered_rocks_keep_away_from_what_is_placed() -> None:
    seeds = {"seed": 3, "relief_m": 0.0, "rocks": 60}
    alone = build_small_scene(scene_settings(seeds, Path())).world.rocks.spheres_m
    near = alone[np.argmin(np.hypot(*alone[:, :2].T))]
    boards = [{"x_m": float(near[0]), "y_m": float(near[1])}]
    beside = build_small_scene(scene_settings({**seeds, "boards": boards}, Path())).world.rocks
    stones = beside.spheres_m[beside.boards < 0]
    assert len(stones) < len(alone)
    assert all((stone == alone).all(axis=1).any() for stone in stones), "the others stay where they were"
    assert np.hypot(*(stones[:, :2] - near[:2]).T).min() > 0.3


def test_a_scene_with_boards_is_kept_on_disk_and_read_again(placed: Scene, tmp_path: Path) -> None:
    write(tmp_path / "kept" / "one", placed)
    again = read(tmp_path / "kept" / "one", placed.settings)
    np.testing.assert_array_equal(again.world.boards.texels, placed.world.boards.texels)
    np.testing.assert_array_equal(again.world.rocks.boards, placed.world.rocks.boards)
    np.testing.assert_array_equal(
        again.boards[1].site_from_board.translation_m, placed.boards[1].site_from_board.translation_m
    )


def test_another_picture_on_a_board_is_another_scene(tmp_path: Path) -> None:
    """What is kept goes by the picture's bytes, not by its name."""
    board = {"kind": "picture", "picture": "face.png", "x_m": 3, "y_m": 0, "width_m": 0.5}
    cv2.imwrite(str(tmp_path / "face.png"), np.zeros((40, 80), np.uint8))
    one = scene_settings({"boards": [board]}, tmp_path)
    cv2.imwrite(str(tmp_path / "face.png"), np.full((40, 80), 255, np.uint8))
    other = scene_settings({"boards": [board]}, tmp_path)
    assert one != other and repr(one) != repr(other)
    assert one.boards[0].face.size_m == (0.5, 0.25)
    with pytest.raises(BadOptions, match="changed while the scene was built"):
        build_small_scene(replace(one, relief_m=0.0))


@pytest.mark.parametrize(
    ("scene", "told"),
    [
        ({"boards": 3}, "simulation.scene.boards is 3, expected a list"),
        ({"boards": [3]}, r"scene.boards\[0\] is 3, expected keys and values"),
        ({"rocks": [{"x_m": 3}]}, r"scene.rocks\[0\] has no y_m; metres in the site frame"),
        ({"rocks": [{"x_m": 30, "y_m": 0}]}, r"rocks\[0\].x_m is 30.0, expected a number from -28 to 28"),
        ({"rocks": [{"x_m": "near", "y_m": 0}]}, r"rocks\[0\].x_m is 'near', expected a number"),
        (
            {"rocks": [{"x_m": 3, "y_m": 0, "diameter_m": 9}]},
            r"diameter_m is 9.0, expected a number from 0.03",
        ),
        ({"bricks": [{"x_m": 3, "y_m": 0, "colour": 1}]}, r"bricks\[0\] has no key 'colour'"),
        ({"boards": [{"x_m": 3, "y_m": 0, "kind": "checker"}]}, "kind is 'checker'; there are dots|charuco"),
        ({"boards": [{"x_m": 3, "y_m": 0, "square_m": 1}]}, "no key 'square_m' for kind 'dots'"),
        (
            {"boards": [{"x_m": 3, "y_m": 0, "dot_diameter_m": 0.5}]},
            "dot_diameter_m is 0.5, expected less than",
        ),
        (
            {"boards": [{"x_m": 3, "y_m": 0, "heading_rad": math.nan}]},
            "heading_rad is nan, expected a number",
        ),
        ({"boards": [{"x_m": 3, "y_m": 0, "columns": 50, "spacing_m": 0.5}]}, "m, expected 0.05 to 4 m"),
        (
            {"boards": [{"x_m": 3, "y_m": 0, "kind": "charuco", "dictionary": "DICT_4X4_50", "rows": 20}]},
            "need 100 markers, DICT_4X4_50 has 50",
        ),
        ({"boards": [{"x_m": 3, "y_m": 0, "kind": "picture"}]}, "has no picture; the name"),
        ({"boards": [{"x_m": 3, "y_m": 0, "kind": "picture", "picture": "no.png"}]}, "no.png: No such file"),
        (
            {"boards": [{"x_m": 3, "y_m": 0}], "bricks": [{"x_m": 3, "y_m": 0.2}]},
            r"boards\[0\] at \(3, 0\) m stands in simulation.scene.bricks\[0\] at \(3, 0.2\) m",
        ),
        ({"rocks": [{"x_m": 3, "y_m": 0}] * 501}, "rocks are 501, expected 500 at most"),
    ],
)
def test_what_cannot_be_placed_is_refused_with_place_value_and_what_would_be_right(
    scene: dict[str, Any], told: str
) -> None:
    with pytest.raises(BadOptions, match=told) as refused:
        scene_settings(scene, Path())
    assert "\n" not in str(refused.value)


def test_nothing_is_placed_in_the_rover_or_where_a_camera_can_come(repository: Path) -> None:
    rig = load_rig(repository / "configs" / "sim" / "rocky8.yaml").rig
    for what in ({"bricks": [{"x_m": 0.3, "y_m": 0.0}]}, {"rocks": [{"x_m": 0.7, "y_m": 0.0}]}):
        with pytest.raises(
            BadOptions, match=r"comes within 0.\d\d m of the rover's origin, expected 0.\d\d m at least"
        ):
            check_clear_of(scene_settings(what, Path()).placed, rig)
    check_clear_of(scene_settings({"bricks": [{"x_m": 1.0, "y_m": 0.0}]}, Path()).placed, rig)


def test_things_over_one_another_are_apart() -> None:
    board = {"x_m": 3, "y_m": 0, "raised_m": 0.5}
    scene_settings({"boards": [board], "bricks": [{"x_m": 3, "y_m": 0.0}]}, Path())


@pytest.mark.long(1, "a scene is built for every part")
def test_every_random_part_follows_the_seed(scene: Scene) -> None:
    """Same settings, same bits; another seed, other relief, hills, stones, gravel, soil and bricks."""
    again = build_scene(scene.settings)
    other = build_scene(replace(scene.settings, seed=2))
    for name in ("inner", "outer", "rocks", "detail", "broad", "stone"):
        one, two, three = (getattr(world, name)[0] for world in (scene.world, again.world, other.world))
        np.testing.assert_array_equal(one, two, err_msg=name)
        assert one.shape != three.shape or not np.array_equal(one, three), name
