"""Measure a true rig as the paper's survey does (section III, Table II, Fig. 4), with its errors.

A board of 10x10 dots is put at several places; a total station measures three tapes on its corners and four
prisms on the rover; each head image is taken at angles that the simulated head reads, while the camera looks
from where the head truly is. Everything here knows the truth; what leaves in a ``Survey`` is measurements.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from calib.mast import Rig
from calib.rigid import Rigid, rot_x, rot_y, rot_z
from drivers.clock import ManualClock
from drivers.sim.pan_tilt import HeadSettings, SimulatedPanTilt

DOTS = 10
SPACING_M = 0.08
_steps = (np.arange(DOTS) - (DOTS - 1) / 2) * SPACING_M
DOTS_IN_BOARD_M = np.array([(x, y, 0.0) for y in _steps for x in _steps])
TAPES_IN_BOARD_M = np.array([(-0.44, -0.44, 0.0), (0.44, -0.44, 0.0), (-0.44, 0.44, 0.0)])
PRISMS_IN_ROVER_M = np.array(
    [(0.10, -0.25, -0.75), (0.10, 0.25, -0.80), (-0.30, -0.25, -0.90), (-0.30, 0.25, -0.70)]
)
"""Four prisms on poles, 40 to 60 cm apart, known from the drawing."""


@dataclass(frozen=True)
class Image:
    """The dots found in one picture, (100, 2); ``purpose`` says which step of the fit it is for."""

    purpose: Literal["camera", "mast"]
    camera: str
    setup: str
    placement: str
    pan_rad: float
    tilt_rad: float
    pixels_px: np.ndarray


@dataclass(frozen=True)
class Survey:
    """Measurements: prisms by set-up and tapes by placement (station frame of the set-up), and images."""

    prisms_m: dict[str, np.ndarray]
    tapes_m: dict[tuple[str, str], np.ndarray]
    images: list[Image]


@dataclass(frozen=True)
class Sigmas:
    """Noise of the instruments, one sigma per axis."""

    station_m: float = 0.001
    dot_px: float = 0.1


def board(
    eye_m: np.ndarray, range_m: float, azimuth_rad: float, elevation_rad: float, lean: np.ndarray
) -> Rigid:
    """rover_from_board of a board at a range from an eye, facing it but for small ``lean`` angles (3,)."""
    ahead = rot_z(azimuth_rad) @ rot_y(elevation_rad)
    facing = np.column_stack([ahead[:, 1], ahead[:, 2], ahead[:, 0]])
    rotation = facing @ rot_x(lean[0]) @ rot_y(lean[1]) @ rot_z(lean[2])
    return Rigid(rotation, eye_m + range_m * ahead[:, 0])


class _Surveyor:
    """Goes round with board, station and cameras."""

    def __init__(self, rig: Rig, head: HeadSettings, sigmas: Sigmas, rng: np.random.Generator) -> None:
        self.rig, self.sigmas, self.rng = rig, sigmas, rng
        self.clock = ManualClock()
        self.head = SimulatedPanTilt(head, self.clock)
        self.survey = Survey({}, {}, [])
        self.station_from_rover: dict[str, Rigid] = {}

    def set_up(self, setup: str) -> None:
        """Stand the station some metres off and measure the prisms."""
        turn = rot_z(self.rng.uniform(-np.pi, np.pi)) @ rot_x(self.rng.normal(0, 0.002))
        self.station_from_rover[setup] = Rigid(turn, np.array([6.0, -4.0, 1.5]) + self.rng.normal(0, 0.5, 3))
        self.survey.prisms_m[setup] = self._measured(setup, PRISMS_IN_ROVER_M)

    def place(self, setup: str, placement: str, rover_from_board: Rigid) -> None:
        """Put the board up and measure its tapes."""
        tapes = rover_from_board.points(TAPES_IN_BOARD_M)
        self.survey.tapes_m[setup, placement] = self._measured(setup, tapes)

    def calibrate(
        self,
        pair: str,
        setup: str,
        placement: str,
        place: tuple[np.ndarray, float, float, float, float],
        goal: tuple[float, float],
    ) -> None:
        """Put the board up for one pair of cameras, moved inwards until both see it whole, and take pictures.

        ``place`` is eye (3,), range, elevation of the middle, and angles across and up from there.
        """
        eye_m, range_m, elevation_rad, across_rad, up_rad = place
        lean = self.lean()
        true_joints, reading = self._turn(goal)
        for inwards in np.linspace(1.0, 0.0, 21):
            pose = board(eye_m, range_m, inwards * across_rad, elevation_rad + inwards * up_rad, lean)
            if all(self._whole(name, true_joints, pose) is not None for name in self.rig.stereo[pair]):
                break
        self.place(setup, placement, pose)
        self._picture("camera", self.rig.stereo[pair], setup, placement, pose, true_joints, reading)

    def shoot(
        self, cameras: Sequence[str], setup: str, placement: str, pose: Rigid, goal: tuple[float, float]
    ) -> None:
        """Turn the head; a picture for the mast's step with each camera that sees the whole board."""
        true_joints, reading = self._turn(goal)
        self._picture("mast", cameras, setup, placement, pose, true_joints, reading)

    def lean(self) -> np.ndarray:
        """How far a board is from facing the eye, radians about its axes."""
        return self.rng.uniform(-1, 1, 3) * np.array([0.5, 0.5, 0.15])

    def _turn(self, goal: tuple[float, float]) -> tuple[tuple[float, float], tuple[float, float]]:
        """Move the head; where it truly is, and what it reads."""
        self.head.move(*goal)
        while (reading := self.head.read()).moving:
            self.clock.sleep(0.05)
        return self.head.true_joints(reading.time_s), (reading.pan_rad, reading.tilt_rad)

    def _whole(self, name: str, true_joints: tuple[float, float], pose: Rigid) -> np.ndarray | None:
        """The true pixels of all dots if they are in the picture, else None."""
        model = self.rig.camera_in_rover(name, *true_joints)
        pixels, valid = model.project(pose.points(DOTS_IN_BOARD_M))
        inside = valid & (pixels > 5).all(-1) & (pixels < np.array(model.size_px) - 6).all(-1)
        return pixels if inside.all() else None

    def _picture(
        self,
        purpose: Literal["camera", "mast"],
        cameras: Sequence[str],
        setup: str,
        placement: str,
        pose: Rigid,
        true_joints: tuple[float, float],
        reading: tuple[float, float],
    ) -> None:
        """Note the dots that each camera finds, with their noise."""
        for name in cameras:
            pixels = self._whole(name, true_joints, pose)
            if pixels is not None:
                seen = pixels + self.rng.normal(0, self.sigmas.dot_px, pixels.shape)
                self.survey.images.append(Image(purpose, name, setup, placement, *reading, seen))

    def _measured(self, setup: str, points_in_rover_m: np.ndarray) -> np.ndarray:
        """What the station says about points."""
        points = self.station_from_rover[setup].points(points_in_rover_m)
        return points + self.rng.normal(0, self.sigmas.station_m, points.shape)


