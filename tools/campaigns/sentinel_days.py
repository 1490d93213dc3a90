"""What the drift sentinel looks at in its campaign: changes, and surroundings in rendered pictures of days.

Ground, stones and shadows are the simulator's, drawn anew under each day's sun; what makes a day of it here
is this file's own: the hour and so the sun, haze, exposure, noise, blur, a dirty window, stones that were
moved or taken away, boxes as large as a person or a wheel that stand about.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import cv2
import numpy as np

from calib.calibrate.scene.drift import SceneDrift, ViewShift
from calib.geometry.cahvor import CameraModel
from calib.geometry.rig import Rig
from calib.geometry.rigid import FloatArray, Rigid
from calib.matching.warp import Grey
from drivers.sim import boards, ground, rocks, scene
from drivers.sim.kept import kernels
from drivers.sim.render import Renderer
from drivers.sim.scene import INNER_CELL_M, Scene, SceneSettings
from mastctl.watch.reference import ReferencePicture

LATITUDE_RAD, TURN_OF_AXIS_RAD = math.radians(35.0), math.radians(23.4)
LOWEST_SUN_RAD = 0.22
STONES, NEAREST_M, FARTHEST_M = 130, 1.7, 18.0
GRAVEL_TEXELS = 2048
JOINT_SIGMA_RAD, BEND_SIGMA_RAD = 2e-4, 1e-4
PERSON_M, WHEEL_M = (0.45, 0.3, 1.75), (0.5, 0.25, 0.45)
DIGEST = "campaign"
RESTS = tuple(
    (pan, tilt) for tilt, pans in ((-0.2, (-1.8, 0.0, 1.8)), (-0.5, (-0.9, 0.9, 2.7))) for pan in pans
)


@dataclass(frozen=True)
class ChangedRig:
    """What is changed: turns of eyes, part of the focal length, slips, a turn of the rover; radians."""

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


def alarm(before: SceneDrift | None, now: SceneDrift) -> str:
    """What two looks one after the other name alike, '' if nothing."""
    if before is None or before.named is None or now.named is None:
        return ""
    return now.named.what if before.named.what == now.named.what else ""


@dataclass(frozen=True)
class Weather:
    """What a day does to pictures.

    hour_rad
        The sun's, 0 at noon.
    season_rad
        Of the year.
    haze
        Which part of the contrast is gone.
    gain, noise_dn, blur_px
        Exposure beside the usual one, noise at mid grey, and how unsharp all is.
    dirty
        The camera whose window is dirty, '' for none.
    stones
        By stone that is not where it was: how far it was moved (x, y), metres; None: gone.
    strangers
        (x, y, heading, size) of boxes that stand about.
    """

    hour_rad: float = 0.3
    season_rad: float = 0.0
    haze: float = 0.0
    gain: float = 1.0
    noise_dn: float = 1.0
    blur_px: float = 0.0
    dirty: str = ""
    stones: Mapping[int, tuple[float, float] | None] = field(default_factory=dict)
    strangers: tuple[tuple[float, float, float, tuple[float, float, float]], ...] = ()

    @property
    def sun(self) -> tuple[float, float]:
        """Azimuth (from north over east) and elevation, radians, by the spherical triangle."""
        declination = TURN_OF_AXIS_RAD * math.sin(self.season_rad)
        up = math.sin(LATITUDE_RAD) * math.sin(declination) + math.cos(LATITUDE_RAD) * math.cos(
            declination
        ) * math.cos(self.hour_rad)
        north = math.sin(declination) * math.cos(LATITUDE_RAD) - math.cos(declination) * math.sin(
            LATITUDE_RAD
        ) * math.cos(self.hour_rad)
        west = math.cos(declination) * math.sin(self.hour_rad)
        return math.atan2(-west, north), math.asin(up)


def weather_of(
    rng: np.random.Generator, eyes: Sequence[str], moved: Mapping[int, Any], hour_rad: float | None
) -> Weather:
    """Return a day's weather by chance; at some hour of daylight, or near the one that is given."""
    season = rng.uniform(0.0, 2.0 * math.pi)
    while True:
        hour = rng.uniform(-1.25, 1.25) if hour_rad is None else hour_rad + rng.normal(0.0, 0.04)
        if Weather(hour, season).sun[1] > LOWEST_SUN_RAD:
            break
        season = rng.uniform(0.0, 2.0 * math.pi)
    strangers = []
    for likely, size, near, far in ((0.3, PERSON_M, 2.0, 9.0), (0.3, WHEEL_M, 1.5, 2.2)):
        while rng.random() < likely:
            away, towards = rng.uniform(near, far), rng.uniform(-math.pi, math.pi)
            place = away * math.cos(towards), away * math.sin(towards)
            strangers.append((*place, rng.uniform(0.0, math.pi), size))
    dusk = rng.random() < 0.05
    return Weather(
        hour, season,
        haze=float(rng.uniform(0.3, 0.8) if rng.random() < 0.25 else rng.uniform(0.0, 0.2)),
        gain=float(rng.uniform(0.1, 0.3) if dusk else rng.uniform(0.6, 1.6)),
        noise_dn=float(rng.uniform(3.0, 6.0) if dusk else rng.uniform(0.7, 3.0)),
        blur_px=float(rng.uniform(0.4, 1.2)) if rng.random() < 0.2 else 0.0,
        dirty=str(rng.choice(list(eyes))) if rng.random() < 0.15 else "",
        stones=dict(moved), strangers=tuple(strangers),
    )  # fmt: skip


