"""Picture sequences with exact truth for the trackers: a stereo pair nears one target in twenty steps.

Settings B (10 to 6 m, 2.5 % of the range a step) and C (10 to 1.2 m, 10 % a step) of a bench that others were
measured on, in two worlds:

- ``plane``: level textured ground without rocks; the pair flies straight at the target, 25 degrees from the
  ground's normal in B and along it in C, and the range is that of the left camera;
- ``ground``: the simulator's ground with relief, every second target on a rock where the scene has one in
  reach that both eyes see all the way; the rover drives, and the range is the level distance of the mast,
  so in C the view steepens from 9 to some 50 degrees.

At each stop the rover stands with up to 2 degrees of roll and pitch and heads by 0.08 rad (one sigma) wrong.
The head is turned to the true target, up to 15 px away in x and y, so that it stays in both pictures however
badly a tracker does: every tracker gets the very same pictures. The target is put midway between the eyes,
since one in the middle of the left picture would leave the right one below 2 m. Pictures have 2 DN of noise
and another gain in each (5 %, one sigma). Odometry is wrong by 2 % of the way and 0.5 degrees about each
axis, every step anew.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from calib.errors import CalibError
from calib.files.mast_file import load_rig
from calib.geometry.cahvor import CameraModel
from calib.geometry.pointing import solve
from calib.geometry.rig import Rig
from calib.geometry.rigid import FloatArray, Rigid, rot_x, rot_y, rot_z
from calib.matching.handoff import Eye
from calib.matching.track import start_track
from calib.matching.warp import grey
from drivers.sim.render import Renderer
from drivers.sim.scene import Scene, SceneSettings, build_scene
from mastctl.experiment.targets import texture_mask
from tools.studies.approach_world import WorldErrors

PAIR = ("pancam_left", "pancam_right")
STEPS, START_M = 20, 10.0
SETTINGS = {"B": 0.025, "C": 0.1}
SLANTS_RAD = {"B": math.radians(25.0), "C": 0.0}
WORLDS = ("plane", "ground")
ERRORS = WorldErrors(noise_dn=2.0)
JITTER_PX, TILTED_RAD = 15.0, math.radians(2.0)
HEADING_RAD, BEARING_RAD = 0.08, 0.15
ROCK_M = 0.04
"""A target this far above the ground is on a rock."""
SAME_M = 0.03
"""An eye whose ray to the target ends this much nearer does not see it."""
EDGE_PX = 40
TRIES = 200


@dataclass(frozen=True, eq=False)
class Sequence:
    """One approach, as a tracker gets it, and the truth.

    Attributes
    ----------
    images
        (21, 2, h, w) uint8: stops from the start on, left and right.
    truth_px
        (21, 2, 2) where the target truly is.
    cameras
        For each stop the left and the right camera in the rover frame, as the mast file and the joints'
        readings have them.
    motions, covariances
        (20, 4, 4) and (20, 6, 6): each stop's rover frame from the one before, as odometry tells it.
    predicted_px
        (20, 2, 2) where that motion puts the target, had its position before been known exactly.
    ranges_m
        (21,) of the left camera.
    refused
        How many candidate pixels could not be started from, before this one.
    """

    images: np.ndarray
    truth_px: FloatArray
    cameras: list[tuple[CameraModel, CameraModel]]
    motions: list[Rigid]
    covariances: FloatArray
    predicted_px: FloatArray
    ranges_m: FloatArray
    refused: int


@dataclass(frozen=True, eq=False)
class Path3D:
    """Rover poses, true joint angles, and the target's pixels in both eyes, of all stops."""

    target_m: FloatArray
    poses: list[Rigid]
    joints_rad: FloatArray
    pixels_px: FloatArray
    ranges_m: FloatArray


def rigs(configs: Path) -> tuple[Rig, Rig]:
    """Return the true rig of the simulator and the one of the mast file fitted to a simulated survey."""
    true, believed = (configs / name for name in ("sim/rocky8.yaml", "masts/rocky8_simulated.yaml"))
    return load_rig(true).rig, load_rig(believed).rig


def scene_of(world: str, seed: int) -> Scene:
    """Return the ground of a world."""
    if world == "plane":
        return build_scene(SceneSettings(seed=seed, relief_m=0.0, rocks=0))
    return build_scene(SceneSettings(seed=seed))


