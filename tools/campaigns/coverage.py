"""Fit many simulated surveys or benches and count how often stated intervals hold the truth.

    .venv/bin/python -m tools.campaigns.coverage survey --cases 400 --seed 1 [--method paper] [--mast 8]
    .venv/bin/python -m tools.campaigns.coverage survey --cases 200 --gross 0.05
    .venv/bin/python -m tools.campaigns.coverage bench --cases 200 [--head servo]
    .venv/bin/python -m tools.campaigns.coverage bench --cases 100 --head driven --attitudes 8 --checks 3

Noise of dots and corners is the stated one or larger, by camera and by picture. Printed is how often the 95 %
interval of each parameter and of predicted pixels (points at 2 to 10 m, three directions, every camera) holds
the truth, and how the weighted sum of squares compares with its chi-square. Errors of one case go together (a
shift of the mast is seen by all its pixels), so a pooled rate scatters far more than so many independent
intervals would: behind ± stands its standard error, from the scatter of whole cases.

Surveys: ``--mast 8`` gives the true mast skew axes (10 mm apart, 5 mrad of twist). ``--gross PART`` throws so
many of each image's dots anywhere and one tape 5 cm aside; it prints besides how many of these errors were
named, and the errors of predicted pixels over those of the same surveys without them.

Benches: a Navcam pair and an A2 board at three placements. ``--head ptu`` reads true but for counts of 0.05
mrad. ``servo`` has 4096 counts a turn, harmonics of 6 and 2 mrad, 4 mrad of backlash and a board bent by
1 mm. ``driven`` has two placements, corners of 0.01 px, counts of 0.05 mrad, harmonics of 5 and 3.5 mrad, 4
mrad of backlash, and axes that pass each other by up to 20 mm and are skew by up to 10 mrad. Printed besides
is how far first pointings land from targets at 10, 6 and 2 m that were clicked without noise, with the fitted
file, with one fitted without joints' errors, and with the truth for a file: what counts alone allow; and with
``--checks`` how often the check pictures of a camera are called bad.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from scipy.stats import chi2

from calib.adjust.result import BenchCalibration, Calibration
from calib.adjust.uncertainty import pixel_covariance
from calib.calibrate.bench import fit_bench
from calib.errors import CalibError
from calib.files.mast_file import load_rig
from calib.geometry.cahvor import CameraModel
from calib.geometry.covariance import pixel_rates
from calib.geometry.pointing import solve
from calib.geometry.rig import JOINTS_NAMES, MAST_NAMES, Mast, Rig, joint_numbers_of, numbers_of
from calib.geometry.rigid import rigid_rates, tangents
from calib.geometry.stereo import triangulate
from calib.survey.records import Sigma, Survey
from hil_tests.support.sim_survey.bench import BenchPlan, Placement, simulate_bench
from hil_tests.support.sim_survey.blunders import with_fewer_dots, with_moved_tape, with_scattered_dots
from hil_tests.support.sim_survey.noise import with_uneven_noise
from hil_tests.support.sim_survey.plan import SurveyPlan, SurveyTruth
from hil_tests.support.sim_survey.survey import simulate_survey
from mastctl.calibration.run import FITS, Method
from mastctl.cli.options import at_least, not_negative
from mastctl.packaged import config_folder
from tools.command import end, held_percent, options, results_of, rms

Z = 1.959964
"""95 % of a normal distribution lie within so many sigmas."""

LOWEST = 88.0
"""Rates below are marked."""

RANGES_M = (2.0, 6.0, 10.0)
PLACES = ((0.5, 0.5), (0.2, 0.7))
"""Where points are seen, as parts of the picture's width and height."""

SURVEY_RAD = ((-0.8, -0.2), (0.0, -0.4), (0.7, -0.7))
BENCH_RAD = ((-0.7, -0.3), (0.1, -0.4), (0.8, 0.0))
"""Pan and tilt where pixels are predicted: within what the placements cover."""

