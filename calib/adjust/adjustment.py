"""Everything a survey measures as one least-squares problem: cameras, mast, boards, set-ups, prisms, joints.

Unknown are the cameras (``calib.geometry.parameters``; a head camera in the head frame), 4, 6 or 8 numbers of
the mast, rover_from_station of every set-up, rover_from_board of every placement, and where their sigmas say
so the prisms' places on the rover and the joint angles of every head attitude. Measured are dots (pixels),
prisms and tapes (station), prisms from CAD and joint angles; each residual is divided by its sigma. The
prisms' CAD positions define the rover frame.

A bench has no station: its boards' poses are unknown, or one of them is held; the rover frame is the mast's
own or hangs on what is held; and the joints' errors (``calib.geometry.rig``) and the boards' bows may be
unknowns too. What joints and boards are usually like holds such an unknown where pictures hardly show it.

A residual of the station is taken in the rover frame: turning it does not change its size, since the
station's sigma is the same for each axis. Rigid unknowns move by a turn (3, a rotation vector
about the moved frame's own origin, applied from the left) and a shift (3, metres).

Structure: an image touches one camera, one board, the mast and one attitude, so its Jacobian is a small
dense block that is summed into the normal equations at once; these (some 300 unknowns) are solved densely.
"""

from __future__ import annotations

from collections.abc import Hashable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from calib.adjust.solver import Normal
from calib.adjust.terms import DRAWING, JOINTS, ImageTerm, StationTerm, lens_knowledge, widened_images
from calib.geometry.cahvor import CameraModel
from calib.geometry.parameters import Prediction, parameter_names, parameter_part, predict, stepped
from calib.geometry.rig import (
    JOINTS_NAMES,
    MAST_FREE,
    MAST_NAMES,
    AxisJoint,
    Gimbal,
    JointErrors,
    Mast,
    gimbal,
    gimbal_rates,
    joints_of,
    mast_of,
)
from calib.geometry.rigid import FloatArray, Rigid, moved_rigid, rigid_rates

HUBER = 3.0
"""Length of a residual, in sigmas, from which its pull no longer grows while blunders are looked for."""

USUAL_JOINT_RAD = 0.01
"""What a joint's harmonics and backlash are like, one sigma, radians; hobby servos have 6 to 9 mrad."""

USUAL_BOW_M = 0.005
"""How far a board's edges are usually from flat, one sigma, metres."""

KNOWN_BEFOREHAND = "usual "
"""How the names begin of blocks that are no measurements but what lenses, joints and boards are like."""

Key = Hashable
MAST: Key = ("mast",)
JOINT_ERRORS: Key = ("joints",)


@dataclass(frozen=True, eq=False)
class Estimate:
    """A state of the fit. ``mast`` holds the eight numbers of ``MAST_NAMES``, ``joints_rad`` (k, 2) what is
    added to the readings of each head attitude, ``joint_errors`` (10,) the numbers of
    ``calib.geometry.rig.JOINTS_NAMES``, ``bows_m`` by board (2,) how far the middles of its sides, right and
    left, top and bottom, lie behind its centre, metres."""

    cameras: Mapping[str, CameraModel]
    mast: FloatArray
    rover_from_station: Mapping[str, Rigid]
    rover_from_board: Mapping[tuple[str, str], Rigid]
    prisms_in_rover_m: Mapping[str, FloatArray]
    joints_rad: FloatArray
    joint_errors: FloatArray = field(default_factory=lambda: np.zeros(len(JOINTS_NAMES)))
    bows_m: Mapping[str, FloatArray] = field(default_factory=dict)

    @property
    def as_mast(self) -> Mast:
        """The mast of ``calib.geometry.rig``."""
        return mast_of(self.mast)

    @cached_property
    def as_joints(self) -> JointErrors:
        """The joints of ``calib.geometry.rig``; ValueError if their errors are too large to be any."""
        return joints_of(self.joint_errors)


