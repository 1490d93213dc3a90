"""Fit a two-axis mast and its head camera to camera models that are known at measured joint angles.

The data are whole camera models in the rover frame, one for each pan and tilt; flight labels carry
them. Wanted are the mast of ``calib.mast`` and the one head camera that, carried by it, projects as
each of the models does.

Models are compared by where they project, never by their parameters: |A|, |O| and R0 are gauges, so
that two models may agree in every pixel and in no number. A grid of pixels is followed out of each
model to a near and a far range. Carried into the head and projected there, each point must come back to
the pixel that it left. The far points weigh the orientation and the near ones the position.

Gauges: this form of the kinematics leaves none open unless the two axes are parallel. The mast's x axis
lies along the common perpendicular of the axes at pan zero and the head's origin is the foot of that
perpendicular, which fixes pan zero, tilt zero and the place along the tilt axis. With six parameters
the axes meet at a right angle, and a real mast's offset and twist show up in the residuals.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from calib.cahvor import CameraModel
from calib.errors import CalibError
from calib.mast import Mast
from calib.rigid import FloatArray, Rigid, rot_x, rot_y, rot_z

GRID = 5
"""Pixels of the comparison along each side of the image."""

RANGES_M = (1.0, 100.0)
"""Near and far range of the comparison, metres.

