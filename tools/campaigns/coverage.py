"""Fit many simulated surveys and count how often stated intervals hold the truth.

    .venv/bin/python -m tools.campaigns.coverage --cases 400 --seed 1
    .venv/bin/python -m tools.campaigns.coverage --cases 100 --seed 1 --method paper
    .venv/bin/python -m tools.campaigns.coverage --cases 100 --seed 1 --mast 8
    .venv/bin/python -m tools.campaigns.coverage --cases 200 --seed 1 --gross 0.05

Surveys are simulated (`tools.sim_survey.survey`). Prints, over the surveys, how often the 95 % interval of
each mast parameter and of predicted pixels (points at 2 to 10 m, three directions, every camera) holds the
truth, both pooled, and how the weighted sum of squares compares with its chi-square.

Errors of one survey go together (a shift of the mast is seen by all its pixels), so a pooled rate scatters
far more than so many independent intervals would: behind ± stands its standard error, from the scatter of
whole surveys. ``--mast 8`` gives the true mast skew axes (10 mm apart, 5 mrad of twist).

``--gross PART`` throws so many of each image's dots anywhere in the image and one tape 5 cm aside; every
other survey has a board of 25 dots where the others have 100. It prints besides how many of these errors were
named, and the errors of predicted pixels over those of the same surveys without them.
"""

from __future__ import annotations

import time
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.stats import chi2, kstest

from calib.adjust.result import Calibration
from calib.adjust.uncertainty import pixel_covariance
from calib.errors import CalibError
from calib.files.mast_file import load_rig
from calib.geometry.rig import MAST_NAMES, Rig
from calib.geometry.rigid import rigid_rates
from calib.survey.records import Sigma, Survey
from mastctl.calibration.run import FITS, Method
from mastctl.cli.output import not_negative
from mastctl.packaged import config_folder
from tools.command import end, held_percent, options, rms, run_cases
from tools.sim_survey.blunders import with_fewer_dots, with_moved_tape, with_scattered_dots
from tools.sim_survey.plan import SurveyPlan, SurveyTruth
from tools.sim_survey.survey import simulate_survey

DIRECTIONS_RAD = ((-0.8, -0.2), (0.0, -0.4), (0.7, -0.7))
RANGES_M = (2.0, 6.0, 10.0)
PLACES = ((0.5, 0.5), (0.2, 0.7))
"""Where points are seen, as parts of the picture's width and height."""

LEVEL = 0.95
Z = 1.959964
TAPE_ASIDE_M = 0.05
SKEW = {"axis_offset_m": 0.010, "axis_twist_rad": 0.005}


class Gross(NamedTuple):
    """What came of gross errors: how many there were, which were not named, and what else was; squares of the
    predicted pixels' errors (mean over all of them) with and without the gross ones."""

    count: int
    unnamed: tuple[str, ...]
    besides: int
    square_px2: float
    clean_px2: float


class SurveyScore(NamedTuple):
    """Errors over their sigmas: of the mast's parameters and of pixels by camera; the mast's squared distance
    from the truth by its whole covariance; what errors would be from prisms alone; chi-square; left out."""

    mast: dict[str, float]
    mast_distance: float
    prisms_alone: np.ndarray
    pixels: dict[str, np.ndarray]
    probability: float
    reduced: float
    outliers: tuple[str, ...]
    seconds: float
    gross: Gross | None


class CoverageTask(NamedTuple):
    """One survey of a true rig."""

    true: Rig
    seed: int
    plan: SurveyPlan
    method: Method
    mast_parameters: int
    gross_part: float


def score(task: CoverageTask) -> SurveyScore | str:
    """Return how far one survey's fit is from the truth, in its own sigmas, or why there is none."""
    true = task.true
    survey, of_truth = simulate_survey(true, task.seed, task.plan)
    gross, clean_px2 = frozenset[str](), float("nan")
    try:
        if task.gross_part:
            survey = with_fewer_dots(survey, 1 + task.seed % 2)
            clean_px2 = _square_px2(true, FITS[task.method](survey, task.mast_parameters))
            survey, gross = with_gross_errors(survey, task.gross_part, np.random.default_rng([task.seed, 11]))
        fit = FITS[task.method](survey, task.mast_parameters)
    except CalibError as refused:
        return f"seed {task.seed}: {refused}"
    m = true.mast
    numbers = [*m.translation_m, *m.rotation_rad, m.axis_offset_m, m.axis_twist_rad]
    truth = {f"mast.{n}": v for n, v in zip(MAST_NAMES, numbers, strict=True)}
    at = [i for i, name in enumerate(fit.parameter_names) if name in truth]
    error = np.array([fit.estimate[i] - truth[fit.parameter_names[i]] for i in at])
    covariance = fit.covariance[np.ix_(at, at)]
    in_sigmas = error / np.sqrt(np.diag(covariance))
    named = {outlier.name for outlier in fit.outliers}
    unnamed, besides = tuple(sorted(gross - named)), len(named - gross)
    return SurveyScore(
        {fit.parameter_names[i]: float(e) for i, e in zip(at, in_sigmas, strict=True)},
        float(error @ np.linalg.solve(covariance, error)),
        _prisms_alone(true, survey, of_truth),
        {name: _pixel_errors(true, name, fit)[0] for name in true.cameras},
        fit.chi2_probability,
        fit.chi2 / fit.degrees_of_freedom,
        tuple(outlier.name for outlier in fit.outliers),
        fit.seconds,
        Gross(len(gross), unnamed, besides, _square_px2(true, fit), clean_px2) if gross else None,
    )