TAPE_ASIDE_M = 0.05
SKEW_M, SKEW_RAD = 0.010, 0.005
PLACEMENTS = (
    Placement(0.9, 0.1, -0.45, (0.5, 0.1, 0.1)),
    Placement(1.7, -0.9, -0.1, (-0.3, 0.5, 0.0)),
    Placement(2.6, 0.8, 0.05, (0.2, -0.4, 0.05)),
)
SERVO_RAD = 2 * np.pi / 4096
HEADS = {
    "ptu": BenchPlan(placements=PLACEMENTS, gross=0.005, count_rad=5e-5),
    "servo": BenchPlan(
        placements=PLACEMENTS, gross=0.005, count_rad=SERVO_RAD, backlash_rad=0.004, bow_m=(0.001, -0.0005)
    ),
    "driven": BenchPlan(placements=PLACEMENTS[:2], own_px=0.01, count_rad=5e-5, backlash_rad=0.004),
}
HARMONICS_RAD = {"ptu": (), "servo": (0.006, 0.002), "driven": (0.005, 0.0035)}
"""Amplitudes of the harmonics of either joint; where their waves begin is drawn for each bench."""

BENCH_SKEW = {"driven": (0.02, 0.01)}
"""Most that the axes pass each other by, metres, and are off a right angle, radians."""

TARGETS = 12
"""Pointings at each range."""


class Gross(NamedTuple):
    """What came of gross errors: how many, how many of them were not named, and what else was; squares of the
    predicted pixels' errors with and without the gross ones."""

    errors: int
    unnamed: int
    besides: int
    square_px2: float
    clean_px2: float


class Score(NamedTuple):
    """Errors in sigmas, of parameters and pixels by camera; chi-square per degree of freedom; seconds.

    Of a survey the squared distance of the mast from the truth, errors from prisms alone, and gross
    errors; of a bench how far pointings land (2 files, ranges, targets, 2), pictures and those left out, and
    whether each camera's check pictures are bad."""

    parameters: dict[str, float]
    pixels: dict[str, np.ndarray]
    reduced: float
    seconds: float
    mast_distance: float = np.nan
    prisms_alone: np.ndarray | None = None
    gross: Gross | None = None
    landed_px: np.ndarray | None = None
    pictures: tuple[int, int] = (0, 0)
    checks: tuple[bool, ...] = ()


class SurveyTask(NamedTuple):
    """One survey of a true rig."""

    true: Rig
    seed: int
    plan: SurveyPlan
    method: Method
    mast_parameters: int
    gross_part: float


class BenchTask(NamedTuple):
    """One bench."""

    plan: BenchPlan
    seed: int


