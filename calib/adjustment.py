"""Everything a survey measures as one least-squares problem: cameras, mast, boards, set-ups, prisms, joints.

Unknown are the cameras (``calib.camera_parameters``; a head camera in the head frame), 4, 6 or 8 numbers of
the mast, rover_from_station of every set-up, rover_from_board of every placement, and where their sigmas say
so the prisms' places on the rover and the joint angles of every head attitude. Measured are dots (pixels),
prisms and tapes (station), prisms from CAD and joint angles; each residual is divided by its sigma. The
prisms' CAD positions define the rover frame.

A residual of the station is taken in the rover frame: turning it does not change its size, since the
station's sigma is the same for each axis. Rigid unknowns move by a shift (3, metres) and a turn (3, a
rotation vector about the moved frame's own origin, applied from the left).

Structure: an image touches one camera, one board, the mast and one attitude, so its Jacobian is a small
dense block that is summed into the normal equations at once; these (some 300 unknowns) are solved densely.
"""

from __future__ import annotations

from collections.abc import Hashable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from calib.cahvor import CameraModel
from calib.camera_parameters import parameter_names, parameter_part, predict, stepped, tangents
from calib.least_squares import Normal
from calib.mast import Mast
from calib.rigid import FloatArray, Rigid, rot_x, rot_y, rot_z

MAST_NAMES = (
    *(f"translation_m.{axis}" for axis in "xyz"),
    *(f"rotation_rad.{axis}" for axis in "xyz"),
    "axis_offset_m",
    "axis_twist_rad",
)

MAST_FREE = {4: (0, 1, 2, 5), 6: (0, 1, 2, 3, 4, 5), 8: (0, 1, 2, 3, 4, 5, 6, 7)}
"""Which of the mast's eight numbers a fit of so many parameters moves; 4 is the mast taken as vertical."""

O_SIGMA_RAD = 0.02
R_SIGMA = (0.5, 1.0)
E_SIGMA_M = 0.01
"""What lenses are like, one sigma: O beside A, R1 and R2, E0 to E2. Flight cameras stay within some 2.5 of
these; a survey that sees a lens well does not feel them, and one that does not cannot run away with it."""

HUBER = 3.0
"""Length of a residual, in sigmas, from which its pull no longer grows while blunders are looked for."""

Key = Hashable
MAST: Key = ("mast",)


@dataclass(frozen=True, eq=False)
class Estimate:
    """A state of the fit. ``mast`` holds the eight numbers of ``MAST_NAMES``, ``joints_rad`` (k, 2) what is
    added to the readings of each head attitude."""

    cameras: Mapping[str, CameraModel]
    mast: FloatArray
    rover_from_station: Mapping[str, Rigid]
    rover_from_board: Mapping[tuple[str, str], Rigid]
    prisms_in_rover_m: Mapping[str, FloatArray]
    joints_rad: FloatArray

    @property
    def as_mast(self) -> Mast:
        """The mast of ``calib.mast``."""
        return Mast(self.mast[:3], self.mast[3:6], float(self.mast[6]), float(self.mast[7]))


@dataclass(frozen=True, eq=False)
class ImageTerm:
    """The dots of one image: board points (n, 3), pixels (n, 2), their sigma (n,), and which count (n,)."""

    name: str
    camera: str
    board: tuple[str, str]
    attitude: int | None
    pan_rad: float
    tilt_rad: float
    rows: np.ndarray
    columns: np.ndarray
    in_board_m: FloatArray
    pixels_px: FloatArray
    sigma_px: FloatArray
    keep: np.ndarray


@dataclass(frozen=True, eq=False)
class StationTerm:
    """One point measured by the station: a prism (``board`` None) or a tape."""

    setup: str
    board: tuple[str, str] | None
    point: str
    position_m: FloatArray
    in_board_m: FloatArray
    sigma_m: float
    keep: bool = True


