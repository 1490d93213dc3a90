"""What is no number, rotation or length is refused by name; what is frozen stays so; all bits count."""

from __future__ import annotations

import copy
import math
import pickle
import struct
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from calib.errors import CalibError, Unreachable
from calib.geometry.cahvor import CameraModel
from calib.geometry.covariance import RigCovariance
from calib.geometry.handoff import Joints
from calib.geometry.pointing import Solution, choose, solve
from calib.geometry.rig import Mast, Rig
from calib.geometry.rigid import Rigid
from calib.geometry.stereo import triangulate
from calib.matching.warp import Plane, facing_plane
from calib.survey.find_dots import find_in_file
from calib.targets.boards import Dots
from calib.targets.dots import PredictedBoard
from hil_tests.calib.targets.boards import BOARD, COLUMNS, ROWS, SIZE_PX, camera, gravel, pose
from hil_tests.support.sim_survey.board import draw_board, photograph
from tools.flight.difference import model_difference

NO_NUMBERS = (math.nan, math.inf, -math.inf)
HEAD = CameraModel("CAHV", (101, 101), np.zeros(3), [1, 0, 0], [50, 100, 0], [50, 0, 100])
MAST = Mast(np.array([0.0, 0.0, -1.5]), np.zeros(3))


@pytest.mark.parametrize("bad", NO_NUMBERS)
@pytest.mark.parametrize("name", ["axis_offset_m", "axis_twist_rad"])
def test_a_mast_whose_axes_are_no_numbers_is_refused_by_name(name: str, bad: float) -> None:
    with pytest.raises(ValueError, match=f"{name} is .* where a finite number is expected"):
        Mast(np.zeros(3), np.zeros(3), **{name: bad})


@pytest.mark.parametrize("bad", NO_NUMBERS)
def test_a_head_that_stands_nowhere_has_no_next_angles(bad: float) -> None:
    for here in ({"from_pan_rad": bad}, {"from_tilt_rad": bad}):
        with pytest.raises(Unreachable, match="the head is at") as refused:
            solve(MAST, HEAD, [3.0, 0.0, -1.0], **here)
        assert refused.value.code == "bad_joints"
        with pytest.raises(Unreachable, match="the head is at"):
            choose([Solution(0.1, 0.0, 3.0)], (-1.0, 1.0), (-1.0, 1.0), **here)


@pytest.mark.parametrize(
    ("pan", "tilt", "solution", "words"),
    [
        ((math.nan, 1.0), (-1.0, 1.0), Solution(0.1, 0.0, 3.0), "pan limits"),
        ((-1.0, 1.0), (-1.0, math.nan), Solution(0.1, 0.0, 3.0), "tilt limits"),
        ((1.0, -1.0), (-1.0, 1.0), Solution(0.1, 0.0, 3.0), "rising"),
        ((-1.0, 1.0), (-1.0, 1.0), None, "no solution"),
    ],
)
def test_nothing_is_chosen_by_limits_that_are_none(
    pan: tuple[float, float], tilt: tuple[float, float], solution: Solution | None, words: str
) -> None:
    with pytest.raises(Unreachable, match=words) as refused:
        choose([] if solution is None else [solution], pan, tilt)
    assert refused.value.code == "bad_joints"


