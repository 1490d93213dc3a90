"""The information of images of boards about a rig, before and after they are taken.

Unknown are the cameras, the mast's axis offset and twist, the errors of both joints and one pose for each
placement of a board. No board of unknown pose can show where the mast frame is in the rover frame, nor
pan zero and tilt zero. So the mast frame is fixed as the present estimate has it.

Each shot (all cameras at one attitude of the head) adds JᵀJ of its weighted pixel rates, with the reading
errors of its two joints eliminated. The prior is so wide that it only keeps directions closed that no picture
has shown yet.

From that follows how well the rig would point, over the whole of where it points
(`calib.geometry.covariance`): the figure that the choice of poses lowers.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import product

import numpy as np

from calib.errors import CalibError
from calib.geometry.covariance import JOINT_NAMES, landing_rates, pixel_rates
from calib.geometry.parameters import parameter_names, parameter_part
from calib.geometry.rig import JOINTS_NAMES, Approach, Gimbal, Rig, gimbal, numbers_of
from calib.geometry.rigid import FloatArray, Rigid, rigid_rates

AXES = ("mast.axis_offset_m", "mast.axis_twist_rad")
BEFOREHAND = {"C": 0.2, "A": 0.2, "H": 0.3, "V": 0.3, "O": 0.02, "R": 0.3, "E": 0.1, "D": 0.3}
"""Sigma of a camera's letters before any picture: metres, radians, and of one focal length for H and V."""
AXIS_OFFSET_M, AXIS_TWIST_RAD, JOINT_ERROR_RAD = 0.05, 0.05, 0.01
"""Sigma beforehand of the axes, and of each term of a joint: hobby encoders are off by 6 to 9 mrad."""


@dataclass(frozen=True, eq=False)
class BoardView:
    """Corners of a board in one camera's picture: where on the board (n, 3), metres, and sigma (n,), px."""

    camera: str
    in_board_m: FloatArray
    sigma_px: FloatArray


@dataclass(frozen=True, eq=False)
class BenchShot:
    """All cameras' pictures at one attitude: the read angles, radians, and from where each joint came.

    ``pan_approach`` and ``tilt_approach`` are 1 from smaller angles, -1 from larger, 0 where unknown.
    """

    placement: str
    pan_rad: float
    tilt_rad: float
    views: tuple[BoardView, ...]
    pan_approach: int = 0
    tilt_approach: int = 0


@dataclass(frozen=True, eq=False)
class Knowledge:
    """A rig as it is estimated now, with the boards' poses, and what to make of shots of them.

    ``boards`` maps a placement to rover_from_board; ``joint_sigma_rad`` is that of one reading of a joint,
    such as of its whole counts.
    """

    rig: Rig
    boards: Mapping[str, Rigid]
    joint_sigma_rad: float = 0.0

    @cached_property
    def names(self) -> tuple[str, ...]:
        """The rig's unknowns: cameras, axes, joints."""
        return (*(n for name in self.rig.cameras for n in self._camera_names(name)), *AXES, *JOINTS_NAMES)

    @cached_property
    def beforehand(self) -> FloatArray:
        """Information (p, p) from before any picture."""
        sigma: list[float] = []
        for camera in self.rig.cameras.values():
            kind = camera.model.kind
            mine = np.empty(len(parameter_names(kind)))
            for letter in dict.fromkeys(camera.model.letters):
                scale = float(np.linalg.norm(camera.model.H)) if letter in "HV" else 1.0
                mine[parameter_part(kind, letter)] = BEFOREHAND[letter] * scale
            sigma += mine.tolist()
        sigma += [AXIS_OFFSET_M, AXIS_TWIST_RAD, *len(JOINTS_NAMES) * [JOINT_ERROR_RAD]]
        return np.diag(np.array(sigma) ** -2.0)

    def information(self, shots: Iterable[BenchShot]) -> FloatArray:
        """Return the information of shots about the rig (p, p), boards' poses eliminated, with the prior."""
        total = self.beforehand.copy()
        by_board: dict[str, list[BenchShot]] = {}
        for shot in shots:
            by_board.setdefault(shot.placement, []).append(shot)
        for mine in by_board.values():
            total += without_board(sum(self.of_shot(shot) for shot in mine))  # type: ignore[arg-type]
        return total

    def of_shot(self, shot: BenchShot) -> FloatArray:
        """Return the information of one shot about the rig and its board's pose: (p + 6, p + 6)."""
        size = len(self.names) + 8
        rows = [np.empty((0, size))]
        for view in shot.views:
            rates = self.view_rates(shot, view) / view.sigma_px[:, None, None]
            rows.append(rates[np.isfinite(rates).all(axis=(1, 2))].reshape(-1, size))
        whole = np.concatenate(rows)
        jacobian, by_joint = whole[:, :-2], whole[:, -2:]
        information = jacobian.T @ jacobian
        if self.joint_sigma_rad > 0.0:
            across = by_joint.T @ jacobian
            own = by_joint.T @ by_joint + np.eye(2) / self.joint_sigma_rad**2
            information -= across.T @ np.linalg.solve(own, across)
        return np.asarray(information)

    def view_rates(self, shot: BenchShot, view: BoardView) -> FloatArray:
        """Return (n, 2, p + 8): how a view's corners depend on rig, board's pose and both readings."""
        names, board = (*self.names, *JOINT_NAMES), self.boards[shot.placement]
        points = board.points(view.in_board_m)
        seen = pixel_rates(self.rig, names, view.camera, *self._true_rad(shot), points, _approach(shot))
        to_board = rigid_rates(seen.to_points, points, board.translation_m)
        return np.concatenate([seen.to_rig[..., :-2], to_board, seen.to_rig[..., -2:]], axis=2)

    def head(self, shot: BenchShot) -> Gimbal:
        """Return where the head truly is, as the estimate has it."""
        return gimbal(numbers_of(self.rig.mast), *self._true_rad(shot))

    def _true_rad(self, shot: BenchShot) -> tuple[float, float]:
        return self.rig.joints.true_rad((shot.pan_rad, shot.tilt_rad), _approach(shot))

    def _camera_names(self, camera: str) -> Sequence[str]:
        kind = self.rig.cameras[camera].model.kind
        return [f"cameras.{camera}.{part}" for part in parameter_names(kind)]


