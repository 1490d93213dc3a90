"""Fit many simulated benches and count how often stated intervals hold the truth, and how well the rig
points.

    .venv/bin/python -m tools.campaigns.bench_coverage --cases 200 --seed 1
    .venv/bin/python -m tools.campaigns.bench_coverage --cases 200 --seed 1 --head servo
    .venv/bin/python -m tools.campaigns.bench_coverage --cases 100 --head driven --attitudes 8 --checks 3

Benches are simulated (`tools.sim_survey.bench`): a Navcam pair, an A2 board at three placements, corners
with 0.1 px noise and some of them wrong. ``--head ptu`` reads true but for counts of 0.05 mrad; ``--head
servo`` has 4096 counts a turn, harmonics of 6 and 2 mrad, 4 mrad of backlash and a board that bends by 1 mm.
``--head driven`` has what a driven bench has: two placements, corners with 0.01 px noise and none wrong;
and counts of 0.05 mrad, harmonics of 5 and 3.5 mrad, 4 mrad of backlash, and axes that pass each other by up
to 20 mm and are skew by up to 10 mrad. ``--doubts 5`` has the fit begin without the pictures of five head
positions.
Prints, over the benches, how often the 95 % interval of each parameter and of predicted pixels (points at 2
to 10 m, three directions, both cameras, at what the joints read) holds the truth; and how far first pointings
land from targets at 10, 6 and 2 m that were clicked without noise, with the fitted file, with a file fitted
without joints' errors, and with the truth for a file: what counts alone allow. Last, how many pictures were
left out as a whole, and with ``--checks`` how often the check pictures of a camera are called bad, and how
their chances are spread: a right one is below 0.1 in a tenth of all.

Errors of one bench go together, so a pooled rate scatters far more than so many independent intervals would:
behind ± stands its standard error, from the scatter of whole benches.
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import replace
from typing import NamedTuple
from unittest import mock

import numpy as np

from calib.adjust.result import BenchCalibration
from calib.calibrate.bench.fit import fit_bench
from calib.calibrate.bench.problem import BenchOptions, BenchProblem
from calib.errors import CalibError
from calib.geometry.cahvor import CameraModel
from calib.geometry.covariance import pixel_rates
from calib.geometry.pointing import solve
from calib.geometry.rig import JOINTS_NAMES, Mast, Rig, numbers_of
from calib.geometry.rig import joint_numbers_of as joint_numbers
from calib.geometry.rigid import tangents
from calib.geometry.stereo import triangulate
from mastctl.cli.output import at_least
from tools.command import end, held_percent, options, rms, run_cases
from tools.sim_survey.bench import BenchPlan, Placement, simulate_bench

LEVEL, Z = 0.95, 1.959964
LOWEST = 88.0
DIRECTIONS_RAD = ((-0.7, -0.3), (0.1, -0.4), (0.8, 0.0))
"""What the joints read where pixels are predicted: within what the placements cover."""
PLACES = ((0.5, 0.5), (0.2, 0.7))
RANGES_M = (2.0, 6.0, 10.0)
TARGETS = 12
"""Pointings at each range."""
PLAIN = 5
"""Every so many benches are also fitted without joints' errors."""

PLACEMENTS = (
    Placement(0.9, 0.1, -0.45, (0.5, 0.1, 0.1)),
    Placement(1.7, -0.9, -0.1, (-0.3, 0.5, 0.0)),
    Placement(2.6, 0.8, 0.05, (0.2, -0.4, 0.05)),
)
HEADS = {
    "ptu": BenchPlan(placements=PLACEMENTS, gross=0.005, count_rad=5e-5),
    "servo": BenchPlan(
        placements=PLACEMENTS,
        gross=0.005,
        count_rad=2 * np.pi / 4096,
        backlash_rad=0.004,
        bow_m=(0.001, -0.0005),
    ),
    "driven": BenchPlan(placements=PLACEMENTS[:2], own_px=0.01, count_rad=5e-5, backlash_rad=0.004),
}


HARMONICS_RAD = {"ptu": (), "servo": (0.006, 0.002), "driven": (0.005, 0.0035)}
"""Amplitudes of the harmonics of either joint; where their waves begin is drawn for each bench."""

SKEW = {"driven": (0.02, 0.01)}
"""Most that the axes pass each other by, metres, and are off a right angle, radians; drawn for each bench."""

