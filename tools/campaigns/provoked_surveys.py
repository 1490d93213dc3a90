"""Provoke surveys, calibrate by them, and count how often the verdict errs, both ways.

    .venv/bin/python -m tools.campaigns.provoked_surveys --cases 200 --seed 1

Each case is a simulated survey (`tools.sim_survey`) with one thing wrong, a fifth of them with none; what
is wrong and how much is drawn (`tools.campaigns.survey_provocations`). It is checked, fitted and judged as
`mastctl calibrate` does it. The verdict is held against the simulator's rig:

- pixels that the new mast file predicts for points at 2 to 10 m, each camera by itself, three directions;
- where a target lands that was clicked in a stereo pair of the head and pointed at, the same directions;
- the mast's parameters together, unless its model is another one.

The truth is *beyond 3 sigma* if errors of one camera or pair, rms over its places and in sigmas that the
calibration states, exceed 3, or the mast's squared distance what chance makes of it once in 370. Trusted is
what comes out as "trust it", doubted as "use it with care", rejected as "do not trust it"; a refusal to
calibrate counts by itself. Of surveys with nothing wrong it is told besides how often each test was passed,
at the level that it claims and at 5 %: whether chances are what they say.
"""

from __future__ import annotations

import time
from collections import Counter
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.stats import chi2

from calib.adjust import goodness as components
from calib.adjust import wider
from calib.adjust.result import Calibration
from calib.adjust.significance import THREE_SIGMAS
from calib.adjust.terms import DRAWING
from calib.adjust.uncertainty import pixel_covariance, pointing_covariance
from calib.calibrate.survey import fit_joint
from calib.errors import CalibError
from calib.files.mast_file import load_rig
from calib.geometry.pointing import solve
from calib.geometry.rig import MAST_NAMES, Rig, numbers_of
from calib.geometry.rigid import FloatArray
from calib.geometry.stereo import triangulate
from calib.survey.records import Sigma, Survey
from mastctl.calibration import checks as expected
from mastctl.calibration.checks import check_sizes
from mastctl.calibration.run import SurveyRefused, checked_survey
from mastctl.calibration.verdict import judge_calibration
from mastctl.packaged import config_folder
from tools.campaigns.survey_provocations import PROVOCATIONS, Provoked
from tools.command import end, options, rms, run_cases
from tools.sim_survey.plan import SurveyPlan, rover_from_head

DIRECTIONS_RAD = ((-0.8, -0.2), (0.0, -0.4), (0.7, -0.7))
RANGES_M = (2.0, 6.0, 10.0)
PLACES = ((0.5, 0.5), (0.25, 0.7))
"""Where points are seen, as parts of the picture's width and height."""

SIGMAS = 3.0
CLEAN = 5
"""One case in so many has nothing wrong."""

SIGMA = Sigma(station_m=0.001, dot_px=0.1)
COUNTED_RAD = 1e-4
"""What every other survey states of its joints, and what their readings err by."""


FAR = ("beyond", "within")
"""Where the truth is, against three of the stated sigmas."""

SAID = {"good": "trusted", "care": "doubted", "bad": "rejected"}

LEVELS = {
    "sigmas": components.RARELY,
    "wider models": wider.FALSE_ALARMS,
    "prisms' drawing": wider.DRAWING_ALARMS,
    "boards by the others": expected.RARELY,
    "check images": 4 * expected.RARELY,
}
"""At what chance each test warns; check images do for each of four cameras."""


class ProvokedTask(NamedTuple):
    """One survey of a true rig."""

    rig: Rig
    kind: str
    seed: int


class ProvokedOutcome(NamedTuple):
    """What came of a survey: what was wrong, the grade or '' if refused, the worst error in sigmas and of
    what, the reasons that were not good, and by test the chance of what it found (`chances_of`)."""

    kind: str
    words: str
    grade: str
    sigmas: float
    worst: str
    reasons: tuple[str, ...]
    chances: dict[str, float]


def judged(task: ProvokedTask) -> ProvokedOutcome:
    """Return what the verdict on one provoked survey is, and how far the truth is."""
    joint_rad = COUNTED_RAD if task.seed % 2 else 0.0
    plan = SurveyPlan(sigma=replace(SIGMA, joint_rad=joint_rad))
    rng = np.random.default_rng([task.seed, 7])
    made = PROVOCATIONS[task.kind](task.rig, task.seed, plan, rng)
    try:
        warnings = checked_survey(made.survey)
        fit = fit_joint(made.survey, made.mast_parameters)
    except (SurveyRefused, CalibError) as refused:
        return ProvokedOutcome(task.kind, made.words, "", float("nan"), "", (str(refused),), {})
    verdict = judge_calibration(made.survey, fit, warnings)
    errors = errors_in_sigmas(made, fit)
    worst = max(errors, key=errors.__getitem__)
    reasons = tuple(r.sentence for r in verdict.reasons if r.grade != "good")
    reasons += tuple(str(warning) for warning in warnings)
    return ProvokedOutcome(
        task.kind, made.words, verdict.grade, errors[worst], worst, reasons, chances_of(made.survey, fit)
    )