def survey_score(task: SurveyTask) -> Score | str:
    """Return how far one survey's fit is from the truth, in its own sigmas, or why there is none."""
    true = task.true
    survey, of_truth = simulate_survey(true, task.seed, task.plan)
    survey = with_uneven_noise(survey, task.seed)
    wrong, clean_px2 = frozenset[str](), np.nan
    try:
        if task.gross_part:
            survey = with_fewer_dots(survey, 1 + task.seed % 2)
            clean_px2 = square_px2(true, FITS[task.method](survey, task.mast_parameters))
            survey, wrong = with_gross_errors(survey, task.gross_part, np.random.default_rng([task.seed, 11]))
        fit = FITS[task.method](survey, task.mast_parameters)
    except CalibError as refused:
        return f"seed {task.seed}: {refused}"
    truth = dict(zip((f"mast.{name}" for name in MAST_NAMES), numbers_of(true.mast), strict=True))
    at = [i for i, name in enumerate(fit.parameter_names) if name in truth]
    error = np.array([fit.estimate[i] - truth[fit.parameter_names[i]] for i in at])
    covariance = fit.covariance[np.ix_(at, at)]
    named = {outlier.name for outlier in fit.outliers}
    gross = Gross(len(wrong), len(wrong - named), len(named - wrong), square_px2(true, fit), clean_px2)
    in_sigmas = (error / np.sqrt(np.diag(covariance))).tolist()
    return Score(
        dict(zip((fit.parameter_names[i] for i in at), in_sigmas, strict=True)),
        {name: survey_pixels(true, name, fit)[0] for name in true.cameras},
        fit.chi2 / fit.degrees_of_freedom,
        fit.seconds,
        float(error @ np.linalg.solve(covariance, error)),
        prisms_alone(true, survey, of_truth),
        gross if wrong else None,
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


def prisms_alone(true: Rig, survey: Survey, of_truth: SurveyTruth) -> np.ndarray:
    """Errors (6,) of the mast's place and angles, in sigmas, if only the set-up's prisms were off.

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


def square_px2(true: Rig, fit: Calibration) -> float:
    """Mean square of predicted less true pixels over all cameras."""
    return float(np.mean([np.mean(survey_pixels(true, name, fit)[1] ** 2) for name in true.cameras]))


def points_seen(model: CameraModel) -> np.ndarray:
    """Points (n, 3), in the camera's frame, that a camera sees at its places and ranges."""
    rays = model.ray(np.array(PLACES) * model.size_px)
    return np.concatenate([rays.origins_m + r * rays.directions for r in RANGES_M])


def survey_pixels(true: Rig, name: str, fit: Calibration) -> tuple[np.ndarray, np.ndarray]:
    """Predicted less true pixels of fixed points of the rover frame, in sigmas and in pixels."""
    errors, off_px = [], []
    for pan, tilt in SURVEY_RAD if true.cameras[name].on == "head" else ((0.0, 0.0),):
        model = true.camera_in_rover(name, pan, tilt)
        points = points_seen(model)
        predicted, covariance = pixel_covariance(fit, name, pan, tilt, points)
        off_px.append(predicted - model.project(points)[0])
        errors.append(off_px[-1] / np.sqrt(np.einsum("nii->ni", covariance)))
    return np.concatenate(errors).ravel(), np.concatenate(off_px).ravel()


def plan_of(head: str, attitudes: int, seed: int, checks: int = 0) -> BenchPlan:
    """Return the plan of one bench."""
    rng = np.random.default_rng([seed, 5])
    pan, tilt = (
        tuple(
            (float(size * np.cos(phase)), float(size * np.sin(phase)))
            for size, phase in zip(HARMONICS_RAD[head], rng.uniform(0, 2 * np.pi, 2), strict=False)
        )
        for _ in range(2)
    )
    skew = (rng.uniform(-1, 1, 2) * BENCH_SKEW.get(head, (0.0, 0.0))).tolist()
    mast = Mast(np.zeros(3), np.zeros(3), *skew)
    plan = replace(HEADS[head], mast=mast, pan_harmonics=pan, tilt_harmonics=tilt)
    return replace(plan, attitudes=attitudes, checks=checks)


def bench_score(task: BenchTask) -> Score | str:
    """Return how far one bench's fit is from the truth, or why there is none."""
    survey = with_uneven_noise(simulate_bench(task.seed, task.plan), task.seed)
    try:
        fit = fit_bench(survey)
    except CalibError as refused:
        return f"seed {task.seed}: {refused}"
    true = task.plan.rig
    landed = [pointings(true, rig, task.plan.count_rad, task.seed) for rig in (fit.rig, true)]
    off = errors_of(true, fit.rig)
    sigmas = np.sqrt(np.diag(fit.covariance))
    return Score(
        {name: off[name] / sigma for name, sigma in zip(fit.parameter_names, sigmas, strict=True)},
        {name: pixel_errors(true, name, fit) for name in true.cameras},
        fit.chi2 / fit.degrees_of_freedom,
        fit.seconds,
        landed_px=np.array(landed),
        pictures=(
            sum(image.purpose != "check" for image in fit.images),
            sum(outlier.kind == "image" for outlier in fit.outliers),
        ),
        checks=tuple(rms(xy) > fit.checks[name].most_px for name, xy in fit.check_rms_px.items()),
    )


def errors_of(true: Rig, found: Rig) -> dict[str, float]:
    """Return how far every parameter of a rig is from the truth, by its name."""
    mast = numbers_of(found.mast) - numbers_of(true.mast)
    joints = joint_numbers_of(found.joints) - joint_numbers_of(true.joints)
    off = dict(zip(("mast.axis_offset_m", "mast.axis_twist_rad"), mast[6:].tolist(), strict=True))
    off |= dict(zip(JOINTS_NAMES, joints.tolist(), strict=True))
    for name, camera in found.cameras.items():
        model, exact = camera.model, true.cameras[name].model
        for letter in "CHV":
            parts = (getattr(model, letter) - getattr(exact, letter)).tolist()
            off |= {f"cameras.{name}.{letter}.{k}": part for k, part in zip("xyz", parts, strict=True)}
        for letter in "AO":
            along = (-tangents(getattr(model, letter)) @ getattr(exact, letter)).tolist()
            off |= {f"cameras.{name}.{letter}.{k}": part for k, part in zip("12", along, strict=True)}
        off |= {f"cameras.{name}.R.{k}": float(model.R[k] - exact.R[k]) for k in (1, 2)}
    return off


def pixel_errors(true: Rig, name: str, fit: BenchCalibration) -> np.ndarray:
    """Return predicted less true pixels of points seen at some readings, in sigmas."""
    errors = []
    for reading in BENCH_RAD:
        for approach in ((1, 1), (-1, -1)):
            model = true.camera_in_rover(name, *true.joints.true_rad(reading, approach))
            points = points_seen(model)
            angles = fit.rig.joints.true_rad(reading, approach)
            predicted, rates, _ = pixel_rates(fit.rig, fit.parameter_names, name, *angles, points, approach)
            variance = np.einsum("nip,pq,niq->ni", rates, fit.covariance, rates)
            errors.append((predicted - model.project(points)[0]) / np.sqrt(variance))
    return np.concatenate(errors).ravel()


def pointings(true: Rig, believed: Rig, count_rad: float, seed: int) -> np.ndarray:
    """Return how far targets land from the image centre (ranges, targets, 2), px.

    A target is clicked exactly in both pictures at whole counts; the believed rig ranges it and says what the
    joints should read; the head goes to the nearest counts, its axes anywhere within these.
    """
    rng = np.random.default_rng([seed, 7])
    left, right = true.stereo["navcam"]
    aim = (np.array(true.cameras[left].model.size_px) - 1) / 2

    def counted(reading: np.ndarray) -> tuple[float, float]:
        pan, tilt = (np.round(reading / count_rad) * count_rad).tolist()
        return pan, tilt

    def within(reading: tuple[float, float], sides: tuple[int, int]) -> tuple[float, float]:
        pan, tilt = (np.array(reading) + count_rad * rng.uniform(-0.5, 0.5, 2)).tolist()
        return true.joints.true_rad((pan, tilt), sides)

    out = []
    for range_m in sorted(RANGES_M, reverse=True):
        for _ in range(TARGETS):
            reading = counted(rng.uniform((-0.9, -0.4), (0.9, 0.1)))
            at = within(reading, (1, 1))
            ray = (model := true.camera_in_rover(left, *at)).ray(rng.uniform(0.2, 0.8, 2) * model.size_px)
            target = ray.origins_m + range_m * ray.directions
            clicks = [true.camera_in_rover(name, *at).project(target)[0] for name in (left, right)]
            pan, tilt = believed.joints.true_rad(reading, (1, 1))
            one, other = (believed.camera_in_rover(name, pan, tilt) for name in (left, right))
            position_m = triangulate(one, other, clicks[0], clicks[1]).position_m
            camera, start = believed.cameras[left].model, {"from_pan_rad": pan, "from_tilt_rad": tilt}
            goal = solve(believed.mast, camera, position_m, aim, **start)[0]
            sides = (1 if goal.pan_rad >= pan else -1, 1 if goal.tilt_rad >= tilt else -1)
            command = counted(np.array(believed.joints.read_rad((goal.pan_rad, goal.tilt_rad), sides)))
            out.append(true.camera_in_rover(left, *within(command, sides)).project(target)[0] - aim)
    return np.array(out).reshape(len(RANGES_M), TARGETS, 2)


def main(words: Sequence[str] | None = None) -> int:
    """Print the tables."""
    parser = options(__doc__, 100, "surveys or benches")
    parser.add_argument("of", choices=("survey", "bench"))
    parser.add_argument("--method", choices=sorted(FITS), default="joint")
    parser.add_argument("--mast", type=int, choices=(6, 8), default=6)
    parser.add_argument("--prism-cad-sigma-m", type=not_negative, default=0.0, help="of the prisms' drawing")
    parser.add_argument("--gross", type=not_negative, default=0.0, help="part of the dots thrown anywhere")
    parser.add_argument("--head", choices=sorted(HEADS), default="ptu")
    parser.add_argument("--attitudes", type=at_least(4), default=20, help="head positions per placement")
    parser.add_argument("--checks", type=at_least(0), default=0, help="the same that are not fitted")
    args = parser.parse_args(words)
    seeds = range(args.seed, args.seed + args.cases)
    found: list[Score | str]
    if args.of == "survey":
        true = load_rig(config_folder() / "sim" / "rocky8.yaml").rig
        if args.mast == 8:
            skew = replace(true.mast, axis_offset_m=SKEW_M, axis_twist_rad=SKEW_RAD)
            true = replace(true, mast=skew)
        plan = SurveyPlan(sigma=Sigma(0.001, 0.1, 0.0, args.prism_cad_sigma_m))
        surveys = [SurveyTask(true, seed, plan, args.method, args.mast, args.gross) for seed in seeds]
        found = results_of(args, "surveys", survey_score, surveys, "seed {0.seed}".format)
    else:
        benches = [BenchTask(plan_of(args.head, args.attitudes, seed, args.checks), seed) for seed in seeds]
        found = results_of(args, "benches", bench_score, benches, "seed {0.seed}".format)
    if scores := [one for one in found if isinstance(one, Score)]:
        report(scores)
        if args.of == "survey":
            report_survey(scores)
        else:
            report_bench(scores)
        print(f"fit: {np.mean([s.seconds for s in scores]):.2f} s on average")
    refused = [one for one in found if isinstance(one, str)]
    print("\n".join([f"refused: {len(refused)} of {args.cases} from seed {args.seed}", *refused]))
    return 0


def report(scores: Sequence[Score]) -> None:
    """Print the rates of intervals that hold the truth."""
    print("95 % intervals hold the truth in, %                rms error in sigmas, cases")
    names = dict.fromkeys(name for s in scores for name in s.parameters)
    rows = {name: [[s.parameters[name]] for s in scores if name in s.parameters] for name in names}
    rows["pooled over parameters"] = [list(s.parameters.values()) for s in scores]
    if scores[0].prisms_alone is not None:
        rows["prisms alone (exact)"] = [list(s.prisms_alone) for s in scores if s.prisms_alone is not None]
    rows |= {f"pixels of {name}": [s.pixels[name].tolist() for s in scores] for name in scores[0].pixels}
    rows["pooled over pixels"] = [np.concatenate(list(s.pixels.values())).tolist() for s in scores]
    for name, errors in rows.items():
        rate, error = held_percent([np.abs(one) < Z for one in errors])
        mark = "  <--" if rate < LOWEST else ""
        size = rms(np.concatenate(errors))
        print(f"  {name:36s} {rate:5.1f} ± {error:3.1f}      {size:.2f}  {len(errors)}{mark}")
    reduced = np.array([s.reduced for s in scores])
    print(f"chi-square over its degrees of freedom: mean {reduced.mean():.4f}, sd {reduced.std():.4f}")


def report_survey(scores: Sequence[Score]) -> None:
    """Print the whole mast's distance from the truth, and what came of gross errors."""
    distance, count = np.array([s.mast_distance for s in scores]), len(scores[0].parameters)
    inside = 100 * np.mean(distance < chi2.ppf(0.95, count))
    print(f"whole mast within its 95 % ellipsoid: {inside:.1f} %; {distance.mean():.2f} of {count} expected")
    if gross := [s.gross for s in scores if s.gross]:
        errors, unnamed = sum(one.errors for one in gross), sum(one.unnamed for one in gross)
        besides = sum(one.besides for one in gross)
        print(f"gross errors named: {errors - unnamed} of {errors}; left out besides: {besides}")
        with_px, without_px = (float(np.sqrt(np.mean([one[k] for one in gross]))) for k in (3, 4))
        print(f"predicted pixels are off by {with_px:.4f} px rms, without gross errors by {without_px:.4f}")


def report_bench(scores: Sequence[Score]) -> None:
    """Print where first pointings land, and what became of pictures."""
    print("first pointing, rms px an axis, exact clicks, at 10, 6 and 2 m, and in all:")
    landed = np.array([s.landed_px for s in scores])
    for label, each_px in zip(("the fitted file", "counts alone"), landed.swapaxes(0, 1), strict=True):
        by_range = np.sqrt(np.nanmean(each_px**2, axis=(0, 2, 3)))
        row = "".join(f"{value:8.3f}" for value in (*by_range, np.sqrt(np.nanmean(each_px**2))))
        print(f"  {label:24s}{row}")
    pictures, left_out = np.array([s.pictures for s in scores]).sum(axis=0)
    print(f"pictures left out: {left_out} of {pictures}")
    if checks := [bad for s in scores for bad in s.checks]:
        print(f"check pictures called bad: of {sum(checks)} of {len(checks)} cameras")


if __name__ == "__main__":
    end(main)
