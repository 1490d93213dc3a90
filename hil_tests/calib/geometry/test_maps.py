"""Maps that take the lens out, against cv2.initUndistortRectifyMap, and by lines that are straight."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from calib.geometry.cahvor import CameraModel
from calib.geometry.maps import NOWHERE, ideal_camera, maps_between, rectified_pair
from calib.geometry.rigid import Rigid
from hil_tests.calib.geometry.camera_cases import plain

FLOAT32_PX = 1e-4
"""What a pixel's place in the hundreds is rounded to."""


def test_maps_of_a_round_lens_are_those_of_opencv() -> None:
    k1, k2 = -0.28, 0.07
    model = plain("CAHVOR", R=[0.0, k1, k2])
    matrix = np.array([[500.0, 0.0, 319.5], [0.0, 500.0, 239.5], [0.0, 0.0, 1.0]])
    theirs = cv2.initUndistortRectifyMap(
        matrix, np.array([k1, k2, 0.0, 0.0]), np.eye(3), matrix, (640, 480), cv2.CV_32FC1
    )
    ours = maps_between(ideal_camera(model), model)
    for one, other in zip(ours, theirs, strict=True):
        assert one.dtype == np.float32
        assert one.shape == (480, 640)
        np.testing.assert_allclose(one, other, atol=FLOAT32_PX)


def test_a_focal_length_of_ones_own_shows_more_as_in_opencv() -> None:
    model = plain("CAHVOR", R=[0.0, -0.1, 0.0])
    old, new = np.diag([500.0, 500.0, 1.0]), np.diag([400.0, 400.0, 1.0])
    for matrix in (old, new):
        matrix[:2, 2] = 319.5, 239.5
    theirs = cv2.initUndistortRectifyMap(
        old, np.array([-0.1, 0.0, 0.0, 0.0]), np.eye(3), new, (640, 480), cv2.CV_32FC1
    )
    ours = maps_between(ideal_camera(model, 400.0), model)
    np.testing.assert_allclose(ours.map_x, theirs[0], atol=FLOAT32_PX)
    with pytest.raises(ValueError, match="above 0"):
        ideal_camera(model, 0.0)


def lines_picture(model: CameraModel) -> np.ndarray:
    """What the camera sees of a board 1 m ahead with vertical stripes of 0.2 m, smooth, 8 bits."""
    x, y = np.meshgrid(np.arange(640.0), np.arange(480.0))
    rays = model.ray(np.stack([x.ravel(), y.ravel()], axis=1))
    across = rays.directions[:, 0] / rays.directions[:, 2]
    return np.rint(127 + 120 * np.sin(across * 2 * np.pi / 0.2)).reshape(480, 640).astype(np.uint8)


def bend_px(picture: np.ndarray) -> float:
    """How far the stripes' edges are from straight: the worst of their places off their lines."""
    worst = 0.0
    rows = np.arange(40, 440)
    values = picture[rows].astype(np.float64) - 127.0
    for start in (100, 200, 320, 420, 520):
        row0 = values[0]
        near = np.flatnonzero((row0[:-1] <= 0) & (row0[1:] > 0))
        edge = int(near[np.argmin(np.abs(near - start))])
        places = []
        for row in values:
            ups = np.flatnonzero((row[:-1] <= 0) & (row[1:] > 0))
            edge = int(ups[np.argmin(np.abs(ups - edge))])
            places.append(edge - row[edge] / (row[edge + 1] - row[edge]))
        line = np.polyfit(rows, places, 1)
        worst = max(worst, float(np.abs(np.polyval(line, rows) - places).max()))
    return worst


@pytest.mark.parametrize("kind", ["CAHVOR", "CAHVORE"])
def test_straight_things_come_out_straight(kind: str) -> None:
    model = plain(kind, R=[0.0, -0.2, 0.05])
    if kind == "CAHVORE":
        model = replace(model, E=np.zeros(3))
    seen = lines_picture(model)
    maps = maps_between(ideal_camera(model), model)
    straight = cv2.remap(seen, maps.map_x, maps.map_y, cv2.INTER_CUBIC, borderValue=127)
    assert bend_px(seen) > 2.0
    assert bend_px(straight) < 0.15


def test_what_the_old_picture_cannot_show_is_nowhere() -> None:
    fisheye = plain(
        "CAHVORE", H=[150.0, 0.0, 319.5], V=[0.0, 150.0, 239.5], cahvore_type=1, R=[0.0, -0.3, 0.0]
    )
    maps = maps_between(ideal_camera(fisheye, 40.0), fisheye)
    assert (maps.map_x[0, 0], maps.map_y[0, 0]) == (NOWHERE, NOWHERE)
    assert maps.map_x[240, 320] == pytest.approx(320, abs=2)


def pair() -> tuple[CameraModel, CameraModel]:
    turned = Rotation.from_rotvec([0.01, -0.02, 0.015]).as_matrix()
    left = plain("CAHVOR", R=[0.0, -0.2, 0.05])
    right = plain("CAHVOR", R=[0.0, -0.18, 0.04]).moved(Rigid(turned, np.array([0.3, 0.01, -0.02])))
    return left, right


def test_a_rectified_pair_has_equal_rows_and_disparity_gives_depth() -> None:
    left, right = pair()
    rectified = rectified_pair(left, right)
    points = np.array([[0.2, 0.1, 2.0], [-0.5, 0.4, 5.0], [1.0, -0.6, 8.0]])
    (at_left, _), (at_right, _) = rectified.left.project(points), rectified.right.project(points)
    np.testing.assert_allclose(at_left[:, 1], at_right[:, 1], atol=1e-9)
    told = np.column_stack([at_left, at_left[:, 0] - at_right[:, 0], np.ones(3)]) @ rectified.depth.T
    seen = told[:, :3] / told[:, 3:]
    axes = np.stack([np.cross(np.cross(rectified.left.A, rectified.left.H), rectified.left.A)])
    axes /= np.linalg.norm(axes)
    z = rectified.left.A
    np.testing.assert_allclose(seen[:, 0], points @ axes[0], atol=1e-9)
    np.testing.assert_allclose(seen[:, 2], points @ z, atol=1e-9)


def test_the_maps_of_a_pair_lead_to_where_the_old_pictures_show_a_point() -> None:
    left, right = pair()
    rectified = rectified_pair(left, right)
    point = np.array([0.2, 0.1, 2.0])
    for old, new, maps in (
        (left, rectified.left, rectified.left_maps),
        (right, rectified.right, rectified.right_maps),
    ):
        at = new.project(point)[0].astype(np.float32)
        there = [float(cv2.remap(part, at[:1], at[1:], cv2.INTER_LINEAR)[0, 0]) for part in maps]
        np.testing.assert_allclose(there, old.project(point)[0], atol=0.06)  # remap counts in 1/32 px


def test_a_pair_without_rows_is_refused() -> None:
    left, right = pair()
    with pytest.raises(ValueError, match="no baseline"):
        rectified_pair(left, left)
    with pytest.raises(ValueError, match="along their baseline"):
        rectified_pair(left, left.moved(Rigid(np.eye(3), np.array([0.0, 0.0, 1.0]))))
    with pytest.raises(ValueError, match="px and the right one"):
        rectified_pair(left, replace(right, size_px=(320, 240)))
