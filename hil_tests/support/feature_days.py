"""Features of simulated days before a rover's reference pictures, for the drift sentinel to be tried on.

A day, at the level of features: six rests, two cameras; each rest of the head off by chance (0.2 mrad each
joint), a mast that bends with the day's temperature (0.1 mrad), dust and dusk that leave 20 to 100 % of the
features and make the rest up to twice as uncertain as stated; light that moves a rest's views together, turns
and stretches each, as measured in rendered pictures; shadows that drag up to a quarter of the features along
by some pixels; rocks that moved, up to 20 % of the features of a view, together, by up to 30 px; now and then
(1 % of the views) another scene altogether. Pixels come from this file's own formulas.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from calib.calibrate.drift import SceneDrift, ViewShift, find_drift
from calib.geometry.cahvor import CameraModel
from calib.geometry.rig import Mast, Rig, RigCamera
from calib.geometry.rigid import FloatArray

SIZE = (1024, 768)
FOCAL_PX = 1280.0
CAMERAS_M = {"navcam_left": np.array([0.06, -0.1, -0.08]), "navcam_right": np.array([0.06, 0.1, -0.08])}
MAST_M = np.array([0.2, 0.0, -1.1])
FEATURES = 60
JOINT_SIGMA_RAD, BEND_RAD = 2e-4, 1e-4
LIGHT_PX, CAMERA_PX, LIGHT_TURN, LIGHT_SCALE = np.array([0.16, 0.08]), 0.03, 1e-4, 1.4e-4
"""What light moves both views of a rest, and one of them, by, turns and stretches it by beside the features'
own noise; one sigma, of rendered days at any hour (at the same hour two thirds of it)."""

RESTS = tuple(
    (pan, tilt) for tilt, pans in ((-0.2, (-1.8, 0.0, 1.8)), (-0.5, (-0.9, 0.9, 2.7))) for pan in pans
)


@dataclass(frozen=True)
class ChangedRig:
    """What is changed: turns of cameras, part of the focal length, slips, a turn of the rover; radians."""

    turned: Mapping[str, FloatArray] = field(default_factory=dict)
    focal: Mapping[str, float] = field(default_factory=dict)
    slip: tuple[float, float] = (0.0, 0.0)
    rover: FloatArray = field(default_factory=lambda: np.zeros(3))
    name: str = ""


def about(axis: int, angle_rad: float) -> FloatArray:
    """A turn about x, y or z (3, 3), right-handed."""
    c, s = np.cos(angle_rad), np.sin(angle_rad)
    i, j = [(1, 2), (2, 0), (0, 1)][axis]
    matrix = np.eye(3)
    matrix[i, i] = matrix[j, j] = c
    matrix[i, j], matrix[j, i] = -s, s
    return matrix


def rig() -> Rig:
    """The rig that is believed: two ideal cameras on an upright mast."""
    cx, cy = (SIZE[0] - 1) / 2, (SIZE[1] - 1) / 2
    cameras = {
        name: RigCamera("head", CameraModel("CAHV", SIZE, C, [1, 0, 0], [cx, FOCAL_PX, 0], [cy, 0, FOCAL_PX]))
        for name, C in CAMERAS_M.items()
    }
    return Rig("campaign", Mast(MAST_M, np.zeros(3)), cameras)


def shown(points: FloatArray, camera: str, pan: float, tilt: float, truth: ChangedRig) -> FloatArray:
    """Pixels (n, 2) of points (n, 3) in the rover's first frame, by a pinhole and turns one after another."""
    r = truth.rover
    seen = points @ (about(2, r[2]) @ about(1, r[1]) @ about(0, r[0]))
    in_head = (seen - MAST_M) @ (about(2, pan + truth.slip[0]) @ about(1, tilt + truth.slip[1]))
    t = truth.turned.get(camera, np.zeros(3))
    x, y, z = ((in_head - CAMERAS_M[camera]) @ (about(2, t[2]) @ about(1, t[1]) @ about(0, t[0]))).T
    f = FOCAL_PX * (1.0 + truth.focal.get(camera, 0.0))
    return np.stack([f * y / x + (SIZE[0] - 1) / 2, f * z / x + (SIZE[1] - 1) / 2], axis=1)


class FeatureSite:
    """A rover's surroundings with its reference look."""

    def __init__(self, rng: np.random.Generator) -> None:
        self.rng = rng
        self.rig = rig()
        self.pixels: dict[tuple[int, str], FloatArray] = {}
        self.points: dict[tuple[int, str], FloatArray] = {}
        self.then: dict[tuple[int, str], FloatArray] = {}
        off = rng.normal(0.0, JOINT_SIGMA_RAD, (len(RESTS), 2))
        for pose, (pan, tilt) in enumerate(RESTS):
            for camera, place in CAMERAS_M.items():
                pixels = rng.uniform([30, 30], np.array(SIZE) - 30, (FEATURES, 2))
                y = (pixels[:, 0] - (SIZE[0] - 1) / 2) / FOCAL_PX
                z = (pixels[:, 1] - (SIZE[1] - 1) / 2) / FOCAL_PX
                ahead = np.stack([np.ones(FEATURES), y, z], axis=1)
                far = rng.uniform(2.0, 25.0, FEATURES)[:, None]
                points = MAST_M + (place + ahead * far) @ (about(2, pan) @ about(1, tilt)).T
                self.points[pose, camera] = points
                self.then[pose, camera] = shown(  # type: ignore[call-arg]
                    points, camera, *(np.array([pan, tilt]) + off[pose]), ChangedRig()
                )

    def look(self, truth: ChangedRig) -> SceneDrift:
        """One day's look: what the sentinel finds."""
        rng = self.rng
        dust, spoil = rng.uniform(0.2, 1.0), rng.uniform(1.0, 2.0)
        bend = rng.normal(0.0, BEND_RAD, 2)
        shifts = []
        for pose, (pan, tilt) in enumerate(RESTS):
            light = rng.normal(0.0, LIGHT_PX)
            angles = np.array([pan, tilt]) + rng.normal(0.0, JOINT_SIGMA_RAD, 2) + bend
            for camera in CAMERAS_M:
                now = shown(self.points[pose, camera], camera, *angles, truth)  # type: ignore[call-arg]
                moved = now - self.then[pose, camera]
                sigma = rng.uniform(0.03, 0.15, FEATURES)
                moved = moved + spoil * sigma[:, None] * rng.normal(0, 1, moved.shape)
                arm = self.then[pose, camera] - (np.array(SIZE) - 1) / 2
                across = np.stack([-arm[:, 1], arm[:, 0]], axis=1)
                moved += light + rng.normal(0.0, CAMERA_PX, 2)
                moved += rng.normal(0.0, LIGHT_TURN) * across + rng.normal(0.0, LIGHT_SCALE) * arm
                dragged = rng.random(FEATURES) < rng.uniform(0.0, 0.25)
                moved[dragged] += rng.normal(0, 1, 2) * rng.uniform(0.0, 3.0)
                if rng.random() < 0.3:
                    rocks = rng.random(FEATURES) < rng.uniform(0.0, 0.2)
                    moved[rocks] += rng.uniform(-30, 30, 2)
                if rng.random() < 0.01:
                    moved = rng.uniform(-20, 20, moved.shape)
                kept = rng.random(FEATURES) < dust
                shifts.append(
                    ViewShift(
                        camera, pose, pan, tilt, self.then[pose, camera][kept], moved[kept], sigma[kept]
                    )
                )
        return find_drift(self.rig, shifts)