def measure(rig: Rig, head: HeadSettings, sigmas: Sigmas, rng: np.random.Generator) -> Survey:
    """Return the survey of a rig: both head pairs and the mast in one set-up, the Hazcams in another.

    Pancam: four boards each at 5 and 10 m, tilt -5°. Navcam: four each at 3 and 6 m, tilt -10°. Mast: three
    boards at 5 to 10 m, five at 2 to 5 m, pan within ±1 rad, tilt -0.1 to -0.8 rad, each from three head
    attitudes. Hazcam: four each at 1.5 and 3 m, the rover tilted back.
    """
    surveyor = _Surveyor(rig, head, sigmas, rng)
    eye = np.array(rig.mast.translation_m)
    head_cameras = [name for name, camera in rig.cameras.items() if camera.on == "head"]

    surveyor.set_up("level")
    corners = [(-1, -1), (1, -1), (1, 1), (-1, 1)]
    plan = (
        ("pancam", np.radians(-5), ((5.0, 0.055, 0.040), (10.0, 0.10, 0.065))),
        ("navcam", np.radians(-10), ((3.0, 0.22, 0.15), (6.0, 0.28, 0.21))),
    )
    for pair, tilt, rings in plan:
        for range_m, across, up in rings:
            for index, (right, top) in enumerate(corners):
                place = (eye, range_m, tilt, right * across, top * up)
                surveyor.calibrate(pair, "level", f"{pair}-{range_m:g}m-{index}", place, (0.0, tilt))
    far = [(10.0, -0.9, -0.10), (7.0, 0.1, -0.16), (5.0, 1.0, -0.25)]
    near = [(5.0, -1.0, -0.25), (4.0, -0.4, -0.32), (3.0, 0.5, -0.45), (2.2, 1.0, -0.62), (2.0, -0.2, -0.8)]
    for index, (range_m, pan, tilt) in enumerate(far + near):
        pose = board(eye, range_m, pan, tilt, surveyor.lean())
        placement = f"mast-{index}"
        surveyor.place("level", placement, pose)
        spread = 0.03 if index < len(far) else 0.12
        for right, up in ((0, 0), (-1, 0.6), (1, -0.6)):
            goal = (pan + right * spread, tilt + up * spread)
            surveyor.shoot(head_cameras, "level", placement, pose, goal)
    surveyor.set_up("tilted back")
    haz_eye = np.mean([rig.cameras[name].model.C for name in rig.stereo["hazcam"]], axis=0)
    for range_m, across, up in ((1.5, 0.45, 0.30), (3.0, 0.75, 0.48)):
        for index, (right, top) in enumerate(corners):
            place = (haz_eye, range_m, np.radians(-38), right * across, top * up)
            surveyor.calibrate("hazcam", "tilted back", f"hazcam-{range_m:g}m-{index}", place, (0.0, 0.0))
    return surveyor.survey
