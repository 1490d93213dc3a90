"""Mast kinematics against SciPy's rotations and cases worked by hand."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from calib.geometry.cahvor import CameraModel
from calib.geometry.rig import Mast, Rig, RigCamera
from calib.geometry.rigid import Rigid

ROUNDING_M = 1e-13
FORWARD, RIGHT, DOWN = np.eye(3)
PAPER_T = np.array([0.3443, -0.0043, -1.4572])
PAPER_THETA = np.array([-0.0088, -0.0181, 0.0027])


def straight_mast(offset_m: float = 0.0, twist_rad: float = 0.0) -> Mast:
    """A mast at the rover's origin with no rotation of its own."""
    return Mast(np.zeros(3), np.zeros(3), offset_m, twist_rad)


def test_positive_pan_turns_right() -> None:
    head = straight_mast().rover_from_head(0.3, 0.0)
    np.testing.assert_allclose(head.vectors(FORWARD), [np.cos(0.3), np.sin(0.3), 0.0], atol=ROUNDING_M)
    assert head.vectors(FORWARD) @ RIGHT > 0.0


def test_positive_tilt_looks_up() -> None:
    head = straight_mast().rover_from_head(0.0, 0.3)
    np.testing.assert_allclose(head.vectors(FORWARD), [np.cos(0.3), 0.0, -np.sin(0.3)], atol=ROUNDING_M)
    assert head.vectors(FORWARD) @ DOWN < 0.0


def test_tilt_comes_before_pan_in_the_chain() -> None:
    # A quarter turn right, then looking straight up: the head's forward is up, its right is the rover's back.
    head = straight_mast().rover_from_head(np.pi / 2, np.pi / 2)
    np.testing.assert_allclose(head.vectors(FORWARD), -DOWN, atol=ROUNDING_M)
    np.testing.assert_allclose(head.vectors(RIGHT), -FORWARD, atol=ROUNDING_M)
    np.testing.assert_allclose(head.vectors(DOWN), RIGHT, atol=ROUNDING_M)


def test_offset_carries_the_head_round_the_pan_axis() -> None:
    mast = straight_mast(offset_m=0.1)
    np.testing.assert_allclose(mast.rover_from_head(0.0, 0.7).translation_m, [0.1, 0.0, 0.0], atol=ROUNDING_M)
    np.testing.assert_allclose(
        mast.rover_from_head(np.pi / 2, -0.7).translation_m, [0.0, 0.1, 0.0], atol=ROUNDING_M
    )


def test_twist_turns_the_tilt_axis_about_forward() -> None:
    # The tilt axis is the head's y axis; a positive twist about x lowers its right end (z is down).
    head = straight_mast(twist_rad=0.2).rover_from_head(0.0, 0.9)
    np.testing.assert_allclose(head.vectors(RIGHT), [0.0, np.cos(0.2), np.sin(0.2)], atol=ROUNDING_M)


def test_paper_mast_leans_left_and_forward() -> None:
    # Section III.C: the mast "tilted left by 0.0088 radians and forward by 0.0181 radians".
    up = -Mast(PAPER_T, PAPER_THETA).rover_from_mast.vectors(DOWN)
    assert up @ RIGHT == pytest.approx(-0.0088, abs=1e-5)
    assert up @ FORWARD == pytest.approx(0.0181, abs=1e-5)


@pytest.mark.parametrize("seed", range(20))
def test_chain_agrees_with_scipy(seed: int) -> None:
    rng = np.random.default_rng(seed)
    t, theta = rng.normal(size=3), rng.uniform(-1.0, 1.0, 3)
    a, k, pan, tilt = rng.uniform(-3.0, 3.0, 4)
    point = rng.normal(size=3) * 10.0
    tilted = Rotation.from_rotvec([0, tilt, 0]).apply(point)
    in_arm = Rotation.from_rotvec([k, 0, 0]).apply(tilted) + a * FORWARD
    in_mast = Rotation.from_rotvec([0, 0, pan]).apply(in_arm)
    in_rover = Rotation.from_euler("XYZ", theta).apply(in_mast) + t
    head = Mast(t, theta, a, k).rover_from_head(pan, tilt)
    np.testing.assert_allclose(head.points(point), in_rover, atol=ROUNDING_M, err_msg=f"seed {seed}")
    np.testing.assert_allclose(head.inverse.points(in_rover), point, atol=ROUNDING_M, err_msg=f"seed {seed}")


def test_products_of_transforms_follow_their_names() -> None:
    b_from_a = Rigid(Rotation.from_rotvec([0.1, -0.2, 0.3]).as_matrix(), np.array([1.0, 2.0, 3.0]))
    c_from_b = Rigid(Rotation.from_rotvec([-0.4, 0.2, 0.1]).as_matrix(), np.array([-1.0, 0.5, 2.0]))
    point_in_a = np.array([0.3, -0.7, 5.0])
    c_from_a = c_from_b @ b_from_a
    np.testing.assert_allclose(
        c_from_a.points(point_in_a), c_from_b.points(b_from_a.points(point_in_a)), atol=ROUNDING_M
    )


def simple_rig() -> Rig:
    """A head camera and a body camera with the same vectors on the paper's mast."""
    H, V = 1000.0 * RIGHT + 500.0 * FORWARD, 1000.0 * DOWN + 400.0 * FORWARD
    model = CameraModel("CAHV", (1001, 801), np.array([0.05, -0.1, 0.02]), FORWARD, H, V)
    cameras = {"navcam_left": RigCamera("head", model), "hazcam_left": RigCamera("rover", model)}
    return Rig("test", Mast(PAPER_T, PAPER_THETA), cameras)


def test_head_camera_moves_with_the_joints_and_a_body_camera_stays() -> None:
    rig = simple_rig()
    body = rig.camera_in_rover("hazcam_left", 0.4, -0.3)
    np.testing.assert_array_equal(body.C, rig.cameras["hazcam_left"].model.C)
    head = rig.camera_in_rover("navcam_left", 0.4, -0.3)
    # A point that is ahead of the camera in the head frame keeps its pixel wherever the head is.
    point_in_head = np.array([4.0, 0.5, -0.3])
    point_in_rover = rig.mast.rover_from_head(0.4, -0.3).points(point_in_head)
    there, _ = head.project(point_in_rover)
    here, _ = rig.cameras["navcam_left"].model.project(point_in_head)
    np.testing.assert_allclose(there, here, atol=1e-9)


def test_mast_refuses_values_that_are_not_finite() -> None:
    with pytest.raises(ValueError, match="not finite"):
        Mast(np.array([0.0, np.nan, 0.0]), np.zeros(3))


def test_what_a_mast_holds_cannot_be_changed() -> None:
    rig = simple_rig()
    with pytest.raises(ValueError, match="read-only"):
        rig.mast.translation_m[0] = 1.0
    with pytest.raises(TypeError):
        rig.cameras["another"] = rig.cameras["navcam_left"]  # type: ignore[index]