@dataclass(frozen=True, eq=False)
class Block:
    """Residuals (m,) of one group, in sigmas and unweighted, and their Jacobian (m, k) on unknowns (k,)."""

    residual: FloatArray
    jacobian: FloatArray
    columns: np.ndarray
    width: int
    """How many residuals belong together (2: a dot, 3: a point of the station, 1: a single number)."""


class Gimbal(NamedTuple):
    """rover_from_head and its rates: what turns about which axis through which point, in the rover frame."""

    rotation: FloatArray
    translation_m: FloatArray
    axes: FloatArray
    """(10, 3): the eight numbers of the mast, pan, tilt; for a shift its direction, for an angle its axis."""
    mast_origin_m: FloatArray


_ABOUT_MAST, _ABOUT_HEAD = (3, 4, 5, 8), (7, 9)
"""Which of a gimbal's ten numbers are angles about axes through the mast's or the head's origin."""


def gimbal(mast: FloatArray, pan_rad: float, tilt_rad: float) -> Gimbal:
    """Return rover_from_head of the mast's eight numbers at joint angles, with its rates."""
    x = rot_x(mast[3])
    xy = x @ rot_y(mast[4])
    xyz = xy @ rot_z(mast[5])
    panned = xyz @ rot_z(pan_rad)
    twisted = panned @ rot_x(mast[7])
    origin = mast[:3]
    place = origin + mast[6] * panned[:, 0]
    eye = np.eye(3)
    axes = np.array([*eye, eye[0], x[:, 1], xy[:, 2], panned[:, 0], panned[:, 0], xyz[:, 2], twisted[:, 1]])
    return Gimbal(twisted @ rot_y(tilt_rad), place, axes, origin)


