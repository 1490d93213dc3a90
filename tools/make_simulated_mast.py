"""Make a mast file for a simulated rover: its true rig passed through the errors that a survey leaves.

The true rig is read only to simulate measurements. Same arguments, same file:

    .venv/bin/python tools/make_simulated_mast.py --rig configs/sim/rocky8.yaml --seed 8 \\
        --out configs/masts/rocky8_simulated.yaml
"""

from __future__ import annotations

import argparse
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parent))

from simulated_mast.check import pointing_error_px
from simulated_mast.fit import Fitted, fit
from simulated_mast.survey import Sigmas, measure

from calib.errors import BadFile
from calib.store import load_rig, save_rig
from drivers.sim.pan_tilt import PRESETS


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--rig", required=True, type=Path, help="the true rig")
    parser.add_argument("--out", required=True, type=Path, help="the mast file to write")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--mast", type=int, choices=(6, 8), default=6, help="mast parameters to fit")
    parser.add_argument("--head", choices=sorted(PRESETS), default="ptu_d46_70")
    parser.add_argument("--targets", type=int, default=200, help="targets a distance for the pointing error")
    options = parser.parse_args()
    try:
        true_rig = load_rig(options.rig)
    except BadFile as error:
        print(error, file=sys.stderr)
        return 2
    started_s = time.monotonic()
    sigmas = Sigmas()
    survey = measure(true_rig.rig, PRESETS[options.head], sigmas, np.random.default_rng(options.seed))
    images = {name: sum(image.camera == name for image in survey.images) for name in true_rig.rig.cameras}
    name = options.out.stem
    fitted = fit(survey, name, dict(true_rig.rig.stereo), sigmas, options.mast)
    print(
        f"survey: {len(survey.tapes_m)} boards, {images} images; fit in {time.monotonic() - started_s:.0f} s"
    )
    for step, rms_px in (("camera", fitted.camera_rms_px), ("mast", fitted.mast_rms_px)):
        for camera, (x_px, y_px) in rms_px.items():
            print(f"  {step} step, {camera:13s} residual rms {x_px:.3f} {y_px:.3f} px")
    rig = replace(fitted.rig, fit=_fit_record(fitted), provenance=_provenance(options, true_rig.digest))
    save_rig(rig, options.out)
    stored = load_rig(options.out).rig
    print(f"wrote {options.out}")
    print(f"pointing error with {options.head}, {options.targets} targets a row, rms (mean):")
    for pair in ("navcam", "pancam"):
        for click_px in (0.0, 0.2):
            for distance_m in (10.0, 6.0, 2.0):
                case = (pair, distance_m, options.targets, options.seed, click_px)
                errors = pointing_error_px(true_rig.rig, stored, PRESETS[options.head], *case)
                (x, y), (mean_x, mean_y) = np.sqrt((errors**2).mean(0)), errors.mean(0)
                print(
                    f"  {pair}, clicks {click_px:.1f} px, {distance_m:2.0f} m: x {x:.3f} ({mean_x:+.3f}), "
                    f"y {y:.3f} ({mean_y:+.3f}), worst {np.abs(errors).max():.2f} px"
                )
    return 0


def _fit_record(fitted: Fitted) -> dict[str, object]:
    """The ``fit`` section of the mast file."""
    steps = {"camera_rms_px": fitted.camera_rms_px, "mast_rms_px": fitted.mast_rms_px}
    return {
        step: {camera: [round(x, 4), round(y, 4)] for camera, (x, y) in rms_px.items()}
        for step, rms_px in steps.items()
    }


def _provenance(options: argparse.Namespace, digest: str) -> dict[str, object]:
    """The ``provenance`` section of the mast file."""
    command = (
        f"tools/make_simulated_mast.py --rig {options.rig.as_posix()} --seed {options.seed} "
        f"--mast {options.mast} --head {options.head} --out {options.out.as_posix()}"
    )
    return {
        "kind": "calibration of the simulated rover from a simulated survey",
        "command": command,
        "seed": options.seed,
        "true_rig_digest": digest,
        "station_sigma_m": Sigmas().station_m,
        "dot_sigma_px": Sigmas().dot_px,
    }


if __name__ == "__main__":
    sys.exit(main())