def _approach(shot: BenchShot) -> Approach:
    return shot.pan_approach, shot.tilt_approach


def without_board(information: FloatArray) -> FloatArray:
    """Return what is left of (p + 6, p + 6) about the rig, (p, p), if the board's pose is unknown."""
    rig, across, board = information[:-6, :-6], information[:-6, -6:], information[-6:, -6:]
    scale = 1.0 / np.sqrt(np.maximum(np.diag(board), 1e-300))
    own = np.linalg.pinv(board * np.outer(scale, scale), hermitian=True) * np.outer(scale, scale)
    return np.asarray(rig - across @ own @ across.T)


RANGES_M = (2.0, 6.0, 10.0)
CLICKS = ((0.15, 0.2), (0.85, 0.8), (0.85, 0.2), (0.15, 0.8))
"""Where in the picture targets are clicked, in parts of its width and height: towards its corners."""
STEPS = (5, 3)


@dataclass(frozen=True)
class Workspace:
    """Where a rig points: joint angles at which targets are clicked, from where to where.

    ``cameras`` are the clicked one, and its partner if there is one; targets are ``ranges_m`` away. A
    ``one_sided`` head approaches every goal from the same side by itself, so that backlash is no error.
    """

    cameras: tuple[str, ...]
    pan_rad: tuple[float, float]
    tilt_rad: tuple[float, float]
    one_sided: bool = False
    ranges_m: tuple[float, ...] = RANGES_M


@dataclass(frozen=True, eq=False)
class ExpectedPointing:
    """How landings (2k) depend on the rig's unknowns (2k, p) and on the four joint readings (2k, 4), px/rad.

    ``places`` (k) are pan and tilt of the click, radians, and the target's range, metres.
    """

    to_rig: FloatArray
    to_joints: FloatArray
    places: tuple[tuple[float, float, float], ...] = ()

    def rms_px(self, covariance: FloatArray) -> float:
        """Return the rms per axis of the landings that an uncertainty (p, p) of the rig makes."""
        return float(np.sqrt(max(np.sum(self._weights * covariance), 0.0)))

    @cached_property
    def _weights(self) -> FloatArray:
        """The matrix (p, p) whose product with a covariance has the mean square per axis as trace."""
        return np.asarray(self.to_rig.T @ self.to_rig / max(len(self.to_rig), 1))

    def by_counts_px(self, joint_sigma_rad: float) -> float:
        """Return the rms per axis that the readings alone leave, however well the rig is known."""
        squares = np.sum(self.to_joints**2) / max(len(self.to_joints), 1)
        return float(joint_sigma_rad * np.sqrt(squares))


def pointing(known: Knowledge, where: Workspace) -> ExpectedPointing:
    """Return how pointing over the workspace depends on what is unknown.

    Raises CalibError if nothing of the workspace can be pointed at.
    """
    rig, camera = known.rig, where.cameras[0]
    size_px = np.array(rig.cameras[camera].model.size_px)
    landings: list[tuple[FloatArray, FloatArray]] = []
    places: list[tuple[float, float, float]] = []
    side = 0
    pans, tilts = (
        np.unique(np.linspace(*angles, steps))
        for angles, steps in zip((where.pan_rad, where.tilt_rad), STEPS, strict=True)
    )
    for pan, tilt, range_m, click in product(pans.tolist(), tilts.tolist(), where.ranges_m, CLICKS):
        # Backlash shows where click and landing were approached from different sides.
        side = 0 if where.one_sided else 1 if side != 1 else -1
        sides = (side, side), (-side, -side)
        true_rad = rig.joints.true_rad((pan, tilt), sides[0])
        ray = rig.camera_in_rover(camera, *true_rad).ray(click * size_px)
        target_m = ray.origins_m + range_m * ray.directions
        try:
            landings.append(landing_rates(rig, known.names, where.cameras, *true_rad, target_m, sides))
        except CalibError:
            continue
        places.append((pan, tilt, float(range_m)))
    if not landings:
        raise CalibError(f"camera {camera} can be pointed at nothing of the workspace")
    to_rig, to_readings = (np.concatenate(part) for part in zip(*landings, strict=True))
    return ExpectedPointing(to_rig, to_readings, tuple(places))
