"""The pose fit on masts made of two lines in space: no formula here is shared with calib.geometry.rig or the

fit.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from calib.geometry.cahvor import CameraModel
from calib.geometry.maps import model_difference, with_one_lens
from calib.geometry.rig import numbers_of
from calib.geometry.rigid import Rigid
from tools.flight.poses import PosesTooFew, fit_poses

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
        return abs(gap), abs(np.arcsin(self.pan_axis @ self.tilt_axis))


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


def test_six_parameters_show_the_skew_they_cannot_hold() -> None:
    mast = TwoLines(11, skew=True)
    models = [mast.camera(p, t) for p, t in mast.angles]
    fit = fit_poses(models, *mast.angles.T, parameters=6)
    assert fit.mast.axis_offset_m == 0.0
    assert fit.mast.axis_twist_rad == 0.0
    assert max(np.abs(found.shift_px).max() for found in fit.residuals) > 1.0


def test_gauges_of_the_models_change_nothing() -> None:
    """R0 is absorbed by A, H and V: half of the models are written with another R0, and project the same."""
    mast = TwoLines(5, skew=True)
    pan, tilt = mast.angles[:6].T
    plain = [mast.camera(p, t) for p, t in mast.angles[:6]]
    dressed = [with_other_r0(model, 0.01) if i % 2 else model for i, model in enumerate(plain)]
    point = plain[1].C + 3.0 * plain[1].A + 0.5 * plain[1].O
    assert np.abs(dressed[1].project(point)[0] - plain[1].project(point)[0]).max() < 1e-9
    assert np.abs(dressed[1].A - plain[1].A).max() > 1e-6
    fit = fit_poses(dressed, pan, tilt)
    for p, t in mast.angles[6:]:
        assert (
            np.abs(model_difference(mast.camera(p, t), fit.camera_in_rover(p, t)).shift_px).max() < SHIFT_PX
        )


def with_other_r0(model: CameraModel, r0: float) -> CameraModel:
    """The same camera with another R0: A, H, V absorb I + s (I - O Oᵀ), 1 + s = (1 + R0) / (1 + r0)."""
    old = 1.0 + model.R[0]
    s = old / (1.0 + r0) - 1.0
    absorb = np.eye(3) + s * (np.eye(3) - np.outer(model.O, model.O))
    a = absorb @ model.A
    length = np.linalg.norm(a)
    return replace(
        model,
        A=a / length,
        H=absorb @ model.H / length,
        V=absorb @ model.V / length,
        R=np.array([r0, *(model.R[1:] * (1.0 + r0) / old)]),
    )


def test_a_binned_image_of_the_camera_counts_as_the_same_camera() -> None:
    mast = TwoLines(7, skew=True)
    pan, tilt = mast.angles[:6].T
    models = [mast.camera(p, t) for p, t in mast.angles[:6]]
    models[3] = binned(models[3], 4)
    fit = fit_poses(models, pan, tilt)
    p, t = mast.angles[7]
    assert np.abs(model_difference(mast.camera(p, t), fit.camera_in_rover(p, t)).shift_px).max() < SHIFT_PX


def binned(model: CameraModel, factor: int) -> CameraModel:
    """The model of the image averaged over factor x factor pixels: (x + 1/2) = factor (x' + 1/2)."""
    size = (model.size_px[0] // factor, model.size_px[1] // factor)
    move = 0.5 / factor - 0.5
    return replace(
        model, size_px=size, H=model.H / factor + move * model.A, V=model.V / factor + move * model.A
    )


def test_a_lens_that_changes_with_temperature_leaves_the_pose() -> None:
    mast = TwoLines(9, skew=True)
    pan, tilt = mast.angles.T
    drifting = []
    for i, (p, t) in enumerate(mast.angles):
        model = mast.camera(p, t)
        drifting.append(replace(model, H=model.H * (1 + 1e-4 * i) + 0.02 * i * model.A))
    fit = fit_poses(with_one_lens(drifting, drifting[0]), pan, tilt)
    plain = fit_poses(drifting, pan, tilt)
    assert max(np.linalg.norm(found.rotation_rad) for found in fit.residuals) < 1e-9
    assert max(np.linalg.norm(found.rotation_rad) for found in plain.residuals) > 1e-5


@pytest.mark.parametrize("still", ["pan", "tilt"])
def test_a_joint_that_never_moves_is_refused(still: str) -> None:
    mast = TwoLines(2, skew=True)
    angles = mast.angles.copy()
    angles[:, 0 if still == "pan" else 1] = 0.2
    with pytest.raises(PosesTooFew, match="vary too little"):
        fit_poses([mast.camera(p, t) for p, t in angles], *angles.T)


def test_a_joint_that_hardly_moves_is_named() -> None:
    mast = TwoLines(2, skew=True)
    angles = mast.angles.copy()
    angles[:, 1] = 0.2 + 1e-5 * np.arange(len(angles))
    with pytest.raises(PosesTooFew, match=r"tilt by 8e-05 rad in all.*the mast's"):
        fit_poses([mast.camera(p, t) for p, t in angles], *angles.T)


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


def test_two_poses_are_refused_and_unequal_numbers_are_a_mistake() -> None:
    mast = TwoLines(2, skew=False)
    models = [mast.camera(p, t) for p, t in mast.angles[:3]]
    with pytest.raises(PosesTooFew, match="at least 3"):
        fit_poses(models[:2], mast.angles[:2, 0], mast.angles[:2, 1])
    with pytest.raises(ValueError, match="3 models"):
        fit_poses(models, mast.angles[:2, 0], mast.angles[:2, 1])


def test_model_difference_tells_a_known_turn_and_shift() -> None:
    model = TwoLines(1, skew=False).camera(0.3, -0.2)
    turn = Rotation.from_rotvec([1e-3, -2e-3, 5e-4])
    moved = model.moved(about(model.C, np.array([1e-3, -2e-3, 5e-4]) / turn.magnitude(), turn.magnitude()))
    moved = moved.moved(Rigid(np.eye(3), np.array([0.001, 0.0, -0.002])))
    found = model_difference(model, moved)
    assert found.rotation_rad == pytest.approx(turn.as_rotvec(), abs=1e-9)
    assert found.position_m == pytest.approx([0.001, 0.0, -0.002], abs=1e-12)