def chances_of(survey: Survey, fit: Calibration) -> dict[str, float]:
    """Return by test the chance of what it found or more, were all right, all that it tried counted."""
    found: dict[str, list[float]] = {
        "sigmas": [c.chance for c in fit.components if np.isfinite(c.factor)],
        "wider models": [m.chance for m in fit.wider if m.name != DRAWING],
        "prisms' drawing": [m.chance for m in fit.wider if m.name == DRAWING],
        "boards by the others": [b.least_chance for b in fit.left_out_boards],
        "check images": [size.chance for size in check_sizes(survey, fit).values()],
    }
    return {test: min(1.0, len(each) * min(each)) for test, each in found.items() if each}


def errors_in_sigmas(made: Provoked, fit: Calibration) -> dict[str, float]:
    """Return how far a fit is from the truth, by what it is good for, in its own sigmas."""
    found = {f"pixels of {name}": rms(_pixels(made, fit, name)) for name in made.rig.cameras}
    for pair, names in made.rig.stereo.items():
        if made.rig.cameras[names[0]].on == "head":
            landed = _pointing(made, fit, names)
            found[f"pointing by {pair}"] = rms(landed) if len(landed) else 0.0
    fitted = fit.part("mast.")
    if not made.waves and not (made.rig.mast.axis_offset_m or made.rig.mast.axis_twist_rad):
        names = [fit.parameter_names[i].removeprefix("mast.") for i in fitted]
        truth = dict(zip(MAST_NAMES, numbers_of(made.rig.mast), strict=True))
        off = fit.estimate[fitted] - np.array([truth[name] for name in names])
        covariance = fit.covariance[np.ix_(fitted, fitted)]
        distance = float(off @ np.linalg.solve(covariance, off))
        # The distance at which chance is that of three sigma of one number counts as three.
        found["mast"] = SIGMAS * float(np.sqrt(distance / chi2.isf(THREE_SIGMAS, len(off))))
    return found


def _seen(made: Provoked, name: str, true_rad: FloatArray, points_m: FloatArray) -> FloatArray:
    """True pixels (n, 2) of rover-frame points (n, 3), the kinematics SciPy's."""
    camera = made.rig.cameras[name]
    if camera.on == "head":
        points_m = rover_from_head(made.rig.mast, *true_rad).inverse.points(points_m)
    return camera.model.project(points_m)[0]


def _points(made: Provoked, name: str, true_rad: FloatArray) -> FloatArray:
    """Rover-frame points (n, 3) that a camera sees at its places and ranges."""
    camera = made.rig.cameras[name]
    rays = camera.model.ray(np.array(PLACES) * camera.model.size_px)
    points = np.concatenate([rays.origins_m + r * rays.directions for r in RANGES_M])
    return rover_from_head(made.rig.mast, *true_rad).points(points) if camera.on == "head" else points


def _pixels(made: Provoked, fit: Calibration, name: str) -> FloatArray:
    """Predicted less true pixels over their sigmas."""
    errors = []
    for angles in DIRECTIONS_RAD if made.rig.cameras[name].on == "head" else DIRECTIONS_RAD[:1]:
        true_rad = np.array(angles)
        points = _points(made, name, true_rad)
        read_rad = made.read_rad(true_rad)
        predicted, covariance = pixel_covariance(fit, name, float(read_rad[0]), float(read_rad[1]), points)
        off = predicted - _seen(made, name, true_rad, points)
        errors.append(off / np.sqrt(np.einsum("nii->ni", covariance)))
    return np.concatenate(errors)


def _pointing(made: Provoked, fit: Calibration, pair: tuple[str, str]) -> FloatArray:
    """Where targets land less where they should, over the stated sigmas; exact clicks."""
    errors = []
    wanted = np.array(fit.rig.cameras[pair[0]].model.image_center_px)
    for angles in DIRECTIONS_RAD:
        true_rad = np.array(angles)
        pan, tilt = made.read_rad(true_rad)
        for target in _points(made, pair[0], true_rad)[:: len(PLACES)]:
            clicks = [_seen(made, name, true_rad, target[None])[0] for name in pair]
            sizes = [np.array(made.rig.cameras[name].model.size_px) for name in pair]
            if any((c < 0).any() or (c > s - 1).any() for c, s in zip(clicks, sizes, strict=True)):
                continue
            range_m = float(np.linalg.norm(target - fit.rig.camera_in_rover(pair[0], pan, tilt).C))
            try:
                models = [fit.rig.camera_in_rover(name, pan, tilt) for name in pair]
                position = triangulate(*models, *clicks).position_m
                then = solve(fit.rig.mast, fit.rig.cameras[pair[0]].model, position, from_pan_rad=pan,
                             from_tilt_rad=tilt)[0]  # fmt: skip
                covariance = pointing_covariance(fit, pair, pan, tilt, clicks[0], range_m)
            except CalibError:
                continue
            there = made.true_rad(np.array([then.pan_rad, then.tilt_rad]))
            off = _seen(made, pair[0], there, target[None])[0] - wanted
            errors.append(off / np.sqrt(np.diag(covariance)))
    return np.array(errors)


