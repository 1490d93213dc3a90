"""A bench of corners alone: a true rig with faulty joints and a board, no pictures; quick, repeatable.

The joints' errors are the simulator's own (`drivers.sim`), the kinematics SciPy's rotations.
"""

from __future__ import annotations

import math
from collections.abc import Collection
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from calib.geometry.rig import Rig
from calib.geometry.rigid import FloatArray, Rigid
from calib.plan.placements import Placement
from calib.targets.boards import AnyBoard, Corners
from hil_tests.support.sim_survey.plan import rover_from_head
from mastctl.bench.mast import BenchHead, BenchLook, SeenBoard

EDGE_PX = 3.0
FLATTEST = math.cos(math.radians(72.0))


@dataclass
class TrueAxis:
    """A joint as it is: counts, harmonics of the encoder (c, s), play, and on which flank it rests."""

    count_rad: float = 0.0
    harmonics_rad: tuple[tuple[float, float], ...] = ()
    backlash_rad: float = 0.0
    one_sided: bool = False
    read_rad: float = 0.0
    side: int = 0

    def go(self, wanted_rad: float) -> float:
        """Turn to a reading, and return the true angle."""
        count = self.count_rad
        reached = round(wanted_rad / count) * count if count else wanted_rad
        if self.one_sided:
            self.side = 1
        elif abs(reached - self.read_rad) > 1e-12:
            self.side = 1 if reached > self.read_rad else -1
        self.read_rad = reached
        behind = reached - 0.5 * self.side * self.backlash_rad * (not self.one_sided)
        terms = (
            c * math.cos(i * behind) + s * math.sin(i * behind)
            for i, (c, s) in enumerate(self.harmonics_rad, 1)
        )
        return behind + sum(terms)


@dataclass
class CornerBench:
    """A mast whose pictures are corners: ``head`` is what is believed, ``true_rig`` what is so.

    ``noise_px`` is of a corner, each axis; ``rover_from_board`` where the board stands now, if anywhere.
    """

    head: BenchHead
    true_rig: Rig
    board: AnyBoard
    rng: np.random.Generator
    pan: TrueAxis = field(default_factory=TrueAxis)
    tilt: TrueAxis = field(default_factory=TrueAxis)
    noise_px: float = 0.05
    rover_from_board: Rigid | None = None
    seconds: float = 0.0
    looks: int = 0

    def stand(self, placement: Placement) -> None:
        """Place the board where it is requested, as exactly as a person does: the same each time."""
        rng = np.random.default_rng(abs(hash(placement)))
        pose = placement.rover_from_board(self.true_rig.mast.rover_from_head(0.0, 0.0))
        pose = pose @ Rigid(Rotation.from_rotvec(rng.normal(0.0, 0.08, 3)).as_matrix(), np.zeros(3))
        self.rover_from_board = Rigid(pose.rotation, pose.translation_m + rng.normal(0.0, 0.04, 3))

    def look(
        self,
        pan_rad: float,
        tilt_rad: float,
        approach: tuple[int, int] = (0, 0),
        cameras: Collection[str] | None = None,
    ) -> BenchLook:
        """See `mastctl.bench.mast.BenchMast`."""
        begun = self.pan.read_rad, self.tilt.read_rad
        for axis, wanted, side in ((self.pan, pan_rad, approach[0]), (self.tilt, tilt_rad, approach[1])):
            if side:
                axis.go(wanted - 0.05 * side)
        true_rad = self.pan.go(pan_rad), self.tilt.go(tilt_rad)
        way_rad = max(abs(self.pan.read_rad - begun[0]), abs(self.tilt.read_rad - begun[1]))
        seconds = way_rad / 1.0 + 1.2
        self.seconds += seconds
        self.looks += 1
        names = [name for name in self.head.rig.cameras if cameras is None or name in cameras]
        seen = [self._seen(name, true_rad) for name in names]
        read = self.pan.read_rad, self.tilt.read_rad
        return BenchLook(tuple(seen), *read, self._side(self.pan), self._side(self.tilt))

    def _side(self, axis: TrueAxis) -> int:
        return 0 if axis.one_sided else axis.side

    def _seen(self, camera: str, true_rad: tuple[float, float]) -> SeenBoard:
        mounted = self.true_rig.cameras[camera]
        if self.rover_from_board is None:
            return SeenBoard(camera, None, "no corners")
        pose = self.rover_from_board
        if mounted.on == "head":
            pose = rover_from_head(self.true_rig.mast, *true_rad).inverse @ pose
        points = pose.points(self.board.in_board_m(self.board.ids))
        sight = points - mounted.model.C
        facing = sight @ pose.rotation[:, 2] > FLATTEST * np.linalg.norm(sight, axis=1)
        pixels, valid = mounted.model.project(points)
        size = np.array(mounted.model.size_px)
        inside = valid & facing & ((pixels > EDGE_PX) & (pixels < size - 1 - EDGE_PX)).all(axis=1)
        if inside.sum() < 6:
            return SeenBoard(camera, None, "no corners")
        noisy: FloatArray = pixels[inside] + self.rng.normal(0.0, self.noise_px, (int(inside.sum()), 2))
        corners = Corners(self.board.ids[inside], noisy, np.full(int(inside.sum()), self.noise_px))
        return SeenBoard(camera, corners)


@dataclass
class SelfPlacing:
    """Places the board of a `CornerBench` where it is requested, and keeps what is reported."""

    bench: CornerBench
    sentences: list[str] = field(default_factory=list)
    shown: list[dict[str, Any]] = field(default_factory=list)

    def say(self, sentence: str) -> None:
        """Keep it."""
        self.sentences.append(sentence)

    def change(self, **changed: Any) -> None:
        """Keep how far it is."""
        if "placements" in changed:
            self.shown.append(changed)

    def place(self, name: str, placement: Placement) -> None:
        """Put the board there."""
        self.sentences.append(f"{name}: {placement}")
        self.bench.stand(placement)
