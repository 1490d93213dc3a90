"""Everything a survey measures as one least-squares problem: cameras, mast, boards, set-ups, prisms, joints.

Unknown are the cameras (``calib.geometry.parameters``; a head camera in the head frame), 4, 6 or 8 numbers of
the mast, rover_from_station of every set-up, rover_from_board of every placement, and where their sigmas say
so the prisms' places on the rover and the joint angles of every head attitude. Measured are dots (pixels),
prisms and tapes (station), prisms from CAD and joint angles; each residual is divided by its sigma. The
prisms' CAD positions define the rover frame.

A bench has no station: its boards' poses are unknown, or one of them is held; the rover frame is the mast's
own or hangs on what is held; and the joints' errors (``calib.geometry.rig``) and the boards' bows may be
unknowns too. A prior of usual joints and boards holds such an unknown where pictures hardly show it.

A residual of the station is taken in the rover frame: turning it does not change its size, since the
station's sigma is the same for each axis. Rigid unknowns move by a turn (3, a rotation vector
about the moved frame's own origin, applied from the left) and a shift (3, metres).

Structure: an image touches one camera, one board, the mast and one attitude, so its Jacobian is a small
dense block that is summed into the normal equations at once; these (some 300 unknowns) are solved densely.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace

import numpy as np

from calib.adjust.solver import Normal
from calib.adjust.terms import DRAWING, JOINTS, ImageTerm, StationTerm, lens_knowledge, widened_images
from calib.adjust.unknowns import (
    JOINT_ERRORS,
    MAST,
    Estimate,
    Key,
    Known,
    ResidualBlock,
    Unknown,
    Unknowns,
)
from calib.geometry.parameters import (
    Prediction,
    camera_numbers,
    parameter_names,
    parameter_part,
    predict,
    stepped,
)
from calib.geometry.rig import (
    JOINTS_NAMES,
    MAST_FREE,
    MAST_NAMES,
    AxisJoint,
    Gimbal,
    gimbal,
    gimbal_rates,
)
from calib.geometry.rigid import FloatArray, moved_rigid, rigid_rates

HUBER = 3.0
"""Length of a residual, in sigmas, from which its pull no longer grows while blunders are looked for."""

USUAL_JOINT_RAD = 0.01
"""A joint's usual harmonics and backlash, one sigma, radians; hobby servos have 6 to 9 mrad."""

