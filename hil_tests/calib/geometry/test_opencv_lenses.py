"""OpenCV's lenses, kept as they are, against cv2 itself and against what a lens must be."""

from __future__ import annotations

import re

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from calib.errors import Unreachable
from calib.geometry.cahvor import CameraModel, Kind
from calib.geometry.parameters import parameter_names, predict, stepped
from calib.geometry.pointing import solve
from calib.geometry.rig import Mast
from calib.geometry.rigid import Rigid

EXACT_PX = 1e-9
SIZE = (1280, 720)
LENSES: dict[Kind, list[float]] = {
    "OPENCV4": [-0.31, 0.12, 0.001, -0.0007],
    "OPENCV5": [-0.31, 0.12, 0.001, -0.0007, -0.02],
    "OPENCV8": [0.5, 0.1, 0.001, -0.0005, 0.01, 0.8, 0.2, 0.03],
    "OPENCV12": [0.5, 0.1, 0.001, -0.0005, 0.01, 0.8, 0.2, 0.03, 1e-3, -2e-3, 5e-4, 1e-3],
    "OPENCV14": [0.5, 0.1, 0.001, -0.0005, 0.01, 0.8, 0.2, 0.03, 1e-3, -2e-3, 5e-4, 1e-3, 0.02, -0.03],
    "OPENCV_FISHEYE": [-0.02, 0.01, -0.004, 0.0005],
}
MATRIX = np.array([[600.0, 0.0, 640.5], [0.0, 610.0, 352.0], [0.0, 0.0, 1.0]])
FOLDED = re.compile(r"the lens folds at (\d+\.\d) degrees from its axis")


def camera(kind: Kind, distortion: list[float] | None = None, skew: float = 0.0) -> CameraModel:
    matrix = MATRIX + skew * np.eye(3, k=1) * [[0, 1, 0], [0, 0, 0], [0, 0, 0]]
    turn = Rotation.from_rotvec([0.3, -1.1, 0.4]).as_matrix()
    numbers = LENSES[kind] if distortion is None else distortion
    return CameraModel.of_matrix(kind, SIZE, matrix, numbers, turn, [0.3, -0.2, 1.1])


def cv2_pixels(model: CameraModel, points_m: np.ndarray) -> np.ndarray:
    """cv2 has no skew; what it makes of slopes is sheared by hand."""
    local = (points_m - model.C) @ model.rotation.T
    unit, lens = np.eye(3), model.distortion
    if model.kind == "OPENCV_FISHEYE":
        slopes = cv2.fisheye.projectPoints(local[:, None], np.zeros(3), np.zeros(3), unit, lens)[0]
    else:
        slopes = cv2.projectPoints(local, np.zeros(3), np.zeros(3), unit, lens)[0]
    return slopes.reshape(-1, 2) @ model.camera_matrix[:2, :2].T + model.camera_matrix[:2, 2]


def pixels_over(seed: int = 3, count: int = 3000) -> np.ndarray:
    return np.random.default_rng(seed).uniform([-0.5, -0.5], np.array(SIZE) - 0.5, (count, 2))


@pytest.mark.parametrize("skew", [0.0, 3.0])
@pytest.mark.parametrize("kind", LENSES)
def test_a_lens_projects_as_opencv_does_and_its_rays_come_back(kind: Kind, skew: float) -> None:
    model = camera(kind, skew=skew)
    pixels = pixels_over()
    rays = model.ray(pixels)
    seen = rays.valid
    assert seen.mean() > (0.75 if kind == "OPENCV5" else 0.99)
    np.testing.assert_allclose(np.linalg.norm(rays.directions[seen], axis=1), 1.0, atol=1e-15)
    points = rays.origins_m[seen] + 7.0 * rays.directions[seen]
    again, valid = model.project(points)
    assert valid.all()
    np.testing.assert_allclose(again, pixels[seen], atol=EXACT_PX)
    np.testing.assert_allclose(cv2_pixels(model, points), pixels[seen], atol=EXACT_PX)


@pytest.mark.parametrize("kind", LENSES)
def test_opencvs_own_matrix_and_pose_give_the_same_pixels(kind: Kind) -> None:
    model = camera(kind)
    rng = np.random.default_rng(8)
    local = rng.uniform([-0.5, -0.4, 1.0], [0.5, 0.4, 1.0], (500, 3)) * rng.uniform(0.5, 30.0, (500, 1))
    points = local @ model.rotation + model.C
    turn, move = cv2.Rodrigues(model.rotation)[0], -model.rotation @ model.C
    if kind == "OPENCV_FISHEYE":
        theirs = cv2.fisheye.projectPoints(points[:, None], turn, move, MATRIX, model.distortion)[0]
    else:
        theirs = cv2.projectPoints(points, turn, move, MATRIX, model.distortion)[0]
    np.testing.assert_allclose(model.project(points)[0], theirs.reshape(-1, 2), atol=EXACT_PX)