@dataclass(frozen=True, eq=False)
class ResidualBlock:
    """Residuals (m,) of one group, in sigmas and unweighted, and their Jacobian (m, k) on unknowns (k,)."""

    residual: FloatArray
    jacobian: FloatArray
    columns: np.ndarray
    width: int
    """How many residuals belong together (2: a dot, 3: a point of the station, 1: a single number)."""


class Adjustment:
    """The least-squares problem of a survey.

    Parameters
    ----------
    images, station
        What was measured.
    prisms_cad_m, prism_cad_m
        The prisms from CAD, metres in the rover frame, and their sigma (0: exact). With a sigma, one that the
        start has and CAD has not is known by the station alone.
    joint_rad
        Sigma of a joint reading (0: exact).
    mast_parameters
        4, 6 or 8; 0 leaves the mast as it is. Or which of its eight numbers move.
    joint_errors
        Which of ``calib.geometry.rig.JOINTS_NAMES`` move.
    bowed
        Boards whose bow is unknown, by the first part of their images' ``board``.
    held
        Boards that stay where the start has them.
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
        mast_parameters: int | Sequence[int],
        prisms_cad_m: Mapping[str, FloatArray] | None = None,
        prism_cad_m: float = 0.0,
        joint_rad: float = 0.0,
        joint_errors: Sequence[int] = (),
        bowed: Sequence[str] = (),
        held: Sequence[tuple[str, str]] = (),
        huber: float | None = None,
    ) -> None:
        self.images, self.station = tuple(images), tuple(station)
        self.prisms_cad_m, self.prism_cad_m = prisms_cad_m or {}, prism_cad_m
        self.joint_rad, self.huber = joint_rad, huber
        if isinstance(mast_parameters, int):
            mast_parameters = MAST_FREE.get(mast_parameters, ())
        self.mast_free = np.array(mast_parameters, dtype=int)
        self.joint_errors = np.array(joint_errors, dtype=int)
        self.bowed, self.held = tuple(bowed), frozenset(held)
        self.parts: dict[Key, slice] = {}
        self.names: list[str] = []
        for name, model in start.cameras.items():
            self._add(("camera", name), [f"cameras.{name}.{p}" for p in parameter_names(model.kind)])
        self._add(MAST, [f"mast.{MAST_NAMES[i]}" for i in self.mast_free])
        self._add(JOINT_ERRORS, [JOINTS_NAMES[i] for i in self.joint_errors])
        for board in self.bowed:
            self._add(("bow", board), [f"board {board}.bow_m.{a}" for a in "xy"])
        rigid = [*(f"turn_rad.{a}" for a in "xyz"), *(f"shift_m.{a}" for a in "xyz")]
        for setup in start.rover_from_station:
            self._add(("setup", setup), [f"set-up {setup}.{p}" for p in rigid])
        for pose in start.rover_from_board:
            if pose not in self.held:
                self._add(("board", pose), [f"placement {pose[0]}/{pose[1]}.{p}" for p in rigid])
        if prism_cad_m > 0:
            for prism in start.prisms_in_rover_m:
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

    def with_sigmas(self, factors: Mapping[str, float]) -> Adjustment:
        """Return the same problem with sigmas times ``factors``, by kind (``calib.adjust.goodness``)."""
        return self._copy(
            images=widened_images(self.images, factors),
            station=tuple(replace(p, sigma_m=p.sigma_m * factors.get(p.kind, 1.0)) for p in self.station),
            joint_rad=self.joint_rad * factors.get(JOINTS, 1.0),
            prism_cad_m=self.prism_cad_m * factors.get(DRAWING, 1.0),
        )

    def at_rest(self) -> Adjustment:
        """Return the same problem without unknowns of single attitudes, for images that are not fitted."""
        return self._copy(joint_rad=0.0)

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
        sigma[self.parts[JOINT_ERRORS]] = 1e3  # these have their own knowledge beforehand
        for board in self.bowed:
            sigma[self.parts["bow", board]] = 1e3
        return np.asarray(sigma**-2.0)

    def stepped(self, state: Estimate, step: FloatArray) -> Estimate:
        """Return the state moved by a step; ValueError if a camera is none any more."""
        if not np.isfinite(step).all():
            raise ValueError("the step is not finite")
        mast = state.mast.copy()
        mast[self.mast_free] += step[self.parts[MAST]]
        errors = state.joint_errors.copy()
        errors[self.joint_errors] += step[self.parts[JOINT_ERRORS]]
        prisms, joints = state.prisms_in_rover_m, state.joints_rad
        if self.prism_cad_m > 0:
            prisms = {name: p + step[self.parts["prism", name]] for name, p in prisms.items()}
        if self.joint_rad > 0 and len(joints):
            joints = joints + np.array([step[self.parts["attitude", i]] for i in range(len(joints))])
        moved = replace(
            state,
            cameras={n: stepped(m, step[self.parts["camera", n]]) for n, m in state.cameras.items()},
            mast=mast,
            rover_from_station={
                n: moved_rigid(p, step[self.parts["setup", n]]) for n, p in state.rover_from_station.items()
            },
            rover_from_board={
                n: p if n in self.held else moved_rigid(p, step[self.parts["board", n]])
                for n, p in state.rover_from_board.items()
            },
            prisms_in_rover_m=prisms,
            joints_rad=joints,
            joint_errors=errors,
            bows_m={
                n: b + step[self.parts["bow", n]] if n in self.bowed else b for n, b in state.bows_m.items()
            },
        )
        if len(self.joint_errors):
            _ = moved.as_joints
        return moved

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
                weight = np.sqrt(bounded_weights(residual, block.width, self.huber))
                residual, jacobian = residual * weight, jacobian * weight[:, None]
            columns = block.columns
            matrix[np.ix_(columns, columns)] += jacobian.T @ jacobian
            gradient[columns] += jacobian.T @ residual
        return Normal(cost, matrix, gradient)

    def blocks(self, state: Estimate) -> Iterator[tuple[ImageTerm | StationTerm | str, ResidualBlock]]:
        """Yield every group that counts, residuals and Jacobian; a name for what is known beforehand."""
        for _, images in self._by_camera():
            yield from zip(images, self.image_blocks(state, images), strict=True)
        for point in self.station:
            if point.keep:
                yield point, self.station_block(state, point)
        yield from self.known(state)

    def _by_camera(self) -> Iterator[tuple[str, list[ImageTerm]]]:
        """The images that count, by camera: one call for the points of many is far quicker."""
        for name in dict.fromkeys(t.camera for t in self.images):
            yield name, [t for t in self.images if t.camera == name and t.keep.any()]

    def _residuals(self, state: Estimate) -> Iterator[tuple[FloatArray, int]]:
        for name, images in self._by_camera():
            if not images:
                continue
            pixels, _ = state.cameras[name].project(
                np.concatenate([self.in_camera(state, t)[t.keep] for t in images])
            )
            measured = np.concatenate([t.pixels_px[t.keep] for t in images])
            sigma = np.concatenate([t.sigma_px[t.keep] for t in images])
            yield ((pixels - measured) / sigma[:, None]).ravel(), 2
        for point in self.station:
            if point.keep:
                yield self.station_residual(state, point), 3
        for _, block in self.known(state):
            yield block.residual, 1

    def reading(self, state: Estimate, image: ImageTerm) -> tuple[float, float]:
        """What the joints would have read of an image without noise, as the state has it."""
        if image.attitude is None or image.attitude < 0 or not len(state.joints_rad):
            return image.pan_rad, image.tilt_rad
        pan, tilt = state.joints_rad[image.attitude]
        return image.pan_rad + float(pan), image.tilt_rad + float(tilt)

    def joints(self, state: Estimate, image: ImageTerm) -> tuple[float, float]:
        """The true joint angles of an image as the state has them."""
        reading = self.reading(state, image)
        if image.attitude is None or not state.joint_errors.any():
            return reading
        return state.as_joints.true_rad(reading, image.approach)

    def image_residual(self, state: Estimate, image: ImageTerm) -> FloatArray:
        """Predicted less measured pixels of the dots that count, in sigmas, (2n,)."""
        keep = image.keep
        pixels, _ = state.cameras[image.camera].project(self.in_camera(state, image)[keep])
        return np.asarray(((pixels - image.pixels_px[keep]) / image.sigma_px[keep, None]).ravel())

    def in_camera(self, state: Estimate, image: ImageTerm) -> FloatArray:
        """All the points (n, 3) of an image in its camera's frame, metres, as the state has them."""
        points = state.rover_from_board[image.board].points(bowed_points(state, image))
        if image.attitude is not None:
            head = gimbal(state.mast, *self.joints(state, image))
            points = (points - head.translation_m) @ head.rotation
        return np.asarray(points)

    def _axes(self, state: Estimate) -> tuple[AxisJoint, AxisJoint]:
        """Both joints as the state has them."""
        return state.as_joints.pan, state.as_joints.tilt

    def image_block(self, state: Estimate, image: ImageTerm) -> ResidualBlock:
        """The dots of an image."""
        return next(self.image_blocks(state, [image]))

    def image_blocks(self, state: Estimate, images: Sequence[ImageTerm]) -> Iterator[ResidualBlock]:
        """The dots of some images of one camera."""
        if not images:
            return
        points, heads = [], []
        for image in images:
            board = state.rover_from_board[image.board]
            points.append(board.points(bowed_points(state, image)[image.keep]))
            heads.append(None if image.attitude is None else gimbal(state.mast, *self.joints(state, image)))
        in_camera = [
            p if head is None else (p - head.translation_m) @ head.rotation
            for p, head in zip(points, heads, strict=True)
        ]
        every = predict(state.cameras[images[0].camera], np.concatenate(in_camera))
        first = 0
        for image, there, head in zip(images, points, heads, strict=True):
            mine = slice(first, first + len(there))
            first += len(there)
            yield self._block(state, image, there, head, Prediction(*(array[mine] for array in every)))

    def _block(
        self, state: Estimate, image: ImageTerm, points: FloatArray, head: Gimbal | None, seen: Prediction
    ) -> ResidualBlock:
        """One image whose points (n, 3) of the rover frame are seen so."""
        keep = image.keep
        board = state.rover_from_board[image.board]
        parts, columns = [seen.d_step], [self.at(("camera", image.camera))]
        in_rover = seen.d_points
        if head is not None:
            in_rover = in_rover @ head.rotation.T
            turned = self.joint_rad > 0 or len(self.joint_errors) > 0
            wanted = np.array([*self.mast_free, *((8, 9) if turned else ())], dtype=int)
            rates = -gimbal_rates(in_rover, points, head, wanted)
            parts.append(rates[..., : len(self.mast_free)])
            columns.append(self.at(MAST))
            both = list(zip(self._axes(state), self.reading(state, image), image.approach, strict=True))
            if len(self.joint_errors):
                per_number = np.stack([joint.rates(read, side) for joint, read, side in both])
                per_joint = rates[..., -2:, None] * per_number
                parts.append(per_joint.reshape(*rates.shape[:2], -1)[..., self.joint_errors])
                columns.append(self.at(JOINT_ERRORS))
            if self.joint_rad > 0:
                slopes = np.array([joint.slope(read, side) for joint, read, side in both])
                parts.append(rates[..., -2:] * slopes)
                columns.append(self.at(("attitude", image.attitude)))
        if image.board[0] in self.bowed:
            behind = (in_rover @ board.rotation[:, 2])[..., None]
            parts.append(behind * image.bend[keep][:, None, :])
            columns.append(self.at(("bow", image.board[0])))
        if image.board not in self.held:
            parts.append(rigid_rates(in_rover, points, board.translation_m))
            columns.append(self.at(("board", image.board)))
        sigma = image.sigma_px[keep]
        residual = (seen.pixels_px - image.pixels_px[keep]) / sigma[:, None]
        jacobian = np.concatenate(parts, axis=2) / sigma[:, None, None]
        return ResidualBlock(
            residual.ravel(), jacobian.reshape(residual.size, -1), np.concatenate(columns), width=2
        )

    def station_residual(self, state: Estimate, point: StationTerm) -> FloatArray:
        """Measured less expected place of a prism or tape, in the rover frame and in sigmas, (3,)."""
        measured = state.rover_from_station[point.setup].points(point.position_m)
        if point.board is None:
            expected = state.prisms_in_rover_m[point.point]
        else:
            expected = state.rover_from_board[point.board].points(point.in_board_m)
        return np.asarray((measured - expected) / point.sigma_m)

    def station_block(self, state: Estimate, point: StationTerm) -> ResidualBlock:
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
        return ResidualBlock(self.station_residual(state, point), jacobian, np.concatenate(columns), width=3)

    def known(self, state: Estimate) -> Iterator[tuple[str, ResidualBlock]]:
        """What is known beforehand: usual lenses, prisms from CAD, joint readings."""
        for name, model in state.cameras.items():
            if "O" in model.kind:
                residual, jacobian = lens_knowledge(model)
                yield (
                    f"{KNOWN_BEFOREHAND}lens {name}",
                    ResidualBlock(residual, jacobian, self.at(("camera", name)), width=1),
                )
        if len(self.joint_errors):
            size = len(self.joint_errors)
            usual = state.joint_errors[self.joint_errors] / USUAL_JOINT_RAD
            yield (
                f"{KNOWN_BEFOREHAND}joints",
                ResidualBlock(usual, np.eye(size) / USUAL_JOINT_RAD, self.at(JOINT_ERRORS), 1),
            )
        for board in self.bowed:
            bow = state.bows_m[board] / USUAL_BOW_M
            yield (
                f"{KNOWN_BEFOREHAND}board {board}",
                ResidualBlock(bow, np.eye(2) / USUAL_BOW_M, self.at(("bow", board)), width=1),
            )
        if self.prism_cad_m > 0:
            for name, place in self.prisms_cad_m.items():
                residual = (state.prisms_in_rover_m[name] - place) / self.prism_cad_m
                yield (
                    f"prism {name}",
                    ResidualBlock(residual, np.eye(3) / self.prism_cad_m, self.at(("prism", name)), width=1),
                )
        if self.joint_rad > 0:
            for index, joints in enumerate(state.joints_rad):
                at = self.at(("attitude", index))
                yield (
                    f"attitude {index}",
                    ResidualBlock(joints / self.joint_rad, np.eye(2) / self.joint_rad, at, width=1),
                )

    def at(self, key: Key) -> np.ndarray:
        """Return the indices of an unknown's numbers."""
        part = self.parts[key]
        return np.arange(part.start, part.stop)


def bounded_weights(residual: FloatArray, width: int, huber: float | None) -> FloatArray:
    """Return the weights (m,) of the squares of residuals (m,), ``width`` of them a measurement, whose pull
    no longer grows from a length of ``huber`` on."""
    if huber is None:
        return np.ones(len(residual))
    length = np.linalg.norm(residual.reshape(-1, width), axis=1)
    return np.repeat(np.minimum(1.0, huber / np.maximum(length, 1e-300)), width)


def bowed_points(state: Estimate, image: ImageTerm) -> FloatArray:
    """Return the points (n, 3) of an image's board, metres, bent as the state has it."""
    bow = state.bows_m.get(image.board[0])
    if bow is None or not bow.any():
        return image.in_board_m
    bent = image.in_board_m.copy()
    bent[:, 2] += image.bend @ bow
    return bent