def made(world: str, setting: str, seed: int, true: Rig, believed: Rig) -> dict[str, np.ndarray]:
    """Render a sequence; return the arrays that `loaded` reads."""
    rng = np.random.default_rng([seed, WORLDS.index(world), ord(setting)])
    renderer = Renderer(scene_of(world, seed), workers=1)
    try:
        refused = 0
        for tried in range(TRIES):
            # Not every scene has a rock in reach that both eyes see all the way.
            on_rock = seed % 2 == 1 and tried < TRIES // 2
            path = _path(world, setting, renderer.scene, true, rng, on_rock)
            if path is None:
                continue
            first = _look(renderer, true, path, 0, rng)
            at = np.rint(path.pixels_px[0, 0]).astype(int)
            if not texture_mask(first[0])[at[1], at[0]]:
                continue
            read = path.joints_rad + rng.normal(0.0, ERRORS.joint_rad, path.joints_rad.shape)
            eyes = [
                Eye(grey(image), believed.camera_in_rover(name, *read[0].tolist()))
                for image, name in zip(first, PAIR, strict=True)
            ]
            try:
                start_track(*eyes, path.pixels_px[0, 0])
            except CalibError:
                refused += 1
                continue
            rest = [_look(renderer, true, path, stop, rng) for stop in range(1, STEPS + 1)]
            return {
                "images": np.stack([first, *rest]), "truth_px": path.pixels_px, "read_rad": read,
                "ranges_m": path.ranges_m, "refused": np.array(refused),
                **_odometry(path, true, rng),
            }  # fmt: skip
    finally:
        renderer.close()
    raise SystemExit(f"{world} {setting} seed {seed}: no target in {TRIES} tries")


def _path(
    world: str, setting: str, scene: Scene, true: Rig, rng: np.random.Generator, on_rock: bool
) -> Path3D | None:
    """Draw a target and the way to it; None if an eye would not see it at every stop."""
    target = _target(scene, rng, on_rock) if world == "ground" else rng.uniform(-3.0, 3.0, 3) * [1, 1, 0]
    if target is None:
        return None
    head = true.mast.rover_from_head(0.0, 0.0).translation_m
    bearing = math.atan2(target[1], target[0]) if world == "ground" else rng.uniform(-math.pi, math.pi)
    poses, joints, pixels, ranges = [], [], [], []
    for stop in range(STEPS + 1):
        away_m = START_M * (1.0 - SETTINGS[setting]) ** stop
        if stop:
            bearing += SETTINGS[setting] * rng.normal(0.0, BEARING_RAD)
        tilted = rot_y(rng.uniform(-TILTED_RAD, TILTED_RAD)) @ rot_x(rng.uniform(-TILTED_RAD, TILTED_RAD))
        ahead = np.array([math.cos(bearing), math.sin(bearing), 0.0])
        if world == "ground":
            turned = rot_z(bearing + rng.normal(0.0, HEADING_RAD)) @ tilted
            place = target - (away_m + head[0]) * ahead
            place[2] = scene.ground_z_m(float(place[0]), float(place[1]))
        else:
            down = math.pi / 2 - SLANTS_RAD[setting]
            sight = math.cos(down) * ahead + np.array([0.0, 0.0, math.sin(down)])
            turned = rot_z(bearing) @ rot_y(-down) @ tilted
            place = target - away_m * sight - turned @ head
        pose = Rigid(turned, place)
        found = _pointed(true, pose.inverse.points(target), rng)
        if found is None or not all(_sees(scene, true, pose, name, found[0], target) for name in PAIR):
            return None
        poses.append(pose)
        joints.append(found[0])
        pixels.append(found[1])
        left = pose.points(true.camera_in_rover(PAIR[0], *found[0].tolist()).C)
        ranges.append(float(np.linalg.norm(target - left)))
    return Path3D(target, poses, np.array(joints), np.array(pixels), np.array(ranges))


def _target(scene: Scene, rng: np.random.Generator, on_rock: bool) -> FloatArray | None:
    """Draw a point of the ground, or of a rock, that a mast at the site's origin sees some 10 m away."""
    origin = np.array([0.0, 0.0, -1.5])
    azimuth, range_m = rng.uniform(-0.6, 0.6, 4000), rng.uniform(9.0, 11.0, 4000)
    level = np.sqrt(range_m**2 - 1.5**2)
    aims = np.stack([level * np.cos(azimuth), level * np.sin(azimuth), np.zeros(4000)], axis=1) - origin
    reach = scene.cast(origin, aims)
    points = origin + reach[:, None] * aims / np.linalg.norm(aims, axis=1, keepdims=True)
    points = points[np.isfinite(reach) & (np.abs(reach - START_M) < 1.5)]
    height = np.array([scene.ground_z_m(float(p[0]), float(p[1])) - p[2] for p in points])
    fit = points[height > ROCK_M] if on_rock else points[height < 0.01]
    return np.asarray(fit[rng.integers(len(fit))]) if len(fit) else None