CHANCES = (0.5, 0.1, 0.01, 0.001)


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
    offset_m, twist_rad = (rng.uniform(-1, 1, 2) * SKEW.get(head, (0.0, 0.0))).tolist()
    return replace(
        HEADS[head],
        mast=Mast(np.zeros(3), np.zeros(3), offset_m, twist_rad),
        attitudes=attitudes,
        checks=checks,
        pan_harmonics=pan,
        tilt_harmonics=tilt,
    )


class BenchTask(NamedTuple):
    """One bench, and how many standstills its start is made to doubt."""

    plan: BenchPlan
    seed: int
    doubts: int = 0


@contextmanager
def doubting(task: BenchTask) -> Iterator[None]:
    """Have fits begin without the pictures of some standstills, as those do whose start is far off."""
    begin = BenchProblem.begin

    def begin_without(bench: BenchProblem) -> None:
        begin(bench)
        rng = np.random.default_rng([task.seed, 13])
        out = rng.permutation(bench.terms.attitudes)[: task.doubts].tolist()
        bench.doubtful |= {term.name for term in bench.terms.images if term.attitude in out}

    with mock.patch.object(BenchProblem, "begin", begin_without):
        yield


class BenchScore(NamedTuple):
    """Errors over sigmas, of parameters by name and of pixels; how far pointings land (3 files, ranges,
    targets, 2), px; what entered; chi-square's probability and quotient; pictures that were fitted and how
    many of them were left out; of each camera whether its check pictures are bad, and their chance; seconds.
    """

    parameters: dict[str, float]
    pixels: np.ndarray
    landed_px: np.ndarray
    entered: tuple[str, ...]
    probability: float
    reduced: float
    pictures: int
    left_out: int
    checks: tuple[tuple[bool, float], ...]
    seconds: float


def score(task: BenchTask) -> BenchScore | str:
    """Return how far one bench's fit is from the truth, or why there is none."""
    survey = simulate_bench(task.seed, task.plan)
    try:
        with doubting(task):
            fit = fit_bench(survey)
        entered = tuple(t.name for t in fit.terms if t.entered)
        without = [t for t in entered if not t.startswith(("pan ", "tilt "))]
    except CalibError as refused:
        return f"seed {task.seed}: {refused}"
    plain: BenchCalibration | None = fit
    if len(without) < len(entered):
        plain = None
        if task.seed % PLAIN == 0:
            with suppress(CalibError):  # joints' errors of a driven head are more than such a fit takes
                plain = fit_bench(survey, BenchOptions(terms=without))
    true = task.plan.rig
    rigs = (fit.rig, None if plain is None else plain.rig, true)
    landed = [
        np.full((len(RANGES_M), TARGETS, 2), np.nan)
        if rig is None
        else pointings(true, rig, task.plan.count_rad, task.seed)
        for rig in rigs
    ]
    return BenchScore(
        parameter_errors(true, fit),
        np.concatenate([pixel_errors(true, name, fit) for name in true.cameras]),
        np.array(landed),
        entered,
        fit.chi2_probability,
        fit.chi2 / fit.degrees_of_freedom,
        sum(image.purpose != "check" for image in fit.images),
        sum(outlier.kind == "image" for outlier in fit.outliers),
        tuple(
            (float(np.sqrt(np.mean(np.square(xy)))) > fit.checks[name].most_px, fit.checks[name].chance)
            for name, xy in fit.check_rms_px.items()
        ),
        fit.seconds,
    )


def parameter_errors(true: Rig, fit: BenchCalibration) -> dict[str, float]:
    """Return the errors of all fitted parameters of the rig, in sigmas."""
    values = truths(true, fit.rig)
    sigma = np.sqrt(np.diag(fit.covariance))
    return {n: values[n] / s for n, s in zip(fit.parameter_names, sigma, strict=True)}


def truths(true: Rig, found: Rig) -> dict[str, float]:
    """Return how far every parameter of a rig is from the truth, by its name."""
    mast = numbers_of(found.mast) - numbers_of(true.mast)
    joints = joint_numbers(found.joints) - joint_numbers(true.joints)
    off = dict(zip(("mast.axis_offset_m", "mast.axis_twist_rad"), mast[6:].tolist(), strict=True))
    off |= dict(zip(JOINTS_NAMES, joints.tolist(), strict=True))
    for name, camera in found.cameras.items():
        off |= {
            f"cameras.{name}.{k}": v for k, v in camera_off(camera.model, true.cameras[name].model).items()
        }
    return off


