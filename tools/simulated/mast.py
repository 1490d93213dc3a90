"""Make a mast file for a simulated rover: survey its true rig, calibrate by what was measured.

The true rig is read only to simulate measurements. They are written down as a survey's folder; what
``mastctl calibrate`` does is done with that folder alone, and the mast file is what comes of it. Same
arguments, same file:

    .venv/bin/python -m tools.simulated.mast --rig configs/sim/rocky8.yaml --seed 8 \
        --out configs/masts/rocky8_simulated.yaml

Then it tells what the file costs: where it puts points that the true rig sees, and where targets land.
"""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from calib.errors import Unreachable
from calib.files.mast_file import load_rig, save_rig
from calib.geometry.cahvor import CameraModel
from calib.geometry.pointing import choose, solve
from calib.geometry.rig import Rig
from calib.geometry.rigid import Rigid
from calib.geometry.stereo import triangulate
from calib.survey.reader import read_survey
from calib.survey.records import Sigma
from calib.survey.writer import write_survey
from drivers.clock import ManualClock
from drivers.sim.heads import PRESETS, HeadModel
from drivers.sim.pan_tilt import SimulatedPanTilt
from hil_tests.support.sim_survey.plan import Ring, SurveyPlan
from hil_tests.support.sim_survey.survey import simulate_survey
from mastctl.calibration.run import Calibrated, calibrate, checked_survey
from mastctl.cli.options import at_least
from tools.command import end

SIGMA = Sigma(station_m=0.001, dot_px=0.1, joint_rad=3e-5)
"""The joints' is half a step of the packaged rover's head."""

PANCAM_TILT_RAD, NAVCAM_TILT_RAD = np.radians(-5.0), np.radians(-10.0)
RINGS = (
    Ring("pancam", 4.2, boards=4, head_tilt_rad=PANCAM_TILT_RAD),
    Ring("pancam", 6.0, boards=2, head_tilt_rad=PANCAM_TILT_RAD),
    Ring("pancam", 10.0, boards=2, head_tilt_rad=PANCAM_TILT_RAD),
    Ring("navcam", 1.7, boards=4, head_tilt_rad=NAVCAM_TILT_RAD),
    Ring("navcam", 3.0, boards=2, head_tilt_rad=NAVCAM_TILT_RAD),
    Ring("navcam", 10.0, boards=2, head_tilt_rad=NAVCAM_TILT_RAD),
    Ring("hazcam", 0.8, boards=4, also="navcam"),
    Ring("hazcam", 1.5, boards=2, also="navcam"),
    Ring("hazcam", 3.0, boards=2, also="navcam"),
)
"""Eight placements a pair, from the nearest at which both its cameras see the whole board."""

DISTANCES_M = (10.0, 6.0, 2.0, 1.0)


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--rig", required=True, type=Path, help="the true rig")
    parser.add_argument("--out", required=True, type=Path, help="the mast file to write")
    parser.add_argument("--seed", type=at_least(0), default=1)
    parser.add_argument("--mast", type=int, choices=(6, 8), default=6, help="mast parameters to fit")
    parser.add_argument("--head", choices=sorted(PRESETS), default="ptu_d46_70")
    parser.add_argument(
        "--targets", type=at_least(1), default=200, help="targets a distance for the pointing error"
    )
    options = parser.parse_args()
    true_rig = load_rig(options.rig)
    done = survey_and_calibrate(true_rig.rig, options.seed, options.mast)
    provenance = _provenance(options, true_rig.digest, done)
    name = options.out.stem
    save_rig(replace(done.saved.rig, name=name, provenance=provenance), options.out)
    stored = load_rig(options.out).rig
    print(f"wrote {options.out}: {len(done.survey.images)} images, {done.verdict.advice}")
    tell_projection(true_rig.rig, stored)
    tell_pointing(true_rig.rig, stored, options)
    return 0


def survey_and_calibrate(true: Rig, seed: int, mast_parameters: int) -> Calibrated:
    """Survey a true rig, and calibrate by the folder that the survey leaves."""
    survey, _ = simulate_survey(true, seed, SurveyPlan(rings=RINGS, sigma=SIGMA))
    nameless = tuple(replace(image, file=Path()) for image in survey.images)
    with tempfile.TemporaryDirectory() as folder:
        write_survey(replace(survey, images=nameless), Path(folder) / "survey")
        measured = read_survey(Path(folder) / "survey")
        warnings = checked_survey(measured)
        return calibrate(measured, Path(folder) / "mast.yaml", "joint", mast_parameters, warnings)


def tell_projection(true: Rig, believed: Rig) -> None:
    """Print by how many pixels points are put elsewhere; the rover frames as they are, and laid together."""
    together = turned_rover_frame(true, believed, DISTANCES_M)
    for what, rig in (("rover frame as surveyed", true), ("rover frames laid together", together)):
        print(f"projection error, {what}, rms px an axis (worst, its length):")
        for distance_m in DISTANCES_M:
            errors = {name: projection_error_px(rig, believed, name, distance_m) for name in true.cameras}
            words = ", ".join(
                f"{name} {np.sqrt(np.mean(off**2)):.2f} ({np.linalg.norm(off, axis=1).max():.2f})"
                for name, off in errors.items()
            )
            print(f"  {distance_m:2.0f} m: {words}")


def tell_pointing(true: Rig, believed: Rig, options: argparse.Namespace) -> None:
    """Print where targets land after one pointing by the mast file."""
    print(f"pointing error with {options.head}, {options.targets} targets a row, rms (mean):")
    for pair in ("navcam", "pancam"):
        for click_px in (0.0, 0.2):
            for distance_m in (10.0, 6.0, 2.0):
                case = (pair, distance_m, options.targets, options.seed, click_px)
                errors = pointing_error_px(true, believed, PRESETS[options.head], *case)
                (x, y), (mean_x, mean_y) = np.sqrt((errors**2).mean(0)), errors.mean(0)
                print(
                    f"  {pair}, clicks {click_px:.1f} px, {distance_m:2.0f} m: x {x:.3f} ({mean_x:+.3f}), "
                    f"y {y:.3f} ({mean_y:+.3f}), worst {np.abs(errors).max():.2f} px"
                )


def _provenance(options: argparse.Namespace, digest: str, done: Calibrated) -> dict[str, object]:
    """The ``provenance`` section of the mast file."""
    command = (
        f"python -m tools.simulated.mast --rig {options.rig.as_posix()} --seed {options.seed} "
        f"--mast {options.mast} --head {options.head} --out {options.out.as_posix()}"
    )
    return {
        "kind": "calibration of the simulated rover from a simulated survey",
        "command": command,
        "seed": options.seed,
        "true_rig_digest": digest,
        "survey_digest": done.survey.digest,
        "station_sigma_m": SIGMA.station_m,
        "dot_sigma_px": SIGMA.dot_px,
        "joint_sigma_rad": SIGMA.joint_rad,
    }


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


def pointing_error_px(
    truth: Rig,
    belief: Rig,
    head: HeadModel,
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
        one, other = (belief.camera_in_rover(n, *measured) for n in (left, right))
        found = triangulate(one, other, left_px, right_px)
        aim = choose(solve(belief.mast, believed, found.position_m), PAN_LIMITS_RAD, TILT_LIMITS_RAD)
        _, true = go(aim.pan_rad, aim.tilt_rad)
        landed, _ = truth.camera_in_rover(left, *true).project(target[None])
        errors.append(landed[0] - centre)
    return np.array(errors)


if __name__ == "__main__":
    end(main)