def with_gross_errors(survey: Survey, part: float, rng: np.random.Generator) -> tuple[Survey, frozenset[str]]:
    """Return the survey with a part of each image's dots anywhere and a tape 5 cm aside, and their names."""
    wrong = set[str]()
    for image in survey.images:
        count = round(part * len(survey.dots[image.name].rows))
        survey, places = with_scattered_dots(survey, image.name, count, rng)
        wrong |= {f"image {image.name} dot (row {row}, column {column})" for row, column in places}
    tapes = [point for point in survey.station if point.kind == "tape"]
    tape, aside = tapes[rng.integers(len(tapes))], rng.standard_normal(3)
    aside_m = TAPE_ASIDE_M * aside / np.linalg.norm(aside)
    wrong.add(f"tape {tape.point} of placement {tape.placement} (set-up {tape.setup})")
    return with_moved_tape(survey, tape.setup, tape.placement, tape.point, aside_m), frozenset(wrong)


def _prisms_alone(true: Rig, survey: Survey, of_truth: SurveyTruth) -> np.ndarray:
    """Errors (6,) of the mast's place and angles, in sigmas, were nothing off but the set-up's prisms.

    Four points aligned, small angles: a linear problem with equal noise everywhere.
    """
    measured = {p.point: p.position_m for p in survey.station if (p.setup, p.kind) == ("level", "prism")}
    places = np.array([survey.prisms_in_rover_m[name] for name in measured])
    seen = of_truth.rover_from_station["level"].points(np.array(list(measured.values())))
    moves = rigid_rates(np.eye(3)[None], places, np.zeros(3)).reshape(-1, 6)
    error, *_ = np.linalg.lstsq(moves, (seen - places).ravel(), rcond=None)
    sigma = np.hypot(survey.sigma.station_m, survey.sigma.prism_cad_m)
    at_mast = rigid_rates(np.eye(3)[None], np.array(true.mast.translation_m)[None], np.zeros(3))[0]
    carry = np.concatenate([at_mast, np.eye(6)[:3]])
    spread = sigma * np.sqrt(np.diag(carry @ np.linalg.inv(moves.T @ moves) @ carry.T))
    return np.asarray(carry @ error / spread)


def _square_px2(true: Rig, fit: Calibration) -> float:
    """Mean square of predicted less true pixels over all cameras."""
    return float(np.mean([np.mean(_pixel_errors(true, name, fit)[1] ** 2) for name in true.cameras]))


def _pixel_errors(true: Rig, name: str, fit: Calibration) -> tuple[np.ndarray, np.ndarray]:
    """Predicted less true pixels of fixed points of the rover frame, in sigmas and in pixels."""
    errors, off_px = [], []
    on_head = true.cameras[name].on == "head"
    for pan, tilt in DIRECTIONS_RAD if on_head else ((0.0, 0.0),):
        model = true.camera_in_rover(name, pan, tilt)
        rays = model.ray(np.array(PLACES) * model.size_px)
        for range_m in RANGES_M:
            points = rays.origins_m + range_m * rays.directions
            at, _ = model.project(points)
            predicted, covariance = pixel_covariance(fit, name, pan, tilt, points)
            off_px.append(predicted - at)
            errors.append(off_px[-1] / np.sqrt(np.einsum("nii->ni", covariance)))
    return np.concatenate(errors).ravel(), np.concatenate(off_px).ravel()


