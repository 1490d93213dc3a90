"""Simulate the survey of a true rig as the paper made it (section III, Tables II and III, Figs. 2 and 4).

A board of 10x10 dots is put up at many places; a total station measures three tapes on it and four prisms on
the rover; the cameras see dots. Everything here knows the truth and hands it out apart from the measurements.
Poses come from SciPy's rotations, and pixels from the true cameras: nothing of an estimator is used.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from calib.geometry.cahvor import CameraModel
from calib.geometry.rig import Rig
from calib.geometry.rigid import FloatArray, Rigid
from calib.survey.records import Purpose, StationKind, StationPoint, Survey, SurveyCamera, SurveyImage
from calib.targets.boards import Dots
from hil_tests.support.sim_survey.plan import (
    BOARD,
    PRISMS_IN_ROVER_M,
    Ring,
    SurveyPlan,
    SurveyTruth,
    rover_from_head,
)

PLACES = ((-1, -1), (1, 1), (1, -1), (-1, 1), (0, 0), (0, 1), (1, 0), (0, -1), (-1, 0))
"""Where the boards of a ring stand in the picture, right and up; further ones stand anywhere."""

EDGE_PX = 6.0
"""A board counts as seen if every dot is so far inside the picture."""

PAPER_BEYOND_DOTS_M = 0.10
CLEARANCE_M = 0.05
"""Between the ground and the lowest corner of the paper."""

NEAREST_M, FURTHEST_M = 1.6, 10.0
"""How far boards for the mast stand from the head."""

REAR_WHEELS_M = np.array([-0.5, 0.0, 0.0])
"""Where the rover touches the ground while its nose is raised."""

LEAN_RAD = np.array([0.5, 0.5, 0.15])
"""How far a board may be turned about its own axes from facing the camera."""


def simulate_survey(true_rig: Rig, seed: int, plan: SurveyPlan | None = None) -> tuple[Survey, SurveyTruth]:
    """Return a survey of a rig, and the truth about it.

    Same arguments, same survey. Boards and joint angles depend on the seed alone and not on the noise. Dots
    are projected, not rendered; images whose board is not wholly in the picture are not taken.

    Parameters
    ----------
    true_rig
        The rig that is surveyed; pairs as in its ``stereo``.
    seed
        Of everything random.
    plan
        The paper's by default.
    """
    surveyor = _Surveyor(true_rig, seed, plan or SurveyPlan())
    surveyor.go_round()
    return surveyor.survey(), surveyor.truth()


class _Surveyor:
    """Goes round with board, station and cameras."""

    def __init__(self, rig: Rig, seed: int, plan: SurveyPlan) -> None:
        self.rig, self.seed, self.plan = rig, seed, plan
        self.places = np.random.default_rng([seed, 0])
        self.errors = np.random.default_rng([seed, 1])
        self.station: list[StationPoint] = []
        self.images: list[SurveyImage] = []
        self.dots: dict[str, Dots] = {}
        self.rover_from_station: dict[str, Rigid] = {}
        self.site_from_rover: dict[str, Rigid] = {}
        self.rover_from_board: dict[tuple[str, str], Rigid] = {}
        self.joints_rad: dict[str, tuple[float, float]] = {}
        self.drawing = {
            name: np.array(place) for name, place in list(PRISMS_IN_ROVER_M.items())[: plan.prisms]
        }
        self.prisms = {
            name: place + self.error(plan.sigma.prism_cad_m, 3) for name, place in self.drawing.items()
        }
        rows, columns = np.meshgrid(np.arange(BOARD.rows), np.arange(BOARD.columns), indexing="ij")
        self.rows, self.columns = rows.ravel(), columns.ravel()
        self.dots_in_board_m = BOARD.dots_in_board_m(self.rows, self.columns)

    def error(self, sigma: float, size: int | tuple[int, ...]) -> FloatArray:
        """Noise of the stated size, or as many times as much as the plan says."""
        return self.plan.noise * sigma * self.errors.standard_normal(size)

    def go_round(self) -> None:
        """Measure everything in the paper's order: head cameras, mast, then the rover tilted back."""
        plan = self.plan
        head = [name for name, camera in self.rig.cameras.items() if camera.on == "head"]
        rings = [ring for ring in plan.rings if ring.pair in self.rig.stereo]
        levels = ["level", *(f"level-{i}" for i in range(2, plan.level_setups + 1))]
        if head:
            for setup in levels:
                self.set_up(setup, 0.0)
        for ring in rings:
            if self.on(ring.pair) == "head":
                self.ring(ring, levels[0])
        if head:
            self.mast(head, levels)
        body = [ring for ring in rings if self.on(ring.pair) == "rover"]
        if body:
            self.set_up("tilted-back", plan.tilted_back_rad)
        for ring in body:
            self.ring(ring, "tilted-back")
        for pair in dict.fromkeys(ring.pair for ring in body):
            ranges = [ring.range_m for ring in body if ring.pair == pair]
            for number in range(plan.check_boards // 2):
                range_m = float(self.places.uniform(min(ranges), max(ranges)))
                where = self.places.uniform(-0.7, 0.7, 2)
                self.ring_board(Ring(pair, range_m), "tilted-back", f"check-{pair}-{number}", where, "check")

    def on(self, pair: str) -> str:
        """What a pair is mounted on."""
        return self.rig.cameras[self.rig.stereo[pair][0]].on

    def set_up(self, setup: str, nose_up_rad: float) -> None:
        """Put rover and station down, and measure the prisms. The station is levelled, its heading any."""
        nose_up = Rotation.from_rotvec([0, nose_up_rad, 0])
        self.site_from_rover[setup] = Rigid(nose_up.as_matrix(), REAR_WHEELS_M - nose_up.apply(REAR_WHEELS_M))
        heading = Rotation.from_rotvec([0, 0, self.places.uniform(-np.pi, np.pi)])
        level = Rotation.from_rotvec([*self.places.normal(0, 0.002, 2), 0.0])
        site_from_station = Rigid(
            (heading * level).as_matrix(), np.array([2.0, -6.0, -1.6]) + self.places.normal(0, 0.3, 3)
        )
        self.rover_from_station[setup] = self.site_from_rover[setup].inverse @ site_from_station
        for prism, place in self.prisms.items():
            self.measure(setup, "prism", "", prism, place)

    def measure(
        self, setup: str, kind: StationKind, placement: str, point: str, in_rover_m: FloatArray
    ) -> None:
        """Note a point as the station sees it."""
        position_m = self.rover_from_station[setup].inverse.points(in_rover_m)
        position_m = position_m + self.error(self.plan.sigma.station_m, 3)
        row = len(self.station) + 2
        self.station.append(StationPoint(setup, kind, placement, point, position_m, row))

    def put_up(self, setup: str, placement: str, rover_from_board: Rigid) -> None:
        """Leave a board where it stands, and measure its tapes."""
        self.rover_from_board[setup, placement] = rover_from_board
        for tape, place in BOARD.tapes_in_board_m.items():
            self.measure(setup, "tape", placement, tape, rover_from_board.points(place))

    def lean(self) -> Rotation:
        """How a board is turned from facing the camera."""
        return Rotation.from_rotvec(self.places.uniform(-1, 1, 3) * LEAN_RAD)

    def board(
        self, setup: str, view: Rigid, range_m: float, right_rad: float, up_rad: float, lean: Rotation
    ) -> Rigid:
        """rover_from_board at a range and angles aside of a view (x ahead, y right), above the ground."""
        looks = Rotation.from_matrix(view.rotation)
        ahead = looks * Rotation.from_rotvec([0, 0, right_rad]) * Rotation.from_rotvec([0, up_rad, 0])
        facing = ahead * Rotation.from_matrix([[0, 0, 1], [1, 0, 0], [0, 1, 0]]) * lean
        pose = Rigid(facing.as_matrix(), view.translation_m + range_m * ahead.apply([1.0, 0.0, 0.0]))
        half_m = BOARD.spacing_m * (BOARD.rows - 1) / 2 + PAPER_BEYOND_DOTS_M
        corners = [(x, y, 0.0) for x in (-half_m, half_m) for y in (-half_m, half_m)]
        site = self.site_from_rover[setup]
        below_m = float((site @ pose).points(corners)[:, 2].max()) + CLEARANCE_M
        up = site.inverse.vectors([0.0, 0.0, -max(below_m, 0.0)])
        return Rigid(pose.rotation, pose.translation_m + up)

    def ring(self, ring: Ring, setup: str) -> None:
        """Put boards at the corners of the pictures of a pair, and further ones in between."""
        for number in range(ring.boards):
            where = np.array(PLACES[number]) if number < len(PLACES) else self.places.uniform(-1, 1, 2)
            self.ring_board(ring, setup, f"{ring.pair}-{ring.range_m:g}m-{number + 1}", where, "camera")

    def ring_board(self, ring: Ring, setup: str, placement: str, where: FloatArray, purpose: Purpose) -> None:
        """Put up one board for a pair, moved in from the picture's edge until both cameras see it whole."""
        names = self.rig.stereo[ring.pair]
        on_head = self.on(ring.pair) == "head"
        mount = rover_from_head(self.rig.mast, 0.0, ring.head_tilt_rad) if on_head else Rigid.identity()
        models = [self.rig.cameras[name].model for name in names]
        ahead = mount.vectors(np.mean([model.A for model in models], axis=0))
        aside = np.cross([0.0, 0.0, 1.0], ahead)
        axes = np.column_stack([ahead, aside, np.cross(ahead, aside)])
        eye = mount.points(np.mean([model.C for model in models], axis=0))
        view = Rigid(axes / np.linalg.norm(axes, axis=0), eye)
        reach = np.array([_half_view_rad(models[0], axis) for axis in (0, 1)])
        lean, inwards = self.lean(), np.ones(2)
        joints = (0.0, ring.head_tilt_rad)
        while True:
            right_rad, up_rad = where * reach * inwards
            pose = self.board(setup, view, ring.range_m, right_rad, up_rad, lean)
            out = np.any([self.outside(name, joints, pose) for name in names], axis=0)
            if not out.any() or not inwards.any():
                break
            inwards = np.maximum(inwards - 0.05 * (out if out.any() else 1), 0.0)
            if (inwards[out] == 0).all():
                inwards = np.zeros(2)
        self.put_up(setup, placement, pose)
        self.shoot(names, setup, placement, purpose, joints)
        if ring.also:
            turned = self.rig.stereo[ring.also]
            self.shoot(turned, setup, placement, "mast", self.aim(turned, pose))

    def mast(self, head: Sequence[str], setups: Sequence[str]) -> None:
        """Put boards over the range of the mast, nearer the steeper; check boards in the same way."""
        plan = self.plan
        purposes: tuple[tuple[Purpose, int], ...] = (("mast", plan.mast_boards), ("check", plan.check_boards))
        for purpose, count in purposes:
            downs = np.concatenate([np.linspace(0, 0.2, count - count // 2), np.linspace(0.3, 1, count // 2)])
            pans = (np.arange(count) + self.places.uniform(0.3, 0.7, count)) / max(count, 1) * 2 - 1
            for number, (down, pan) in enumerate(zip(downs, self.places.permutation(pans), strict=True)):
                tilt = plan.tilt_rad[0] + (plan.tilt_rad[1] - plan.tilt_rad[0]) * down
                setup = setups[number % len(setups)]
                placement = f"{purpose}-{number + 1}"
                pose = self.mast_board(head, setup, pan * plan.pan_rad, tilt)
                self.put_up(setup, placement, pose)
                for _ in range(plan.attitudes):
                    self.shoot(head, setup, placement, purpose, self.aim(head, pose))

    def mast_board(self, head: Sequence[str], setup: str, pan_rad: float, tilt_rad: float) -> Rigid:
        """A board near the ground in a direction of the head, so far off that a pair sees it whole."""
        height_m = -self.rig.mast.translation_m[2] - 0.45
        nearest_m = float(np.clip(height_m / max(np.sin(-tilt_rad), 1e-3), NEAREST_M, FURTHEST_M))
        view = rover_from_head(self.rig.mast, pan_rad, tilt_rad)
        lean = self.lean()
        for range_m in nearest_m * np.linspace(1.0, 2.0, 21):
            pose = self.board(setup, view, range_m, 0.0, 0.0, lean)
            seeing = {name for name in head if not self.outside(name, self.middle(pose), pose).any()}
            if any(set(pair) <= seeing for pair in self.rig.stereo.values()):
                break
        return pose

    def middle(self, pose: Rigid) -> tuple[float, float]:
        """Joint angles at which the head faces a board."""
        x, y, z = rover_from_head(self.rig.mast, 0.0, 0.0).inverse.points(pose.translation_m)
        return float(np.arctan2(y, x)), float(np.arctan2(-z, np.hypot(x, y)))

    def aim(self, head: Sequence[str], pose: Rigid) -> tuple[float, float]:
        """Joint angles that bring a board into the pictures, off their middle as far as all still see it."""
        middle = self.middle(pose)
        seeing = [name for name in head if not self.outside(name, middle, pose).any()]
        offset = self.places.uniform(-1, 1, 2) * np.array([0.25, 0.18])
        for size in np.linspace(1.0, 0.0, 41):
            goal = _pair(np.round(np.array(middle) + size * offset, 3))
            if not any(self.outside(name, goal, pose).any() for name in seeing):
                return goal
        return middle

    def outside(self, name: str, joints_rad: tuple[float, float], pose: Rigid) -> np.ndarray:
        """(2,) whether dots lie beyond the picture's sides, and beyond its top or bottom."""
        model = self.rig.cameras[name].model
        half_x, half_y = (
            BOARD.spacing_m * (n - 1) / 2 + BOARD.dot_diameter_m / 2 for n in (BOARD.columns, BOARD.rows)
        )
        steps = np.linspace(-1, 1, 7)
        edge = np.array([(x * half_x, y * half_y, 0.0) for x in steps for y in steps])
        pixels, valid = self.seen(name, joints_rad, pose, edge)
        if not valid.all():
            return np.array([True, True])
        size = np.array(model.size_px)
        return np.asarray(((pixels < EDGE_PX) | (pixels > size - 1 - EDGE_PX)).any(axis=0))

    def seen(
        self, name: str, joints_rad: tuple[float, float], pose: Rigid, in_board_m: FloatArray
    ) -> tuple[FloatArray, np.ndarray]:
        """True pixels of board points, and which of them the camera can see."""
        camera = self.rig.cameras[name]
        points = pose.points(in_board_m)
        if camera.on == "head":
            points = rover_from_head(self.rig.mast, *joints_rad).inverse.points(points)
        return camera.model.project(points)

    def shoot(
        self,
        names: Sequence[str],
        setup: str,
        placement: str,
        purpose: Purpose,
        reading_rad: tuple[float, float],
    ) -> None:
        """Photograph a board with the cameras that see it whole, the head being off its reading."""
        true_rad = _pair(np.array(reading_rad) + self.error(self.plan.sigma.joint_rad, 2))
        pose = self.rover_from_board[setup, placement]
        for name in names:
            noise = self.error(self.plan.sigma.dot_px, (len(self.dots_in_board_m), 2))
            if self.outside(name, reading_rad, pose).any():
                continue
            on_head = self.rig.cameras[name].on == "head"
            joints = true_rad if on_head else (0.0, 0.0)
            pixels, _ = self.seen(name, joints, pose, self.dots_in_board_m)
            image = f"{name}-{len(self.images) + 1:03d}"
            pan_rad, tilt_rad = reading_rad if on_head else (None, None)
            file, row = Path("images") / f"{image}.png", len(self.images) + 2
            self.images.append(
                SurveyImage(image, name, setup, placement, purpose, pan_rad, tilt_rad, file, row)
            )
            self.dots[image] = Dots(self.rows, self.columns, pixels + noise)
            self.joints_rad[image] = joints

    def survey(self) -> Survey:
        """What was measured."""
        seen = {image.camera for image in self.images}
        return Survey(
            folder=Path(),
            board=BOARD,
            prisms_in_rover_m=self.drawing,
            sigma=self.plan.sigma,
            cameras={name: self.known(name) for name in self.rig.cameras if name in seen},
            stereo={pair: names for pair, names in self.rig.stereo.items() if set(names) <= seen},
            station=tuple(self.station),
            images=tuple(self.images),
            dots=self.dots,
        )

    def known(self, name: str) -> SurveyCamera:
        """What is known of a camera beforehand: focal length to 5 %, place to 10 cm, axis to 5 degrees."""
        camera = self.rig.cameras[name]
        model = camera.model
        rng = np.random.default_rng([self.seed, *name.encode()])
        focal_px = model.focal_px[0] * (1 + rng.uniform(-0.05, 0.05))
        rough: dict[str, FloatArray] = {}
        if self.plan.rough:
            first = next(image for image in self.images if image.camera == name)
            joints = self.joints_rad[first.name]
            mount = rover_from_head(self.rig.mast, *joints) if camera.on == "head" else Rigid.identity()
            turn = Rotation.from_rotvec(rng.uniform(-1, 1, 3) * np.radians(5))
            rough = {
                "rough_C_m": np.round(mount.points(model.C) + rng.uniform(-1, 1, 3) * 0.1, 3),
                "rough_A": turn.apply(mount.vectors(model.A)),
            }
        return SurveyCamera(name, camera.on, model.size_px, model.kind, round(focal_px), **rough)

    def truth(self) -> SurveyTruth:
        """What was."""
        return SurveyTruth(
            self.rig,
            self.rover_from_station,
            self.site_from_rover,
            self.rover_from_board,
            self.prisms,
            self.joints_rad,
        )


def _pair(values: FloatArray) -> tuple[float, float]:
    return float(values[0]), float(values[1])


def _half_view_rad(model: CameraModel, axis: int) -> float:
    """Half the angle that a camera sees across (0) or down (1), found from its own rays."""
    middle = np.array(model.image_center_px)
    side = middle.copy()
    side[axis] = 0.0
    rays = model.ray(np.array([middle, side])).directions
    return float(np.arccos(np.clip(rays[0] @ rays[1], -1, 1)))
