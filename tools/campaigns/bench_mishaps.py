"""How large a slip, push, knock or refocus of a bench has to be for the fit to name it.

    .venv/bin/python -m tools.campaigns.bench_mishaps --benches 10 --seed 1

Simulated benches as `tools.campaigns.bench_coverage --head driven` has them: two placements of eight looks.
One thing happens in the first of them, after so many looks, and stays. Counted is how often the fit names it,
and how often it says at least that something is wrong: it refuses, or its verdict is less than good for any
other reason than that there are no check pictures.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import replace
from typing import Literal, NamedTuple

import numpy as np

from calib.errors import CalibError
from calib.fit.bench import fit_bench
from drivers.sim_survey.bench import BenchPlan, Mishap, simulate_bench
from mastctl.calibration.bench_verdict import judge_bench
from mastctl.cli.output import at_least
from mastctl.cli.tasks import add_task_options, results_of
from tools.arguments import end
from tools.campaigns.bench_coverage import plan_of

LOOKS = 8
What = Literal["board", "pan", "tilt", "focus", "knock"]
SIZES: dict[What, tuple[float, ...]] = {
    "pan": (0.0002, 0.001, 0.01),
    "tilt": (0.0002, 0.001, 0.01),
    "board": (0.0002, 0.001, 0.02),
    "focus": (0.0001, 0.0005, 0.005),
    "knock": (0.0001, 0.0005, 0.005),
}
"""Radians; metres of the board; a part of the focal length."""

UNITS: dict[What, str] = {
    "pan": "mrad",
    "tilt": "mrad",
    "board": "mm",
    "focus": "thousandths of it",
    "knock": "mrad",
}

WORDS: dict[What, str] = {
    "pan": "pan slipped",
    "tilt": "tilt slipped",
    "board": " moved during placement ",
    "focus": "camera navcam_left was refocused",
    "knock": "camera navcam_left was knocked",
}


class Task(NamedTuple):
    """One bench on which one thing happens."""

    what: What
    size: float
    after: int
    seed: int


class Found(NamedTuple):
    """Whether it was named, and whether anything was said to be wrong."""

    named: bool
    doubted: bool


def plan(task: Task) -> BenchPlan:
    """Return the bench's plan."""
    sign = float(np.random.default_rng([task.seed, 11]).choice([-1.0, 1.0]))
    mishap = Mishap(task.what, task.after, sign * task.size)
    return replace(plan_of("driven", LOOKS, task.seed), mishaps=(mishap,))


def found(task: Task) -> Found:
    """Return what the fit of one bench says."""
    survey = simulate_bench(task.seed, plan(task))
    try:
        fit = fit_bench(survey)
    except CalibError as refused:
        return Found(WORDS[task.what] in str(refused), True)
    named = any(WORDS[task.what] in note for note in fit.notes)
    reasons = [r.sentence for r in judge_bench(survey, fit).reasons if r.grade != "good"]
    return Found(named, any("there is no check picture" not in sentence for sentence in reasons))


def main(words: Sequence[str] | None = None) -> int:
    """Print the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--benches", type=at_least(1), default=10, help="of each thing, size and moment")
    parser.add_argument("--seed", type=at_least(0), default=1, help="of the first bench; the others follow")
    parser.add_argument("--after", type=at_least(1), nargs="+", default=[4, 6], help="looks (default 4 6)")
    parser.add_argument("--only", choices=sorted(SIZES), nargs="+", default=list(SIZES), help="what happens")
    add_task_options(parser)
    options = parser.parse_args(words)
    seeds = range(options.seed, options.seed + options.benches)
    tasks = [
        Task(what, size, after, seed)
        for what in options.only
        for after in options.after
        for size in SIZES[what]
        for seed in seeds
    ]
    results = results_of(
        options, "mishaps", found, tasks, lambda t: f"seed {t.seed}, {t.what} {t.size:g} after {t.after}"
    )
    if results is None:
        return 0
    print(f"of {options.benches} each: named, and said to be wrong")
    for what in options.only:
        print(f"| {what}, {UNITS[what]} | " + " | ".join(f"{1e3 * size:g}" for size in SIZES[what]) + " |")
        print("| --- " * (1 + len(SIZES[what])) + "|")
        for after in options.after:
            cells = []
            for size in SIZES[what]:
                mine = [r for t, r in zip(tasks, results, strict=True) if t[:3] == (what, size, after)]
                cells.append(f"{sum(r.named for r in mine)}, {sum(r.doubted for r in mine)}")
            print(f"| after {after} looks | " + " | ".join(cells) + " |")
    return 0


if __name__ == "__main__":
    end(main)
