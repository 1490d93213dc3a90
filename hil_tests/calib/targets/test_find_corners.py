"""Corners of drawn boards, against where OpenCV projects the board; and what is said where there are none."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache

import cv2
import numpy as np
import pytest
from numpy.typing import ArrayLike, NDArray

from calib.geometry.cahvor import CameraModel
from calib.geometry.rigid import Rigid
from calib.targets.boards import (
    AnyBoard,
    AprilGrid,
    Charuco,
    Checkerboard,
    Corners,
    CornersNotFound,
    DotBoard,
)
from calib.targets.corners import find_corners
from calib.targets.pattern import pattern_of
from drivers.sim.bench_boards import BenchBoard, BenchBoards

Image = NDArray[np.uint8]
F_PX, SIZE_PX = 900.0, (640, 480)
FINER = 2
FINE = CameraModel(
    "CAHV", (640 * FINER, 480 * FINER), C=[0, 0, 0], A=[0, 0, 1],
    H=[F_PX * FINER, 0, 320 * FINER - 0.5], V=[0, F_PX * FINER, 240 * FINER - 0.5],
)  # fmt: skip
"""The same camera with finer pixels: blurred on whole ones, edges along these would be bent."""
MATRIX = np.array([[F_PX, 0, 319.5], [0, F_PX, 239.5], [0, 0, 1]])
SHARP_PX = 0.03
TURN = (0.4, -0.5, 0.2)

CHARUCO = Charuco(9, 7, 0.03, 0.0225)
APRILGRID = AprilGrid(6, 5, 0.04, 0.012)
BOARDS: list[AnyBoard] = [CHARUCO, APRILGRID, Checkerboard(9, 8, 0.03), DotBoard(10, 8, 0.03, 0.015)]


def grey(
    camera: CameraModel, pose: Rigid, samples: int = 2, rows: tuple[int, int] | None = None
) -> NDArray[np.float32]:
    """A scene of nothing."""
    return np.full(camera.size_px[::-1], 100.0, dtype=np.float32)


@lru_cache
def _drawn(
    boards: tuple[tuple[AnyBoard, tuple[float, ...], tuple[float, ...]], ...], blur_px: float
) -> Image:
    scene = BenchBoards(grey)
    for k, (board, turn, place) in enumerate(boards):
        rotation, _ = cv2.Rodrigues(np.asarray(turn, dtype=np.float64))
        scene.put(str(k), BenchBoard(board, Rigid(rotation, np.asarray(place, dtype=np.float64))))
    fine = cv2.GaussianBlur(scene.image(FINE, Rigid.identity()), (0, 0), blur_px * FINER)
    light = cv2.resize(fine, SIZE_PX, interpolation=cv2.INTER_AREA)
    noisy = light + np.random.default_rng(1).normal(0.0, 2.0, light.shape)
    return np.clip(np.rint(noisy), 0, 255).astype(np.uint8)


def drawn(*boards: tuple[AnyBoard, tuple[float, ...], tuple[float, ...]], blur_px: float = 0.7) -> Image:
    """A picture of boards, each with its rotation vector and place before the camera."""
    return _drawn(boards, blur_px).copy()


def off_px(board: AnyBoard, found: Corners, turn: ArrayLike, place: ArrayLike) -> NDArray[np.float64]:
    """How far corners are from where OpenCV projects them."""
    points, vectors = board.in_board_m(found.ids), (np.asarray(v, dtype=np.float64) for v in (turn, place))
    wanted, _ = cv2.projectPoints(points, *vectors, MATRIX, None)
    return np.asarray(found.pixels_px - wanted.reshape(-1, 2), dtype=np.float64)


def corners_of(board: AnyBoard, image: NDArray[np.uint8] | NDArray[np.uint16]) -> Corners:
    found = find_corners(board, image)
    assert isinstance(found, Corners), found
    return found


def why_not(board: AnyBoard, image: Image) -> str:
    found = find_corners(board, image)
    assert isinstance(found, CornersNotFound), found
    assert "\n" not in found.reason
    return found.reason


@pytest.mark.parametrize("board", BOARDS, ids=lambda board: board.kind)
@pytest.mark.parametrize("turn", [(0.05, 0.1, 0.0), (0.6, 0.3, 0.2), (0.2, -1.0, 0.1)])
def test_corners_of_a_sharp_picture_are_true_and_so_is_their_sigma(
    board: AnyBoard, turn: tuple[float, ...]
) -> None:
    place = (0.01, 0.02, 0.8)
    found = corners_of(board, drawn((board, turn, place)))
    off = off_px(board, found, turn, place)
    assert len(found) >= 0.95 * len(board.ids)
    assert float(np.sqrt(np.mean(off**2))) < SHARP_PX
    assert float(np.abs(off).max()) < 5 * SHARP_PX
    assert 0.6 < float(np.sqrt(np.mean((off / found.sigma_px[:, None]) ** 2))) < 1.6


@pytest.mark.parametrize("board", [CHARUCO, APRILGRID], ids=lambda board: board.kind)
def test_half_a_board_is_enough_and_what_is_covered_is_not_found(board: AnyBoard) -> None:
    place = (0.0, 0.0, 0.8)
    image = drawn((board, TURN, place))
    everything = corners_of(board, image)
    image[:, :320] = np.random.default_rng(2).integers(90, 160, (480, 320))
    found = corners_of(board, image)
    assert 0.3 < len(found) / len(everything) < 0.6
    assert found.pixels_px[:, 0].min() > 319.0
    assert float(np.abs(off_px(board, found, TURN, place)).max()) < 0.2


def test_a_board_partly_outside_the_picture_is_found_where_visible() -> None:
    place = (0.12, 0.08, 0.5)
    found = corners_of(APRILGRID, drawn((APRILGRID, TURN, place)))
    off = off_px(APRILGRID, found, TURN, place)
    assert 20 < len(found) < len(APRILGRID.ids)
    assert float(np.abs(off / found.sigma_px[:, None]).max()) < 6.0
    rim = np.minimum(found.pixels_px, np.array(SIZE_PX) - 1 - found.pixels_px) + 0.5
    assert float(rim.min()) > 2 * 0.7, "a corner of which the blur reaches out of the picture"


@pytest.mark.parametrize(
    ("board", "place"),
    [(APRILGRID, (0.12, 0.08, 0.55)), (APRILGRID, (-0.12, -0.08, 0.55)), (CHARUCO, (0.0, 0.0, 0.36))],
)
def test_each_side_of_a_picture_is_as_good_as_the_other(
    board: AnyBoard, place: tuple[float, float, float]
) -> None:
    image = drawn((board, TURN, place))
    found, turned = (corners_of(board, np.ascontiguousarray(one)) for one in (image, image[::-1, ::-1]))
    np.testing.assert_array_equal(turned.ids, found.ids)
    np.testing.assert_allclose(turned.pixels_px, np.array(SIZE_PX) - 1 - found.pixels_px, atol=1e-6)
    np.testing.assert_allclose(turned.sigma_px, found.sigma_px, rtol=1e-6)


@pytest.mark.parametrize(("astray_px", "kept"), [(0.6, True), (1.0, False)])
def test_a_corner_is_left_out_by_how_far_off_the_others_are(astray_px: float, kept: bool) -> None:
    """Each corner of a print is 0.1 px off, far beyond what its picture shows, in no pattern."""
    image = drawn((CHARUCO, (0.1, 0.1, 0.0), (0.0, 0.0, 0.7)))
    true = corners_of(CHARUCO, image)
    shift = np.random.default_rng(8).normal(0.0, 0.1, (len(true), 2))
    shift[20] = np.array([0.6, 0.8]) * astray_px
    pixels = np.stack(np.meshgrid(*(np.arange(n, dtype=np.float64) for n in SIZE_PX)), axis=-1)
    for middle, by in zip(true.pixels_px, shift, strict=True):
        # a corner's window moves as a whole, the next corner not at all
        pixels -= np.exp(-((np.linalg.norm(pixels - middle, axis=-1, keepdims=True) / 14.0) ** 8)) * by
    found = corners_of(CHARUCO, cv2.remap(image, pixels.astype(np.float32), None, cv2.INTER_CUBIC))
    assert set(true.ids) - set(found.ids) == (set() if kept else {true.ids[20]})
    assert float(found.sigma_px.max()) < 0.02


def test_a_board_upside_down_or_on_its_side_keeps_its_ids() -> None:
    place = (0.0, 0.0, 0.9)
    for board in (CHARUCO, APRILGRID, Checkerboard(10, 7, 0.03)):
        for roll in (np.pi / 2, -2.0):
            turn = (0.0, 0.0, roll)
            image = drawn((board, turn, place))
            found = corners_of(board, image)
            assert float(np.abs(off_px(board, found, turn, place)).max()) < 0.2, (board.kind, roll)
            there = corners_of(board, np.ascontiguousarray(image[::-1, ::-1]))  # the picture itself turned
            np.testing.assert_array_equal(np.sort(there.ids), np.sort(found.ids))
            turned = (0.0, 0.0, roll + np.pi)
            assert float(np.abs(off_px(board, there, turned, place)).max()) < 0.2, (board.kind, roll)


def test_a_board_drawn_before_opencv_4_6_is_found_as_such() -> None:
    board = Charuco(9, 8, 0.03, 0.0225, legacy=True)
    image = drawn((board, TURN, (0, 0, 0.8)))
    assert float(np.abs(off_px(board, corners_of(board, image), TURN, (0, 0, 0.8))).max()) < 0.2
    assert "legacy: true" in why_not(replace(board, legacy=False), image)
    today = drawn((replace(board, legacy=False), TURN, (0, 0, 0.8)))
    assert "legacy: false" in why_not(board, today)


def test_colour_and_16_bits_change_nothing() -> None:
    image = drawn((CHARUCO, TURN, (0, 0, 0.8)))
    plain = corners_of(CHARUCO, image)
    for other in (np.dstack([image] * 3), image.astype(np.uint16) * 200):
        assert np.abs(corners_of(CHARUCO, other).pixels_px - plain.pixels_px).max() < 0.01
    with pytest.raises(ValueError, match="uint8 or uint16"):
        find_corners(CHARUCO, image.astype(np.float32))  # type: ignore[arg-type]


@pytest.mark.parametrize("board", [CHARUCO, APRILGRID], ids=lambda board: board.kind)
def test_what_is_wrong_with_a_picture_is_said(board: AnyBoard) -> None:
    image = drawn((board, TURN, (0.0, 0.0, 0.7)))
    assert "mirrored" in why_not(board, np.ascontiguousarray(image[:, ::-1]))
    assert "too dark" in why_not(board, (image * 0.02).astype(np.uint8))
    assert "is blurred" in why_not(board, cv2.GaussianBlur(image, (0, 0), 6.0).astype(np.uint8))
    assert "moved across" in why_not(board, cv2.blur(image, (25, 1)).astype(np.uint8))
    assert "moved down" in why_not(board, cv2.blur(image, (1, 25)).astype(np.uint8))
    assert "next to nothing" in why_not(board, np.full((480, 640), 120, np.uint8))
    noise = np.random.default_rng(3).integers(60, 200, (480, 640)).astype(np.uint8)
    assert "not in the picture" in why_not(board, noise)
    twice = drawn((board, (0, 0, 0), (-0.2, 0, 1.0)), (board, (0, 0, 0), (0.2, 0.05, 1.0)))
    assert "two boards with the same markers" in why_not(board, twice)


def test_of_two_boards_with_different_markers_each_is_found() -> None:
    small, large = Charuco(4, 4, 0.03, 0.0225), Charuco(9, 7, 0.03, 0.0225, first_id=50)
    places = {small: (-0.2, -0.05, 0.9), large: (0.1, 0.03, 1.0)}
    image = drawn(*((board, TURN, place) for board, place in places.items()))
    for board, place in places.items():
        assert float(np.abs(off_px(board, corners_of(board, image), TURN, place)).max()) < 0.2


def test_sigmas_of_a_picture_without_blur_are_of_the_size_of_errors() -> None:
    found = corners_of(APRILGRID, drawn((APRILGRID, TURN, (0, 0, 0.9)), blur_px=0.01))
    off = off_px(APRILGRID, found, TURN, (0, 0, 0.9))
    assert 0.4 < float(np.sqrt(np.mean((off / found.sigma_px[:, None]) ** 2))) < 1.6


def test_a_blur_of_2_5_px_spoils_no_corner_by_the_markers_beside_it() -> None:
    place = (0.0, 0.0, 0.5)
    found = corners_of(CHARUCO, drawn((CHARUCO, (0.1, 0.2, 0.3), place), blur_px=2.5))
    off = off_px(CHARUCO, found, (0.1, 0.2, 0.3), place)
    assert len(found) > 40
    assert float(np.sqrt(np.mean(off**2))) < 0.04  # noise alone: 0.025
    assert 0.6 < float(np.sqrt(np.mean((off / found.sigma_px[:, None]) ** 2))) < 1.6


def test_another_board_than_stated_is_named() -> None:
    image = drawn((CHARUCO, TURN, (0.0, 0.0, 0.7)))
    tags = drawn((APRILGRID, TURN, (0.0, 0.0, 0.7)))
    assert "do not stand as on one of 11 x" in why_not(replace(CHARUCO, columns=11), image)
    assert "its markers are 0, 1, 2, 3" in why_not(replace(CHARUCO, first_id=60), image)
    assert "of DICT_5X5_1000" in why_not(replace(CHARUCO, dictionary="DICT_4X4_100"), image)
    assert "of DICT_5X5_1000" in why_not(APRILGRID, image)
    assert "DICT_APRILTAG_36h11 with a border of 2" in why_not(CHARUCO, tags)
    assert "one of 5 x 6 tags" in why_not(replace(APRILGRID, columns=5, rows=6), tags)


def test_kalibrs_own_tags_are_upright() -> None:
    """Tag 0 of tag36h11 is 0xd5d628584, row by row from the upper left, 1 being white."""
    board = AprilGrid(2, 2, 0.1, 0.03)
    lower_left = board.in_board_m([0])[0, :2]
    middles = (np.arange(6) + 2.5) * 0.01
    x, y = np.meshgrid(lower_left[0] + middles, lower_left[1] - 0.1 + middles)
    white = ~pattern_of(board).is_black(x, y)
    assert sum(int(bit) << (35 - k) for k, bit in enumerate(white.ravel())) == 0xD5D628584


@pytest.mark.parametrize("from_top", [True, False])
@pytest.mark.parametrize("turns", [0, 1, 2])
def test_an_aprilgrid_of_opencvs_tags_is_refused(from_top: bool, turns: int) -> None:
    """OpenCV's dictionary holds each tag half a turn off Kalibr's; its GridBoard counts from the top."""
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11)
    image = np.full((5 * 78 + 60, 6 * 78 + 60), 255, np.uint8)
    for k in range(30):
        row, column = divmod(k, 6)
        top, left = 39 + (row if from_top else 4 - row) * 78, 39 + column * 78
        tag = cv2.aruco.generateImageMarker(dictionary, k, 60, borderBits=2)
        image[top : top + 60, left : left + 60] = tag
    picture = np.ascontiguousarray(np.rot90(cv2.GaussianBlur(image, (0, 0), 0.8), turns))
    reason = why_not(APRILGRID, picture)
    assert "print its board with 'mastctl board make'" in reason