At 1 m a shift of 1 µm moves a pixel as much as a turn of 1 µrad. Labels of six digits round positions
and joint angles above 1 m and 1 rad to 2.9 µm and 2.9 µrad (one sigma), so these ranges weigh them as
they deserve.
"""

TWISTS_RAD = np.linspace(-1.4, 1.4, 15)
"""Twists tried for a start, since the closed form of the start needs one."""

MAX_CONDITION = 1e4
"""Condition number of the column-scaled Jacobian beyond which the poses do not fix the mast."""

LOST_PX = 1e4
"""Residual of a point that the camera does not see at all: a step that leads there is never taken."""

TOLERANCE = 1e-12
"""Of the solver, relative: far below what six printed digits leave. 1e-15 changes no reported number."""


class PosesTooFew(CalibError):
    """The given poses do not determine a mast: too few, or one of the joints hardly moves."""


@dataclass(frozen=True, eq=False)
class ModelDifference:
    """How far one model of a camera is from another one, by where they project.

    Attributes
    ----------
    position_m
        (3,) the other's C minus the reference's, in their common frame.
    rotation_rad
        (3,) rotation vector that turns the reference's rays onto the other's, same frame.
    shift_px
        (n, 2) how far the other projects points far away from where the reference does, pixels of the other.
    """

    position_m: FloatArray
    rotation_rad: FloatArray
    shift_px: FloatArray


@dataclass(frozen=True, eq=False)
class PoseFit:
    """A mast and head camera fitted to camera models.

    Attributes
    ----------
    mast
        The fitted mast; axis offset and twist are 0 where six parameters were asked.
    camera_in_head
        The head camera in the head frame.
    residuals
        For each given model, how far the fitted one is from it.
    """

    mast: Mast
    camera_in_head: CameraModel
    residuals: tuple[ModelDifference, ...]

    def camera_in_rover(self, pan_rad: float, tilt_rad: float) -> CameraModel:
        """Return the fitted camera in the rover frame at the given joint angles, radians."""
        return self.camera_in_head.moved(self.mast.rover_from_head(pan_rad, tilt_rad))


def fit_poses(
    models: Sequence[CameraModel],
    pan_rad: ArrayLike,
    tilt_rad: ArrayLike,
    *,
    parameters: Literal[6, 8] = 8,
    ranges_m: tuple[float, float] = RANGES_M,
) -> PoseFit:
    """Fit mast and head camera to camera models in the rover frame, each known at measured joint angles.

    Unknown are the mast and the six of the camera's place in the head; the camera's lens (focal
    lengths, centre, distortion) is the first model's. Every pixel residual weighs the same. Where the
    lens itself changes from model to model, ``with_one_lens`` takes that out first.

    Parameters
    ----------
    models
        At least three models of one camera in the rover frame. Sizes may differ by binning.
    pan_rad, tilt_rad
        (n,) measured joint angles of the models, radians; positive tilt looks up.
    parameters
        6 for axes that meet at a right angle (the paper's mast), 8 for any two axes that are not parallel.
    ranges_m
        Near and far range of the compared points, metres.

    Raises
    ------
    PosesTooFew
        If the poses do not fix the parameters: fewer than three, or a joint that hardly moves.
    ValueError
        If the numbers of models and angles differ, or an angle is not finite.
    """
    pan = np.asarray(pan_rad, dtype=np.float64)
    tilt = np.asarray(tilt_rad, dtype=np.float64)
    if pan.shape != (len(models),) or tilt.shape != pan.shape:
        raise ValueError(f"{len(models)} models with {pan.shape} pan and {tilt.shape} tilt angles")
    if not (np.isfinite(pan).all() and np.isfinite(tilt).all()):
        raise ValueError("a joint angle is not finite")
    if len(models) < 3:
        raise PosesTooFew(f"{len(models)} camera models do not fix a mast; at least 3 are needed")

    start = _start(models, pan, tilt, TWISTS_RAD if parameters == 8 else np.zeros(1))
    camera = models[0].moved(start.rover_from_head(pan[0], tilt[0]).inverse)
    points_m, wanted_px, seen = _targets(models, camera.size_px, ranges_m)

    def residual(x: NDArray[np.float64]) -> NDArray[np.float64]:
        mast, head_from_moved = _unpack(x, start, parameters)
        in_camera_m = np.stack(
            [
                (mast.rover_from_head(p, t) @ head_from_moved).inverse.points(points)
                for p, t, points in zip(pan, tilt, points_m, strict=True)
            ]
        )
        px, valid = camera.project(in_camera_m)
        shift = np.where(valid[..., None], px - wanted_px, LOST_PX)
        return np.asarray(shift[seen].ravel(), dtype=np.float64)

    fit = least_squares(
        residual,
        np.zeros(6 + parameters),
        jac="3-point",
        x_scale="jac",
        xtol=TOLERANCE,
        ftol=TOLERANCE,
        gtol=TOLERANCE,
    )
    _check_determined(np.asarray(fit.jac))
    mast, head_from_moved = _unpack(fit.x, start, parameters)
    fitted = camera.moved(head_from_moved)
    differences = (
        model_difference(model, fitted.moved(mast.rover_from_head(p, t)))
        for model, p, t in zip(models, pan, tilt, strict=True)
    )
    return PoseFit(mast, fitted, tuple(differences))


def model_difference(reference: CameraModel, other: CameraModel) -> ModelDifference:
    """Return how far ``other`` is from ``reference`` (two models of one camera in one frame), by where
    they project.

    The rotation is the one that turns a grid of the reference's rays onto the other's best (Kabsch).
    Sizes may differ where one image is the other one binned.
    """
    wanted_px = pixel_grid(other.size_px)
    rays, other_rays = reference.ray(pixel_grid(reference.size_px)), other.ray(wanted_px)
    px, valid = other.project(rays.origins_m + RANGES_M[1] * rays.directions)
    both = rays.valid & other_rays.valid & valid
    rotation, _ = Rotation.align_vectors(other_rays.directions[both], rays.directions[both])
    return ModelDifference(other.C - reference.C, rotation.as_rotvec(), (px - wanted_px)[both])


def with_one_lens(models: Sequence[CameraModel], lens: CameraModel) -> tuple[CameraModel, ...]:
    """Return ``lens`` put where each of the models stands, as told by its C, A and H.

    For models whose lens changes from one to the next (interpolated over temperature): what stays of them is
    position and orientation. It trusts parameters, so it holds within one calibration only: A means the same
    direction in two models only if their R0 is the same.
    """
    from_lens = Rigid(camera_axes(lens), lens.C).inverse
    return tuple(lens.moved(Rigid(camera_axes(model), model.C) @ from_lens) for model in models)


def camera_axes(model: CameraModel) -> FloatArray:
    """Return the rotation (3, 3) from camera axes (x right, y down, z along A) to the model's frame."""
    across = model.H - (model.H @ model.A) * model.A
    x = across / np.linalg.norm(across)
    return np.stack([x, np.cross(model.A, x), model.A], axis=-1)


def pixel_grid(size_px: tuple[int, int]) -> FloatArray:
    """Return (25, 2) pixels spread evenly over an image: the same places of the view for a binned image."""
    fractions = (np.arange(GRID) + 0.5) / GRID
    x, y = np.meshgrid(fractions * size_px[0] - 0.5, fractions * size_px[1] - 0.5)
    return np.stack([x.ravel(), y.ravel()], axis=-1)


def _targets(
    models: Sequence[CameraModel], size_px: tuple[int, int], ranges_m: tuple[float, float]
) -> tuple[FloatArray, FloatArray, NDArray[np.bool_]]:
    """Points (n, 50, 3) seen at the grid, rover frame; the pixels (50, 2) wanted; which points exist."""
    points = []
    for model in models:
        rays = model.ray(pixel_grid(model.size_px))
        points.append(np.concatenate([rays.origins_m + r * rays.directions for r in ranges_m]))
    points_m = np.stack(points)
    return points_m, np.tile(pixel_grid(size_px), (len(ranges_m), 1)), np.isfinite(points_m).all(axis=-1)


def _unpack(x: FloatArray, start: Mast, parameters: int) -> tuple[Mast, Rigid]:
    """The mast that a step from the start leads to, and the camera's own step in the head."""
    rotation = start.rover_from_mast.rotation @ Rotation.from_rotvec(x[3:6]).as_matrix()
    offset_m, twist_rad = (x[12], x[13]) if parameters == 8 else (0.0, 0.0)
    mast = Mast(
        start.translation_m + x[:3],
        Rotation.from_matrix(rotation).as_euler("XYZ"),
        float(start.axis_offset_m + offset_m),
        float(start.axis_twist_rad + twist_rad),
    )
    return mast, Rigid(Rotation.from_rotvec(x[6:9]).as_matrix(), x[9:12])


def _start(
    models: Sequence[CameraModel], pan_rad: FloatArray, tilt_rad: FloatArray, twists_rad: FloatArray
) -> Mast:
    """The mast in closed form, for the twist that explains the orientations best.

    Orientations: R = M K B with K = Rz(pan) Rx(k) Ry(tilt). For a given k, K B = Mᵀ R is linear in the
    18 entries of B and Mᵀ: the right singular vector of the smallest singular value (the robot-world,
    hand-eye problem). Positions are then linear in t, a and the camera's place in the head.
    """
    eye = np.eye(3)
    rotations = [camera_axes(model) for model in models]
    best_value, best_vector, twist = np.inf, np.zeros(18), 0.0
    for trial in twists_rad:
        gimbals = [rot_z(p) @ rot_x(trial) @ rot_y(t) for p, t in zip(pan_rad, tilt_rad, strict=True)]
        # Row by row, vec(X Y) = (X kron I) vec(Y) = (I kron Yᵀ) vec(X).
        blocks = [
            np.hstack([np.kron(gimbal, eye), -np.kron(eye, rotation.T)])
            for gimbal, rotation in zip(gimbals, rotations, strict=True)
        ]
        _, values, right = np.linalg.svd(np.concatenate(blocks))
        if values[-1] < best_value:
            best_value, best_vector, twist = values[-1], right[-1], float(trial)
    left, _, right = np.linalg.svd(best_vector[9:].reshape(3, 3))
    mast_rotation = (left @ right).T
    mast_rotation *= np.sign(np.linalg.det(mast_rotation))

    with_offset = len(twists_rad) > 1
    rows = []
    for p, t in zip(pan_rad, tilt_rad, strict=True):
        turned = mast_rotation @ rot_z(p)
        offset = turned[:, :1] if with_offset else np.zeros((3, 1))
        rows.append(np.hstack([eye, offset, turned @ rot_x(twist) @ rot_y(t)]))
    places = np.concatenate([model.C for model in models])
    solved = np.linalg.lstsq(np.concatenate(rows), places, rcond=None)[0]
    angles_rad = Rotation.from_matrix(mast_rotation).as_euler("XYZ")
    return Mast(solved[:3], angles_rad, float(solved[3]) if with_offset else 0.0, twist)


def _check_determined(jacobian: FloatArray) -> None:
    """Raise PosesTooFew where the data leave a combination of parameters open."""
    norms = np.linalg.norm(jacobian, axis=0)
    values = np.linalg.svd(jacobian / np.where(norms > 0, norms, 1.0), compute_uv=False)
    condition = values[0] / values[-1] if values[-1] > 0 else np.inf
    if not condition < MAX_CONDITION:
        raise PosesTooFew(
            f"the joint angles vary too little to fix the mast: condition {condition:.1e} of the fit, "
            f"at most {MAX_CONDITION:.0e} is expected; add poses that move both joints"
        )
