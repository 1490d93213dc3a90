"""Simulate what a head on a bench sees of boards that stand anywhere, and what its joints read.

Pixels come from OpenCV's ``projectPoints``, poses from SciPy's rotations, and the joints' errors are written
out here: nothing of an estimator is used. Everything here knows the truth and hands it out apart
from the measurements.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Literal

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from calib.geometry.cahvor import CameraModel, Kind
from calib.geometry.rig import AxisJoint, JointErrors, Mast, Rig, RigCamera
from calib.geometry.rigid import FloatArray, Rigid
from calib.survey.records import Approach, Purpose, Sigma, Survey, SurveyCamera, SurveyImage
from calib.targets.boards import NO_BOARD, AnyBoard, Charuco, Corners

CAMERA_FROM_HEAD = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]])
"""Axes of a camera that looks straight ahead."""

A2_BOARD = Charuco(12, 9, 0.045, 0.034, "DICT_5X5_100")

Harmonics = Sequence[tuple[float, float]]

GROSS_PX = (3.0, 30.0)
"""How far a corner is off that was found wrongly."""


@dataclass(frozen=True)
class BenchCamera:
    """A true camera in OpenCV's terms, at ``place_m`` in the head (or rover), turned from straight ahead.

    ``lens`` are the first coefficients of OpenCV's model; ``turn_rad`` a rotation vector in the head's axes.
    """

    on: Literal["head", "rover"] = "head"
    size_px: tuple[int, int] = (1024, 768)
    focal_px: tuple[float, float] = (1226.0, 1224.0)
    centre_px: tuple[float, float] = (511.5, 383.5)
    lens: tuple[float, ...] = (-0.12, 0.05)
    place_m: tuple[float, float, float] = (0.06, 0.0, 0.03)
    turn_rad: tuple[float, float, float] = (0.0, 0.0, 0.0)

    @property
    def axes(self) -> FloatArray:
        """camera_from_head (3, 3)."""
        return np.asarray(CAMERA_FROM_HEAD @ Rotation.from_rotvec(self.turn_rad).as_matrix().T)

    def pixels(self, in_mount_m: FloatArray) -> FloatArray:
        """Return where OpenCV sees points (n, 3) of the mount; not-a-number behind the camera."""
        points = (in_mount_m - np.array(self.place_m)) @ self.axes.T
        (fx, fy), (cx, cy) = self.focal_px, self.centre_px
        matrix = np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
        seen, _ = cv2.projectPoints(
            points, np.zeros(3), np.zeros(3), matrix, np.array([*self.lens, *[0.0] * (8 - len(self.lens))])
        )
        seen = seen.reshape(-1, 2)
        # Beyond the picture a lens's polynomial folds back.
        ahead = (points[:, 2] > 0.05) & (np.abs(points[:, :2]).max(axis=1) < points[:, 2])
        return np.where(ahead[:, None], seen, np.nan)

    def model(self, kind: Kind = "CAHVOR") -> CameraModel:
        """Return the same camera as CAHVOR, whose lens bends as k1 and k2 do."""
        x, y, a = self.axes
        (fx, fy), (cx, cy) = self.focal_px, self.centre_px
        h, v = fx * x + cx * a, fy * y + cy * a
        bends = np.array([0.0, *self.lens[:2]]) if kind != "CAHV" else np.zeros(3)
        return CameraModel(kind, self.size_px, np.array(self.place_m), a, h, v, a, bends)


NAVCAMS = {
    "navcam_left": BenchCamera(place_m=(0.060, -0.1016, 0.029), turn_rad=(0.004, -0.006, 0.009)),
    "navcam_right": BenchCamera(
        focal_px=(1231.0, 1230.0), centre_px=(505.0, 389.0), lens=(-0.09, 0.03),
        place_m=(0.058, 0.0995, 0.031), turn_rad=(-0.006, 0.004, -0.011),
    ),
}  # fmt: skip


@dataclass(frozen=True)
class Placement:
    """Where a board stands: range and direction from the mast's origin, and how it is turned from facing
    it."""

    range_m: float = 1.5
    pan_rad: float = 0.0
    tilt_rad: float = -0.2
    lean_rad: tuple[float, float, float] = (0.0, 0.0, 0.0)

    @property
    def mast_from_board(self) -> Rigid:
        """The board's pose."""
        looks = Rotation.from_euler("ZY", [self.pan_rad, self.tilt_rad])
        facing = looks * Rotation.from_matrix(CAMERA_FROM_HEAD.T) * Rotation.from_rotvec(self.lean_rad)
        return Rigid(facing.as_matrix(), self.range_m * looks.apply([1.0, 0.0, 0.0]))


THREE_PLACEMENTS = (
    Placement(0.9, 0.1, -0.45, (0.5, 0.1, 0.1)),
    Placement(1.7, -0.9, -0.1, (-0.3, 0.5, 0.0)),
    Placement(2.8, 0.8, 0.05, (0.2, -0.4, 0.05)),
)


