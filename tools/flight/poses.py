"""Fit a two-axis mast and its head camera to camera models that are known at measured joint angles.

The data are whole camera models in the rover frame, one for each pan and tilt; flight labels carry
them. Wanted are the mast of ``calib.geometry.rig`` and the one head camera that, carried by it, projects as
each of the models does.

Models are compared by where they project, never by their parameters: |A|, |O| and R0 are gauges, so
that two models may agree in every pixel and in no number. A grid of pixels is followed out of each
model to a near and a far range. Carried into the head and projected there, each point must come back to
the pixel that it left. The far points weigh the orientation and the near ones the position.

Gauges: this form of the kinematics leaves none open unless the two axes are parallel. The mast's x axis
lies along the common perpendicular of the axes at pan zero and the head's origin is the foot of that
perpendicular, which fixes pan zero, tilt zero and the place along the tilt axis. With six parameters
the axes meet at a right angle, and a real mast's offset and twist show up in the residuals.

Least squares, the kinematics' rates and the test for directions that the data leave open are those of the
survey's fits. The pixels of a model are not independent measurements: they say where one camera stands, and
what may be off is its place and its direction, each by as much along every axis. How much, the residuals
tell; the covariance is what such errors of the models make of the parameters.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

from calib.adjust.solver import Minimum, Normal, covariance_of, minimise
from calib.adjust.uncertainty import SEEN_RAD, in_english, open_parameters
from calib.errors import CalibError
from calib.geometry.cahvor import CameraModel
from calib.geometry.rig import MAST_FREE, MAST_NAMES, Mast, gimbal, gimbal_rates, mast_of, numbers_of
from calib.geometry.rigid import FloatArray, Rigid, moved_rigid, rigid_rates, rot_x, rot_y, rot_z
from tools.flight.difference import RANGES_M, ModelDifference, model_difference, pixel_grid

TWISTS_RAD = np.linspace(-1.4, 1.4, 15)
"""Twists tried for a start, since the closed form of the start needs one."""

MODEL_PX = 0.01
"""Camera models are taken as no better than this where it is asked what they leave open. Six printed digits
round a Navcam's pixels by some 0.002."""

WEAK = 1.0
"""One over the square of how far an unknown could be off at all: 1 m, 1 rad."""

CAMERA_NAMES = (*(f"camera.turn_rad.{a}" for a in "xyz"), *(f"camera.shift_m.{a}" for a in "xyz"))


class PosesTooFew(CalibError):
    """The given poses do not determine a mast: too few, or one of the joints hardly moves."""


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
    parameter_names, covariance
        (p,) ``mast.translation_m.x`` and so on, then the camera's turn about C and its shift in the head
        frame; and (p, p) of these, as the residuals show the models' errors to be.
    """

    mast: Mast
    camera_in_head: CameraModel
    residuals: tuple[ModelDifference, ...]
    parameter_names: tuple[str, ...]
    covariance: FloatArray

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
    lens itself changes from model to model, ``tools.flight.difference.with_one_lens``
    takes that out first.

    Models are in the rover frame, of one camera, and may differ in size by binning; joint angles (n,) are in
    radians, positive tilt looks up. Six parameters are for axes that meet at a right angle (the paper's
    mast), eight for any two that are not parallel. Compared are points at the near and the far range.

    Raises
    ------
    PosesTooFew
        If the poses do not fix the parameters: fewer than three, a joint that hardly moves, no mast near
        which the camera sees what the models see, or a fit that does not settle.
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

    problem = _Poses(points_m, wanted_px, seen, pan, tilt, np.array(MAST_FREE[parameters]))
    fit = minimise(problem, _State(numbers_of(start), camera))
    if not np.isfinite(fit.normal.cost):
        raise PosesTooFew(
            "no mast was found from which the camera sees what its models see; "
            "check the joint angles (radians, right and up positive) and that the models are of one camera"
        )
    names = (*(f"mast.{MAST_NAMES[i]}" for i in problem.free), *CAMERA_NAMES)
    weak = np.full(len(names), WEAK)
    _check_determined(names, covariance_of(fit.normal.matrix, weak), weak, pan, tilt)
    if not fit.settled:
        raise PosesTooFew(
            f"the fit did not settle in {fit.steps} steps: the poses hardly fix the mast; add poses that "
            "move both joints"
        )
    state = fit.state
    differences = (
        model_difference(model, state.camera.moved(mast_of(state.mast).rover_from_head(p, t)))
        for model, p, t in zip(models, pan, tilt, strict=True)
    )
    return PoseFit(mast_of(state.mast), state.camera, tuple(differences), names, problem.covariance(fit))


class _State(NamedTuple):
    """The mast's eight numbers, and the camera in the head frame."""

    mast: FloatArray
    camera: CameraModel


