"""Fit many simulated surveys and count how often stated intervals hold the truth.

    .venv/bin/python tools/calibration_coverage.py --surveys 100 --seed 1

Prints, over the surveys, how often the 95 % interval of each mast parameter and of predicted pixels
(points at 2 to 10 m, three directions, every camera) holds the truth, both pooled, and how the weighted sum
of squares compares with its chi-square.
"""

from __future__ import annotations

import argparse
import sys
import time
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.stats import kstest

sys.path.insert(0, str(Path(__file__).resolve().parent.parent / "hil_tests" / "calib"))

from made_survey import make_survey

from calib.adjustment import MAST_NAMES
from calib.fit_joint import fit_joint
from calib.mast import Rig
from calib.store import load_rig
from calib.uncertainty import pixel_covariance

DIRECTIONS_RAD = ((-0.8, -0.2), (0.0, -0.4), (0.7, -0.7))
RANGES_M = (2.0, 6.0, 10.0)
Z_95 = 1.959964


class Score(NamedTuple):
    """Errors over their sigmas: of the mast's parameters and of pixels by camera; chi-square; outliers."""

    mast: dict[str, float]
    pixels: dict[str, np.ndarray]
    probability: float
    reduced: float
    outliers: int
    seconds: float


def score(path: Path, seed: int, mast_parameters: int) -> Score:
    """Return how far one survey's fit is from the truth, in its own sigmas."""
    true = load_rig(path).rig
    fit = fit_joint(make_survey(true, seed), mast_parameters)
    m = true.mast
    numbers = [*m.translation_m, *m.rotation_rad, m.axis_offset_m, m.axis_twist_rad]
    truth = {f"mast.{n}": v for n, v in zip(MAST_NAMES, numbers, strict=True)}
    sigma = np.sqrt(np.diag(fit.covariance))
    mast = {
        name: float((fit.estimate[i] - truth[name]) / sigma[i])
        for i, name in enumerate(fit.parameter_names)
        if name in truth
    }
    pixels = {name: _pixel_errors(true, name, fit) for name in true.cameras}
    return Score(
        mast,
        pixels,
        fit.chi2_probability,
        fit.chi2 / fit.degrees_of_freedom,
        len(fit.outliers),
        fit.seconds,
    )


def _pixel_errors(true: Rig, name: str, fit) -> np.ndarray:  # type: ignore[no-untyped-def]
    """Predicted less true pixels of fixed points of the rover frame, in sigmas."""
    errors = []
    on_head = true.cameras[name].on == "head"
    for pan, tilt in DIRECTIONS_RAD if on_head else ((0.0, 0.0),):
        model = true.camera_in_rover(name, pan, tilt)
        width, height = model.size_px
        for range_m in RANGES_M:
            rays = model.ray(np.array([(0.5 * width, 0.5 * height), (0.2 * width, 0.7 * height)]))
            points = rays.origins_m + range_m * rays.directions
            at, _ = model.project(points)
            predicted, covariance = pixel_covariance(fit, name, pan, tilt, points)
            errors.append((predicted - at) / np.sqrt(np.einsum("nii->ni", covariance)))
    return np.concatenate(errors).ravel()


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--surveys", type=int, default=100)
    parser.add_argument("--seed", type=int, default=1, help="of the first survey; the others follow")
    parser.add_argument("--mast", type=int, choices=(6, 8), default=6)
    parser.add_argument("--workers", type=int, default=2)
    root = Path(__file__).resolve().parent.parent
    parser.add_argument("--rig", type=Path, default=root / "configs" / "sim" / "rocky8.yaml")
    options = parser.parse_args()
    seeds = range(options.seed, options.seed + options.surveys)
    began = time.monotonic()
    with ProcessPoolExecutor(options.workers) as pool:
        count = options.surveys
        scores = list(pool.map(score, [options.rig] * count, seeds, [options.mast] * count))
    report(scores)
    print(f"{count} surveys from seed {options.seed} in {time.monotonic() - began:.0f} s")
    return 0


def report(scores: list[Score]) -> None:
    """Print the table."""
    print("95 % intervals hold the truth in, %   (rms error in sigmas)")
    mast = {n: np.array([s.mast[n] for s in scores]) for n in scores[0].mast}
    pixels = {n: np.array([s.pixels[n] for s in scores]) for n in scores[0].pixels}
    for name, errors in (*mast.items(), *((f"pixels of {n}", e) for n, e in pixels.items())):
        print(f"  {name:28s} {_held(errors):5.1f}   ({np.sqrt(np.mean(errors**2)):.2f})")
    print(f"  pooled over mast parameters  {_held(np.concatenate(list(mast.values()))):5.1f}")
    print(
        f"  pooled over pixels           {_held(np.concatenate([e.ravel() for e in pixels.values()])):5.1f}"
    )
    each = {f"{n} {k}": _held(e[:, k]) for n, e in pixels.items() for k in range(e.shape[1])}
    lowest = min(each, key=lambda n: each[n])
    print(f"  least of {len(each)} single pixel coordinates {each[lowest]:.1f} ({lowest})")
    probabilities = [s.probability for s in scores]
    reduced = np.array([s.reduced for s in scores])
    test = kstest(probabilities, "uniform")
    print(f"chi-square over its degrees of freedom: mean {reduced.mean():.4f}, sd {reduced.std():.4f}")
    print(f"its probabilities against uniform (Kolmogorov-Smirnov): p = {test.pvalue:.3f}")
    print(f"surveys that lost any measurement: {sum(s.outliers > 0 for s in scores)}")
    print(f"fit: {np.mean([s.seconds for s in scores]):.2f} s on average")


def _held(errors: np.ndarray) -> float:
    """Part of errors within the 95 % interval, per cent."""
    return float(100 * np.mean(np.abs(errors) < Z_95))


if __name__ == "__main__":
    sys.exit(main())