@dataclass(frozen=True)
class Mishap:
    """Something that happens before a look at a board, and stays so.

    Attributes
    ----------
    what
        ``board`` moved, ``pan`` or ``tilt`` slipped, ``focus`` or ``knock`` of a camera, or a ``twin`` with
        the same ids that the camera finds instead of the board in every other picture.
    look
        Before which look, counted from 0 over all placements; a moved board stands elsewhere until the next
        placement.
    size
        Metres along the board's x; radians; a part of the focal length.
    camera
        Whose focus, or which one is knocked.
    """

    what: Literal["board", "pan", "tilt", "focus", "knock", "twin"]
    look: int
    size: float
    camera: str = "navcam_left"


@dataclass(frozen=True)
class BenchPlan:
    """What is true, what is photographed, and how well.

    Attributes
    ----------
    cameras, mast
        The true ones; the mast stands where the rover frame is.
    pan_harmonics, tilt_harmonics, backlash_rad
        What the joints' encoders and gears are wrong by.
    count_rad
        One encoder count; readings are whole counts. 0: exact.
    board, placements, bow_m
        The board and where it stands in turn; its bow is not told to the fit.
    attitudes, checks
        Head positions per placement that are fitted, and that are not.
    reach_rad
        How far pan and tilt go to either side of the board, at most; less where it would not be seen.
    corner_px, noise
        What is stated, and what happens, times that.
    own_px
        Sigma that each corner comes with, and what it is off by then, times the noise; 0: corner_px.
    print_m
        How far each corner is printed beside its place, one sigma an axis, the same in all pictures.
    gross
        Part of the corners that are grossly off.
    mishaps
        What happens on the way.
    """

    cameras: Mapping[str, BenchCamera] = field(default_factory=lambda: dict(NAVCAMS))
    mast: Mast = field(default_factory=lambda: Mast(np.zeros(3), np.zeros(3)))
    pan_harmonics: Harmonics = ()
    tilt_harmonics: Harmonics = ()
    backlash_rad: float = 0.0
    count_rad: float = 0.0
    board: AnyBoard = A2_BOARD
    placements: tuple[Placement, ...] = THREE_PLACEMENTS
    bow_m: tuple[float, float] = (0.0, 0.0)
    attitudes: int = 20
    checks: int = 3
    reach_rad: tuple[float, float] = (0.32, 0.26)
    corner_px: float = 0.1
    noise: float = 1.0
    own_px: float = 0.0
    print_m: float = 0.0
    gross: float = 0.0
    mishaps: tuple[Mishap, ...] = ()

    @property
    def rig(self) -> Rig:
        """The truth as a rig."""
        cameras = {n: RigCamera(c.on, c.model()) for n, c in self.cameras.items()}
        joints = JointErrors(
            AxisJoint(tuple(self.pan_harmonics), self.backlash_rad),
            AxisJoint(tuple(self.tilt_harmonics), self.backlash_rad),
        )
        return Rig("true", self.mast, cameras, self.stereo, joints=joints)

    @property
    def stereo(self) -> dict[str, tuple[str, str]]:
        """Pairs by their names."""
        pairs = dict.fromkeys(n.rsplit("_", 1)[0] for n in self.cameras if n.endswith("_left"))
        return {p: (f"{p}_left", f"{p}_right") for p in pairs if f"{p}_right" in self.cameras}


def simulate_bench(seed: int, plan: BenchPlan | None = None) -> Survey:
    """Return what a bench's pictures show, their corners projected and not rendered.

    Same arguments, same survey.
    """
    return _Bench(seed, plan or BenchPlan()).survey()


def shaft_rad(read_rad: float, harmonics: Harmonics) -> float:
    """Return where a shaft truly is whose encoder reads an angle."""
    turns = np.arange(1, len(harmonics) + 1) * read_rad
    waves = np.array(harmonics).reshape(-1, 2) * np.stack([np.cos(turns), np.sin(turns)], axis=1)
    return float(read_rad + waves.sum())


