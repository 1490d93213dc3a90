"""Make a mast file for a simulated rover: survey its true rig, calibrate by what was measured.

The true rig is read only to simulate measurements. They are written down as a survey's folder; what
``mastctl calibrate`` does is done with that folder alone, and the mast file is what comes of it. Same
arguments, same file:

    .venv/bin/python -m tools.simulated.mast --rig configs/sim/rocky8.yaml --seed 8 \\
        --out configs/masts/rocky8_simulated.yaml

Then it tells what the file costs: where it puts points that the true rig sees, and where targets land.
"""

from __future__ import annotations

import argparse
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np

from calib.files.mast_file import load_rig, save_rig
from calib.geometry.rig import Rig
from calib.survey.reader import read_survey
from calib.survey.records import Sigma
from calib.survey.writer import write_survey
from drivers.sim.heads import PRESETS
from mastctl.calibration.run import Calibrated, calibrate, checked_survey
from mastctl.cli.output import at_least
from tools.arguments import end
from tools.sim_survey.survey import Ring, SurveyPlan, simulate_survey
from tools.simulated.check import (
    hazcam_range_error_m,
    pointing_error_px,
    projection_error_px,
    turned_rover_frame,
)

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
    print(f"wrote {options.out}: {len(done.survey.images)} images, {done.verdict.words}")
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
    if "hazcam" in true.stereo:
        off_mm = 1000 * hazcam_range_error_m(true, believed, 1.0)
        print(
            f"range by the Hazcams at 1 m: rms {np.sqrt(np.mean(off_mm**2)):.2f} mm, worst "
            f"{np.abs(off_mm).max():.2f} mm"
        )


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


if __name__ == "__main__":
    end(main)
