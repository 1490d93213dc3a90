"""The pose fit on masts made of two lines in space: no formula here is shared with calib.geometry.rig or the

fit.
"""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from calib.geometry.cahvor import CameraModel
from calib.geometry.rig import numbers_of
from calib.geometry.rigid import Rigid
from tools.flight.difference import model_difference
from tools.flight.poses import fit_poses

POSITION_M = 1e-9
SHIFT_PX = 1e-7

LENS = CameraModel(
    "CAHVOR",
    (640, 480),
    C=np.zeros(3),
    A=np.array([0.0, 0.0, 1.0]),
    H=np.array([400.0, 0.0, 318.0]),
    V=np.array([0.6, 403.0, 241.0]),
    O=Rotation.from_rotvec([0.008, -0.005, 0.0]).apply([0.0, 0.0, 1.0]),
    R=np.array([0.0003, -0.05, 0.02]),
)


class TwoLines:
    """A mast as two lines at joint angles zero: pan turns about one, which carries the other, tilt's."""

    def __init__(self, seed: int, skew: bool, twist_rad: float = 0.3) -> None:
        random = np.random.default_rng(seed)
        self.pan_point = np.array([0.4, 0.05, -1.2]) + random.normal(0, 0.2, 3)
        self.pan_axis = Rotation.from_rotvec(random.normal(0, 0.2, 3)).apply([0.0, 0.0, 1.0])
        across = np.cross(self.pan_axis, random.normal(0, 1, 3))
        across /= np.linalg.norm(across)
        if skew:
            self.tilt_axis = np.cos(twist_rad) * across + np.sin(twist_rad) * self.pan_axis
            self.tilt_point = self.pan_point + random.normal(0, 0.05, 3)
        else:
            self.tilt_axis = across
            self.tilt_point = self.pan_point
        at_zero = Rigid(Rotation.from_rotvec(random.normal(0, 1, 3)).as_matrix(), random.normal(0, 0.3, 3))
        self.camera_at_zero = LENS.moved(at_zero)
        self.angles = np.stack([random.uniform(-2.5, 2.5, 9), random.uniform(-0.8, 0.6, 9)], axis=-1)

    def camera(self, pan_rad: float, tilt_rad: float) -> CameraModel:
        tilted = self.camera_at_zero.moved(about(self.tilt_point, self.tilt_axis, tilt_rad))
        return tilted.moved(about(self.pan_point, self.pan_axis, pan_rad))

    def offset_and_twist(self) -> tuple[float, float]:
        """Distance of the lines, and how far their angle is from a right one."""
        normal = np.cross(self.pan_axis, self.tilt_axis)
        gap = (self.tilt_point - self.pan_point) @ normal / np.linalg.norm(normal)
        return float(abs(gap)), float(abs(np.arcsin(self.pan_axis @ self.tilt_axis)))


def about(point: np.ndarray, axis: np.ndarray, angle_rad: float) -> Rigid:
    """The turn about a line."""
    rotation = Rotation.from_rotvec(angle_rad * axis).as_matrix()
    return Rigid(rotation, point - rotation @ point)


@pytest.mark.parametrize("skew", [False, True])
@pytest.mark.parametrize("seed", range(4))
def test_six_poses_predict_every_other_pose(seed: int, skew: bool) -> None:
    mast = TwoLines(seed, skew)
    pan, tilt = mast.angles[:6].T
    fit = fit_poses([mast.camera(p, t) for p, t in mast.angles[:6]], pan, tilt, parameters=8 if skew else 6)
    for p, t in mast.angles[6:]:
        found = model_difference(mast.camera(p, t), fit.camera_in_rover(p, t))
        assert np.abs(found.position_m).max() < POSITION_M
        assert np.abs(found.shift_px).max() < SHIFT_PX
    offset_m, twist_rad = mast.offset_and_twist()
    assert abs(fit.mast.axis_offset_m) == pytest.approx(offset_m, abs=1e-9)
    assert abs(fit.mast.axis_twist_rad) == pytest.approx(twist_rad, abs=1e-9)


@pytest.mark.parametrize("twist_rad", [-1.25, -0.8, 0.8, 1.25])
def test_axes_that_are_far_from_square_are_found(twist_rad: float) -> None:
    mast = TwoLines(4, skew=True, twist_rad=twist_rad)
    pan, tilt = mast.angles.T
    fit = fit_poses([mast.camera(p, t) for p, t in mast.angles], pan, tilt)
    assert max(np.abs(found.shift_px).max() for found in fit.residuals) < SHIFT_PX
    assert abs(fit.mast.axis_twist_rad) == pytest.approx(abs(twist_rad), abs=1e-9)


def test_covariance_is_the_scatter() -> None:
    """Labels of exact poses, each off by 20 µm and 20 µrad, an axis: errors are as the covariance says."""
    mast = TwoLines(3, skew=True)
    pan, tilt = mast.angles.T
    exact = [mast.camera(p, t) for p, t in mast.angles]
    true = fit_poses(exact, pan, tilt)
    squares, parts = [], range(8)
    for seed in range(40):
        rng = np.random.default_rng(seed)
        noisy = []
        for model in exact:
            turn = Rotation.from_rotvec(rng.normal(0, 20e-6, 3)).as_matrix()
            shift = model.C + rng.normal(0, 20e-6, 3) - turn @ model.C
            noisy.append(model.moved(Rigid(turn, shift)))
        fit = fit_poses(noisy, pan, tilt)
        assert fit.parameter_names[7] == "mast.axis_twist_rad"
        error = (numbers_of(fit.mast) - numbers_of(true.mast))[parts]
        squares.append(float(error @ np.linalg.solve(fit.covariance[np.ix_(parts, parts)], error)))
    assert np.mean(squares) == pytest.approx(8, rel=0.25)


def test_model_difference_tells_a_known_turn_and_shift() -> None:
    model = TwoLines(1, skew=False).camera(0.3, -0.2)
    turn = Rotation.from_rotvec([1e-3, -2e-3, 5e-4])
    moved = model.moved(about(model.C, np.array([1e-3, -2e-3, 5e-4]) / turn.magnitude(), turn.magnitude()))
    moved = moved.moved(Rigid(np.eye(3), np.array([0.001, 0.0, -0.002])))
    found = model_difference(model, moved)
    assert found.rotation_rad == pytest.approx(turn.as_rotvec(), abs=1e-9)
    assert found.position_m == pytest.approx([0.001, 0.0, -0.002], abs=1e-12)