def tasks_of(rig: Rig, cases: int, seed: int) -> list[ProvokedTask]:
    """The cases: one kind after the other, the clean ones a fifth of all."""
    wrong = [kind for kind in PROVOCATIONS if kind != "nothing wrong"]
    kinds = [
        "nothing wrong" if n % CLEAN == 0 else wrong[(n - n // CLEAN - 1) % len(wrong)] for n in range(cases)
    ]
    return [ProvokedTask(rig, kind, seed + number) for number, kind in enumerate(kinds)]


def main() -> int:
    """Print the table."""
    parser = options(__doc__, 200, "surveys")
    parser.add_argument(
        "--rig", type=Path, default=config_folder() / "sim" / "rocky8.yaml", help="the true rig"
    )
    parser.add_argument(
        "--pairs", nargs="+", default=["navcam", "hazcam"], help="the stereo pairs that are surveyed"
    )
    parser.add_argument("--only", choices=sorted(PROVOCATIONS), help="this kind alone")
    args = parser.parse_args()
    rig = load_rig(args.rig).rig
    if lacking := [pair for pair in args.pairs if pair not in rig.stereo]:
        parser.error(f"--rig {args.rig} has no stereo pair '{lacking[0]}'")
    names = {name for pair in args.pairs for name in rig.stereo[pair]}
    rig = replace(
        rig,
        cameras={name: camera for name, camera in rig.cameras.items() if name in names},
        stereo={pair: rig.stereo[pair] for pair in args.pairs},
    )
    tasks = tasks_of(rig, args.cases, args.seed)
    if args.only:
        tasks = [task._replace(kind=args.only) for task in tasks]
    began = time.monotonic()
    report(run_cases(args, "surveys", judged, tasks, "seed {0.seed}, {0.kind}".format))
    print(f"{args.cases} surveys from seed {args.seed}: {time.monotonic() - began:.0f} s")
    return 0


def report(outcomes: list[ProvokedOutcome]) -> None:
    """Print the table, and every case in which the verdict erred."""
    heads = ("cases", "refused", *(f"{far}: {what}" for far in FAR for what in SAID.values()))
    print(f"{'':16s} " + "  ".join(heads))
    for kind in [*PROVOCATIONS, "all"]:
        mine = [one for one in outcomes if kind in (one.kind, "all")]
        if not mine:
            continue
        count = Counter(_cell(one) for one in mine)
        cells = [len(mine), *(count[head] for head in heads[1:])]
        print(
            f"{kind:16s} "
            + "  ".join(f"{cell:{len(head)}d}" for cell, head in zip(cells, heads, strict=True))
        )
    for one in outcomes:
        trusted = _cell(one) == f"{FAR[0]}: {SAID['good']}"
        if trusted or (one.kind == "nothing wrong" and one.grade != "good"):
            print(f"{_cell(one)}: {one.words}: {one.worst} {one.sigmas:.1f} sigma; {' | '.join(one.reasons)}")
    for kind in PROVOCATIONS:
        mine = [one for one in outcomes if one.kind == kind and kind != "nothing wrong"]
        for far, said in ((FAR[1], SAID["good"]), (FAR[1], SAID["bad"])):
            if words := sorted(one.words for one in mine if _cell(one) == f"{far}: {said}"):
                print(f"{said} in spite of {kind}, truth {far} ({len(words)}): {'; '.join(words)}")
    false_alarms([one.chances for one in outcomes if one.kind == "nothing wrong" and one.grade])


def false_alarms(chances: list[dict[str, float]]) -> None:
    """Print how often each test said of surveys with nothing wrong that something is."""
    for test, level in LEVELS.items():
        mine = [found[test] for found in chances if test in found]
        usual, rare = (sum(chance < limit for chance in mine) for limit in (0.05, level))
        if mine:
            print(
                f"nothing wrong, {test}: {usual} of {len(mine)} below 5 %, {rare} below its {100 * level:g} %"
            )


def _cell(one: ProvokedOutcome) -> str:
    """Which column of the table an outcome belongs to."""
    if not one.grade:
        return "refused"
    return f"{FAR[one.sigmas <= SIGMAS]}: {SAID[one.grade]}"


if __name__ == "__main__":
    end(main)
