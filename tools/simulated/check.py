"""What a mast file costs: where it puts points that the true rig sees, and where targets truly land by it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from calib.errors import Unreachable
from calib.geometry.cahvor import CameraModel
from calib.geometry.pointing import solve
from calib.geometry.rig import Rig
from calib.geometry.rigid import Rigid
from calib.geometry.solutions import choose
from calib.geometry.stereo import triangulate
from drivers.clock import ManualClock
from drivers.sim.heads import HeadSettings
from drivers.sim.pan_tilt import SimulatedPanTilt

PAN_LIMITS_RAD, TILT_LIMITS_RAD = (-2.6, 2.6), (-1.2, 0.5)
JOINTS_RAD = ((0.0, -0.2), (0.8, -0.5), (-0.8, -0.8))
"""Where the head stands for projection errors."""
GRID = 9


def _grid(model: CameraModel) -> np.ndarray:
    """(n, 2) pixels over the whole picture."""
    width, height = model.size_px
    axes = np.linspace(0, width - 1, GRID), np.linspace(0, height - 1, GRID)
    return np.stack(np.meshgrid(*axes), axis=-1).reshape(-1, 2)


def _seen_at(rig: Rig, camera: str, joints_rad: tuple[float, float], distance_m: float) -> np.ndarray:
    """(n, 3) points, rover frame, that a camera sees on the grid at a distance."""
    model = rig.camera_in_rover(camera, *joints_rad)
    rays = model.ray(_grid(model))
    return np.asarray(rays.origins_m + distance_m * rays.directions)


def turned_rover_frame(truth: Rig, belief: Rig, distances_m: Sequence[float]) -> Rig:
    """Return the true rig in the rover frame that the belief has.

    Four prisms half a metre apart fix that frame to some 2 mrad, all cameras together. Neither pointing at a
    click nor hand-off notices; so projection is compared with this part taken away too.
    """
    cases = [
        (name, joints, distance_m)
        for name, camera in truth.cameras.items()
        for joints in (JOINTS_RAD if camera.on == "head" else JOINTS_RAD[:1])
        for distance_m in distances_m
    ]
    true = np.concatenate([_seen_at(truth, *case) for case in cases])
    believed = np.concatenate([_seen_at(belief, *case) for case in cases])
    middle, there = true.mean(0), believed.mean(0)
    turn, _ = Rotation.align_vectors(believed - there, true - middle)
    belief_from_true = Rigid(turn.as_matrix(), there - turn.apply(middle))
    mast = truth.mast
    rotation = turn * Rotation.from_euler("XYZ", mast.rotation_rad)
    moved = replace(
        mast,
        translation_m=belief_from_true.points(mast.translation_m),
        rotation_rad=rotation.as_euler("XYZ"),
    )
    cameras = {
        name: camera if camera.on == "head" else replace(camera, model=camera.model.moved(belief_from_true))
        for name, camera in truth.cameras.items()
    }
    return replace(truth, mast=moved, cameras=cameras)


def projection_error_px(truth: Rig, belief: Rig, camera: str, distance_m: float) -> np.ndarray:
    """Return (n, 2) pixels: where the belief puts points, less where the true camera sees them.

    The points are seen over the whole picture at ``distance_m``, from several joint angles if the camera is
    on the head.
    """
    errors = []
    for joints in JOINTS_RAD if truth.cameras[camera].on == "head" else JOINTS_RAD[:1]:
        points = _seen_at(truth, camera, joints, distance_m)
        believed = belief.camera_in_rover(camera, *joints)
        errors.append(believed.project(points)[0] - _grid(believed))
    return np.concatenate(errors)


def hazcam_range_error_m(truth: Rig, belief: Rig, distance_m: float) -> np.ndarray:
    """Return (n,) metres: believed less true distance from the left Hazcam, of points that both see."""
    left, right = truth.stereo["hazcam"]
    points = _seen_at(truth, left, (0.0, 0.0), distance_m)
    pixels, valid = truth.cameras[right].model.project(points)
    size = np.array(truth.cameras[right].model.size_px)
    both = valid & ((pixels >= 0) & (pixels <= size - 1)).all(axis=1)
    eyes = belief.cameras[left].model, belief.cameras[right].model
    clicks = zip(_grid(eyes[0])[both], pixels[both], strict=True)
    found = np.array([triangulate(*eyes, *pair).position_m for pair in clicks])
    return np.asarray(np.linalg.norm(found - eyes[0].C, axis=1) - distance_m)


def pointing_error_px(
    truth: Rig,
    belief: Rig,
    head: HeadSettings,
    pair: str,
    distance_m: float,
    targets: int,
    seed: int,
    click_px: float = 0.0,
) -> np.ndarray:
    """Return (n, 2) pixels: where ground targets truly lie from the image centre after one pointing.

    With perfect clicks (``click_px`` 0, one sigma per axis in each eye) what is left is the mast file, the
    counts, backlash and sag. A target starts somewhere in the inner half of the left image.
    """
    rng = np.random.default_rng(seed)
    clock = ManualClock()
    device = SimulatedPanTilt(head, clock)
    left, right = truth.stereo[pair]
    believed = belief.cameras[left].model
    centre = np.array(believed.image_center_px)

    def go(pan_rad: float, tilt_rad: float) -> tuple[tuple[float, float], tuple[float, float]]:
        device.move(pan_rad, tilt_rad)
        while (reading := device.read()).moving:
            clock.sleep(0.05)
        return (reading.pan_rad, reading.tilt_rad), device.true_joints(reading.time_s)

    errors: list[np.ndarray] = []
    while len(errors) < targets:
        azimuth = rng.uniform(-1.0, 1.0)
        along = np.array([np.cos(azimuth), np.sin(azimuth), 0.0]) * distance_m
        target = truth.mast.translation_m * np.array([1.0, 1.0, 0.0]) + along
        target[2] = rng.normal(0, 0.1)
        start_px = centre + rng.uniform(-0.25, 0.25, 2) * believed.size_px
        try:
            start = choose(solve(belief.mast, believed, target, start_px), PAN_LIMITS_RAD, TILT_LIMITS_RAD)
        except Unreachable:
            continue
        measured, true = go(start.pan_rad, start.tilt_rad)
        clicks, seen = zip(
            *(truth.camera_in_rover(n, *true).project(target[None]) for n in (left, right)), strict=True
        )
        if not (seen[0][0] and seen[1][0]):
            continue
        left_px, right_px = (click[0] + rng.normal(0, click_px, 2) for click in clicks)
        models = (belief.camera_in_rover(n, *measured) for n in (left, right))
        found = triangulate(*models, left_px, right_px)
        aim = choose(solve(belief.mast, believed, found.position_m), PAN_LIMITS_RAD, TILT_LIMITS_RAD)
        _, true = go(aim.pan_rad, aim.tilt_rad)
        landed, _ = truth.camera_in_rover(left, *true).project(target[None])
        errors.append(landed[0] - centre)
    return np.array(errors)
