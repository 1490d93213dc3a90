"""Everything a survey measures as one least-squares problem: cameras, mast, boards, set-ups, prisms, joints.

Unknown are the cameras (``calib.geometry.parameters``; a head camera in the head frame), 4, 6 or 8 numbers of
the mast, rover_from_station of every set-up, rover_from_board of every placement, and where their sigmas say
so the prisms' places on the rover and the joint angles of every head attitude. Measured are dots (pixels),
prisms and tapes (station), prisms from CAD and joint angles; each residual is divided by its sigma. The
prisms' CAD positions define the rover frame.

A bench has no station: its boards' poses are unknown, the mast is fixed, and the joints' errors
(``calib.geometry.rig``) and the boards' bows may be unknowns too. A prior of usual joints and boards holds
such an unknown where pictures hardly show it.

A residual of the station is taken in the rover frame: turning it does not change its size, since the
station's sigma is the same for each axis. Rigid unknowns move by a turn (3, a rotation vector
about the moved frame's own origin, applied from the left) and a shift (3, metres).

Structure: an image touches one camera, one board, the mast and one attitude, so its Jacobian is a small
dense block that is summed into the normal equations at once; these (some 300 unknowns) are solved densely.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from calib.adjust.gross import bounded
from calib.adjust.solver import Normal
from calib.adjust.terms import DRAWING, JOINTS, ImageTerm, StationTerm, lens_knowledge, scaled_images
from calib.adjust.unknowns import JOINT_ERRORS, MAST, Estimate, Key, ResidualBlock, Unknown
from calib.geometry.covariance import camera_rates
from calib.geometry.parameters import (
    camera_numbers,
    focus_and_turn_rates,
    parameter_names,
    parameter_part,
    stepped,
    twist_rates,
)
from calib.geometry.rig import JOINTS_NAMES, MAST_FREE, MAST_NAMES, Gimbal, gimbal, joint_twists
from calib.geometry.rigid import FloatArray, moved_rigid, rigid_rates, rigid_twists

HUBER, SCAN_HUBER = 3.0, 100.0
"""Length of a residual, in sigmas, from which its pull no longer grows while blunders are looked for, and
while changes are, which are no blunders."""

USUAL_JOINT_RAD = 0.01
"""A joint's usual harmonics and backlash, one sigma, radians; hobby servos have 6 to 9 mrad."""

USUAL_BOW_M = 0.005
"""How far a board's edges are usually from flat, one sigma, metres."""

PAN_TILT = [len(MAST_NAMES) + len(JOINTS_NAMES), len(MAST_NAMES) + len(JOINTS_NAMES) + 1]
"""Places of the readings among the numbers that move the head."""


class Motions(NamedTuple):
    """An image's residuals as the fit weighs them, and how these (m,) follow small motions.

    ``head`` (m, 20) is by the mast's eight numbers, the joints' ten and the readings of pan and tilt, (m, 0)
    of a body camera; ``camera`` (m, 4) by a part of the focal length, and by a turn about C, radians.
    """

    block: ResidualBlock
    head: FloatArray
    camera: FloatArray


@dataclass(frozen=True, eq=False)
class _Stack:
    """Terms in a row, of n points in all, with unknowns of the same kinds: as many, in the same order.

    A fit spends its time on the Jacobians of some hundred images of some hundred dots. Numpy takes as long to
    begin an operation on a hundred numbers as to carry it out. So all images of a camera go through each
    operation together, and only their normal equations are summed one by one.

    By term are its unknowns' ``keys``, their indices ``columns`` (k,), and where its points are (``parts``);
    ``sizes`` says how many numbers each unknown has. ``sigma`` (n,) is in pixels or metres; points (n, 3),
    pixels (n, 2) and ``bend`` (n, 2) are of those dots that count.
    """

    terms: tuple[Any, ...]
    keys: tuple[tuple[Key, ...], ...]
    columns: tuple[np.ndarray, ...]
    sizes: tuple[int, ...]
    parts: tuple[slice, ...]
    sigma: FloatArray
    in_board_m: FloatArray
    pixels_px: FloatArray
    bend: FloatArray

    @property
    def images(self) -> bool:
        """Whether these are images, and no points of the station."""
        return isinstance(self.terms[0], ImageTerm)