def moved_stones(
    rng: np.random.Generator, before: Mapping[int, tuple[float, float] | None]
) -> dict[int, tuple[float, float] | None]:
    """Return which stones are elsewhere a day later: mostly none, now and then some of them, for good."""
    now = dict(before)
    if rng.random() < 0.3:
        for stone in rng.choice(STONES, rng.integers(1, STONES // 6), replace=False):
            gone = rng.random() < 0.3
            now[int(stone)] = None if gone else (float(rng.normal(0, 0.08)), float(rng.normal(0, 0.08)))
    return now


class Surroundings:
    """A place for a rover, made from a seed: what stays the same from day to day."""

    def __init__(self, seed: int) -> None:
        self.seed = seed
        rng = np.random.default_rng([seed, 1])
        settings = SceneSettings(seed=seed, rocks=())
        self.inner = scene.make_grid(scene.inner_relief_m(settings, rng), INNER_CELL_M)
        self.outer = scene.make_grid(scene.outer_relief_m(settings, rng), scene.OUTER_CELL_M)
        self.ground = partial(scene.ground_z_m, self.inner)
        self.stone = ground.pyramid(ground.stone(rng, ground.STONE_TEXELS), ground.STONE_TEXEL_M)
        away = NEAREST_M * (FARTHEST_M / NEAREST_M) ** (rng.random(STONES) ** 0.75)
        towards = rng.uniform(-math.pi, math.pi, STONES)
        wide = np.minimum(0.05 * 12.0 ** (rng.random(STONES) ** 1.1), 0.09 * away)
        self.stones = np.column_stack([away * np.cos(towards), away * np.sin(towards), wide])
        self._at_home = [self._stone(number, (0.0, 0.0)) for number in range(STONES)]

    def _stone(self, number: int, off_m: tuple[float, float]) -> Any:
        """A stone of a shape of its own, so far from where it was at first."""
        x, y, wide = self.stones[number]
        place = np.array([[x + off_m[0], y + off_m[1], wide]])
        rng = np.random.default_rng([self.seed, 2, number])
        return rocks.stones_at(place, rng, self.ground, [float(number)])

    def scene(self, day: Weather) -> Scene:
        """The scene of a day: the same ground and stones under its sun."""
        azimuth, elevation = day.sun
        settings = SceneSettings(
            seed=self.seed, rocks=(), sun_azimuth_rad=azimuth, sun_elevation_rad=elevation
        )
        sun = scene.sun_direction(settings)
        parts = [stone for number, stone in enumerate(self._at_home) if number not in day.stones]
        parts += [self._stone(number, off) for number, off in day.stones.items() if off is not None]
        if day.strangers:
            boxes = [rocks.make_brick(x, y, turn, self.ground, size) for x, y, turn, size in day.strangers]
            parts.append(rocks.meshes(boxes))
        things = rocks.together(*parts)
        tones = scene.ground_tones(self.inner, sun, np.random.default_rng([self.seed, 3]))
        tones *= scene.shadows(self.inner, things, sun)
        gravel = ground.gravel(np.random.default_rng([self.seed, 4]), sun, GRAVEL_TEXELS)
        world = kernels().World(
            self.inner, self.outer, things, ground.pyramid(gravel, ground.DETAIL_TEXEL_M),
            ground.pyramid(tones, INNER_CELL_M), self.stone, boards.faces([]), sun,
        )  # fmt: skip
        return Scene(settings, world)


def changed(model: CameraModel, eye: str, truth: ChangedRig) -> CameraModel:
    """A camera of the head as a change leaves it: turned about its own place, its focal length another."""
    t = truth.turned.get(eye, np.zeros(3))
    turn = about(2, t[2]) @ about(1, t[1]) @ about(0, t[0])
    longer = 1.0 + truth.focal.get(eye, 0.0)
    told = {}
    for letter in "HV":
        vector = getattr(model, letter)
        along = float(model.A @ vector) * model.A
        told[letter] = turn @ (along + longer * (vector - along))
    told |= {"A": turn @ model.A, "O": turn @ model.O}
    return replace(model, **told)


def smaller(model: CameraModel, by: int) -> CameraModel:
    """The same view in ``by`` times fewer pixels along each side; (0, 0) is the middle of the first pixel."""
    width, height = model.size_px
    h, v = (vector / by + (0.5 / by - 0.5) * model.A for vector in (model.H, model.V))
    return replace(model, size_px=(width // by, height // by), H=h, V=v)


@dataclass(frozen=True)
class DaysLook:
    """One look: where the head really stood at each rest (r, 2), the scene then, and its pictures."""

    stood_rad: FloatArray
    scene: Scene
    pictures: list[ReferencePicture]


class Days:
    """A true rig in surroundings, and the pictures that it takes of them from rests of its head."""

    def __init__(self, rig: Rig, place: Surroundings, rests: Sequence[tuple[float, float]]) -> None:
        self.rig, self.place, self.rests = rig, place, rests
        self._renderer: Renderer | None = None

    def look(
        self, rng: np.random.Generator, day: Weather, truths: Sequence[ChangedRig] = (ChangedRig(),)
    ) -> list[DaysLook]:
        """Return a look for each truth, all on one day and from the same rests."""
        shown = self.place.scene(day)
        if self._renderer is None:
            self._renderer = Renderer(shown, workers=1)
        self._renderer.scene = shown
        off = rng.normal(0.0, JOINT_SIGMA_RAD, (len(self.rests), 2)) + rng.normal(0.0, BEND_SIGMA_RAD, 2)
        stood = np.array(self.rests) + off
        drawn: dict[object, Grey] = {}
        return [DaysLook(stood, shown, self._pictures(rng, day, stood, truth, drawn)) for truth in truths]

    def _pictures(
        self,
        rng: np.random.Generator,
        day: Weather,
        stood: FloatArray,
        truth: ChangedRig,
        drawn: dict[object, Grey],
    ) -> list[ReferencePicture]:
        """One truth's pictures; light that another truth had as well is not drawn again."""
        assert self._renderer is not None
        found = []
        r = truth.rover
        site_from_rover = Rigid(about(2, r[2]) @ about(1, r[1]) @ about(0, r[0]), np.zeros(3))
        for pose, rest in enumerate(self.rests):
            pan, tilt = stood[pose] + truth.slip
            site_from_head = site_from_rover @ self.rig.mast.rover_from_head(pan, tilt)
            for eye in self.rig.cameras:
                key = (eye, pose, str(truth.turned.get(eye)), truth.focal.get(eye), truth.slip, tuple(r))
                if key not in drawn:
                    model = changed(self.rig.cameras[eye].model, eye, truth)
                    drawn[key] = self._renderer.image(model, site_from_head, 2)
                picture = developed(rng, drawn[key], day, eye)
                found.append(ReferencePicture(eye, pose, *rest, DIGEST, picture))
        return found

    def truly_moved(self, then: DaysLook, now: DaysLook, shift: ViewShift) -> FloatArray:
        """How far (n, 2) what stands still has moved in a view by where the head stood, pixels."""
        model = self.rig.cameras[shift.camera].model
        before = model.moved(self.rig.mast.rover_from_head(*then.stood_rad[shift.pose]))
        after = model.moved(self.rig.mast.rover_from_head(*now.stood_rad[shift.pose]))
        rays = before.ray(shift.pixels_px)
        ranges = then.scene.cast(rays.origins_m, rays.directions)
        far = np.where(np.isfinite(ranges), ranges, 1e4)[:, None]
        return np.asarray(after.project(rays.origins_m + far * rays.directions)[0] - shift.pixels_px)

    def close(self) -> None:
        """Let the renderer go."""
        if self._renderer is not None:
            self._renderer.close()


def developed(rng: np.random.Generator, light: Grey, day: Weather, eye: str) -> Grey:
    """Return the picture (h, w) in whole grey levels that a day makes of the scene's light."""
    light = np.asarray(light, dtype=np.float32)
    if day.blur_px:
        light = cv2.GaussianBlur(light, (0, 0), day.blur_px)
    light = ((1.0 - day.haze) * light + day.haze * 150.0) * day.gain
    if day.dirty == eye:
        light = light * dirt(eye, light.shape)
    noise = day.noise_dn * np.sqrt(0.3 + 0.7 * np.maximum(light, 0.0) / 128.0)
    light = light + noise * rng.standard_normal(light.shape, dtype=np.float32)
    return np.asarray(np.clip(np.rint(light), 0, 255), dtype=np.float32)


def dirt(eye: str, shape: tuple[int, ...]) -> Grey:
    """What part of its light a dirty window lets through: smears and specks, the same each day."""
    rng = np.random.default_rng([7, len(eye)])
    height, width = shape
    left = np.ones(shape, dtype=np.float32)
    y, x = np.mgrid[:height, :width].astype(np.float32)
    for _ in range(40):
        cx, cy, wide = rng.uniform(0, width), rng.uniform(0, height), rng.uniform(0.003, 0.05) * width
        dark = rng.uniform(0.1, 0.6)
        left *= 1.0 - dark * np.exp(-((x - cx) ** 2 + (y - cy) ** 2) / (2.0 * wide**2))
    return left
