"""Random masts, cameras, pixels and targets, with kinematics by SciPy's rotations, not by the project's own.

Each case chooses the joint angles first and puts the target on the pixel's ray, so a solution exists.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from calib.errors import Unreachable
from calib.geometry.cahvor import CameraModel
from calib.geometry.pointing import Solution, solve
from calib.geometry.rig import Mast

SAME_RAD = 1e-5
"""A solution is the generating one within this; two that meet at the edge of reach are good to 1e-6."""


@dataclass(frozen=True)
class MastCase:
    """One random mast, camera and pixel, the joint angles chosen, and the target they put on the pixel."""

    mast: Mast
    camera: CameraModel
    pixel_px: np.ndarray
    pan_rad: float
    tilt_rad: float
    target_in_rover_m: np.ndarray


@dataclass(frozen=True)
class SolvedCase:
    """What became of a case: its solutions, or the refusal, and whether the generating one is there."""

    case: MastCase
    solutions: list[Solution]
    refused: str
    found: bool
    worst_px: float


def rover_from_head(mast: Mast, pan_rad: float, tilt_rad: float, points_m: np.ndarray) -> np.ndarray:
    """Return a head-frame point in the rover frame, by SciPy's rotations."""
    tilted = Rotation.from_rotvec([0.0, tilt_rad, 0.0]).apply(points_m)
    twisted = Rotation.from_rotvec([mast.axis_twist_rad, 0.0, 0.0]).apply(tilted)
    offset = np.array([mast.axis_offset_m, 0.0, 0.0])
    in_mast = Rotation.from_rotvec([0.0, 0.0, pan_rad]).apply(twisted + offset)
    return Rotation.from_euler("XYZ", mast.rotation_rad).apply(in_mast) + mast.translation_m


def head_from_rover(mast: Mast, pan_rad: float, tilt_rad: float, point_m: np.ndarray) -> np.ndarray:
    """Return a rover-frame point in the head frame, by SciPy's rotations."""
    in_mast = Rotation.from_euler("XYZ", mast.rotation_rad).inv().apply(point_m - mast.translation_m)
    in_arm = Rotation.from_rotvec([0.0, 0.0, -pan_rad]).apply(in_mast) - [mast.axis_offset_m, 0.0, 0.0]
    turned = Rotation.from_rotvec([-mast.axis_twist_rad, 0.0, 0.0]).apply(in_arm)
    return Rotation.from_rotvec([0.0, -tilt_rad, 0.0]).apply(turned)


def random_mast(rng: np.random.Generator, skew: bool) -> Mast:
    """Return a mast; a skew one has a = 1 µm to 0.3 m and k = 1e-6 to 1.2 rad, of either sign."""
    offset = twist = 0.0
    if skew:
        offset = 10.0 ** rng.uniform(-6.0, np.log10(0.3)) * rng.choice([-1.0, 1.0])
        twist = 10.0 ** rng.uniform(-6.0, np.log10(1.2)) * rng.choice([-1.0, 1.0])
    return Mast(rng.normal(size=3), rng.normal(size=3) * 0.1, float(offset), float(twist))


def random_camera(rng: np.random.Generator, kind: str) -> CameraModel:
    """Return a head camera with lens distortion, skewed H and V and an off-centre principal point."""
    width, height = ((1024, 768), (640, 480), (1024, 1024))[rng.integers(3)]
    cahvore_type = int(rng.integers(1, 4)) if kind == "CAHVORE" else 0
    wide = cahvore_type >= 2
    focal = width * (rng.uniform(0.45, 1.0) if wide else rng.uniform(0.7, 3.5))
    # One camera in five looks anywhere; the rest look ahead within some 20 degrees.
    anywhere = rng.random() < 0.2
    turn = Rotation.random(random_state=rng) if anywhere else Rotation.from_rotvec(rng.normal(size=3) * 0.15)
    forward, right, down = turn.as_matrix().T
    lens_axis = forward + 0.01 * rng.normal() * right + 0.01 * rng.normal() * down
    return CameraModel(
        kind,  # type: ignore[arg-type]
        (width, height),
        C=rng.uniform(-0.3, 0.3, 3),
        A=forward,
        H=focal * (right + rng.normal() * 2e-3 * down) + ((width - 1) / 2 + rng.normal() * 10) * forward,
        V=focal * rng.uniform(0.98, 1.02) * down + ((height - 1) / 2 + rng.normal() * 10) * forward,
        O=lens_axis / np.linalg.norm(lens_axis),
        R=rng.normal(size=3) * [5e-4, 0.02, 0.005],
        E=rng.normal(size=3) * [5e-3, 1e-3, 1e-4],
        cahvore_type=cahvore_type,
        linearity=float(rng.uniform(0.2, 0.9)) if cahvore_type == 3 else 1.0,
    )


def random_case(rng: np.random.Generator, number: int) -> MastCase:
    """Return case ``number``: every second mast is skew, the three camera models take turns."""
    mast = random_mast(rng, skew=number % 2 == 1)
    while True:
        camera = random_camera(rng, ("CAHV", "CAHVOR", "CAHVORE")[number % 3])
        pixel = rng.uniform([-0.5, -0.5], np.array(camera.size_px) - 0.5)
        rays = camera.ray(pixel)
        if rays.valid:
            break
    pan, tilt = rng.uniform(-np.pi, np.pi, 2)
    if number % 4 < 2:
        tilt *= 0.4
    range_m = 10.0 ** rng.uniform(np.log10(0.5), 2.0)
    target = rover_from_head(mast, pan, tilt, rays.origins_m + range_m * rays.directions)
    return MastCase(mast, camera, pixel, float(pan), float(tilt), target)


def run_case(case: MastCase) -> SolvedCase:
    """Return what the solver makes of one case."""
    try:
        solutions = solve(case.mast, case.camera, case.target_in_rover_m, case.pixel_px)
    except Unreachable as why:
        return SolvedCase(case, [], str(why), False, np.inf)
    wanted = np.array([case.pan_rad, case.tilt_rad])
    joints = np.array([[one.pan_rad, one.tilt_rad] for one in solutions])
    misses = np.abs(np.angle(np.exp(1j * (joints - wanted)))).max(axis=1)
    in_head = [head_from_rover(case.mast, pan, tilt, case.target_in_rover_m) for pan, tilt in joints]
    pixels, valid = case.camera.project(np.array(in_head))
    errors = np.where(valid, np.abs(pixels - case.pixel_px).max(axis=1), np.inf)
    return SolvedCase(case, solutions, "", bool(misses.min() <= SAME_RAD), float(errors.max()))