@pytest.mark.parametrize("kind", LENSES)
def test_derivatives_are_those_of_small_steps(kind: Kind) -> None:
    model = camera(kind, skew=3.0)
    pixels = np.random.default_rng(2).uniform([300, 150], [950, 550], (100, 2))
    rays, d_directions, d_origins = model.ray_jacobian(pixels)
    points = rays.origins_m + 4.0 * rays.directions
    _, jacobian, _ = model.project_jacobian(points)
    seen = predict(model, points)
    np.testing.assert_allclose(seen.pixels_px, pixels, atol=EXACT_PX)
    np.testing.assert_allclose(seen.d_points, jacobian, atol=1e-8)
    for axis, bit in enumerate(1e-6 * np.eye(3)):
        rate = (model.project(points + bit)[0] - model.project(points - bit)[0]) / 2e-6
        np.testing.assert_allclose(jacobian[..., axis], rate, atol=1e-5)
    for axis, bit in enumerate(1e-2 * np.eye(2)):
        rate = (model.ray(pixels + bit).directions - model.ray(pixels - bit).directions) / 2e-2
        np.testing.assert_allclose(d_directions[..., axis], rate, atol=1e-10)
    assert not d_origins.any()
    for at, bit in enumerate(1e-6 * np.eye(len(parameter_names(kind)))):
        rate = (stepped(model, bit).project(points)[0] - stepped(model, -bit).project(points)[0]) / 2e-6
        np.testing.assert_allclose(
            seen.d_step[..., at],
            rate,
            atol=1e-6 * np.abs(rate).max() + 1e-6,
            err_msg=parameter_names(kind)[at],
        )


@pytest.mark.parametrize(
    ("kind", "distortion"),
    [
        ("OPENCV4", [-0.4, 0.0, 0.0, 0.0]),
        ("OPENCV4", [-0.4, 0.0, 0.02, -0.03]),
        ("OPENCV5", LENSES["OPENCV5"]),
        ("OPENCV8", [0.9, 0.6, 0.002, -0.001, 0.0, 0.3, 0.9, 0.35]),
        ("OPENCV8", [0.1, 0.0, 0.0, 0.0, 0.0, -0.3, 0.0, 0.0]),
        ("OPENCV12", [-0.3, 0.02, 0.001, 0.0, 0.0, 0.0, 0.0, 0.0, 0.02, -0.02, 0.01, 0.005]),
        ("OPENCV_FISHEYE", [-0.2, 0.0, 0.0, 0.0]),
    ],
)
def test_no_ray_lies_beyond_the_fold_and_the_fold_is_told(kind: Kind, distortion: list[float]) -> None:
    """Along each direction the picture moves outwards until the fold; what lies beyond is refused."""
    model = camera(kind, distortion)
    told = FOLDED.match(model.limit_reason)
    assert told is not None
    fold_rad = np.radians(float(told[1]))
    angles = np.linspace(0.0, 1.55, 3000)
    for around in np.linspace(0.0, 2 * np.pi, 17):
        across = np.array([np.cos(around), np.sin(around), 0.0])
        local = np.sin(angles)[:, None] * across + np.cos(angles)[:, None] * np.array([0.0, 0.0, 1.0])
        points = model.C + local @ model.rotation
        pixels, valid = model.project(points)
        assert valid[angles < fold_rad - 1e-3].all()
        last = int(valid.argmin()) if not valid.all() else len(valid)
        assert not valid[last:].any()  # one piece, from the axis on
        assert angles[last - 1] < fold_rad + 0.12
        reached = model.ray(pixels[: last - 20])
        assert reached.valid.all()
        np.testing.assert_allclose(reached.directions @ model.rotation.T, local[: last - 20], atol=1e-7)
        np.testing.assert_allclose(
            model.project(model.C + reached.directions)[0], pixels[: last - 20], atol=EXACT_PX
        )