class Adjustment:
    """The least-squares problem of a survey.

    Parameters
    ----------
    images, station
        What was measured.
    prisms_cad_m, prism_cad_m
        The prisms from CAD, metres in the rover frame, and their sigma (0: exact).
    joint_rad
        Sigma of a joint reading (0: exact).
    mast_parameters
        4, 6 or 8; 0 leaves the mast as it is.
    start
        The state to start from; it settles which unknowns there are.
    huber
        Length in sigmas from which pulls are bounded; None for plain least squares.
    """

    def __init__(
        self,
        images: Sequence[ImageTerm],
        station: Sequence[StationTerm],
        start: Estimate,
        *,
        mast_parameters: int,
        prisms_cad_m: Mapping[str, FloatArray],
        prism_cad_m: float = 0.0,
        joint_rad: float = 0.0,
        huber: float | None = None,
    ) -> None:
        self.images, self.station = tuple(images), tuple(station)
        self.prisms_cad_m, self.prism_cad_m = prisms_cad_m, prism_cad_m
        self.joint_rad, self.huber = joint_rad, huber
        self.mast_free = np.array(MAST_FREE.get(mast_parameters, ()), dtype=int)
        self.parts: dict[Key, slice] = {}
        self.names: list[str] = []
        for name, model in start.cameras.items():
            self._add(("camera", name), [f"cameras.{name}.{p}" for p in parameter_names(model.kind)])
        self._add(MAST, [f"mast.{MAST_NAMES[i]}" for i in self.mast_free])
        rigid = [*(f"shift_m.{a}" for a in "xyz"), *(f"turn_rad.{a}" for a in "xyz")]
        for setup in start.rover_from_station:
            self._add(("setup", setup), [f"set-up {setup}.{p}" for p in rigid])
        for board in start.rover_from_board:
            self._add(("board", board), [f"placement {board[0]}/{board[1]}.{p}" for p in rigid])
        if prism_cad_m > 0:
            for prism in prisms_cad_m:
                self._add(("prism", prism), [f"prism {prism}.{a}" for a in "xyz"])
        if joint_rad > 0:
            for index in range(len(start.joints_rad)):
                self._add(("attitude", index), [f"attitude {index}.{j}" for j in ("pan_rad", "tilt_rad")])
        self.weak = self._weak(start)

    def _add(self, key: Key, names: Sequence[str]) -> None:
        self.parts[key] = slice(len(self.names), len(self.names) + len(names))
        self.names.extend(names)

    def with_huber(self, huber: float | None) -> Adjustment:
        """Return the same problem with another bound on pulls."""
        return self._copy(huber=huber)

    def with_terms(self, images: Sequence[ImageTerm], station: Sequence[StationTerm]) -> Adjustment:
        """Return the same problem with other terms of the same unknowns."""
        return self._copy(images=tuple(images), station=tuple(station))

    def _copy(self, **changed: object) -> Adjustment:
        other = object.__new__(type(self))
        other.__dict__.update(self.__dict__, **changed)
        return other

    def _weak(self, start: Estimate) -> FloatArray:
        """One over the square of how far an unknown could be off at all; see ``least_squares.minimise``."""
        sigma = np.ones(len(self.names))
        for name, model in start.cameras.items():
            part = np.ones(len(parameter_names(model.kind)))
            for letter in "HV":
                part[parameter_part(model.kind, letter)] = float(np.linalg.norm(model.H))
            sigma[self.parts["camera", name]] = part
        return np.asarray(sigma**-2.0)

    def stepped(self, state: Estimate, step: FloatArray) -> Estimate:
        """Return the state moved by a step; ValueError if a camera is none any more."""
        if not np.isfinite(step).all():
            raise ValueError("the step is not finite")
        mast = state.mast.copy()
        mast[self.mast_free] += step[self.parts[MAST]]
        prisms, joints = state.prisms_in_rover_m, state.joints_rad
        if self.prism_cad_m > 0:
            prisms = {name: p + step[self.parts["prism", name]] for name, p in prisms.items()}
        if self.joint_rad > 0 and len(joints):
            joints = joints + np.array([step[self.parts["attitude", i]] for i in range(len(joints))])
        return replace(
            state,
            cameras={n: stepped(m, step[self.parts["camera", n]]) for n, m in state.cameras.items()},
            mast=mast,
            rover_from_station={
                n: moved_rigid(p, step[self.parts["setup", n]]) for n, p in state.rover_from_station.items()
            },
            rover_from_board={
                n: moved_rigid(p, step[self.parts["board", n]]) for n, p in state.rover_from_board.items()
            },
            prisms_in_rover_m=prisms,
            joints_rad=joints,
        )

    def cost(self, state: Estimate) -> float:
        """Return the weighted sum of squares (pulls bounded if asked); infinite where a dot has no pixel."""
        total = 0.0
        for residual, width in self._residuals(state):
            if not np.isfinite(residual).all():
                return float("inf")
            total += self._loss(residual, width)
        return total

    def _loss(self, residual: FloatArray, width: int) -> float:
        if self.huber is None or width == 1:
            return float(residual @ residual)
        length = np.linalg.norm(residual.reshape(-1, width), axis=1)
        bounded = np.where(length <= self.huber, length**2, self.huber * (2 * length - self.huber))
        return float(bounded.sum())

    def normal(self, state: Estimate) -> Normal:
        """Return cost and normal equations of everything that counts."""
        size = len(self.names)
        cost, matrix, gradient = 0.0, np.zeros((size, size)), np.zeros(size)
        for _, block in self.blocks(state):
            if not np.isfinite(block.residual).all():
                return Normal(float("inf"), matrix, gradient)
            residual, jacobian = block.residual, block.jacobian
            cost += self._loss(residual, block.width)
            if self.huber is not None and block.width > 1:
                length = np.linalg.norm(residual.reshape(-1, block.width), axis=1)
                weight = np.repeat(
                    np.sqrt(np.minimum(1.0, self.huber / np.maximum(length, 1e-300))), block.width
                )
                residual, jacobian = residual * weight, jacobian * weight[:, None]
            columns = block.columns
            matrix[np.ix_(columns, columns)] += jacobian.T @ jacobian
            gradient[columns] += jacobian.T @ residual
        return Normal(cost, matrix, gradient)

    def blocks(self, state: Estimate) -> Iterator[tuple[ImageTerm | StationTerm | str, Block]]:
        """Yield every group that counts, residuals and Jacobian; a name for what is known beforehand."""
        for image in self.images:
            if image.keep.any():
                yield image, self.image_block(state, image)
        for point in self.station:
            if point.keep:
                yield point, self.station_block(state, point)
        yield from self.known(state)

    def _residuals(self, state: Estimate) -> Iterator[tuple[FloatArray, int]]:
        for image in self.images:
            if image.keep.any():
                yield self.image_residual(state, image), 2
        for point in self.station:
            if point.keep:
                yield self.station_residual(state, point), 3
        for _, block in self.known(state):
            yield block.residual, 1

    def joints(self, state: Estimate, image: ImageTerm) -> tuple[float, float]:
        """The joint angles of an image as the state has them."""
        if image.attitude is None or not len(state.joints_rad):
            return image.pan_rad, image.tilt_rad
        pan, tilt = state.joints_rad[image.attitude]
        return image.pan_rad + float(pan), image.tilt_rad + float(tilt)

    def image_residual(self, state: Estimate, image: ImageTerm) -> FloatArray:
        """Predicted less measured pixels of the dots that count, in sigmas, (2n,)."""
        keep = image.keep
        points = state.rover_from_board[image.board].points(image.in_board_m[keep])
        if image.attitude is not None:
            head = gimbal(state.mast, *self.joints(state, image))
            points = (points - head.translation_m) @ head.rotation
        pixels, _ = state.cameras[image.camera].project(points)
        return np.asarray(((pixels - image.pixels_px[keep]) / image.sigma_px[keep, None]).ravel())

    def image_block(self, state: Estimate, image: ImageTerm) -> Block:
        """The dots of an image."""
        keep = image.keep
        board = state.rover_from_board[image.board]
        points = board.points(image.in_board_m[keep])
        parts, columns = [], [self.at(("camera", image.camera))]
        if image.attitude is None:
            seen = predict(state.cameras[image.camera], points)
            in_rover = seen.d_points
            parts.append(seen.d_step)
        else:
            head = gimbal(state.mast, *self.joints(state, image))
            seen = predict(state.cameras[image.camera], (points - head.translation_m) @ head.rotation)
            in_rover = seen.d_points @ head.rotation.T
            parts.append(seen.d_step)
            wanted = list(self.mast_free)
            columns.append(self.at(MAST))
            if self.joint_rad > 0:
                wanted += [8, 9]
                columns.append(self.at(("attitude", image.attitude)))
            parts.append(-gimbal_rates(in_rover, points, head, np.array(wanted, dtype=int)))
        parts.append(rigid_rates(in_rover, points, board.translation_m))
        columns.append(self.at(("board", image.board)))
        sigma = image.sigma_px[keep]
        residual = (seen.pixels_px - image.pixels_px[keep]) / sigma[:, None]
        jacobian = np.concatenate(parts, axis=2) / sigma[:, None, None]
        return Block(residual.ravel(), jacobian.reshape(residual.size, -1), np.concatenate(columns), width=2)

    def station_residual(self, state: Estimate, point: StationTerm) -> FloatArray:
        """Measured less expected place of a prism or tape, in the rover frame and in sigmas, (3,)."""
        measured = state.rover_from_station[point.setup].points(point.position_m)
        if point.board is None:
            expected = state.prisms_in_rover_m[point.point]
        else:
            expected = state.rover_from_board[point.board].points(point.in_board_m)
        return np.asarray((measured - expected) / point.sigma_m)

    def station_block(self, state: Estimate, point: StationTerm) -> Block:
        """One point of the station."""
        setup = state.rover_from_station[point.setup]
        eye = np.eye(3)[None]
        parts = [rigid_rates(eye, setup.points(point.position_m)[None], setup.translation_m)]
        columns = [self.at(("setup", point.setup))]
        if point.board is not None:
            board = state.rover_from_board[point.board]
            parts.append(-rigid_rates(eye, board.points(point.in_board_m)[None], board.translation_m))
            columns.append(self.at(("board", point.board)))
        elif self.prism_cad_m > 0:
            parts.append(-eye)
            columns.append(self.at(("prism", point.point)))
        jacobian = np.concatenate(parts, axis=2)[0] / point.sigma_m
        return Block(self.station_residual(state, point), jacobian, np.concatenate(columns), width=3)

    def known(self, state: Estimate) -> Iterator[tuple[str, Block]]:
        """What is known beforehand: usual lenses, prisms from CAD, joint readings."""
        for name, model in state.cameras.items():
            if "O" in model.kind:
                residual, jacobian = lens_knowledge(model)
                yield f"lens {name}", Block(residual, jacobian, self.at(("camera", name)), width=1)
        if self.prism_cad_m > 0:
            for name, place in state.prisms_in_rover_m.items():
                residual = (place - self.prisms_cad_m[name]) / self.prism_cad_m
                yield (
                    f"prism {name}",
                    Block(residual, np.eye(3) / self.prism_cad_m, self.at(("prism", name)), width=1),
                )
        if self.joint_rad > 0:
            for index, joints in enumerate(state.joints_rad):
                at = self.at(("attitude", index))
                yield (
                    f"attitude {index}",
                    Block(joints / self.joint_rad, np.eye(2) / self.joint_rad, at, width=1),
                )

    def at(self, key: Key) -> np.ndarray:
        """Return the indices of an unknown's numbers."""
        part = self.parts[key]
        return np.arange(part.start, part.stop)


