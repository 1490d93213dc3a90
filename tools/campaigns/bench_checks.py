"""How often check pictures of a bench that is right are called bad.

    .venv/bin/python -m tools.campaigns.bench_checks --cases 300 --seed 1

Benches as `tools.campaigns.bench_coverage` has them are linearised at the truth: each of twelve is simulated
without noise and fitted; errors of all that is measured are then drawn anew for every bench (corners normal,
readings anywhere within a count), and its calibration is off by the linear least-squares step that they make.
That is honest where errors are small against the bends of the model, as on benches, and leaves out the choice
of terms and of outliers; `bench_coverage --checks` has these too, on fewer benches. Printed is how often the
check pictures of a camera are called bad, and how their chances are spread: a right one is below 0.1 in a
tenth of all.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple
from unittest import mock

import numpy as np

from calib.adjust.changes import reading_rates
from calib.adjust.robust import Weighed
from calib.adjust.significance import chance_of_sum
from calib.adjust.terms import JOINTS, ImageTerm
from calib.calibrate.bench.fit import fit_bench
from calib.calibrate.bench.problem import BenchProblem
from calib.calibrate.bench.told import UNPREDICTED, check_weights
from mastctl.cli.output import at_least
from tools.campaigns.bench_coverage import CHANCES, HEADS, plan_of
from tools.command import end, options, run_cases
from tools.sim_survey.bench import simulate_bench

GEOMETRIES = 12


class ChecksTask(NamedTuple):
    """Benches of one geometry: head, head positions a placement, fitted and not, how many benches, seed."""

    head: str
    attitudes: int
    checks: int
    benches: int
    seed: int


class ChecksFound(NamedTuple):
    """Chances of the check pictures (benches, cameras), and the part of their expected squares that is the
    calibration's, by camera."""

    chances: np.ndarray
    part: np.ndarray


def found(task: ChecksTask) -> ChecksFound:
    """Return the chances of the check pictures of some benches."""
    plan = replace(plan_of(task.head, task.attitudes, task.seed, task.checks), gross=0.0)
    survey = simulate_bench(task.seed, replace(plan, noise=0.0))
    with mock.patch("calib.calibrate.bench.fit.told") as told:
        fit_bench(survey)
    bench: BenchProblem = told.call_args.args[0]
    weighed: Weighed = told.call_args.args[2]
    rng = np.random.default_rng([task.seed, 17])
    steps = drawn_steps(weighed, task.benches, rng)
    chances, part = [], []
    for camera in weighed.fit.state.cameras:
        mine = [term for term in bench.terms.checks if term.camera == camera]
        weights = check_weights(weighed, mine)
        exact = replace(weighed, covariance=np.zeros_like(weighed.covariance))
        part.append(1.0 - check_weights(exact, mine).sum() / weights.sum())
        squares = drawn_squares(
            weighed, mine, steps, np.random.default_rng([task.seed, 19, *camera.encode()])
        )
        chances.append([chance_of_sum(float(square), weights) for square in squares])
    return ChecksFound(np.array(chances).T, np.array(part))


def drawn_steps(weighed: Weighed, count: int, rng: np.random.Generator) -> np.ndarray:
    """Return what drawn errors of all measurements make of the unknowns, (count, p)."""
    pull = np.zeros((count, len(weighed.covariance)))
    for what, block in weighed.problem.blocks(weighed.fit.state):
        if what.kind is None:
            continue
        size = (count, len(block.residual))
        errors = rng.uniform(-(3**0.5), 3**0.5, size) if what.kind == JOINTS else rng.standard_normal(size)
        pull[:, block.columns] += errors @ block.jacobian
    return np.asarray(pull @ weighed.covariance)


def drawn_squares(
    weighed: Weighed, terms: Sequence[ImageTerm], steps: np.ndarray, rng: np.random.Generator
) -> np.ndarray:
    """Return the sums of squares, px², of a camera's check pictures (benches,)."""
    squares = np.zeros(len(steps))
    exact, state = weighed.problem.at_rest(), weighed.fit.state
    blocks = exact.image_blocks(state, terms)
    by_reading = reading_rates(exact, state, terms, [block.residual for block in blocks])
    for term, block, read in zip(terms, blocks, by_reading, strict=True):
        readings = rng.uniform(-(3**0.5), 3**0.5, (len(steps), 2)) * weighed.problem.joint_rad
        off = rng.standard_normal((len(steps), len(block.residual)))
        off += steps[:, block.columns] @ block.jacobian.T + readings @ read.T
        squares += np.sum((off * np.repeat(term.sigma_px, 2)) ** 2, axis=1)
    return squares


def main(words: Sequence[str] | None = None) -> int:
    """Print the table."""
    parser = options(__doc__, 300, "benches")
    parser.add_argument("--head", choices=sorted(HEADS), default="driven")
    parser.add_argument("--attitudes", type=at_least(4), default=8, help="head positions per placement")
    parser.add_argument("--checks", type=at_least(1), default=3, help="the same that are not fitted")
    args = parser.parse_args(words)
    each = -(-args.cases // GEOMETRIES)
    tasks = [
        ChecksTask(args.head, args.attitudes, args.checks, each, seed)
        for seed in range(args.seed, args.seed + GEOMETRIES)
    ]
    results = run_cases(args, "checks", found, tasks, lambda task: f"seed {task.seed}")
    chances = np.concatenate([one.chances for one in results]).ravel()
    part = np.concatenate([one.part for one in results])
    below = ", ".join(f"{100 * np.mean(chances < p):.2f} % below {p:g}" for p in CHANCES)
    bad = int(np.sum(chances < UNPREDICTED))
    print(
        f"check pictures of {len(chances)} cameras of {each * GEOMETRIES} benches ({args.head}): {bad} "
        f"called bad, {len(chances) * UNPREDICTED:.2g} meant\n"
        f"chances: {below}\n"
        f"calibration's part of the squares: {part.min():.2f} to {part.max():.2f}"
    )
    return 0


if __name__ == "__main__":
    end(main)
