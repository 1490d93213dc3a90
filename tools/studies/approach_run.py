"""The paper's approach (its Fig. 1): a target picked in Pancam at 10 m, followed to 1 m."""

from __future__ import annotations

import math
import time
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from calib.errors import CalibError
from calib.geometry.cahvor import CameraModel
from calib.geometry.pointing import solve
from calib.geometry.rig import Rig
from calib.geometry.rigid import FloatArray
from calib.matching.handoff import Eye
from calib.matching.look import seen_by
from calib.matching.track import Track, moved_track, start_track
from calib.matching.verdict import PatchMatch
from drivers.interfaces import Image
from drivers.sim.scene import SceneSettings, build_scene
from mastctl.experiment.targets import texture_mask
from mastctl.motion.pairs import choose_pairs
from tools.studies.approach_world import ApproachWorld, WorldErrors

START_M, END_M = 10.0, 1.0
STEP = 0.1
"""Of the range, driven in one step."""

On = Literal["rocks", "ground"]
"""What targets lie on: rocks, as the paper's, or wherever there is texture, which is mostly level ground."""

ROCK_M = 0.05
"""A target so far above the ground is on a rock."""

ROCKS = 150
"""In the scene, so that several stand at the start range."""

PICKS = 12
"""Pixels that are tried in one view: most of a rock's strongest texture is its edge, which is refused."""

INSIDE_PX, APART_M = 15.0, 0.15
"""On a rock, what is seen this far beside a target (4 cm across at 10 m) is not farther away from it."""

NEAR_ROCK_PX = 40
"""How far from the rock's chosen point its texture is looked for."""

SUN_MOVES_RAD = math.radians(8.0)
LOST_LOOKS = 3
"""How often a lost target is looked for at one stop, before the rover drives on."""

PATCH_PX = 30
"""Half the side of the pictures that are kept for the report."""

GIVE_UP = 4
"""Stops without the target after which the run ends as lost."""


@dataclass(frozen=True, eq=False)
class Stop:
    """One stop of an approach.

    Attributes
    ----------
    range_m
        True distance from the middle of the pair's cameras.
    pair
        What looked.
    state
        ``tracked`` or ``lost``, and ``reason`` why.
    error_m
        (3,) believed less true position in the rover frame: along the pair's line of sight, to its right,
        below it.
    sigma_m
        What the track says of the same three.
    pixel_error_px
        Of the left eye's match, against the truth; not-a-number where there was none.
    untracked_m
        The error along, right and below had the start's position been carried by reported motions alone.
    pose_doubt
        What the pictures say against the reported motion, which is honest here; empty for nothing.
    patches
        The key picture around the target, and both eyes' pictures around where it was found or expected.
    """

    range_m: float
    pair: str
    state: str
    reason: str
    error_m: FloatArray
    sigma_m: FloatArray
    pixel_error_px: float
    renewed: bool
    untracked_m: FloatArray
    pose_doubt: str = ""
    patches: tuple[Image, ...] = ()


@dataclass(frozen=True, eq=False)
class ApproachRun:
    """One approach: its stops, or why it did not begin; ``start_m`` (3,) is the first stereo's error."""

    seed: int
    stops: tuple[Stop, ...]
    error: str = ""
    seconds: float = 0.0
    start_m: FloatArray = field(default_factory=lambda: np.full(3, np.nan))

    @property
    def kept(self) -> bool:
        """Whether the target was tracked at the last stop, near its end."""
        return bool(self.stops) and self.stops[-1].state == "tracked" and self.stops[-1].range_m < 1.3

    @property
    def final_error_m(self) -> FloatArray:
        """(3,) of the last stop: along, right, below."""
        return self.stops[-1].error_m if self.stops else np.full(3, np.nan)


@dataclass(frozen=True, eq=False)
class ApproachTask:
    """One approach: the true and the believed rig, the seed, what the target lies on."""

    true: Rig
    believed: Rig
    seed: int
    on: On


def one_approach(task: ApproachTask) -> ApproachRun:
    """Drive the approach of a task, which comes to the same wherever it runs."""
    return run_approach(task.true, task.believed, task.seed, on=task.on)


