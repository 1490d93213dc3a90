"""Everything a survey measures as one least-squares problem: cameras, mast, boards, set-ups, prisms, joints.

Unknown are the cameras (``calib.camera.parameters``; a head camera in the head frame), 4, 6 or 8 numbers of
the mast, rover_from_station of every set-up, rover_from_board of every placement, and where their sigmas say
so the prisms' places on the rover and the joint angles of every head attitude. Measured are dots (pixels),
prisms and tapes (station), prisms from CAD and joint angles; each residual is divided by its sigma. The
prisms' CAD positions define the rover frame.

A residual of the station is taken in the rover frame: turning it does not change its size, since the
station's sigma is the same for each axis. Rigid unknowns move by a turn (3, a rotation vector
about the moved frame's own origin, applied from the left) and a shift (3, metres).

Structure: an image touches one camera, one board, the mast and one attitude, so its Jacobian is a small
dense block that is summed into the normal equations at once; these (some 300 unknowns) are solved densely.
"""

from __future__ import annotations

from collections.abc import Hashable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from calib.camera.cahvor import CameraModel
from calib.camera.parameters import parameter_names, parameter_part, predict, stepped
from calib.fit.least_squares import Normal
from calib.fit.terms import DRAWING, JOINTS, ImageTerm, StationTerm, widened_images
from calib.fit.usual_lens import lens_knowledge
from calib.mast.gimbal import MAST_FREE, MAST_NAMES, gimbal, gimbal_rates, mast_of
from calib.mast.rig import Mast
from calib.rigid import FloatArray, Rigid, moved_rigid, rigid_rates

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
        """The mast of ``calib.mast.rig``."""
        return mast_of(self.mast)


@dataclass(frozen=True, eq=False)
class Block:
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
        rigid = [*(f"turn_rad.{a}" for a in "xyz"), *(f"shift_m.{a}" for a in "xyz")]
        for setup in start.rover_from_station:
            self._add(("setup", setup), [f"set-up {setup}.{p}" for p in rigid])
        for board in start.rover_from_board:
            self._add(("board", board), [f"placement {board[0]}/{board[1]}.{p}" for p in rigid])
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
        """Return the same problem with sigmas times ``factors``, by kind (``calib.fit.components``)."""
        return self._copy(
            images=widened_images(self.images, factors),
            station=tuple(replace(p, sigma_m=p.sigma_m * factors.get(p.kind, 1.0)) for p in self.station),
            joint_rad=self.joint_rad * factors.get(JOINTS, 1.0),
            prism_cad_m=self.prism_cad_m * factors.get(DRAWING, 1.0),
        )

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
            for name, place in self.prisms_cad_m.items():
                residual = (state.prisms_in_rover_m[name] - place) / self.prism_cad_m
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
