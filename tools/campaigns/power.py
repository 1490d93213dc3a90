"""How large something wrong has to be for a fit to name it: on a bench, or a joint's slip in a survey.

    .venv/bin/python -m tools.campaigns.power bench --cases 10 --seed 1
    .venv/bin/python -m tools.campaigns.power survey --cases 20 --seed 1

``bench``: simulated benches as `tools.campaigns.bench_coverage --head driven` has them, two placements of
eight looks. One thing (a slip, a push, a knock, another focus) happens in the first of them, after so many
looks, and stays. ``survey``: simulated surveys of the Navcams (12 placements for the mast), in which a joint
is read off by some size: from the middle of the head's pictures on, or at one placement alone.

Counted is how often the fit names it, and how often it says at least that something is wrong. Of a bench: it
refuses, or its verdict is less than good for any other reason than that there are no check pictures. Of a
survey: any wider model, a stated sigma that is too small, a board that contradicts the others, an image or a
point of the station left out.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import replace
from itertools import product
from typing import Literal, NamedTuple

import numpy as np

from calib.calibrate.bench.fit import fit_bench
from calib.calibrate.survey import fit_joint
from calib.errors import CalibError
from calib.files.mast_file import load_rig
from calib.geometry.rig import Rig
from calib.survey.records import Survey
from mastctl.calibration.bench_verdict import judge_bench
from mastctl.calibration.checks import RARELY
from mastctl.cli.output import at_least
from mastctl.packaged import config_folder
from tools.campaigns.bench_coverage import plan_of
from tools.command import end, heading, line, options, run_cases
from tools.sim_survey.bench import BenchPlan, Mishap, simulate_bench
from tools.sim_survey.blunders import with_slipped_joint
from tools.sim_survey.plan import SurveyPlan
from tools.sim_survey.survey import simulate_survey

LOOKS = 8
What = Literal["board", "pan", "tilt", "focus", "knock"]


class Thing(NamedTuple):
    """What can happen to a bench: sizes in radians, metres of the board, or a part of the focal length; their
    unit in thousandths; and the words by which a fit names it."""

    sizes: tuple[float, ...]
    unit: str
    words: str


THINGS: dict[What, Thing] = {
    "pan": Thing((0.0002, 0.001, 0.01), "mrad", "pan slipped"),
    "tilt": Thing((0.0002, 0.001, 0.01), "mrad", "tilt slipped"),
    "board": Thing((0.0002, 0.001, 0.02), "mm", " moved during placement "),
    "focus": Thing((0.0001, 0.0005, 0.005), "thousandths of it", "camera navcam_left was refocused"),
    "knock": Thing((0.0001, 0.0005, 0.005), "mrad", "camera navcam_left was knocked"),
}

PAIR = ("navcam_left", "navcam_right")
SLIPS_RAD = (0.0005, 0.0008, 0.0012, 0.002, 0.003)
WAYS = ("from the middle on", "at one placement")
NAMES = {WAYS[0]: ("slip of pan", "slip of tilt"), WAYS[1]: ("attitude",)}


class MishapTask(NamedTuple):
    """One bench on which one thing happens."""

    what: What
    size: float
    after: int
    seed: int


class SlipTask(NamedTuple):
    """One survey with one slip."""

    rig: Rig
    way: str
    size_rad: float
    seed: int


class Said(NamedTuple):
    """Whether it was named, and whether anything was said to be wrong."""

    named: bool
    doubted: bool


def bench_plan(task: MishapTask) -> BenchPlan:
    """Return the bench's plan."""
    sign = float(np.random.default_rng([task.seed, 11]).choice([-1.0, 1.0]))
    mishap = Mishap(task.what, task.after, sign * task.size)
    return replace(plan_of("driven", LOOKS, task.seed), mishaps=(mishap,))


def of_bench(task: MishapTask) -> Said:
    """Return what the fit of one bench says."""
    survey, words = simulate_bench(task.seed, bench_plan(task)), THINGS[task.what].words
    try:
        fit = fit_bench(survey)
    except CalibError as refused:
        return Said(words in str(refused), True)
    reasons = [r.sentence for r in judge_bench(survey, fit).reasons if r.grade != "good"]
    doubted = any("there is no check picture" not in sentence for sentence in reasons)
    return Said(any(words in note for note in fit.notes), doubted)