class _Bench:
    """Turns the head, looks, and notes."""

    def __init__(self, seed: int, plan: BenchPlan) -> None:
        self.plan = plan
        self.places, self.errors = np.random.default_rng([seed, 0]), np.random.default_rng([seed, 1])
        self.seed = seed
        self.images: list[SurveyImage] = []
        self.corners: dict[str, Corners] = {}
        self.reading, self.looks, self.moved_m = np.zeros(2), 0, 0.0
        self.slipped, self.cameras = np.zeros(2), dict(plan.cameras)
        self.twin_m = 0.0
        ids = plan.board.ids
        self.points = plan.board.in_board_m(ids, plan.bow_m)
        printed = np.random.default_rng([seed, 2]).standard_normal((len(ids), 2))
        self.points[:, :2] += plan.print_m * printed
        self.own_px = plan.own_px or plan.corner_px

    def survey(self) -> Survey:
        plan = self.plan
        for number, placement in enumerate(plan.placements, 1):
            self.moved_m = self.twin_m = 0.0
            for index in range(plan.attitudes + plan.checks):
                purpose: Purpose = "mast" if index < plan.attitudes else "check"
                self.look(f"p{number}", placement, purpose)
        counts = plan.count_rad / np.sqrt(12.0)
        return Survey(
            folder=Path("bench"),
            board=NO_BOARD,
            prisms_in_rover_m={},
            sigma=Sigma(0.0, 0.0, joint_rad=counts, corner_px=plan.corner_px),
            cameras={name: self.known(name, camera) for name, camera in plan.cameras.items()},
            stereo=plan.stereo,
            station=(),
            images=tuple(self.images),
            dots={},
            boards={"b1": plan.board},
            corners=self.corners,
        )

    def known(self, name: str, camera: BenchCamera) -> SurveyCamera:
        """What is known beforehand: the focal length to 10 %."""
        rng = np.random.default_rng([self.seed, *name.encode()])
        focal_px = camera.focal_px[0] * (1 + rng.uniform(-0.1, 0.1))
        return SurveyCamera(name, camera.on, camera.size_px, "CAHVOR", focal_px)

    def look(self, placement: str, where: Placement, purpose: Purpose) -> None:
        """Turn to somewhere near the board, from either side, and photograph it with all cameras."""
        plan = self.plan
        for mishap in plan.mishaps:
            if mishap.look == self.looks:
                self.meet(mishap)
        self.looks += 1
        goal = np.array([where.pan_rad, where.tilt_rad]) + self.places.uniform(-1, 1, 2) * plan.reach_rad
        if plan.count_rad > 0:
            goal = np.round(goal / plan.count_rad) * plan.count_rad
        approach = [int(np.sign(step)) for step in goal - self.reading]
        self.reading = goal
        true = self.true_rad(goal, approach)
        aside_m = self.moved_m + self.twin_m * (self.looks % 2)
        in_rover = where.mast_from_board.points(self.points + np.array([aside_m, 0.0, 0.0]))
        panned = Rotation.from_rotvec([0, 0, true[0]])
        head = (
            panned
            * Rotation.from_rotvec([plan.mast.axis_twist_rad, 0, 0])
            * Rotation.from_rotvec([0, true[1], 0])
        )
        in_head = head.inv().apply(in_rover - panned.apply([plan.mast.axis_offset_m, 0.0, 0.0]))
        for name, camera in self.cameras.items():
            self.shoot(name, camera, in_head, in_rover, placement, purpose, goal, approach)

    def meet(self, mishap: Mishap) -> None:
        """Let it happen."""
        camera = self.cameras[mishap.camera] if mishap.what in ("focus", "knock") else None
        if mishap.what == "board":
            self.moved_m = mishap.size
        elif mishap.what == "twin":
            self.twin_m = mishap.size
        elif camera is None:
            self.slipped[("pan", "tilt").index(mishap.what)] = mishap.size
        elif mishap.what == "focus":
            fx, fy = camera.focal_px
            longer = (fx * (1 + mishap.size), fy * (1 + mishap.size))
            self.cameras[mishap.camera] = replace(camera, focal_px=longer)
        else:
            x, y, z = camera.turn_rad
            self.cameras[mishap.camera] = replace(camera, turn_rad=(x, y, z + mishap.size))

    def true_rad(self, reading: FloatArray, approach: list[int]) -> tuple[float, float]:
        """Where the load is: the count anywhere within itself, the gears' play, the encoder's error."""
        plan = self.plan
        within = plan.noise * plan.count_rad * self.errors.uniform(-0.5, 0.5, 2)
        pan, tilt = reading + self.slipped + within - 0.5 * plan.backlash_rad * np.array(approach)
        return shaft_rad(pan, plan.pan_harmonics), shaft_rad(tilt, plan.tilt_harmonics)

    def shoot(
        self,
        name: str,
        camera: BenchCamera,
        in_head: FloatArray,
        in_rover: FloatArray,
        placement: str,
        purpose: Purpose,
        reading: FloatArray,
        approach: list[int],
    ) -> None:
        """Note the corners that a camera sees."""
        plan = self.plan
        pixels = camera.pixels(in_head if camera.on == "head" else in_rover)
        noise = plan.noise * self.own_px * self.errors.standard_normal(pixels.shape)
        wrong = self.errors.random(len(pixels)) < plan.gross
        far = self.errors.uniform(*GROSS_PX, len(pixels)) * wrong
        angle = self.errors.uniform(-np.pi, np.pi, len(pixels))
        size = np.array(camera.size_px)
        inside = np.isfinite(pixels).all(axis=1) & ((pixels > 3) & (pixels < size - 4)).all(axis=1)
        if inside.sum() < 12:
            return
        found = pixels + noise + far[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)
        image = f"{name}-{len(self.images) + 1:03d}"
        sides: list[Approach] = [1 if side > 0 else -1 if side < 0 else 0 for side in approach]
        on_head = camera.on == "head"
        self.images.append(
            SurveyImage(
                image, name, "bench", placement, purpose,
                float(reading[0]) if on_head else None, float(reading[1]) if on_head else None,
                Path("images") / f"{image}.png", len(self.images) + 2, "b1",
                sides[0] if on_head else 0, sides[1] if on_head else 0,
            )
        )  # fmt: skip
        self.corners[image] = Corners(
            plan.board.ids[inside], found[inside], np.full(int(inside.sum()), self.own_px)
        )
