"""Calibrate where some pictures are noisier than others, and count good pictures left out and false causes.

    .venv/bin/python -m tools.campaigns.uneven_noise noisy-survey --cases 50 --seed 1
    .venv/bin/python -m tools.campaigns.uneven_noise noisy-bench --cases 50 --seed 1

Surveys and benches are right but for the noise of one camera, one picture, or all pictures of one placement,
which is 1.1 to 5 times the stated one; the others' noise differs besides by picture and camera as that of all
campaigns (`sim_survey.noise`). Printed is how many good pictures were left out, and every refusal or reason
for doubt that is not the noise itself: a false cause.

Errors are in stated sigmas, rms over predicted pixels of one camera, the worst camera; beyond 3 and trusted
is the harm that counts.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from typing import Literal, NamedTuple

import numpy as np

from calib.adjust.result import BenchCalibration, Calibration
from calib.calibrate.bench import fit_bench
from calib.calibrate.survey import fit_joint
from calib.errors import CalibError
from calib.geometry.rig import Rig
from calib.survey.records import Survey
from hil_tests.support.sim_survey.bench import BenchPlan, simulate_bench
from hil_tests.support.sim_survey.noise import with_noise, with_uneven_noise
from hil_tests.support.sim_survey.plan import SurveyPlan
from hil_tests.support.sim_survey.survey import simulate_survey
from mastctl.calibration.run import SurveyRefused, checked_survey
from mastctl.calibration.verdict import judge
from mastctl.cli.experiment import results_of
from tools.campaigns.coverage import pixel_errors, plan_of
from tools.campaigns.provocations import PAIRS, RIG, errors_in_sigmas, rig_of_pairs
from tools.campaigns.provoked import Provoked
from tools.command import end, heading, line, options, rms

FACTORS = (1.1, 1.3, 1.5, 2.0, 3.0, 5.0)
SUBJECTS = ("camera", "picture", "placement")
PLAN = SurveyPlan(mast_boards=6, check_boards=2)
ATTITUDES, CHECKS = 7, 2
"""Of a bench, per placement."""

Of = Literal["noisy-survey", "noisy-bench"]

NOISE_ITSELF = re.compile(r"chi-square is|scatter(s)? by|corners are off by some|measurements were left out")
"""Reasons that say no more than that some measurements are noisier than stated."""


class UnevenTask(NamedTuple):
    """One survey or bench: what is noisier, how many times, and the seed."""

    of: Of
    what: str
    size: float
    seed: int


class UnevenOutcome(NamedTuple):
    """What came of it: the grade or '' if refused, pictures that were fitted, those of them that were left
    out, sentences of what is not well, and the worst error in sigmas."""

    what: str
    size: float
    grade: str
    pictures: int
    lost: int
    sentences: tuple[str, ...]
    sigmas: float


def judged(task: UnevenTask) -> UnevenOutcome:
    """Return what comes of one case."""
    rng = np.random.default_rng([task.seed, 23])
    if task.of == "noisy-survey":
        rig = rig_of_pairs(RIG, PAIRS)
        survey = with_uneven_noise(simulate_survey(rig, task.seed, PLAN)[0], task.seed)
        return _outcome(task, noisier(survey, task, rng), rig)
    plan = bench_plan(task.seed)
    survey = with_uneven_noise(simulate_bench(task.seed, plan), task.seed)
    return _outcome(task, noisier(survey, task, rng), plan.rig)


def bench_plan(seed: int) -> BenchPlan:
    """Return a driven bench's plan: corners of 0.02 px, joints with harmonics and play, boards any way up."""
    plan = plan_of("driven", ATTITUDES, seed, CHECKS)
    rng = np.random.default_rng([seed, 31])
    placements = tuple(
        replace(one, lean_rad=tuple((np.array(one.lean_rad) + rng.uniform(-0.15, 0.15, 3)).tolist()))
        for one in plan.placements
    )
    return replace(plan, own_px=0.02, placements=placements)