def camera_off(found: CameraModel, true: CameraModel) -> dict[str, float]:
    """Return how far a camera's parameters are from the truth."""
    off: dict[str, float] = {}
    for letter in "CHV":
        off |= dict(
            zip((f"{letter}.{a}" for a in "xyz"), getattr(found, letter) - getattr(true, letter), strict=True)
        )
    for letter in "AO":
        along = -tangents(getattr(found, letter)) @ getattr(true, letter)
        off |= {f"{letter}.1": along[0], f"{letter}.2": along[1]}
    off |= {f"R.{i}": found.R[i] - true.R[i] for i in (1, 2)}
    return {key: float(value) for key, value in off.items()}


def pixel_errors(true: Rig, name: str, fit: BenchCalibration) -> np.ndarray:
    """Return predicted less true pixels of points seen at some readings, in sigmas."""
    errors = []
    for reading in DIRECTIONS_RAD:
        for approach in ((1, 1), (-1, -1)):
            model = true.camera_in_rover(name, *true.joints.true_rad(reading, approach))
            rays = model.ray(np.array(PLACES) * model.size_px)
            for range_m in RANGES_M:
                points = rays.origins_m + range_m * rays.directions
                angles = fit.rig.joints.true_rad(reading, approach)
                predicted, rates = pixel_rates(fit.rig, fit.parameter_names, name, *angles, points, approach)
                covariance = np.einsum("nip,pq,njq->nij", rates, fit.covariance, rates)
                errors.append(
                    (predicted - model.project(points)[0]) / np.sqrt(np.einsum("nii->ni", covariance))
                )
    return np.concatenate(errors).ravel()


def pointings(true: Rig, believed: Rig, count_rad: float, seed: int) -> np.ndarray:
    """Return how far targets land from the image centre (ranges, targets, 2), px.

    A target is clicked exactly in both pictures at whole counts; the believed rig ranges it and says what the
    joints should read; the head goes to the nearest counts, its axes anywhere within these.
    """
    rng = np.random.default_rng([seed, 7])
    left, right = true.stereo["navcam"]
    aim = (np.array(true.cameras[left].model.size_px) - 1) / 2
    out = []
    for range_m in sorted(RANGES_M, reverse=True):
        for _ in range(TARGETS):
            reading = counted(rng.uniform((-0.9, -0.4), (0.9, 0.1)), count_rad)
            at = within(true, reading, (1, 1), count_rad, rng)
            model = true.camera_in_rover(left, *at)
            ray = model.ray(rng.uniform(0.2, 0.8, 2) * model.size_px)
            target = ray.origins_m + range_m * ray.directions
            clicks = [true.camera_in_rover(name, *at).project(target)[0] for name in (left, right)]
            angles = believed.joints.true_rad(reading, (1, 1))
            seen = [believed.camera_in_rover(name, *angles) for name in (left, right)]
            found = triangulate(*seen, *clicks)
            goal = solve(
                believed.mast, believed.cameras[left].model, found.position_m, aim,
                from_pan_rad=angles[0], from_tilt_rad=angles[1],
            )[0]  # fmt: skip
            wanted = (goal.pan_rad, goal.tilt_rad)
            sides = (1 if wanted[0] >= angles[0] else -1, 1 if wanted[1] >= angles[1] else -1)
            command = counted(np.array(believed.joints.read_rad(wanted, sides)), count_rad)
            landed = true.camera_in_rover(left, *within(true, command, sides, count_rad, rng))
            out.append(landed.project(target)[0] - aim)
    return np.array(out).reshape(len(RANGES_M), TARGETS, 2)


def counted(reading: np.ndarray, count_rad: float) -> tuple[float, float]:
    """Return a reading in whole counts."""
    pan, tilt = (np.round(reading / count_rad) * count_rad).tolist()
    return pan, tilt


def within(
    true: Rig,
    reading: tuple[float, float],
    approach: Sequence[int],
    count_rad: float,
    rng: np.random.Generator,
) -> tuple[float, float]:
    """Return true angles where the joints read some counts."""
    pan, tilt = np.array(reading) + count_rad * rng.uniform(-0.5, 0.5, 2)
    return true.joints.true_rad((float(pan), float(tilt)), (approach[0], approach[1]))