def run_approach(
    true: Rig, believed: Rig, seed: int, errors: WorldErrors | None = None, on: On = "rocks"
) -> ApproachRun:
    """Drive one approach to a random target.

    Parameters
    ----------
    true, believed
        The rig that takes the pictures, and the mast file's.
    seed
        Of scene, target, path and every error.
    on
        What the target lies on.
    """
    begun_s = time.monotonic()
    rng = np.random.default_rng([seed, 6])
    light = SceneSettings(seed=seed, rocks=ROCKS) if on == "rocks" else SceneSettings(seed=seed)
    world = ApproachWorld(build_scene(light), true, believed, errors or WorldErrors(), rng)
    try:
        begun = _begin(world, rng, on)
        if isinstance(begun, str):
            return ApproachRun(seed, (), begun, time.monotonic() - begun_s)
        track, target = begun
        there = world.site_from_rover.inverse.points(target)
        start_m = _axes(there - track.key.eye.camera.C) @ (track.position_m - there)
        world.read_windows()
        stops = _drive(world, track, target, light, rng)
        return ApproachRun(seed, tuple(stops), "", time.monotonic() - begun_s, start_m)
    finally:
        world.close()


def _begin(world: ApproachWorld, rng: np.random.Generator, on: On) -> tuple[Track, FloatArray] | str:
    """Pick a textured pixel of the left Pancam at the start range; the track, and the truth in the site."""
    pair = world.believed.stereo["pancam"]
    reason = "no view offered a target"
    for _ in range(12):
        aim = _aim(world, rng, on)
        if aim is None:
            return "no rock stands at the start range"
        angles = solve(world.believed.mast, world.believed.cameras[pair[0]].model, aim)[0]
        eyes = world.look(pair, angles.pan_rad, angles.tilt_rad)
        left, right = (eyes[name] for name in pair)
        fit = texture_mask(left.image.astype(np.uint8))
        if on == "rocks":
            fit &= _near(left.camera, aim)
        rows, columns = np.nonzero(fit)
        for pick in rng.integers(len(rows), size=PICKS) if len(rows) else ():
            pixel = np.array([float(columns[pick]), float(rows[pick])])
            target = world.point_at(pair[0], angles.pan_rad, angles.tilt_rad, pixel)
            if target is None or (
                on == "rocks" and not _on_rock(world, pair[0], angles.pan_rad, angles.tilt_rad, pixel, target)
            ):
                continue
            range_m = float(np.linalg.norm(world.site_from_rover.inverse.points(target) - left.camera.C))
            if abs(range_m - START_M) > 0.15 * START_M:
                continue
            try:
                return start_track(left, right, pixel), target
            except CalibError as error:
                reason = str(error)
    return reason


def _aim(world: ApproachWorld, rng: np.random.Generator, on: On) -> FloatArray | None:
    """Where to look for a target, (3,) in the rover frame; None without a rock."""
    if on == "rocks":
        rock = world.turn_to_rock(START_M, ROCK_M)
        return None if rock is None else world.site_from_rover.inverse.points(rock)
    azimuth = rng.uniform(-0.5, 0.5)
    return np.array([START_M * math.cos(azimuth), START_M * math.sin(azimuth), 0.0])


def _near(camera: CameraModel, aim_m: FloatArray) -> NDArray[np.bool_]:
    """Which pixels (h, w) lie near the image of a point."""
    (x, y), (width, height) = camera.project(aim_m)[0], camera.size_px
    columns, rows = np.arange(width), np.arange(height)[:, None]
    return np.asarray(np.maximum(np.abs(columns - x), np.abs(rows - y)) <= NEAR_ROCK_PX)


def _on_rock(
    world: ApproachWorld, camera: str, pan_rad: float, tilt_rad: float, pixel: FloatArray, target: FloatArray
) -> bool:
    """Whether a target lies on a rock and not at its boundary, where nobody would put one."""
    if world.height_m(target) < ROCK_M:
        return False
    for off in INSIDE_PX * np.array([[1.0, 0.0], [-1.0, 0.0], [0.0, 1.0], [0.0, -1.0]]):
        beside = world.point_at(camera, pan_rad, tilt_rad, pixel + off)
        if beside is None or float(np.linalg.norm(beside - target)) > APART_M:
            return False
    return True


