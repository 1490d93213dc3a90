"""The nearest cameras of one family to another, measured by OpenCV."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from calib.files import CameraFile
from calib.files.any_camera import LIMIT_PX, load_any, save_any
from calib.files.mast_file import load_rig
from calib.files.twin import as_kind, kind_of_lens, nearest_cahvor, nearest_opencv, nearest_square, twin_error
from calib.geometry.cahvor import CameraModel
from hil_tests.calib.geometry.camera_cases import plain
from mastctl.config import load_config

NUMERICAL_PX = 1e-9
PINHOLE: dict[str, list[float]] = {
    "none": [],
    "radtan": [-0.31, 0.12, 0.001, -0.0007],
    "plumb_bob": [-0.31, 0.12, 0.001, -0.0007, 0.02],
    "rational": [0.4, 0.05, 0.001, -0.0007, 0.002, 0.75, 0.1, 0.005],
    "turned image": [-0.31, 0.12, 0.001, -0.0007, 0.02, *[0.0] * 7, 0.02, -0.03],
}


def camera(distortion: list[float], focal: float = 600.0) -> CameraModel:
    matrix = [[focal, 0.0, 317.0], [0.0, focal + 1.5, 244.5], [0.0, 0.0, 1.0]]
    turn = Rotation.from_rotvec([0.3, -1.1, 0.4]).as_matrix()
    kind = kind_of_lens("pinhole", distortion)
    return CameraModel.of_matrix(kind, (640, 480), matrix, distortion, turn, [0.3, -0.2, 1.1])


def opencv_pixels(one: CameraModel, points: np.ndarray) -> np.ndarray:
    turn, move = cv2.Rodrigues(one.rotation)[0], -one.rotation @ one.C
    lens = one.distortion if len(one.distortion) else np.zeros(4)
    seen, _ = cv2.projectPoints(points, turn, move, one.camera_matrix, lens)
    return np.asarray(seen).reshape(-1, 2)


def test_a_round_lens_has_an_exact_twin_both_ways() -> None:
    model = plain("CAHVOR", R=[0.0, -0.2, 0.05])
    there = nearest_opencv(model, "OPENCV4")
    assert there.distortion.tolist() == pytest.approx([-0.2, 0.05, 0.0, 0.0], abs=1e-12)
    assert twin_error(model, there).worst_px < NUMERICAL_PX
    assert twin_error(there, nearest_cahvor(there)).worst_px < NUMERICAL_PX
    fisheye = plain("CAHVORE", R=[0.0, -0.02, 0.003])
    there = nearest_opencv(fisheye, "OPENCV_FISHEYE")
    assert twin_error(fisheye, there).worst_px < NUMERICAL_PX
    back = nearest_cahvor(there)
    assert (back.kind, back.cahvore_type) == ("CAHVORE", 2)
    assert twin_error(there, back).worst_px < NUMERICAL_PX


@pytest.mark.parametrize(
    ("name", "within_px"),
    [("none", 1e-9), ("radtan", 0.5), ("plumb_bob", 0.5), ("rational", 0.5), ("turned image", 0.5)],
)
@pytest.mark.parametrize("decentred", [False, True])
def test_the_error_of_a_twin_of_the_cahv_family_is_what_is_stated(
    name: str, within_px: float, decentred: bool
) -> None:
    """p1 and p2 have no place in it but O beside A; without them it comes within 0.05 px."""
    numbers = np.array(PINHOLE[name])
    if not decentred and len(numbers):
        numbers[2:4], within_px = 0.0, min(within_px, 0.05)
    one = camera(numbers.tolist())
    twin = nearest_cahvor(one)
    error = twin_error(one, twin)
    assert error.worst_px < within_px
    # measured here again, at other pixels, with OpenCV in between
    rng = np.random.default_rng(1)
    pixels = rng.uniform([-0.5, -0.5], [639.5, 479.5], (300, 2))
    rays = twin.ray(pixels)
    seen = opencv_pixels(one, rays.origins_m + 50.0 * rays.directions)
    off = np.linalg.norm(seen - pixels, axis=1).max()
    assert off < 1.1 * error.worst_px + NUMERICAL_PX
    assert off > 0.2 * error.worst_px - NUMERICAL_PX


def test_a_skew_of_h_and_v_is_what_a_square_twin_misses_by() -> None:
    skew = 1e-3
    model = plain("CAHV", H=[500.0, 500.0 * skew, 319.5])
    square = nearest_square(model)
    across = square.H - (square.H @ square.A) * square.A
    down = square.V - (square.V @ square.A) * square.A
    assert abs(across @ down) < 1e-6
    # a turn by half the skew shares it out: x errs by skew y / 2, y by skew x / 2
    expected = 0.5 * skew * np.hypot(239.5 + 0.5, 319.5 + 0.5)
    assert twin_error(model, square).worst_px == pytest.approx(expected, rel=0.05)


def test_an_error_knows_of_a_camera_that_does_not_see_all_of_the_image() -> None:
    folding = camera([-0.4, 0.0, 0.0, 0.0], focal=300.0)
    assert twin_error(plain("CAHV"), folding).worst_px == np.inf
    assert twin_error(folding, folding).worst_px < 1e-6


def general(linearity: float, focal: float, skew_rad: float) -> CameraModel:
    """A CAHVORE of type 3 whose entrance point does not move."""
    ahead, down = np.array([1.0, 0.0, 0.0]), np.array([0.0, 0.0, 1.0])
    across = np.array([0.0, 1.0, 0.0]) + skew_rad * down
    return CameraModel(
        "CAHVORE",
        (640, 480),
        C=np.zeros(3),
        A=ahead,
        H=focal * across + 319.5 * ahead,
        V=focal * down + 239.5 * ahead,
        O=ahead,
        R=np.zeros(3),
        E=np.zeros(3),
        cahvore_type=3,
        linearity=linearity,
    )


def test_a_lens_within_the_limit_is_taken_where_a_plainer_one_is_beyond(tmp_path: Path) -> None:
    model = general(0.6, 400.0, 1e-3)
    assert twin_error(model, nearest_opencv(model, "OPENCV5")).worst_px > LIMIT_PX
    done = save_any(CameraFile(model, "head"), tmp_path / "camera.ros.yaml")
    assert done.worst_px <= LIMIT_PX
    read = load_any(tmp_path / "camera.ros.yaml")
    assert isinstance(read, CameraFile)


@pytest.mark.parametrize("linearity", [0.6, 0.8])
@pytest.mark.parametrize("focal", [300.0, 400.0])
def test_a_rational_lens_sees_what_the_camera_it_is_fitted_to_sees(linearity: float, focal: float) -> None:
    """A skew, which no term of the lens holds, drives its fraction to fold just in the corners."""
    model = general(linearity, focal, 1e-3)
    assert twin_error(model, nearest_opencv(model, "OPENCV8")).worst_px < 0.3


def packaged(name: str) -> CameraModel:
    return load_rig(load_config().mast_file).rig.cameras[name].model


@pytest.mark.parametrize(
    ("name", "within_px"), [("pancam_left", 0.1), ("navcam_left", 0.5), ("hazcam_left", np.inf)]
)
def test_the_stated_error_of_a_plumb_bob_is_that_of_opencv(name: str, within_px: float) -> None:
    """A fisheye says how far it is off instead of pretending."""
    model = packaged(name)
    near = nearest_opencv(model, "OPENCV5")
    error = twin_error(model, near)
    if name == "hazcam_left":
        assert error.worst_px > 10.0
        return
    assert error.worst_px < within_px
    width, height = model.size_px
    x, y = np.meshgrid(np.linspace(-0.5, width - 0.5, 38), np.linspace(-0.5, height - 0.5, 31))
    pixels = np.stack([x.ravel(), y.ravel()], axis=1)
    rays = model.ray(pixels)
    off = np.linalg.norm(opencv_pixels(near, rays.origins_m + 100.0 * rays.directions) - pixels, axis=1)
    assert off.max() == pytest.approx(error.worst_px, rel=0.05)


def test_a_lens_is_stored_by_any_family_that_loses_nothing() -> None:
    one = camera(PINHOLE["radtan"])
    assert one.kind == "OPENCV4"
    for kind in ("OPENCV4", "OPENCV5", "OPENCV8", "OPENCV12", "OPENCV14"):
        stored = as_kind(one, kind)  # type: ignore[arg-type]
        assert stored is not None and stored.kind == kind
        assert twin_error(one, stored).worst_px < NUMERICAL_PX
    longer = camera([*PINHOLE["radtan"], 0.0, 0.0, 0.0, 0.0])
    back = as_kind(longer, "OPENCV4")
    assert back is not None and twin_error(one, back).worst_px < NUMERICAL_PX
    assert as_kind(camera(PINHOLE["plumb_bob"]), "OPENCV4") is None
    assert as_kind(one, "OPENCV_FISHEYE") is None
    skewed = np.add(one.camera_matrix, 0.5 * np.outer([1.0, 0.0, 0.0], [0.0, 1.0, 0.0]))
    leaning = CameraModel.of_matrix("OPENCV4", one.size_px, skewed, one.distortion, one.rotation, one.C)
    assert as_kind(leaning, "OPENCV5") is None
    near = nearest_opencv(leaning, "OPENCV5")
    assert near.camera_matrix[0, 1] == 0.0
    assert 0.01 < twin_error(leaning, near).worst_px < 0.5