def moved_rigid(pose: Rigid, step: FloatArray) -> Rigid:
    """Return a pose shifted by step[:3] and turned by the rotation vector step[3:] about its origin."""
    turned = Rotation.from_rotvec(step[3:]).as_matrix() @ pose.rotation
    return Rigid(turned, pose.translation_m + step[:3])


def lens_knowledge(model: CameraModel) -> tuple[FloatArray, FloatArray]:
    """Return how far a lens is from usual, in sigmas, and the Jacobian to the camera's step."""
    kind = model.kind
    size = len(parameter_names(kind))
    aside = np.zeros((3, size))
    aside[:, parameter_part(kind, "O")] = tangents(model.O).T / O_SIGMA_RAD
    aside[:, parameter_part(kind, "A")] = -tangents(model.A).T / O_SIGMA_RAD
    residuals, rows = [(model.O - model.A) / O_SIGMA_RAD, model.R[1:] / np.array(R_SIGMA)], [aside]
    bends = np.zeros((2, size))
    bends[:, parameter_part(kind, "R")] = np.diag(1 / np.array(R_SIGMA))
    rows.append(bends)
    if "E" in kind:
        enters = np.zeros((3, size))
        enters[:, parameter_part(kind, "E")] = np.eye(3) / E_SIGMA_M
        rows.append(enters)
        residuals.append(model.E / E_SIGMA_M)
    return np.concatenate(residuals), np.concatenate(rows)


def gimbal_rates(per_point: FloatArray, points_m: FloatArray, head: Gimbal, wanted: np.ndarray) -> FloatArray:
    """(n, m, k): rates of something per rover-frame point (n, m, 3) as the head carries points along."""
    about_mast = np.cross((points_m - head.mast_origin_m)[:, None, :], per_point)
    about_head = np.cross((points_m - head.translation_m)[:, None, :], per_point)
    columns = []
    for index in wanted:
        kind = about_head if index in _ABOUT_HEAD else about_mast if index in _ABOUT_MAST else per_point
        columns.append(kind @ head.axes[index])
    return np.stack(columns, axis=-1) if columns else np.zeros((*per_point.shape[:2], 0))


def rigid_rates(per_point: FloatArray, points_m: FloatArray, origin_m: FloatArray) -> FloatArray:
    """(n, m, 6): rates of something per point (n, m, 3) for a shift and a turn about ``origin_m``."""
    arm = points_m - origin_m
    moment = np.cross(arm[:, None, :], per_point)
    return np.concatenate([np.broadcast_to(per_point, moment.shape), moment], axis=2)
