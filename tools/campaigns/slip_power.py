"""How large a joint's slip has to be for a survey's fit to name it.

    .venv/bin/python -m tools.campaigns.slip_power --surveys 20 --seed 1

Simulated surveys of the Navcams (12 placements for the mast). In each a joint is read off by some size: from
the middle of the head's pictures on, or at one placement alone. Counted is how often the fit names it (as a
slip or an attitude), and how often it says at least that something is wrong (any wider model, a stated sigma
that is too small, a board that contradicts the others, an image or a point of the station left out).
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from calib.errors import CalibError
from calib.files.mast_file import load_rig
from calib.fit.joint import fit_joint
from calib.mast.rig import Rig
from calib.survey import Survey
from drivers.sim_survey.blunders import with_slipped_joint
from drivers.sim_survey.plan import SurveyPlan
from drivers.sim_survey.survey import simulate_survey
from mastctl.calibration.expected import RARELY
from mastctl.cli.output import at_least
from mastctl.cli.tasks import add_task_options, results_of
from tools.arguments import end

PAIR = ("navcam_left", "navcam_right")
SIZES_RAD = (0.0005, 0.0008, 0.0012, 0.002, 0.003)
WAYS = ("from the middle on", "at one placement")
NAMES = {WAYS[0]: ("slip of pan", "slip of tilt"), WAYS[1]: ("attitude",)}


class Task(NamedTuple):
    """One survey with one slip."""

    rig: Rig
    way: str
    size_rad: float
    seed: int


class Found(NamedTuple):
    """Whether the slip was named, and whether anything was said to be wrong."""

    named: bool
    doubted: bool


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


def found(task: Task) -> Found:
    """Return what a fit says of one slipped survey; a refusal counts as a doubt."""
    rng = np.random.default_rng([task.seed, 11])
    joint, sign = str(rng.choice(["pan", "tilt"])), float(rng.choice([-1.0, 1.0]))
    survey = simulate_survey(task.rig, task.seed, SurveyPlan(mast_boards=12))[0]
    try:
        fit = fit_joint(slipped(survey, task.way, joint, sign * task.size_rad, rng))
    except CalibError:
        return Found(False, True)
    asked = [model.name for model in fit.wider if model.significant]
    odd = any(one.least_chance * len(fit.left_out_boards) < RARELY for one in fit.left_out_boards)
    wrong = any(component.wrong for component in fit.components)
    left_out = any(outlier.kind != "dot" for outlier in fit.outliers)
    return Found(any(name in NAMES[task.way] for name in asked), bool(asked) or odd or wrong or left_out)


def main() -> int:
    """Print the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    root = Path(__file__).resolve().parents[2]
    parser.add_argument("--rig", type=Path, default=root / "configs" / "sim" / "rocky8.yaml")
    parser.add_argument("--surveys", type=at_least(1), default=20, help="of each size and way")
    parser.add_argument("--seed", type=at_least(0), default=1, help="of the first survey; the others follow")
    add_task_options(parser)
    options = parser.parse_args()
    rig = load_rig(options.rig).rig
    rig = replace(rig, cameras={name: rig.cameras[name] for name in PAIR}, stereo={"navcam": PAIR})
    seeds = range(options.seed, options.seed + options.surveys)
    tasks = [Task(rig, way, size, seed) for seed in seeds for way in WAYS for size in SIZES_RAD]
    results = results_of(
        options, "slips", found, tasks, lambda t: f"seed {t.seed}, {1e3 * t.size_rad:g} mrad {t.way}"
    )
    if results is None:
        return 0
    print("slip, mrad          " + "".join(f"{1e3 * size:8g}" for size in SIZES_RAD))
    for way in WAYS:
        for what in Found._fields:
            cells = []
            for size in SIZES_RAD:
                mine = [r for t, r in zip(tasks, results, strict=True) if (t.way, t.size_rad) == (way, size)]
                cells.append(f"{100 * np.mean([getattr(r, what) for r in mine]):6.0f} %")
            print(f"{way:20s}" + "".join(cells) + f"  {what}")
    return 0


if __name__ == "__main__":
    end(main)