def noisier(survey: Survey, task: UnevenTask, rng: np.random.Generator) -> Survey:
    """Return the survey with noise so many times the stated one in some pictures."""
    fitted = [image for image in survey.images if image.purpose != "check"]
    key = "name" if task.what == "picture" else task.what
    chosen = str(rng.choice(sorted({getattr(image, key) for image in fitted})))
    names = [image.name for image in survey.images if getattr(image, key) == chosen]
    return with_noise(survey, dict.fromkeys(names, task.size), rng)


def _outcome(task: UnevenTask, survey: Survey, rig: Rig) -> UnevenOutcome:
    count = sum(image.purpose != "check" for image in survey.images)
    warnings: Sequence[object] = ()
    fit: Calibration | BenchCalibration
    try:
        if task.of == "noisy-survey":
            warnings = checked_survey(survey)
            fit = fit_joint(survey, 6)
            verdict = judge(survey, fit, warnings)
            worst = max(errors_in_sigmas(Provoked(survey, rig, ""), fit).values())
        else:
            fit = fit_bench(survey)
            verdict = judge(survey, fit)
            worst = max(rms(pixel_errors(rig, name, fit)) for name in rig.cameras)
    except (SurveyRefused, CalibError) as refused:
        return UnevenOutcome(task.what, task.size, "", count, 0, (str(refused),), float("nan"))
    sentences = tuple(r.sentence for r in verdict.reasons if r.grade != "good")
    sentences += tuple(str(warning) for warning in warnings)
    lost = sum(one.kind != "dot" for one in fit.outliers)
    return UnevenOutcome(task.what, task.size, verdict.grade, count, lost, sentences, worst)


def tasks_of(of: Of, cases: int, seed: int) -> list[UnevenTask]:
    """Return the cases."""
    return [
        UnevenTask(of, subject, factor, seed + n)
        for subject in SUBJECTS
        for factor in FACTORS
        for n in range(cases)
    ]


def report(outcomes: Sequence[UnevenOutcome]) -> None:
    """Print the table, and every false cause."""
    heads = ("what", "size", "cases", "refused", "trust", "care", "do not", "beyond 3 sigma and trusted")
    print(heading((*heads, "false causes", "good ones left out", "rms sigmas")))
    for what, size in dict.fromkeys((one.what, one.size) for one in outcomes):
        mine = [one for one in outcomes if (one.what, one.size) == (what, size)]
        count = Counter(one.grade for one in mine)
        harm = sum(one.grade == "good" and one.sigmas > 3.0 for one in mine)
        lost, pictures = sum(one.lost for one in mine), sum(one.pictures for one in mine)
        sigmas = rms([one.sigmas for one in mine if np.isfinite(one.sigmas)])
        print(
            line(
                what, f"{size:g}", len(mine), count[""], count["good"], count["care"], count["bad"],
                harm, sum(bool(_false(one)) for one in mine), f"{lost} of {pictures}", f"{sigmas:.2f}",
            )
        )  # fmt: skip
    for one in outcomes:
        if false := _false(one):
            print(f"{one.what} {one.size:g} ({one.grade or 'refused'}): {' | '.join(false)[:600]}")


def _false(one: UnevenOutcome) -> list[str]:
    """The sentences that say more than that noise is what it is."""
    return [sentence for sentence in one.sentences if not NOISE_ITSELF.search(sentence)]


def main() -> int:
    """Print the table."""
    parser = options(__doc__, 50, "of each kind and size")
    parser.add_argument("of", choices=("noisy-survey", "noisy-bench"))
    args = parser.parse_args()
    tasks = tasks_of(args.of, args.cases, args.seed)
    report(results_of(args, args.of, judged, tasks, "{0.what} {0.size:g}, seed {0.seed}".format))
    return 0


if __name__ == "__main__":
    end(main)