class Adjustment:
    """The least-squares problem of a survey or bench; the start settles which unknowns there are.

    ``mast_parameters`` are 4, 6 or 8 (0 leaves the mast as it is), or the places of the mast's numbers that
    move, ``joint_errors`` those of ``calib.geometry.rig.JOINTS_NAMES``. ``prism_cad_m`` is the sigma of the
    prisms from CAD (metres in the rover frame; 0: exact): with one, a prism that the start has and CAD has
    not is known by the station alone. ``joint_rad`` is the sigma of a joint reading (0: exact). ``bowed`` are
    boards, the first part of their images' ``board``, whose bow is unknown, ``fixed`` those that stay. From a
    length of ``huber`` sigmas on pulls are bounded; None is plain least squares.
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
        fixed: Sequence[tuple[str, str]] = (),
        huber: float | None = None,
    ) -> None:
        self.images, self.station = tuple(images), tuple(station)
        self.prisms_cad_m, self.prism_cad_m = prisms_cad_m or {}, prism_cad_m
        self.joint_rad, self.huber = joint_rad, huber
        if isinstance(mast_parameters, int):
            mast_parameters = MAST_FREE.get(mast_parameters, ())
        self.mast_free = np.array(mast_parameters, dtype=int)
        self.joint_errors = np.array(joint_errors, dtype=int)
        self.bowed, self.fixed = tuple(bowed), frozenset(fixed)
        declared = list(self._declared(start))
        self.names = tuple(name for one in declared for name in one.names)
        self.weak: FloatArray = np.concatenate([np.zeros(0), *(one.step for one in declared)]) ** -2.0
        self._unknowns = {one.key: one for one in declared}
        parts = _slices([len(one.names) for one in declared])
        self._places = {
            one.key: np.arange(part.start, part.stop) for one, part in zip(declared, parts, strict=True)
        }

    def _declared(self, start: Estimate) -> Iterator[Unknown]:
        """Every unknown, once."""
        for name, model in start.cameras.items():
            names = tuple(f"cameras.{name}.{p}" for p in parameter_names(model.kind))
            step = np.ones(len(names))
            for letter in "HV":
                step[parameter_part(model.kind, letter)] = float(np.linalg.norm(model.H))
            yield Unknown(("camera", name), names, step)
        names = tuple(f"mast.{MAST_NAMES[i]}" for i in self.mast_free)
        yield Unknown(MAST, names, np.ones(len(names)))
        errors = tuple(JOINTS_NAMES[i] for i in self.joint_errors)
        yield _usual(JOINT_ERRORS, errors, USUAL_JOINT_RAD)
        for board in self.bowed:
            yield _usual(("bow", board), tuple(f"board {board}.bow_m.{a}" for a in "xy"), USUAL_BOW_M)
        for setup in start.rover_from_station:
            yield _pose(("setup", setup), f"set-up {setup}")
        for placement in start.rover_from_board:
            if placement not in self.fixed:
                yield _pose(("board", placement), f"placement {placement[0]}/{placement[1]}")
        if self.prism_cad_m > 0:
            for prism in start.prisms_in_rover_m:
                names, drawn = tuple(f"prism {prism}.{a}" for a in "xyz"), self.prisms_cad_m.get(prism)
                yield Unknown(("prism", prism), names, np.ones(3), drawn, kind=DRAWING)
        if self.joint_rad > 0:
            for index in range(len(start.joints_rad)):
                names = tuple(f"attitude {index}.{joint}" for joint in ("pan_rad", "tilt_rad"))
                yield Unknown(("attitude", index), names, np.ones(2), np.zeros(2), kind=JOINTS)

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
        """Return the same problem with sigmas times ``factors``, by kind (``calib.adjust.noise``)."""
        return self._copy(
            images=scaled_images(self.images, factors),
            station=tuple(replace(p, sigma_m=p.sigma_m * factors.get(p.kind, 1.0)) for p in self.station),
            joint_rad=self.joint_rad * factors.get(JOINTS, 1.0),
            prism_cad_m=self.prism_cad_m * factors.get(DRAWING, 1.0),
        )

    def exact(self) -> Adjustment:
        """Return the same problem for images that are not fitted: no unknowns of single attitudes, no bound
        on pulls."""
        return self._copy(joint_rad=0.0, huber=None)

    def _copy(self, **changed: object) -> Adjustment:
        other = object.__new__(type(self))
        other.__dict__.update(self.__dict__, **changed)
        other.__dict__.pop("_stacks", None)
        return other

    def stepped(self, state: Estimate, step: FloatArray) -> Estimate:
        """Return the state moved by a step; ValueError if a camera is none any more."""
        if not np.isfinite(step).all():
            raise ValueError("the step is not finite")

        def of(key: Key) -> FloatArray:
            return step[self._places[key]]

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
                n: p if n in self.fixed else moved_rigid(p, of(("board", n)))
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
        """Return the weighted sum of squares, pulls bounded; infinite where a dot has no pixel."""
        total = sum(self._loss(self._off(state, stack)) for stack in self._stacks)
        total += sum(float(block.residual @ block.residual) for _, block in self.known(state))
        return total if np.isfinite(total) else float("inf")

    def _loss(self, off: FloatArray) -> float:
        """What the measurements (n, width) of a stack cost."""
        if self.huber is None:
            return float(np.sum(off * off))
        length = np.linalg.norm(off, axis=1)
        bounded = np.where(length <= self.huber, length**2, self.huber * (2 * length - self.huber))
        return float(bounded.sum())

    def normal(self, state: Estimate) -> Normal:
        """Return cost and normal equations of everything that counts."""
        size = len(self.names)
        cost, matrix, gradient = 0.0, np.zeros((size, size)), np.zeros(size)
        for stack in self._stacks:
            rows = self._rows(state, stack)
            cost += self._loss(rows[:, -1].T)
            if not np.isfinite(cost):
                return Normal(float("inf"), matrix, gradient)
            if self.huber is not None:
                rows *= np.sqrt(bounded_weights(rows[:, -1].T.ravel(), len(rows), self.huber)[:: len(rows)])
            for part, columns in zip(stack.parts, stack.columns, strict=True):
                mine = rows[..., part]
                both = (mine @ mine.transpose(0, 2, 1)).sum(axis=0)
                matrix[columns[:, None], columns] += both[:-1, :-1]
                gradient[columns] += both[:-1, -1]
        for _, block in self.known(state):
            cost += float(block.residual @ block.residual)
            matrix[block.columns[:, None], block.columns] += block.jacobian.T @ block.jacobian
            gradient[block.columns] += block.jacobian.T @ block.residual
        return Normal(cost, matrix, gradient)

    def blocks(self, state: Estimate) -> Iterator[tuple[ImageTerm | StationTerm | Unknown, ResidualBlock]]:
        """Yield every group that counts, residuals and Jacobian."""
        for stack in self._stacks:
            yield from zip(stack.terms, self._blocks(state, stack), strict=True)
        yield from self.known(state)

    @cached_property
    def _stacks(self) -> list[_Stack]:
        """Everything that counts, but what is known beforehand."""
        return self._stacked(
            [*(t for t in self.images if t.keep.any()), *(p for p in self.station if p.keep)]
        )

    def _stacked(self, terms: Iterable[ImageTerm | StationTerm]) -> list[_Stack]:
        """Stacks of terms of one camera, or of the station, with unknowns of the same kinds."""
        groups: dict[tuple[object, ...], tuple[list[Any], list[tuple[Key, ...]]]] = {}
        for term in terms:
            image, keys = isinstance(term, ImageTerm), tuple(self._keys(term))
            kind = (image, keys[0] if image else (), *(key[0] for key in keys))
            mine = groups.setdefault(kind, ([], []))
            mine[0].append(term)
            mine[1].append(keys)
        found = []
        for mine_terms, keys_of in groups.values():
            columns = tuple(np.concatenate([self._places[key] for key in keys]) for keys in keys_of)
            sizes = tuple(len(self._places[key]) for key in keys_of[0])
            if isinstance(mine_terms[0], ImageTerm):
                parts = _slices([int(t.keep.sum()) for t in mine_terms])
                bends = [t.bend if len(t.bend) else np.zeros((len(t.keep), 2)) for t in mine_terms]
                every = [
                    (t.sigma_px[t.keep], t.in_board_m[t.keep], t.pixels_px[t.keep], bend[t.keep])
                    for t, bend in zip(mine_terms, bends, strict=True)
                ]
                arrays = [np.concatenate(one) for one in zip(*every, strict=True)]
            else:
                parts = _slices([1] * len(mine_terms))
                arrays = [np.array([p.sigma_m for p in mine_terms]), *[np.zeros((0, 2))] * 3]
            found.append(_Stack(tuple(mine_terms), tuple(keys_of), columns, sizes, parts, *arrays))
        return found

    def _keys(self, term: ImageTerm | StationTerm) -> Iterator[Key]:
        """The unknowns that a term depends on: of an image its camera first, a bow last, between them what
        moves the board before the camera."""
        if isinstance(term, StationTerm):
            yield "setup", term.setup
            if term.board is not None:
                yield "board", term.board
            elif self.prism_cad_m > 0:
                yield "prism", term.point
            return
        yield "camera", term.camera
        if term.attitude is not None:
            yield MAST
            yield JOINT_ERRORS
            if self._own_reading(term):
                yield "attitude", term.attitude
        if term.board not in self.fixed:
            yield "board", term.board
        if term.board[0] in self.bowed:
            yield "bow", term.board[0]

    def _own_reading(self, image: ImageTerm) -> bool:
        """Whether the readings of an image are unknowns: they are fitted, and not exact."""
        return self.joint_rad > 0 and image.attitude is not None and image.attitude >= 0

    def readings(self, state: Estimate, images: Sequence[ImageTerm]) -> tuple[FloatArray, FloatArray]:
        """What pan and tilt read (2, k) at head images, without noise, and from which side they came."""
        read = np.array([(t.pan_rad, t.tilt_rad) for t in images], dtype=np.float64)
        if len(state.joints_rad):
            attitude = np.array([-1 if t.attitude is None else t.attitude for t in images])
            read[attitude >= 0] += state.joints_rad[attitude[attitude >= 0]]
        return read.T, np.array([t.approach for t in images], dtype=np.float64).T

    def head(self, state: Estimate, images: Sequence[ImageTerm]) -> Gimbal:
        """Where the head was at some of its images (k,), as the state has it."""
        (pan, tilt), (from_pan, from_tilt) = self.readings(state, images)
        joints = state.as_joints
        return gimbal(state.mast, joints.pan.true_rad(pan, from_pan), joints.tilt.true_rad(tilt, from_tilt))

    def residuals(self, state: Estimate, terms: Sequence[ImageTerm | StationTerm]) -> list[FloatArray]:
        """Return of each term, in sigmas: predicted less measured pixels of the dots that count, (2n,), or
        the measured less the expected place in the rover frame, (3,)."""
        found: dict[int, FloatArray] = {}
        for stack in self._stacked(terms):
            off = self._off(state, stack)
            found |= {id(t): off[part].ravel() for t, part in zip(stack.terms, stack.parts, strict=True)}
        return [found[id(term)] for term in terms]

    def blocks_of(self, state: Estimate, terms: Sequence[ImageTerm | StationTerm]) -> list[ResidualBlock]:
        """Return the same with their Jacobians; all at once is far quicker than one by one."""
        found: dict[int, ResidualBlock] = {}
        for stack in self._stacked(terms):
            blocks = self._blocks(state, stack)
            found |= {id(t): block for t, block in zip(stack.terms, blocks, strict=True)}
        return [found[id(term)] for term in terms]

    def without_unseen(self, state: Estimate) -> Adjustment:
        """Return the same problem without images in which a dot that counts has no pixel."""
        residuals = self.residuals(state, self.images)
        kept = [
            t if np.isfinite(off).all() else replace(t, keep=np.zeros_like(t.keep))
            for t, off in zip(self.images, residuals, strict=True)
        ]
        return self.with_terms(kept, self.station)

    def _blocks(self, state: Estimate, stack: _Stack) -> Iterator[ResidualBlock]:
        """The terms of a stack, each by itself."""
        rows, places = self._rows(state, stack), _slices(stack.sizes)
        for part, columns, keys in zip(stack.parts, stack.columns, stack.keys, strict=True):
            mine = rows[..., part].transpose(2, 0, 1).reshape(-1, rows.shape[1])
            yield ResidualBlock(mine[:, -1], mine[:, :-1], columns, dict(zip(keys, places, strict=True)))

    def _off(self, state: Estimate, stack: _Stack) -> FloatArray:
        """Predicted less measured pixels (n, 2), or measured less expected places (n, 3), in sigmas."""
        if not stack.images:
            measured, expected = self._station_m(state, stack)
            return np.asarray((measured - expected) / stack.sigma[:, None])
        model = state.cameras[stack.terms[0].camera]
        pixels, _ = model.project(self._in_camera(state, stack)[0])
        return np.asarray((pixels - stack.pixels_px) / stack.sigma[:, None])

    def _rows(self, state: Estimate, stack: _Stack) -> FloatArray:
        """The Jacobian of a stack's residuals and, last, these themselves, in sigmas, (width, k + 1, n)."""
        if not stack.images:
            return self._station_rows(state, stack)
        in_camera, head = self._in_camera(state, stack)
        pixels_px, by_step, by_motion = camera_rates(state.cameras[stack.terms[0].camera], in_camera)
        rows = np.empty((2, sum(stack.sizes) + 1, len(in_camera)))
        first, bow = by_step.shape[1], 2 if stack.terms[0].board[0] in self.bowed else 0
        rows[:, :first] = by_step
        for part, twists in zip(stack.parts, self._twists(state, stack, head), strict=True):
            moved = twists @ by_motion[..., part]
            last = first + len(twists) - (1 if bow else 0)
            rows[:, first:last, part] = moved[:, : last - first]
            if bow:
                rows[:, last:-1, part] = moved[:, -1:] * stack.bend[part].T
        rows[:, -1] = (pixels_px - stack.pixels_px).T
        rows /= stack.sigma
        return rows

    def _in_camera(self, state: Estimate, stack: _Stack) -> tuple[FloatArray, Gimbal | None]:
        """Points (n, 3) in the frame that the camera is in, head or rover, metres, and where the head was."""
        boards = [state.rover_from_board[t.board] for t in stack.terms]
        turns, shifts = np.array([b.rotation for b in boards]), np.array([b.translation_m for b in boards])
        head = None
        if stack.terms[0].attitude is not None:
            head = self.head(state, stack.terms)
            shifts = ((shifts - head.translation_m)[:, None] @ head.rotation)[:, 0]
            turns = head.rotation.transpose(0, 2, 1) @ turns
        points = stack.in_board_m
        bows = [state.bows_m.get(t.board[0], np.zeros(2)) for t in stack.terms]
        if np.any(bows):
            points = points.copy()
            for part, bow in zip(stack.parts, bows, strict=True):
                points[part, 2] += stack.bend[part] @ bow
        found = np.empty_like(points)
        for part, turn, shift in zip(stack.parts, turns, shifts, strict=True):
            found[part] = points[part] @ turn.T + shift
        return found, head

    def _twists(self, state: Estimate, stack: _Stack, head: Gimbal | None) -> FloatArray:
        """Twists (images, k, 6) by which unknowns move the points of each image in the frame that its camera
        is in: a turn, and the shift of what is carried through the origin; last, of a bow, the board's z."""
        boards = [state.rover_from_board[t.board] for t in stack.terms]
        parts = [np.zeros((len(boards), 0, 6))]
        if head is not None:
            own = PAN_TILT if self._own_reading(stack.terms[0]) else []
            free = np.array([*self.mast_free, *(len(MAST_NAMES) + self.joint_errors), *own], dtype=int)
            parts.append(-self._head_twists(state, stack.terms, head)[:, free])
        if stack.terms[0].board not in self.fixed:
            parts.append(rigid_twists(np.array([board.translation_m for board in boards])))
        if stack.terms[0].board[0] in self.bowed:
            parts.append(np.array([[[0.0, 0.0, 0.0, *board.rotation[:, 2]]] for board in boards]))
        twists = np.concatenate(parts, axis=1)
        return twists if head is None else head.in_head(twists)

    def _head_twists(self, state: Estimate, images: Sequence[ImageTerm], head: Gimbal) -> FloatArray:
        """Twists (images, 20, 6) by which the mast's eight numbers, the joints' ten and the readings of pan
        and tilt move the head."""
        joints = joint_twists(head, state.as_joints, *self.readings(state, images))
        return np.concatenate([head.twists[:, : len(MAST_NAMES)], joints], axis=1)

    def motions(self, state: Estimate, images: Sequence[ImageTerm]) -> list[Motions]:
        """Return how the residuals of images that count follow small motions of the head and the camera,
        whether these are unknowns or not."""
        found = []
        for image, block in zip(images, self.blocks_of(state, images), strict=True):
            model = state.cameras[image.camera]
            weight = np.sqrt(bounded_weights(block.residual, 2, self.huber))
            block = replace(
                block, residual=weight * block.residual, jacobian=weight[:, None] * block.jacobian
            )
            rates = block.rates(("camera", image.camera))
            by_head = np.zeros((len(rates), 0))
            if image.attitude is not None:
                head = self.head(state, [image])
                twists = head.in_head(self._head_twists(state, [image], head))[0]
                by_head = rates @ twist_rates(model) @ twists.T
            found.append(Motions(block, by_head, rates @ focus_and_turn_rates(model)))
        return found

    def _station_m(self, state: Estimate, stack: _Stack) -> tuple[FloatArray, FloatArray]:
        """Where points of the station were measured and are expected (n, 3), metres in the rover frame."""
        measured = [state.rover_from_station[p.setup].points(p.position_m) for p in stack.terms]
        expected = [
            state.prisms_in_rover_m[p.point]
            if p.board is None
            else state.rover_from_board[p.board].points(p.in_board_m)
            for p in stack.terms
        ]
        return np.array(measured), np.array(expected)

    def _station_rows(self, state: Estimate, stack: _Stack) -> FloatArray:
        """The same of points of the station."""
        measured, expected = self._station_m(state, stack)
        unit = np.eye(3)
        rows = np.empty((3, sum(stack.sizes) + 1, len(measured)))
        origins = np.array([state.rover_from_station[p.setup].translation_m for p in stack.terms])
        rows[:, :6] = rigid_rates(unit[None], measured, origins).transpose(1, 2, 0)
        boards = [state.rover_from_board[p.board] for p in stack.terms if p.board is not None]
        if boards:
            origins = np.array([board.translation_m for board in boards])
            rows[:, 6:-1] = -rigid_rates(unit[None], expected, origins).transpose(1, 2, 0)
        elif self.prism_cad_m > 0:
            rows[:, 6:-1] = -unit[..., None]
        rows[:, -1] = (measured - expected).T
        rows /= stack.sigma
        return rows

    def known(self, state: Estimate) -> Iterator[tuple[Unknown, ResidualBlock]]:
        """The priors: usual lenses, joints and boards, prisms from CAD, joint readings."""
        measured = {JOINTS: self.joint_rad, DRAWING: self.prism_cad_m}
        for key, unknown in self._unknowns.items():
            sigma = measured.get(unknown.kind or "", unknown.sigma)
            if key[0] == "camera" and state.cameras[str(key[1])].kind != "CAHV":
                residual, rates = lens_knowledge(state.cameras[str(key[1])])
            elif unknown.prior is not None and sigma > 0 and len(unknown.names):
                residual = (self.numbers(state, key) - unknown.prior) / sigma
                rates = np.eye(len(residual)) / sigma
            else:
                continue
            parts = {key: slice(0, rates.shape[1])}
            yield unknown, ResidualBlock(residual, rates, self.at(key), parts)

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
        """Return the numbers of all unknowns of some kinds by name, in the order of ``kinds``."""
        return {
            name: float(value)
            for kind in kinds
            for key, unknown in self._unknowns.items()
            if key[0] == kind
            for name, value in zip(unknown.names, self.numbers(state, key), strict=True)
        }

    def at(self, key: Key) -> np.ndarray:
        """Return the indices of an unknown's numbers."""
        return self._places[key]

    def of_kinds(self, *kinds: str) -> np.ndarray:
        """Return the indices of all unknowns of some kinds, the kinds in this order."""
        found = [at for kind in kinds for key, at in self._places.items() if key[0] == kind]
        return np.concatenate([np.zeros(0, dtype=int), *found])


def _usual(key: Key, names: tuple[str, ...], sigma: float) -> Unknown:
    """Numbers that are usually nothing, to so much; where the data leave them open, that alone decides."""
    return Unknown(key, names, np.full(len(names), 1e3), np.zeros(len(names)), sigma)


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
    return np.repeat(bounded(length, huber), width)


def _slices(sizes: Sequence[int]) -> tuple[slice, ...]:
    """Where parts of some sizes are, one after another."""
    ends = np.cumsum(sizes, dtype=int).tolist()
    return tuple(slice(end - size, end) for end, size in zip(ends, sizes, strict=True))