def test_steep_and_turned_lenses_come_back_to_their_pixels_up_to_the_edge() -> None:
    """Random lenses, points up to a billionth of the fold: as exactly as 64 bits hold a direction."""
    rng = np.random.default_rng(29)
    spread = np.array([0.8, 0.4, 3e-3, 3e-3, 0.05, 0.8, 0.4, 0.1, *[3e-3] * 4, 0.1, 0.1])
    steep = 0
    for number in range(24):
        kind: Kind = ("OPENCV8", "OPENCV12", "OPENCV14", "OPENCV_FISHEYE")[number % 4]
        fisheye = kind == "OPENCV_FISHEYE"
        some = rng.normal(size=4) * [0.1, 0.05, 0.02, 0.005] if fisheye else rng.normal(size=14) * spread
        model = camera(kind, some[: len(LENSES[kind])].tolist())
        edge_rad = model.lens.limit_rad
        angle = edge_rad * np.sqrt(rng.uniform(size=800))
        angle[:200] = edge_rad * (1.0 - 10.0 ** rng.uniform(-9.0, -2.0, 200))
        around = rng.uniform(0.0, 2.0 * np.pi, 800)
        local = np.stack([np.sin(angle) * np.cos(around), np.sin(angle) * np.sin(around), np.cos(angle)], 1)
        pixels, seen = model.project(model.C + local @ model.rotation)
        pixels = pixels[seen & (np.abs(pixels) < 3000.0).all(axis=1)]
        rays = model.ray(pixels)
        again, jacobian, _ = model.project_jacobian(model.C + rays.directions)
        held_px = np.maximum(EXACT_PX, 2e-15 * np.abs(jacobian).sum(axis=(1, 2)))
        steep += int(np.count_nonzero(held_px > EXACT_PX))
        found = rays.valid.mean()
        assert found > (0.9 if kind == "OPENCV14" else 0.999), f"lens {number}: {found}"
        assert (np.abs(again - pixels).max(axis=1) <= held_px)[rays.valid].all(), f"lens {number}"
    assert steep < 200


def test_a_pixel_beyond_the_fold_is_refused_by_the_angle_of_the_fold() -> None:
    model = camera("OPENCV5").moved(Rigid.identity())
    mast = Mast(np.zeros(3), np.zeros(3))
    with pytest.raises(
        Unreachable, match=r"has no ray in this OPENCV5 camera: the lens folds at 5\d\.\d degrees"
    ):
        solve(mast, model, [5.0, 1.0, 0.2], [2.0, 2.0])


@pytest.mark.parametrize("kind", LENSES)
def test_pointing_brings_a_target_onto_the_pixel_by_cv2(kind: Kind) -> None:
    """Any pixel, any two axes: the target, seen by cv2 at the angles found, is on the pixel."""
    head_from_camera = Rigid(np.array([[0.0, 0, 1], [1, 0, 0], [0, 1, 0]]), np.array([0.06, -0.1, -0.05]))
    model = CameraModel.of_matrix(kind, SIZE, MATRIX, LENSES[kind], np.eye(3), np.zeros(3)).moved(
        head_from_camera
    )
    mast = Mast(np.array([0.34, 0.0, -1.46]), np.array([-0.009, -0.018, 0.003]), 0.05, 0.02)
    rng = np.random.default_rng(4)
    for pixel in rng.uniform([250, 100], [1000, 600], (30, 2)):
        target = rng.uniform([-8, -8, -0.5], [8, 8, 1.0])
        if np.hypot(*target[:2]) < 2.0:
            continue
        best = solve(mast, model, target, pixel)[0]
        rover_from_head = mast.rover_from_head(best.pan_rad, best.tilt_rad)
        in_rover = model.moved(rover_from_head)
        np.testing.assert_allclose(cv2_pixels(in_rover, target[None])[0], pixel, atol=1e-8)


@pytest.mark.parametrize("count", [1, 3, 6, 9, 20])
def test_a_count_of_coefficients_that_the_family_has_not_is_refused(count: int) -> None:
    with pytest.raises(ValueError, match="distortion"):
        camera("OPENCV5", [0.0] * count)


def test_numbers_come_back_from_a_camera_to_the_last_bit() -> None:
    model = camera("OPENCV8", skew=1.7)
    assert model.camera_matrix.tolist() == np.add(MATRIX, [[0, 1.7, 0], [0, 0, 0], [0, 0, 0]]).tolist()
    assert model.distortion.tolist() == LENSES["OPENCV8"]
    assert model.rotation.tolist() == Rotation.from_rotvec([0.3, -1.1, 0.4]).as_matrix().tolist()
    for wrong in (np.diag([600.0, -600.0, 1.0]), np.eye(3) + 0.1 * np.eye(3, k=-1)):
        with pytest.raises(ValueError, match="camera matrix"):
            CameraModel.of_matrix("OPENCV4", SIZE, wrong, [0.0] * 4, np.eye(3), np.zeros(3))
    with pytest.raises(ValueError, match="no rotation"):
        CameraModel.of_matrix("OPENCV4", SIZE, MATRIX, [0.0] * 4, 2.0 * np.eye(3), np.zeros(3))
