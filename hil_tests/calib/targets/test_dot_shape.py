"""The image of a circle against the integral over its area, and against the facts' measured numbers."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from calib.geometry.cahvor import CameraModel
from calib.geometry.rigid import Rigid
from calib.targets.dot_middles import area_centroids, bias_through
from hil_tests.calib.targets.boards import BOARD, COLUMNS, NAVCAM_PX, ROWS, camera, pose

RADIUS_M = BOARD.dot_diameter_m / 2
INTEGRAL_PX = 2e-5
"""What the pieces of the sum are too coarse for."""


def bias_px(model: CameraModel, camera_from_board: Rigid) -> np.ndarray:
    """The bias of every dot of the board through a camera."""

    def pixel_of(points_m: np.ndarray) -> np.ndarray:
        in_board = np.concatenate([points_m, np.zeros_like(points_m[..., :1])], axis=-1)
        return model.project(camera_from_board.points(in_board))[0]

    return bias_through(pixel_of, BOARD.dots_in_board_m(ROWS, COLUMNS)[:, :2], RADIUS_M)


def conic_centre(pixel_from_plane: np.ndarray, centre: np.ndarray) -> np.ndarray:
    """Centre of the ellipse that a dot becomes under a homography (Heikkilä 2000, section 3).

    With Q = inv(H)' C inv(H) = [[A, b], [b', c]] it is -inv(A) b, and D[:2, 2] / D[2, 2] in the adjugate D.
    """
    moved = pixel_from_plane @ np.array([[1.0, 0.0, centre[0]], [0.0, 1.0, centre[1]], [0.0, 0.0, 1.0]])
    dual = moved @ np.diag([RADIUS_M**2, RADIUS_M**2, -1.0]) @ moved.T
    return dual[:2, 2] / dual[2, 2]


def integrated_bias_px(model: CameraModel, camera_from_board: Rigid, centre_m: np.ndarray) -> np.ndarray:
    """Centroid over the area, by summing small pieces of the disc times how much the camera enlarges each."""
    radius = RADIUS_M * (np.arange(200) + 0.5) / 200
    angle = np.arange(48) * (2 * np.pi / 48)
    r, a = np.meshgrid(radius, angle)
    points = centre_m + np.stack([r * np.cos(a), r * np.sin(a), 0 * r], axis=-1)
    step = 1e-6
    pixels, right, down = (
        model.project(camera_from_board.points(points + step * shift))[0]
        for shift in np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]])
    )
    dx, dy = right - pixels, down - pixels
    weight = r * (dx[..., 0] * dy[..., 1] - dx[..., 1] * dy[..., 0])
    centre = model.project(camera_from_board.points(centre_m))[0]
    return (pixels * weight[..., None]).sum(axis=(0, 1)) / weight.sum() - centre


@pytest.mark.parametrize("kind", ["CAHV", "CAHVOR", "CAHVORE"])
def test_bias_is_that_of_the_integral_over_the_dot(kind: str) -> None:
    model = camera(NAVCAM_PX if kind != "CAHVORE" else 400.0)
    if kind != "CAHVOR":
        type_ = {"cahvore_type": 2, "E": [0.004, 0.001, 0]} if kind == "CAHVORE" else {}
        model = type(model)(
            kind, model.size_px, model.C, model.A, model.H, model.V, R=[0, -0.05, 0.01], **type_
        )
    placed = pose(1.5, tilt=(40, 30), aside_m=(0.1, -0.1))
    bias = bias_px(model, placed)
    for k in (0, 9, 44, 99):
        centre = BOARD.dots_in_board_m(ROWS[k], COLUMNS[k])
        assert bias[k] == pytest.approx(integrated_bias_px(model, placed, centre), abs=INTEGRAL_PX)
    assert np.abs(bias).max() > 0.02


def test_ellipse_of_a_homography_has_its_centre_where_the_conic_says() -> None:
    placed = pose(3.0, tilt=(45, 60))
    turn = placed.rotation
    H = np.diag([NAVCAM_PX, NAVCAM_PX, 1.0]) @ np.column_stack([turn[:, 0], turn[:, 1], placed.translation_m])
    centres = BOARD.dots_in_board_m(ROWS, COLUMNS)[:, :2]
    conic = conic_centre(H, centres[7])
    # The points of an ellipse whose tangents are parallel lie opposite each other about its centre: take the
    # extreme columns of a fine boundary.
    angle = np.arange(100_000) * (2 * np.pi / 100_000)
    circle = centres[7] + RADIUS_M * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    carried = np.column_stack([circle, np.ones(len(circle))]) @ H.T
    boundary = carried[:, :2] / carried[:, 2:]
    extremes = boundary[[boundary[:, 0].argmin(), boundary[:, 0].argmax()]]
    assert conic == pytest.approx(extremes.mean(axis=0), abs=1e-3)
    assert conic == pytest.approx(area_centroids(boundary[None])[0], abs=1e-6)


def test_bias_is_as_large_as_was_measured() -> None:
    # measured with other code: rms distance over 12 poses, tilts of 15, 30 and 45 degrees about random axes
    rng = np.random.default_rng(3)
    model = camera(1280.0)
    for tilt_deg, expected_px in ((15, 0.014), (30, 0.025), (45, 0.030)):
        squares = []
        for _ in range(12):
            placed = pose(3.0, tilt=(tilt_deg, rng.uniform(0, 360)), roll_deg=rng.uniform(-10, 10))
            squares.append((bias_px(model, placed) ** 2).sum(axis=1))
        assert np.sqrt(np.mean(squares)) == pytest.approx(expected_px, rel=0.25), tilt_deg


def test_a_board_that_faces_the_pinhole_has_no_bias() -> None:
    model = type(camera(900.0))("CAHV", (640, 480), [0, 0, 0], [0, 0, 1], [900, 0, 319.5], [0, 900, 239.5])
    turned = Rigid(Rotation.from_rotvec([0, 0, 0.7]).as_matrix(), [0.2, 0.3, 2.0])
    assert np.abs(bias_px(model, turned)).max() < 1e-9