def _drive(
    world: ApproachWorld, track: Track, target: FloatArray, light: SceneSettings, rng: np.random.Generator
) -> list[Stop]:
    """Step by step up to the target."""
    stops: list[Stop] = []
    missed, relit, carried = 0, False, track.position_m
    for _ in range(60):
        here = world.site_from_rover
        away = target[:2] - here.translation_m[:2]
        distance = float(np.linalg.norm(away))
        # Where the front cameras stand, ahead of the rover's origin, is where 1 m counts from.
        ahead = _front_m(world)
        left_m = distance - ahead
        if left_m <= END_M * 1.02 or missed >= GIVE_UP:
            break
        step = min(STEP * left_m, left_m - END_M)
        bearing = math.atan2(away[1], away[0]) + rng.normal(0.0, 0.15)
        x, y = here.translation_m[:2] + step * np.array([math.cos(bearing), math.sin(bearing)])
        facing = math.atan2(target[1] - y, target[0] - x) + rng.normal(0.0, 0.08)
        motion, covariance = world.drive(float(x), float(y), facing)
        track, carried = moved_track(track, motion, covariance), motion.points(carried)
        if not relit and left_m < 4.0:
            sun = light.sun_azimuth_rad + SUN_MOVES_RAD
            world.relight(build_scene(replace(light, sun_azimuth_rad=sun)))
            relit = True
        track, stop = _look(world, track, target, carried)
        stops.append(stop)
        missed = 0 if stop.state == "tracked" else missed + 1
    return stops


def _front_m(world: ApproachWorld) -> float:
    """How far ahead of the rover's origin the last pair stands."""
    left, right = (world.believed.cameras[n].model.C[0] for n in world.believed.stereo["hazcam"])
    return float(left + right) / 2


def _look(
    world: ApproachWorld, track: Track, target: FloatArray, carried_m: FloatArray
) -> tuple[Track, Stop]:
    """Look for the target with the pair of its range, again if it is lost; the track and the record."""
    rig = world.believed
    chosen = choose_pairs(rig, track.position_m)[0]
    name, pan, tilt = chosen.pair, chosen.pan_rad or 0.0, chosen.tilt_rad or 0.0
    pair = rig.stereo[name]
    key, doubt = track.key, ""
    for _ in range(LOST_LOOKS):
        eyes = world.look(pair, pan, tilt)
        look = seen_by(track, eyes)
        doubt = doubt or (look.doubt.sentence if look.doubt else "")
        if look.track.state == "tracked":
            break
    track = look.track
    true = world.site_from_rover.inverse.points(target)
    middle = (eyes[pair[0]].camera.C + eyes[pair[1]].camera.C) / 2
    axes = _axes(true - middle)
    found = look.found.get(pair[0])
    pixel_error = math.nan
    if found is not None and found.verdict == "good":
        exact = world.true_pixel(pair[0], pan, tilt, target)
        pixel_error = float(np.linalg.norm(found.pixel_px - exact))
    return track, Stop(
        float(np.linalg.norm(true - middle)),
        name,
        track.state,
        look.reason,
        axes @ (track.position_m - true),
        np.sqrt(np.diag(axes @ track.target_covariance_m2 @ axes.T)),
        pixel_error,
        look.renewed,
        axes @ (carried_m - true),
        doubt,
        (_patch(key.eye, key.pixel_px), *(_patch(eyes[n], _place(look.found.get(n))) for n in pair)),
    )


def _place(found: PatchMatch | None) -> FloatArray:
    """Where a match found the target, or expected it."""
    if found is None:
        return np.full(2, np.nan)
    return found.pixel_px if found.verdict == "good" else found.predicted_px


def _patch(eye: Eye, pixel_px: FloatArray) -> Image:
    """The picture around a pixel, black beyond its border."""
    side = 2 * PATCH_PX + 1
    if not np.isfinite(pixel_px).all():
        return np.zeros((side, side), np.uint8)
    x, y = (int(v) for v in np.rint(pixel_px))
    whole = np.pad(np.clip(eye.image, 0, 255).astype(np.uint8), side)
    return np.ascontiguousarray(
        whole[max(0, y + side - PATCH_PX) :, max(0, x + side - PATCH_PX) :][:side, :side]
    )


def _axes(sight: FloatArray) -> FloatArray:
    """Rows: along a line of sight, to its right, below it."""
    along = sight / np.linalg.norm(sight)
    right = np.cross([0.0, 0.0, 1.0], along)
    right /= np.linalg.norm(right)
    return np.stack([along, right, np.cross(along, right)])