@pytest.mark.parametrize(
    "matrix",
    [
        2.0 * np.eye(3),
        np.diag([1.0, 1.0, -1.0]),
        np.zeros((3, 3)),
        np.array([[1.0, 0.1, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]),
        np.eye(3) + 1e-4,
    ],
)
def test_what_stretches_shears_or_mirrors_is_no_rigid_motion(matrix: np.ndarray) -> None:
    with pytest.raises(ValueError, match="is no rotation"):
        Rigid(matrix, np.zeros(3))


def test_every_rotation_is_one() -> None:
    for turn in Rotation.random(200, random_state=1):
        motion = Rigid(turn.as_matrix(), np.ones(3))
        step = motion
        for _ in range(50):
            motion = motion @ step @ step.inverse @ step
    # Six printed digits are a rotation still.
    Rigid(np.round(Rotation.from_rotvec([0.3, 0.2, 0.1]).as_matrix(), 7), np.zeros(3))


def test_models_that_look_past_each_other_are_not_alike() -> None:
    turned = HEAD.moved(Rigid(Rotation.from_rotvec([0.0, 0.0, np.radians(150)]).as_matrix(), np.zeros(3)))
    found = model_difference(HEAD, turned)
    assert math.degrees(np.linalg.norm(found.rotation_rad)) == pytest.approx(150.0)
    assert np.isinf(found.shift_px).all() and len(found.shift_px)
    # Rays in common need not be in the other's picture: at 30 degrees some are and some are not.
    partly = model_difference(
        HEAD, HEAD.moved(Rigid(Rotation.from_rotvec([0.0, 0.0, 1.2]).as_matrix(), np.zeros(3)))
    )
    assert pytest.approx(np.linalg.norm(partly.rotation_rad)) == 1.2
    assert 0 < np.isinf(partly.shift_px[:, 0]).sum() < len(partly.shift_px)


@pytest.mark.parametrize("bad", [*NO_NUMBERS, -0.1])
def test_a_sigma_that_is_none_gives_no_covariance(bad: float) -> None:
    right = replace(HEAD, C=np.array([0.0, 0.2, 0.0]))
    with pytest.raises(ValueError, match="sigma_px is"):
        triangulate(HEAD, right, [52, 50], [48, 50], bad)
    with pytest.raises(ValueError, match="sigma_rad is"):
        Joints(0.0, 0.0, bad)


@pytest.mark.parametrize("bad", [*NO_NUMBERS, 0.0, -1.0])
def test_ranges_that_are_none_are_refused(bad: float) -> None:
    with pytest.raises(CalibError, match="no plane at range"):
        facing_plane(HEAD, [50, 50], bad)


@pytest.mark.parametrize("bad", [*NO_NUMBERS, -1.0])
def test_a_covariance_that_is_none_is_refused(bad: float) -> None:
    with pytest.raises(ValueError, match=r"not finite|negative variance"):
        RigCovariance(("mast.translation_m.x",), np.array([[bad]]))
    with pytest.raises(ValueError, match="shape"):
        RigCovariance(("mast.translation_m.x",), np.eye(2))


def again(one: object) -> list[object]:
    """The same thing out of a pickle and out of deep and shallow copies."""
    return [pickle.loads(pickle.dumps(one)), copy.deepcopy(one), copy.copy(one)]


def test_frozen_geometry_stays_frozen_through_pickles_and_copies(true_rig: Rig) -> None:
    model = true_rig.camera_in_rover("hazcam_left", 0.0, 0.0)
    head = true_rig.camera_in_rover("navcam_left", 0.3, -0.2)
    right = replace(HEAD, C=np.array([0.0, 0.2, 0.0]))
    things: list[tuple[object, tuple[str, ...]]] = [
        (model, tuple("CAHVORE")),
        (head, tuple("CAHVORE")),
        (true_rig.mast, ("translation_m", "rotation_rad")),
        (true_rig.mast.rover_from_head(0.1, 0.2), ("rotation", "translation_m")),
        (RigCovariance(("mast.translation_m.x",), np.eye(1)), ("covariance",)),
        (Plane(np.zeros(3), np.array([0.0, 0.0, 2.0])), ("point_m", "normal")),
        (triangulate(HEAD, right, [52, 50], [48, 50]), ("position_m", "covariance_m2", "rates_m_per_px")),
    ]
    for one, names in things:
        for same in again(one):
            for name in names:
                with pytest.raises(ValueError, match="read-only"):
                    getattr(same, name)[0] = 7.0
                np.testing.assert_array_equal(getattr(same, name), getattr(one, name))
    point = np.array([2.0, 0.3, 0.1])
    for same in again(model):
        assert isinstance(same, CameraModel)
        np.testing.assert_array_equal(same.project(point)[0], model.project(point)[0])


@pytest.mark.parametrize("bits", [8, 12, 16])
def test_a_picture_of_more_bits_is_measured_with_all_of_them(tmp_path: Path, bits: int) -> None:
    rng = np.random.default_rng(3)
    model, at = camera(1290.0), pose(2.0, (25, 40), 5)
    exact = photograph(draw_board(gravel(rng), model, at, BOARD), 0.7, 0.0, np.random.default_rng(1))
    levels = np.asarray(exact, dtype=np.float64) * (2**bits - 1) / 255
    path = tmp_path / "board.png"
    cv2.imwrite(str(path), levels.astype(np.uint8 if bits == 8 else np.uint16))
    found = find_in_file(path, SIZE_PX, BOARD, PredictedBoard(model, at))
    assert isinstance(found, Dots), found
    assert len(found.rows) == 100
    points = at.points(BOARD.dots_in_board_m(ROWS, COLUMNS))
    wanted = model.project(points)[0].reshape(10, 10, 2)[found.rows, found.columns]
    assert np.sqrt(np.mean((found.pixels_px - wanted) ** 2)) < 0.02


def test_a_turned_tag_turns_no_picture(tmp_path: Path) -> None:
    """Pixels are where the sensor has them, whatever a tag says of how to hang the picture."""
    image = np.zeros((30, 40), dtype=np.uint8)
    done, data = cv2.imencode(".jpg", image)
    assert done
    # One entry: orientation (0x0112), a short, once, 6: to be turned by 90 degrees.
    entry = struct.pack("<HHHIHHI", 1, 0x0112, 3, 1, 6, 0, 0)
    tag = b"Exif\x00\x00II*\x00\x08\x00\x00\x00" + entry
    turned = data.tobytes()[:2] + b"\xff\xe1" + (len(tag) + 2).to_bytes(2, "big") + tag + data.tobytes()[2:]
    path = tmp_path / "turned.jpg"
    path.write_bytes(turned)
    failure = find_in_file(path, (40, 30), BOARD, None)
    assert "px where" not in getattr(failure, "reason", str(failure))