def slipped(survey: Survey, way: str, joint: str, size_rad: float, rng: np.random.Generator) -> Survey:
    """Return the survey with a joint that slipped: for good, or at one placement of the mast."""
    images = [image.name for image in survey.images]
    if way == WAYS[0]:
        head = [image.name for image in survey.images if image.purpose == "mast"]
        return with_slipped_joint(survey, joint, head[len(head) // 2], size_rad)
    places = list(dict.fromkeys(i.placement for i in survey.images if i.purpose == "mast"))
    place = places[rng.integers(len(places))]
    shown = [image.name for image in survey.images if image.placement == place]
    there = with_slipped_joint(survey, joint, shown[0], size_rad)
    after = images[images.index(shown[-1]) + 1 :]
    return with_slipped_joint(there, joint, after[0], -size_rad) if after else there


def of_survey(task: SlipTask) -> Said:
    """Return what a fit says of one slipped survey; a refusal counts as a doubt."""
    rng = np.random.default_rng([task.seed, 11])
    joint, sign = str(rng.choice(["pan", "tilt"])), float(rng.choice([-1.0, 1.0]))
    survey = simulate_survey(task.rig, task.seed, SurveyPlan(mast_boards=12))[0]
    try:
        fit = fit_joint(slipped(survey, task.way, joint, sign * task.size_rad, rng))
    except CalibError:
        return Said(False, True)
    asked = [model.name for model in fit.wider if model.significant]
    odd = any(one.least_chance * len(fit.left_out_boards) < RARELY for one in fit.left_out_boards)
    wrong = any(component.wrong for component in fit.components)
    left_out = any(outlier.kind != "dot" for outlier in fit.outliers)
    return Said(any(name in NAMES[task.way] for name in asked), bool(asked) or odd or wrong or left_out)


def main(words: Sequence[str] | None = None) -> int:
    """Print the table."""
    parser = options(__doc__, 10, "benches of each thing, size and moment, or surveys of each size and way")
    parser.add_argument("of", choices=("bench", "survey"))
    parser.add_argument("--after", type=at_least(1), nargs="+", default=[4, 6], help="looks (default 4 6)")
    parser.add_argument("--only", choices=sorted(THINGS), nargs="+", default=list(THINGS), help="on a bench")
    args = parser.parse_args(words)
    seeds = range(args.seed, args.seed + args.cases)
    return _benches(args, seeds) if args.of == "bench" else _surveys(args, seeds)


def _benches(args: argparse.Namespace, seeds: range) -> int:
    tasks = [
        MishapTask(what, size, after, seed)
        for what, after in product(args.only, args.after)
        for size, seed in product(THINGS[what].sizes, seeds)
    ]
    label = "seed {0.seed}, {0.what} {0.size:g} after {0.after}".format
    results = run_cases(args, "mishaps", of_bench, tasks, label)
    print(f"of {args.cases} each: named, and said to be wrong")
    for what in args.only:
        thing = THINGS[what]
        print(heading([f"{what}, {thing.unit}", *(f"{1e3 * size:g}" for size in thing.sizes)]))
        for after in args.after:
            cells = []
            for size in thing.sizes:
                mine = [r for t, r in zip(tasks, results, strict=True) if t[:3] == (what, size, after)]
                cells.append(f"{sum(r.named for r in mine)}, {sum(r.doubted for r in mine)}")
            print(line(f"after {after} looks", *cells))
    return 0


def _surveys(args: argparse.Namespace, seeds: range) -> int:
    rig = load_rig(config_folder() / "sim" / "rocky8.yaml").rig
    rig = replace(rig, cameras={name: rig.cameras[name] for name in PAIR}, stereo={"navcam": PAIR})
    tasks = [SlipTask(rig, way, size, seed) for seed, way, size in product(seeds, WAYS, SLIPS_RAD)]
    results = run_cases(
        args, "slips", of_survey, tasks, lambda t: f"seed {t.seed}, {1e3 * t.size_rad:g} mrad {t.way}"
    )
    print(heading(["slip, mrad", "", *(f"{1e3 * size:g}" for size in SLIPS_RAD)]))
    for way, what in product(WAYS, Said._fields):
        cells = []
        for size in SLIPS_RAD:
            mine = [r for t, r in zip(tasks, results, strict=True) if (t.way, t.size_rad) == (way, size)]
            cells.append(f"{100 * np.mean([getattr(r, what) for r in mine]):.0f} %")
        print(line(way, what, *cells))
    return 0


if __name__ == "__main__":
    end(main)