def main() -> int:
    """Print the table."""
    parser = options(__doc__, 100, "surveys")
    parser.add_argument("--method", choices=sorted(FITS), default="joint")
    parser.add_argument("--mast", type=int, choices=(6, 8), default=6)
    parser.add_argument("--joint-sigma-rad", type=not_negative, default=0.0, help="noise of joint readings")
    parser.add_argument(
        "--prism-cad-sigma-m", type=not_negative, default=0.0, help="noise of the prisms' drawing"
    )
    parser.add_argument("--gross", type=not_negative, default=0.0, help="part of the dots thrown anywhere")
    parser.add_argument("--rig", type=Path, default=config_folder() / "sim" / "rocky8.yaml")
    args = parser.parse_args()
    true = load_rig(args.rig).rig
    if args.mast == 8:
        true = replace(true, mast=replace(true.mast, **SKEW))
    plan = SurveyPlan(sigma=Sigma(0.001, 0.1, args.joint_sigma_rad, args.prism_cad_sigma_m))
    began = time.monotonic()
    tasks = [
        CoverageTask(true, seed, plan, args.method, args.mast, args.gross)
        for seed in range(args.seed, args.seed + args.cases)
    ]
    found = run_cases(args, "surveys", score, tasks, lambda task: f"seed {task.seed}")
    if scores := [one for one in found if isinstance(one, SurveyScore)]:
        report(scores)
    refused = [one for one in found if isinstance(one, str)]
    print("\n".join([f"surveys refused: {len(refused)}", *refused]))
    what = f"{args.cases} surveys from seed {args.seed}, {args.method}, {args.mast} parameters"
    print(f"{what}: {time.monotonic() - began:.0f} s")
    return 0


def report(scores: list[SurveyScore]) -> None:
    """Print the table."""
    mast = np.array([list(s.mast.values()) for s in scores])
    pixels = {n: np.array([s.pixels[n] for s in scores]) for n in scores[0].pixels}
    together = np.concatenate(list(pixels.values()), axis=1)
    print(f"{100 * LEVEL:g} % intervals hold the truth in, %          rms error in sigmas")
    rows = {name: mast[:, [i]] for i, name in enumerate(scores[0].mast)}
    rows["pooled over mast parameters"] = mast
    rows["  prisms alone (exact)"] = np.array([s.prisms_alone for s in scores])
    rows |= {f"pixels of {name}": errors for name, errors in pixels.items()}
    rows["pooled over pixels"] = together
    for name, errors in rows.items():
        rate, error = held_percent([np.abs(one) < Z for one in errors])
        print(f"  {name:30s} {rate:5.1f} ± {error:3.1f}      {rms(errors):.2f}")
    coordinates = [f"{n} {k}" for n, errors in pixels.items() for k in range(errors.shape[1])]
    rates = 100 * np.mean(np.abs(together) < Z, axis=0)
    lowest = int(np.argmin(rates))
    print(f"  least of {len(rates)} single pixel coordinates {rates[lowest]:.1f} ({coordinates[lowest]})")
    count = mast.shape[1]
    distance = np.array([s.mast_distance for s in scores])
    inside = 100 * np.mean(distance < chi2.ppf(LEVEL, count))
    print(
        f"whole mast within its {100 * LEVEL:g} % ellipsoid: {inside:.1f} %; squared distance "
        f"{distance.mean():.2f} on average, {count} expected"
    )
    probabilities = np.array([s.probability for s in scores])
    reduced = np.array([s.reduced for s in scores])
    print(f"chi-square over its degrees of freedom: mean {reduced.mean():.4f}, sd {reduced.std():.4f}")
    if np.isfinite(probabilities).all():
        uniform = kstest(probabilities, "uniform").pvalue
        print(f"its probabilities against uniform (Kolmogorov-Smirnov): p = {uniform:.3f}")
    lost = [s.outliers for s in scores if s.outliers]
    print(f"surveys that lost any measurement: {len(lost)}")
    if gross := [s.gross for s in scores if s.gross]:
        report_gross(gross)
    print(f"fit: {np.mean([s.seconds for s in scores]):.2f} s on average")


def report_gross(gross: list[Gross]) -> None:
    """Print what came of gross errors."""
    count, unnamed = sum(one.count for one in gross), [name for one in gross for name in one.unnamed]
    print(
        f"gross errors named: {count - len(unnamed)} of {count}; left out besides: "
        f"{sum(one.besides for one in gross)}"
    )
    with_px, without_px = (
        float(np.sqrt(np.mean([getattr(one, key) for one in gross]))) for key in ("square_px2", "clean_px2")
    )
    worst = max(np.sqrt(one.square_px2 / one.clean_px2) for one in gross)
    print(
        f"predicted pixels are off by {with_px:.4f} px rms, without gross errors by {without_px:.4f}: "
        f"{with_px / without_px:.3f} times, in the worst survey {worst:.2f} times"
    )
    print("\n".join(f"not named: {name}" for name in unnamed[:20]))


if __name__ == "__main__":
    end(main)
