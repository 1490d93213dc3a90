"""Surveys made in memory from a true rig: station, boards and pixels by numpy and SciPy's rotations alone.

The plan is the paper's (section III, Table II, Fig. 4): both head pairs at one joint setting each, eight
boards for each pair; eight boards over the mast's range of pan and tilt; the Hazcams in a second set-up.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from calib.mast.rig import Mast, Rig
from calib.rigid import Rigid
from calib.survey import Board, Dots, Sigma, StationPoint, Survey, SurveyCamera, SurveyImage

PRISMS_M = {
    "p1": np.array([0.10, -0.25, -0.75]),
    "p2": np.array([0.10, 0.25, -0.80]),
    "p3": np.array([-0.30, -0.25, -0.90]),
    "p4": np.array([-0.30, 0.25, -0.70]),
}
TAPES_M = {
    "a": np.array([-0.44, -0.44, 0.0]),
    "b": np.array([0.44, -0.44, 0.0]),
    "c": np.array([-0.44, 0.44, 0.0]),
}
BOARD = Board(10, 10, 0.08, 0.04, TAPES_M)
ROWS, COLUMNS = (a.ravel() for a in np.meshgrid(np.arange(10), np.arange(10), indexing="ij"))
ROUGH_FOCAL_PX = {"pancam": 3300.0, "navcam": 1350.0, "hazcam": 320.0}
MARGIN_PX = 5.0


def rover_from_head(mast: Mast, pan_rad: float, tilt_rad: float) -> Rigid:
    """The contract's kinematics, written with SciPy."""
    base = Rotation.from_euler("XYZ", mast.rotation_rad)
    pan = base * Rotation.from_rotvec([0, 0, pan_rad])
    head = pan * Rotation.from_rotvec([mast.axis_twist_rad, 0, 0]) * Rotation.from_rotvec([0, tilt_rad, 0])
    return Rigid(head.as_matrix(), mast.translation_m + pan.apply([mast.axis_offset_m, 0, 0]))


@dataclass(frozen=True)
class Plan:
    """What to measure: boards of each ring and of the mast, and how the head moves.

    Every second camera image is taken with pan ``apart_rad`` beside the others.
    """

    ring: int = 4
    mast_boards: int = 8
    pan_rad: float = 1.0
    tilt_rad: tuple[float, float] = (-0.1, -0.8)
    checks: int = 3
    hazcam: bool = True
    one_tilt_rad: float | None = None
    setups: int = 1
    apart_rad: float = 0.0


@dataclass(frozen=True)
class Blunders:
    """What goes wrong: shifts of tapes and prisms (metres) and of images' dots (pixels), by name."""

    tapes: tuple[tuple[str, str, tuple[float, float, float]], ...] = ()
    prisms: tuple[tuple[str, str, tuple[float, float, float]], ...] = ()
    dots: tuple[tuple[str, int, tuple[float, float]], ...] = ()
    swapped: tuple[tuple[str, str], ...] = ()


def make_survey(
    rig: Rig,
    seed: int,
    sigma: Sigma | None = None,
    plan: Plan | None = None,
    noise: float = 1.0,
    blunders: Blunders | None = None,
) -> Survey:
    """Return a survey of ``rig`` with the noise that ``sigma`` states, times ``noise``."""
    made = _Making(rig, seed, sigma or Sigma(0.001, 0.1), plan or Plan(), noise)
    made.run()
    return made.survey(blunders or Blunders())