def _pointed(
    true: Rig, target_m: FloatArray, rng: np.random.Generator
) -> tuple[FloatArray, FloatArray] | None:
    """Return joint angles in whole counts that put the target (3,), rover frame, midway between the eyes."""
    left, right = (true.cameras[name].model for name in PAIR)
    middle = np.array(left.image_center_px)
    off = rng.uniform(-JITTER_PX, JITTER_PX, 2)
    aim = middle + off
    angles = np.zeros(2)
    for _ in range(3):
        best = solve(true.mast, left, target_m, aim)[0]
        angles = np.round(np.array([best.pan_rad, best.tilt_rad]) / ERRORS.count_rad) * ERRORS.count_rad
        pixels = _pixels(true, angles, target_m)
        aim = middle + off + (pixels[0] - pixels[1]) * [0.5, 0.0]
    size = np.array([left.size_px, right.size_px])
    if not ((pixels >= EDGE_PX) & (pixels <= size - 1 - EDGE_PX)).all():
        return None
    return angles, pixels


def _pixels(rig: Rig, joints_rad: FloatArray, target_m: FloatArray) -> FloatArray:
    """Return where both eyes (2, 2) see a point of the rover frame."""
    models = [rig.camera_in_rover(name, *joints_rad.tolist()) for name in PAIR]
    return np.array([model.project(target_m)[0] for model in models])


def _sees(
    scene: Scene, true: Rig, pose: Rigid, name: str, joints_rad: FloatArray, target: FloatArray
) -> bool:
    """Whether nothing hides the target from an eye."""
    eye = pose.points(true.camera_in_rover(name, *joints_rad.tolist()).C)
    reach = float(scene.cast(eye, target - eye))
    return abs(reach - float(np.linalg.norm(target - eye))) < SAME_M


def _look(renderer: Renderer, true: Rig, path: Path3D, stop: int, rng: np.random.Generator) -> np.ndarray:
    """Return both pictures (2, h, w) of a stop."""
    head = path.poses[stop] @ true.mast.rover_from_head(*path.joints_rad[stop].tolist())
    shot = []
    for name in PAIR:
        image = renderer.image(true.cameras[name].model, head, 2)
        gain = 1.0 + rng.normal(0.0, ERRORS.gain)
        noisy = gain * image + rng.normal(0.0, ERRORS.noise_dn, image.shape)
        shot.append(np.clip(np.rint(noisy), 0, 255).astype(np.uint8))
    return np.stack(shot)


def _odometry(path: Path3D, true: Rig, rng: np.random.Generator) -> dict[str, np.ndarray]:
    """Return the motions as told, their covariances, and where they put the target."""
    motions, covariances, predicted = [], [], []
    for stop in range(1, STEPS + 1):
        motion = path.poses[stop].inverse @ path.poses[stop - 1]
        way_m = float(np.linalg.norm(path.poses[stop].translation_m - path.poses[stop - 1].translation_m))
        sigma = np.array([ERRORS.heading_rad] * 3 + [ERRORS.odometry * way_m] * 3)
        off = rng.normal(0.0, sigma)
        told = Rigid(rot_x(off[0]) @ rot_y(off[1]) @ rot_z(off[2]), off[3:]).inverse @ motion
        before = path.poses[stop - 1].inverse.points(path.target_m)
        predicted.append(_pixels(true, path.joints_rad[stop], told.points(before)))
        motions.append(np.vstack([np.column_stack([told.rotation, told.translation_m]), [0, 0, 0, 1]]))
        covariances.append(np.diag(sigma**2))
    return {
        "motions": np.array(motions),
        "covariances": np.array(covariances),
        "predicted_px": np.array(predicted),
    }


def sequences(
    work: Path, world: str, setting: str, seeds: range, true: Rig, believed: Rig
) -> Iterator[tuple[int, Path]]:
    """Yield the files of the sequences, rendered where they are not there yet."""
    work.mkdir(parents=True, exist_ok=True)
    for seed in seeds:
        file = work / f"{world}_{setting}_{seed}.npz"
        if not file.exists():
            part = file.with_suffix(".part.npz")
            np.savez(part, **made(world, setting, seed, true, believed))
            part.rename(file)
        yield seed, file


def loaded(file: Path, believed: Rig) -> Sequence:
    """Read a sequence."""
    with np.load(file) as data:
        cameras = [
            (believed.camera_in_rover(PAIR[0], *at), believed.camera_in_rover(PAIR[1], *at))
            for at in data["read_rad"].tolist()
        ]
        motions = [Rigid(one[:3, :3], one[:3, 3]) for one in data["motions"]]
        return Sequence(
            data["images"], data["truth_px"], cameras, motions, data["covariances"], data["predicted_px"],
            data["ranges_m"], int(data["refused"]),
        )  # fmt: skip