def main() -> int:
    """Print the tables."""
    parser = options(__doc__, 100, "benches")
    parser.add_argument("--head", choices=sorted(HEADS), default="ptu")
    parser.add_argument("--attitudes", type=at_least(4), default=20, help="head positions per placement")
    parser.add_argument(
        "--checks", type=at_least(0), default=0, help="head positions per placement that are not fitted"
    )
    parser.add_argument(
        "--doubts", type=at_least(0), default=0, help="head positions that the start is made to doubt"
    )
    args = parser.parse_args()
    began = time.monotonic()
    tasks = [
        BenchTask(plan_of(args.head, args.attitudes, seed, args.checks), seed, args.doubts)
        for seed in range(args.seed, args.seed + args.cases)
    ]
    found = run_cases(args, "benches", score, tasks, lambda task: f"seed {task.seed}")
    if scores := [one for one in found if isinstance(one, BenchScore)]:
        report(scores)
    refused = [one for one in found if isinstance(one, str)]
    print("\n".join([f"benches refused: {len(refused)}", *refused]))
    what = f"{args.cases} benches from seed {args.seed}, {args.head}, {args.attitudes} attitudes"
    print(f"{what}: {time.monotonic() - began:.0f} s")
    return 0


def report(scores: Sequence[BenchScore]) -> None:
    """Print the tables."""
    names = list(dict.fromkeys(name for s in scores for name in s.parameters))
    print(f"{100 * LEVEL:g} % intervals hold the truth in, %            rms error in sigmas, benches")
    for name in names:
        errors = np.array([s.parameters[name] for s in scores if name in s.parameters])
        held = 100 * np.mean(np.abs(errors) < Z)
        mark = "  <--" if held < LOWEST else ""
        print(f"  {name:36s} {held:5.1f}      {rms(errors):.2f}  {len(errors)}{mark}")
    each = [np.abs(list(s.parameters.values())) < Z for s in scores]
    pixels = [np.abs(s.pixels) < Z for s in scores]
    for what, by_bench in (("pooled over parameters", each), ("pooled over pixels", pixels)):
        rate, error = held_percent(by_bench)
        print(f"  {what:36s} {rate:5.1f} ± {error:.1f}")
    print(
        "first pointing, rms px an axis, exact clicks:   "
        + "".join(f"{r:8g} m" for r in sorted(RANGES_M)[::-1])
    )
    landed = np.array([s.landed_px for s in scores])
    labels = ("the fitted file", "without joints' errors", "counts alone")
    counts_px = float(np.sqrt(np.nanmean(landed[:, 2] ** 2)))
    for label, each_px in zip(labels, landed.swapaxes(0, 1), strict=True):
        if np.isnan(each_px).all():
            print(f"  {label:44s}  every fit is refused")
            continue
        by_range = np.sqrt(np.nanmean(each_px**2, axis=(0, 2, 3)))
        whole_px = float(np.sqrt(np.nanmean(each_px**2)))
        row = "".join(f"{value:10.3f}" for value in by_range)
        print(f"  {label:44s}{row}; in all {whole_px:.3f}, {whole_px / counts_px:.2f} times counts alone")
    terms = dict.fromkeys(t for s in scores for t in s.entered)
    counts = {t: sum(t in s.entered for s in scores) for t in terms}
    print("terms that entered: " + (", ".join(f"{t} {n}" for t, n in counts.items()) or "none"))
    reduced = np.array([s.reduced for s in scores])
    print(f"chi-square over its degrees of freedom: mean {reduced.mean():.4f}, sd {reduced.std():.4f}")
    pictures, left_out = sum(s.pictures for s in scores), sum(s.left_out for s in scores)
    most = max(s.left_out for s in scores)
    print(
        f"pictures left out: {left_out} of {pictures}, {100 * left_out / pictures:.2f} %; at most {most} of "
        f"a bench, none of {sum(not s.left_out for s in scores)} benches"
    )
    checks = [check for s in scores for check in s.checks]
    if checks:
        below = ", ".join(f"{100 * np.mean([c < p for _, c in checks]):.1f} % below {p:g}" for p in CHANCES)
        print(f"check pictures: {sum(bad for bad, _ in checks)} of {len(checks)} bad; chances {below}")
    print(f"fit: {np.mean([s.seconds for s in scores]):.2f} s on average")


if __name__ == "__main__":
    end(main)
