"""Drawn boards against the pinhole's formulas, written down here."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from calib.geometry.cahvor import CameraModel
from calib.geometry.rigid import Rigid
from calib.targets.boards import Board
from hil_tests.support.sim_survey.board import BoardLook, draw_board, photograph

BOARD = Board(5, 4, 0.08, 0.04, {})
LOOK = BoardLook(paper_dn=200.0, dot_dn=40.0, margin_m=0.08)
FOCAL_PX, SIZE_PX = 800.0, (320, 240)
CENTRE_PX = np.array([159.5, 119.5])
SAMPLING_PX = 0.01
"""What 8 x 8 samples a pixel leave of a centroid."""


def pinhole() -> CameraModel:
    H, V = [FOCAL_PX, 0, CENTRE_PX[0]], [0, FOCAL_PX, CENTRE_PX[1]]
    return CameraModel("CAHV", SIZE_PX, [0, 0, 0], [0, 0, 1], H, V)


def ground() -> np.ndarray:
    return np.full(SIZE_PX[::-1], 100.0)


def draw(camera_from_board: Rigid, camera: CameraModel | None = None) -> np.ndarray:
    return draw_board(ground(), camera or pinhole(), camera_from_board, BOARD, LOOK, samples=8)


def weighted(picture: np.ndarray, around_px: np.ndarray, half: int) -> tuple[np.ndarray, float]:
    """Centroid and area of what is darker than paper around a pixel."""
    x, y = np.rint(around_px).astype(int)
    columns, rows = np.meshgrid(np.arange(x - half, x + half + 1), np.arange(y - half, y + half + 1))
    dark = (LOOK.paper_dn - picture[rows, columns]) / (LOOK.paper_dn - LOOK.dot_dn)
    return np.array([(dark * columns).sum(), (dark * rows).sum()]) / dark.sum(), float(dark.sum())


def test_tilted_dots_are_at_the_centroid_that_depth_weighs() -> None:
    turn = Rotation.from_euler("xyz", [35, -40, 20], degrees=True).as_matrix()
    at = np.array([0.02, 0.01, 1.2])
    picture = draw(Rigid(turn, at))
    rng = np.random.default_rng(5)
    disc = 0.02 * np.sqrt(rng.uniform(0, 1, 400_000))
    angle = rng.uniform(0, 2 * np.pi, len(disc))
    for row, column in ((0, 0), (3, 4), (2, 1)):
        x, y = (column - 2) * 0.08 + disc * np.cos(angle), (row - 1.5) * 0.08 + disc * np.sin(angle)
        points = np.outer(x, turn[:, 0]) + np.outer(y, turn[:, 1]) + at
        # a piece of a plane is enlarged by (f / Z)^2 times a slant that goes as 1 / Z
        weight = points[:, 2] ** -3
        pixels = CENTRE_PX + FOCAL_PX * points[:, :2] / points[:, 2:]
        expected = weight @ pixels / weight.sum()
        middle, _ = weighted(picture, expected, 15)
        assert middle == pytest.approx(expected, abs=2 * SAMPLING_PX), (row, column)


def test_a_photograph_has_the_blur_and_noise_asked_for() -> None:
    flat = photograph(np.full((200, 200), 120.0), 0.7, 3.0, np.random.default_rng(1))
    assert flat.dtype == np.uint8
    assert flat.std() == pytest.approx(np.hypot(3.0, 1 / np.sqrt(12)), rel=0.03)
    edge = np.zeros((9, 101), dtype=np.float32)
    edge[:, 50:] = 200.0
    row = photograph(edge, 2.0, 0.0, np.random.default_rng(1))[4].astype(float)
    slope = np.diff(row) / 200.0
    x = np.arange(100) + 0.5
    assert np.sqrt(slope @ (x - slope @ x) ** 2) == pytest.approx(2.0, rel=0.02)
