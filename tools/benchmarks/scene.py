"""Time what `mastctl calibrate MAST --refine-scene` does with rendered pictures: seconds of processor time.

    OMP_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1 .venv/bin/python -m tools.benchmarks.scene [--pictures 36]

Two Navcams (1024 x 768) look round in rows; the left one is turned by 2 mrad, the joints repeat to 0.1 mrad.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import TypeVar

import cv2
import numpy as np

from calib.calibrate.scene.features import find_features
from calib.calibrate.scene.fit import fit_scene
from calib.calibrate.scene.terms import corrected
from mastctl.cli.output import at_least
from tools.campaigns.scene import navcams, pictures, rests
from tools.command import end, options

REPEAT_RAD = 1e-4
TURN = (["cameras.navcam_left.turn.y", "cameras.navcam_left.turn.z"], np.array([1.5e-3, -1.3e-3]))

Result = TypeVar("Result")


def main() -> int:
    parser = options(__doc__, seed=None, tasks=False)
    parser.add_argument("--pictures", type=at_least(8), default=36)
    args = parser.parse_args()
    cv2.setNumThreads(1)
    rows = 2 if args.pictures < 60 else 4
    looked = rests(rows, max(2, round(args.pictures / 2 / rows)), 4.8 if rows == 2 else 5.8)
    rng = np.random.default_rng(1)
    errs = rng.normal(0.0, REPEAT_RAD, (len(looked), 2))
    believed = navcams()
    views = list(
        pictures(
            corrected(believed, *TURN),
            looked,
            lambda pose, rest: (rest[0] + errs[pose, 0], rest[1] + errs[pose, 1]),
            seed=1,
        )
    )
    print(f"{len(views)} pictures of {len(looked)} rests", flush=True)
    features, took = timed(lambda: find_features(believed, views))
    sights = sum(len(feature.views) for feature in features)
    print(f"features: {len(features)}, {sights} times seen, {took:.1f} s of processor time", flush=True)
    fit, took = timed(lambda: fit_scene(believed, views, features))
    print(f"fit: {took:.1f} s; {fit.rms_px[0]:.2f} px become {fit.rms_px[-1]:.2f} px; {', '.join(fit.taken)}")
    for name, value, sigma in zip(fit.names, fit.values, np.sqrt(np.diag(fit.covariance)), strict=True):
        print(f"  {name} {1e3 * value:+.3f} +- {1e3 * sigma:.3f} (10^-3)")
    return 0


def timed(work: Callable[[], Result]) -> tuple[Result, float]:
    began = time.process_time()
    result = work()
    return result, time.process_time() - began


if __name__ == "__main__":
    end(main)