class _Making:
    def __init__(self, rig: Rig, seed: int, sigma: Sigma, plan: Plan, noise: float) -> None:
        self.rig, self.sigma, self.plan, self.noise = rig, sigma, plan, noise
        self.rng = np.random.default_rng(seed)
        self.rover_from_station: dict[str, Rigid] = {}
        self.station: list[StationPoint] = []
        self.images: list[SurveyImage] = []
        self.dots: dict[str, Dots] = {}
        self.prisms = {n: p + self._normal(sigma.prism_cad_m, 3) for n, p in PRISMS_M.items()}

    def _normal(self, sigma: float, size: int | tuple[int, ...]) -> np.ndarray:
        return self.noise * sigma * self.rng.standard_normal(size)

    def _set_up(self, name: str) -> None:
        turn = Rotation.from_rotvec([0, 0, self.rng.uniform(-3, 3)]) * Rotation.from_rotvec(
            self.rng.normal(0, 0.005, 3)
        )
        self.rover_from_station[name] = Rigid(turn.as_matrix(), np.array([5.0, -4.0, -1.5]))
        for prism, place in self.prisms.items():
            self._measure(name, "prism", "", prism, place)

    def _measure(self, setup: str, kind: str, placement: str, point: str, in_rover: np.ndarray) -> None:
        pose = self.rover_from_station[setup]
        place = (in_rover - pose.translation_m) @ pose.rotation + self._normal(self.sigma.station_m, 3)
        row = len(self.station) + 2
        self.station.append(StationPoint(setup, kind, placement, point, place, row))  # type: ignore[arg-type]

    def _place(
        self, setup: str, placement: str, view: Rigid, range_m: float, right: float, up: float
    ) -> Rigid:
        """A board seen from a head-like frame (x ahead) some radians aside, facing it within 30 degrees."""
        base = Rotation.from_matrix(view.rotation)
        ahead = base * Rotation.from_rotvec([0, 0, right]) * Rotation.from_rotvec([0, up, 0])
        facing = ahead * Rotation.from_matrix([[0, 0, 1], [1, 0, 0], [0, 1, 0]])
        leaning = facing * Rotation.from_rotvec(self.rng.uniform(-1, 1, 3) * [0.5, 0.5, 0.15])
        board = Rigid(leaning.as_matrix(), view.translation_m + range_m * ahead.apply([1.0, 0, 0]))
        for tape, place in TAPES_M.items():
            self._measure(setup, "tape", placement, tape, board.points(place))
        return board

    def _shoot(
        self,
        names: list[str],
        setup: str,
        placement: str,
        purpose: str,
        board: Rigid,
        pan: float,
        tilt: float,
    ) -> None:
        true = np.array([pan, tilt]) + self._normal(self.sigma.joint_rad, 2)
        for name in names:
            camera = self.rig.cameras[name]
            points = board.points(BOARD.dots_in_board_m(ROWS, COLUMNS))
            if camera.on == "head":
                head = rover_from_head(self.rig.mast, *true)
                points = (points - head.translation_m) @ head.rotation
            pixels, valid = camera.model.project(points)
            size = np.array(camera.model.size_px)
            if not (valid.all() and (pixels > MARGIN_PX).all() and (pixels < size - 1 - MARGIN_PX).all()):
                continue
            pixels = pixels + self._normal(self.sigma.dot_px, pixels.shape)
            image = f"{name}-{len(self.images):03d}"
            angles = (pan, tilt) if camera.on == "head" else (None, None)
            row = len(self.images) + 2
            self.images.append(
                SurveyImage(image, name, setup, placement, purpose, *angles, Path(f"{image}.png"), row)  # type: ignore[arg-type]
            )
            self.dots[image] = Dots(ROWS, COLUMNS, pixels)

    def run(self) -> None:
        """Go round with the board."""
        plan, rng = self.plan, self.rng
        head = [n for n, c in self.rig.cameras.items() if c.on == "head"]
        body = [n for n, c in self.rig.cameras.items() if c.on == "rover"]
        corners = [(-1, -1), (1, 1), (1, -1), (-1, 1), (0, 0), (0, 1), (1, 0), (0, -1)]
        rings = {
            "pancam": (np.radians(-5), ((5.0, 0.025, 0.022), (10.0, 0.085, 0.06))),
            "navcam": (np.radians(-10), ((3.0, 0.15, 0.08), (6.0, 0.25, 0.17))),
        }
        setups = [f"level{i}" for i in range(plan.setups)]
        for setup in setups:
            self._set_up(setup)
        for pair, (tilt, parts) in rings.items():
            cameras = [n for n in head if n.startswith(pair)]
            tilt = tilt if plan.one_tilt_rad is None else plan.one_tilt_rad
            view = rover_from_head(self.rig.mast, 0.0, tilt)
            for range_m, right, up in parts if cameras else ():
                for index, (x, y) in enumerate(corners[: plan.ring]):
                    placement = f"{pair}-{range_m:g}-{index}"
                    board = self._place(setups[0], placement, view, range_m, x * right, y * up)
                    pan = plan.apart_rad * (index % 2)
                    self._shoot(cameras, setups[0], placement, "camera", board, pan, tilt)
        count = plan.mast_boards + plan.checks if head else 0
        outer = -(-3 * count // 8)
        downs = np.concatenate([np.linspace(0, 0.2, outer), np.linspace(0.25, 1, count - outer)])
        downs = downs[np.argsort(np.arange(count) * 7 % max(count, 1), kind="stable")]
        for index, place in enumerate(rng.permutation(np.linspace(-1, 1, count))):
            tilt = plan.tilt_rad[0] + (plan.tilt_rad[1] - plan.tilt_rad[0]) * downs[index]
            tilt = tilt if plan.one_tilt_rad is None else plan.one_tilt_rad
            range_m = float(np.clip(1.2 / np.sin(max(-tilt, 0.1) + 0.02), 2.0, 10.0))
            purpose = "mast" if index < plan.mast_boards else "check"
            setup = setups[index % len(setups)]
            placement = f"{purpose}-{index}"
            pan = place * plan.pan_rad
            view = rover_from_head(self.rig.mast, pan, tilt)
            board = self._place(setup, placement, view, range_m, *rng.uniform(-0.015, 0.015, 2))
            self._shoot(head, setup, placement, purpose, board, pan, tilt)
        if plan.hazcam and body:
            self._set_up("back")
            eye = np.mean([self.rig.cameras[n].model.C for n in body], axis=0)
            view = Rigid(Rotation.from_rotvec([0, np.radians(-38), 0]).as_matrix(), eye)
            for range_m, right, up in ((1.5, 0.45, 0.27), (3.0, 0.70, 0.45)):
                for index, (x, y) in enumerate(corners[: plan.ring]):
                    placement = f"hazcam-{range_m:g}-{index}"
                    board = self._place("back", placement, view, range_m, x * right, y * up)
                    self._shoot(body, "back", placement, "camera", board, 0.0, 0.0)

    def survey(self, blunders: Blunders) -> Survey:
        """What was measured, blunders and all."""
        station = list(self.station)
        for kind, given in (("tape", blunders.tapes), ("prism", blunders.prisms)):
            for where, point, shift in given:
                index = next(
                    i
                    for i, p in enumerate(station)
                    if p.kind == kind and p.point == point and where == (p.placement or p.setup)
                )
                p = station[index]
                station[index] = StationPoint(
                    p.setup, p.kind, p.placement, p.point, p.position_m + np.array(shift), p.row
                )
        dots = dict(self.dots)
        for image, index, shift in blunders.dots:
            pixels = dots[image].pixels_px.copy()
            pixels[index if index >= 0 else slice(None)] += shift
            dots[image] = Dots(ROWS, COLUMNS, pixels)
        for one, other in blunders.swapped:
            dots[one], dots[other] = dots[other], dots[one]
        seen = {i.camera for i in self.images}
        cameras = {
            n: SurveyCamera(n, c.on, c.model.size_px, c.model.kind, ROUGH_FOCAL_PX[n.split("_")[0]])
            for n, c in self.rig.cameras.items()
            if n in seen
        }
        return Survey(
            Path("made"),
            BOARD,
            PRISMS_M,
            self.sigma,
            cameras,
            {p: s for p, s in self.rig.stereo.items() if set(s) <= seen},
            tuple(station),
            tuple(self.images),
            dots,
        )