class _Poses:
    """The mast and the camera's place in the head, as a `calib.adjust.solver.LeastSquaresProblem`.

    Points (n, m, 3) of n models in the rover frame, the pixels (m, 2) to see them at, and which exist (n, m).
    """

    def __init__(
        self,
        points_m: FloatArray,
        wanted_px: FloatArray,
        seen: NDArray[np.bool_],
        pan_rad: FloatArray,
        tilt_rad: FloatArray,
        free: np.ndarray,
    ) -> None:
        self.views = [
            (points[there], wanted_px[there], float(p), float(t))
            for points, there, p, t in zip(points_m, seen, pan_rad, tilt_rad, strict=True)
        ]
        self.free = free

    def normal(self, state: _State) -> Normal:
        size = len(self.free) + len(CAMERA_NAMES)
        cost, matrix, gradient = 0.0, np.zeros((size, size)), np.zeros(size)
        for residual, jacobian in self._rows(state):
            cost += float(residual @ residual)
            matrix += jacobian.T @ jacobian
            gradient += jacobian.T @ residual
        return Normal(cost if np.isfinite(cost) else float("inf"), matrix, gradient)

    def _rows(self, state: _State) -> Iterator[tuple[FloatArray, FloatArray]]:
        """Yield residuals (2m,) and Jacobian (2m, p) of each model; the camera's six come last."""
        for points, wanted, pan, tilt in self.views:
            head = gimbal(state.mast, pan, tilt)
            in_head = (points - head.translation_m) @ head.rotation
            pixels, per_point, _ = state.camera.project_jacobian(in_head)
            by_mast = gimbal_rates(per_point @ head.rotation.T, points, head, self.free)
            by_camera = rigid_rates(per_point, in_head, state.camera.C)
            # What moves the camera moves points the other way.
            jacobian = -np.concatenate([by_mast, by_camera], axis=2) / MODEL_PX
            yield (pixels - wanted).ravel() / MODEL_PX, jacobian.reshape(2 * len(points), -1)

    def covariance(self, fit: Minimum[_State]) -> FloatArray:
        """Return the covariance (p, p) that errors of the models make, as large as residuals show them."""
        rows = list(self._rows(fit.state))
        errors = np.array([np.linalg.lstsq(rates[:, -6:], left, rcond=None)[0] for left, rates in rows])
        count = errors.size
        spread = np.repeat([np.mean(part**2) for part in (errors[:, :3], errors[:, 3:])], 3)
        spread *= count / max(count - rows[0][1].shape[1], 1)
        inverse = covariance_of(fit.normal.matrix)
        moved = [inverse @ (rates.T @ rates[:, -6:]) for _, rates in rows]
        return np.asarray(sum((m * spread) @ m.T for m in moved))

    def cost(self, state: _State) -> float:
        cost = 0.0
        for points, wanted, pan, tilt in self.views:
            head = gimbal(state.mast, pan, tilt)
            pixels, _ = state.camera.project((points - head.translation_m) @ head.rotation)
            cost += float(np.sum(((pixels - wanted) / MODEL_PX) ** 2))
        return cost if np.isfinite(cost) else float("inf")

    def stepped(self, state: _State, step: FloatArray) -> _State:
        mast = state.mast.copy()
        mast[self.free] += step[: len(self.free)]
        pose = moved_rigid(Rigid(np.eye(3), state.camera.C), step[len(self.free) :])
        # The turn is about C, which the shift then carries.
        about_c = Rigid(pose.rotation, pose.translation_m - pose.rotation @ state.camera.C)
        return _State(mast, state.camera.moved(about_c))


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


def _start(
    models: Sequence[CameraModel], pan_rad: FloatArray, tilt_rad: FloatArray, twists_rad: FloatArray
) -> Mast:
    """The mast in closed form, for the twist that explains the orientations best.

    Orientations: R = M K B with K = Rz(pan) Rx(k) Ry(tilt). For a given k, K B = Mᵀ R is linear in the
    18 entries of B and Mᵀ: the right singular vector of the smallest singular value (the robot-world,
    hand-eye problem). Positions are then linear in t, a and the camera's place in the head.
    """
    eye = np.eye(3)
    rotations = [model.rotation.T for model in models]
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


def _check_determined(
    names: Sequence[str], covariance: FloatArray, weak: FloatArray, pan_rad: FloatArray, tilt_rad: FloatArray
) -> None:
    """Raise PosesTooFew where the data leave a combination of parameters open."""
    found = open_parameters(names, covariance, weak)
    if not found:
        return
    moves = {"pan": float(np.ptp(pan_rad)), "tilt": float(np.ptp(tilt_rad))}
    still = [f"{joint} by {moved:.2g} rad" for joint, moved in moves.items() if moved < SEEN_RAD]
    how = f" ({' and '.join(still)} in all)" if still else ""
    raise PosesTooFew(
        f"the joint angles vary too little{how} to fix {in_english(found[0])}; add poses that move both "
        "joints"
    )