USUAL_BOW_M = 0.005
"""How far a board's edges are usually from flat, one sigma, metres."""


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
        self.unknowns = Unknowns(self._declared(start))

    def _declared(self, start: Estimate) -> Iterator[Unknown]:
        """Every unknown, once."""
        for name, model in start.cameras.items():
            names = tuple(f"cameras.{name}.{p}" for p in parameter_names(model.kind))
            step, usual = np.ones(len(names)), np.zeros(len(names), dtype=bool)
            for letter in dict.fromkeys(model.letters):
                part = parameter_part(model.kind, letter)
                step[part] = float(np.linalg.norm(model.H)) if letter in "HV" else 1.0
                usual[part] = letter in "ORED"
            yield Unknown(("camera", name), names, step, usual=usual)
        yield Unknown(
            MAST, tuple(f"mast.{MAST_NAMES[i]}" for i in self.mast_free), np.ones(len(self.mast_free))
        )
        errors = tuple(JOINTS_NAMES[i] for i in self.joint_errors)
        yield _usual(JOINT_ERRORS, errors, USUAL_JOINT_RAD)
        for board in self.bowed:
            yield _usual(("bow", board), tuple(f"board {board}.bow_m.{a}" for a in "xy"), USUAL_BOW_M)
        for setup in start.rover_from_station:
            yield _pose(("setup", setup), f"set-up {setup}")
        for placement in start.rover_from_board:
            if placement not in self.held:
                yield _pose(("board", placement), f"placement {placement[0]}/{placement[1]}")
        if self.prism_cad_m > 0:
            for prism in start.prisms_in_rover_m:
                names, drawn = tuple(f"prism {prism}.{a}" for a in "xyz"), self.prisms_cad_m.get(prism)
                sigma = None if drawn is None else np.full(3, self.prism_cad_m)
                yield Unknown(("prism", prism), names, np.ones(3), drawn, sigma, DRAWING)
        if self.joint_rad > 0:
            for index in range(len(start.joints_rad)):
                names = tuple(f"attitude {index}.{joint}" for joint in ("pan_rad", "tilt_rad"))
                key, sigma = ("attitude", index), np.full(2, self.joint_rad)
                yield Unknown(key, names, np.ones(2), np.zeros(2), sigma, JOINTS)

    @property
    def names(self) -> tuple[str, ...]:
        """(p,) the names of all numbers."""
        return self.unknowns.names

    @property
    def weak(self) -> FloatArray:
        """(p,) how firmly a number stays where it is if the data leave it open."""
        return self.unknowns.weak

    @property
    def upright(self) -> bool:
        """Whether the mast is taken as upright: it turns and shifts, but does not lean."""
        return set(self.mast_free.tolist()) == set(MAST_FREE[4])

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
            unknowns=self.unknowns.with_sigmas(factors),
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

    def stepped(self, state: Estimate, step: FloatArray) -> Estimate:
        """Return the state moved by a step; ValueError if a camera is none any more."""
        if not np.isfinite(step).all():
            raise ValueError("the step is not finite")

        def of(key: Key) -> FloatArray:
            return step[self.unknowns.part(key)]

        mast = state.mast.copy()
        mast[self.mast_free] += of(MAST)
        errors = state.joint_errors.copy()
        errors[self.joint_errors] += of(JOINT_ERRORS)
        prisms, joints = state.prisms_in_rover_m, state.joints_rad
        if self.prism_cad_m > 0:
            prisms = {name: p + of(("prism", name)) for name, p in prisms.items()}
        if self.joint_rad > 0 and len(joints):
            joints = joints + np.array([of(("attitude", i)) for i in range(len(joints))])
        moved = replace(
            state,
            cameras={n: stepped(m, of(("camera", n))) for n, m in state.cameras.items()},
            mast=mast,
            rover_from_station={
                n: moved_rigid(p, of(("setup", n))) for n, p in state.rover_from_station.items()
            },
            rover_from_board={
                n: p if n in self.held else moved_rigid(p, of(("board", n)))
                for n, p in state.rover_from_board.items()
            },
            prisms_in_rover_m=prisms,
            joints_rad=joints,
            joint_errors=errors,
            bows_m={n: b + of(("bow", n)) if n in self.bowed else b for n, b in state.bows_m.items()},
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

    def blocks(self, state: Estimate) -> Iterator[tuple[ImageTerm | StationTerm | Known, ResidualBlock]]:
        """Yield every group that counts, residuals and Jacobian."""
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
        """The joints' readings of an image without noise, by the state."""
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
        rates: dict[Key, FloatArray] = {("camera", image.camera): seen.d_step}
        in_rover = seen.d_points
        if head is not None:
            in_rover = in_rover @ head.rotation.T
            turned = self.joint_rad > 0 or len(self.joint_errors) > 0
            wanted = np.array([*self.mast_free, *((8, 9) if turned else ())], dtype=int)
            by_head = -gimbal_rates(in_rover, points, head, wanted)
            rates[MAST], by_angles = np.split(by_head, [len(self.mast_free)], axis=2)
            both = list(zip(self._axes(state), self.reading(state, image), image.approach, strict=True))
            if len(self.joint_errors):
                per_number = np.stack([joint.rates(read, side) for joint, read, side in both])
                per_joint = by_angles[..., None] * per_number
                rates[JOINT_ERRORS] = per_joint.reshape(*by_head.shape[:2], -1)[..., self.joint_errors]
            if self.joint_rad > 0:
                slopes = np.array([joint.slope(read, side) for joint, read, side in both])
                rates["attitude", image.attitude] = by_angles * slopes
        if image.board[0] in self.bowed:
            behind = (in_rover @ board.rotation[:, 2])[..., None]
            rates["bow", image.board[0]] = behind * image.bend[keep][:, None, :]
        if image.board not in self.held:
            rates["board", image.board] = rigid_rates(in_rover, points, board.translation_m)
        sigma = image.sigma_px[keep]
        residual = (seen.pixels_px - image.pixels_px[keep]) / sigma[:, None]
        return ResidualBlock.of(self.unknowns, residual.ravel(), rates, 2, sigma[:, None, None])

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
        eye = np.eye(3)
        measured = rigid_rates(eye[None], setup.points(point.position_m)[None], setup.translation_m)[0]
        rates: dict[Key, FloatArray] = {("setup", point.setup): measured}
        if point.board is not None:
            board = state.rover_from_board[point.board]
            expected = rigid_rates(eye[None], board.points(point.in_board_m)[None], board.translation_m)[0]
            rates["board", point.board] = -expected
        elif self.prism_cad_m > 0:
            rates["prism", point.point] = -eye
        return ResidualBlock.of(self.unknowns, self.station_residual(state, point), rates, 3, point.sigma_m)

    def known(self, state: Estimate) -> Iterator[tuple[Known, ResidualBlock]]:
        """The priors: usual lenses, joints and boards, prisms from CAD, joint readings."""
        for key, unknown in self.unknowns.items():
            kind, *which = key
            if kind == "camera":
                model = state.cameras[str(which[0])]
                if model.kind != "CAHV":
                    residual, rates = lens_knowledge(model)
                    yield Known(key, None), ResidualBlock.of(self.unknowns, residual, {key: rates}, width=1)
            elif unknown.prior is not None and unknown.sigma is not None and len(unknown.names):
                if kind == "attitude" and not self.joint_rad:
                    continue
                residual = (self.numbers(state, key) - unknown.prior) / unknown.sigma
                block = ResidualBlock(
                    residual, unknown.rates, self.at(key), 1, {key: slice(0, len(residual))}
                )
                yield Known(key, unknown.kind), block

    def numbers(self, state: Estimate, key: Key) -> FloatArray:
        """Return an unknown's numbers in a state; 0 for a camera's A and O, which count from its own.

        A pose has none: it is turned and shifted.
        """
        kind, which = key[0], key[-1]
        if kind == "camera":
            return camera_numbers(state.cameras[str(which)])
        if key == MAST:
            return np.asarray(state.mast[self.mast_free])
        if key == JOINT_ERRORS:
            return np.asarray(state.joint_errors[self.joint_errors])
        if kind == "attitude":
            return np.asarray(state.joints_rad[which])  # type: ignore[call-overload]
        return (state.bows_m if kind == "bow" else state.prisms_in_rover_m)[str(which)]

    def values(self, state: Estimate, *kinds: str) -> dict[str, float]:
        """Return the numbers of all unknowns of some kinds by name, the kinds in the order asked for."""
        return {
            name: float(value)
            for kind in kinds
            for key, unknown in self.unknowns.items()
            if key[0] == kind
            for name, value in zip(unknown.names, self.numbers(state, key), strict=True)
        }

    def at(self, key: Key) -> np.ndarray:
        """Return the indices of an unknown's numbers."""
        return self.unknowns.at(key)


def _usual(key: Key, names: tuple[str, ...], sigma: float) -> Unknown:
    """Numbers that are usually nothing, to so much; where the data leave them open, that alone decides."""
    size = len(names)
    return Unknown(key, names, np.full(size, 1e3), np.zeros(size), np.full(size, sigma))


def _pose(key: Key, name: str) -> Unknown:
    """A rigid motion: a turn about its own origin, and a shift."""
    turn, shift = (tuple(f"{name}.{what}.{axis}" for axis in "xyz") for what in ("turn_rad", "shift_m"))
    return Unknown(key, (*turn, *shift), np.ones(6))


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
