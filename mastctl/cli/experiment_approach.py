"""``mastctl experiment approach``: follow rocks from ten metres to one on the simulated rover."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mastctl.cli import output

if TYPE_CHECKING:
    from mastctl.experiment.approach import ApproachRun, ApproachTask


def add_parser(kinds: Any) -> None:
    """Add ``approach`` to the experiments."""
    from mastctl.cli.experiment_common import add_run_options, at_least_one
    from mastctl.cli.tasks import add_task_options

    parser = kinds.add_parser(
        "approach",
        help="follow a target from Pancam at 10 m to Hazcam at 1 m (simulated, a minute a run)",
    )
    parser.add_argument(
        "--mast", type=Path, metavar="MAST.yaml",
        help="the mast file that is believed (default: the packaged one, from a simulated survey)",
    )  # fmt: skip
    parser.add_argument("--runs", type=at_least_one, default=5, metavar="N", help="approaches (default 5)")
    parser.add_argument(
        "--on", choices=("rocks", "ground"), default="rocks",
        help="what targets lie on (default rocks; ground: wherever there is texture)",
    )  # fmt: skip
    out_help = "folder for stops.csv, record.json, a strip of pictures a run, and error.png"
    add_run_options(parser, "of the first run's scene and errors", out_help)
    add_task_options(parser)
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Run the approaches; 1 if no target at all was kept."""
    from rich.console import Console

    from calib.files.mast_file import load_rig
    from mastctl.cli.places import check_folder
    from mastctl.cli.tasks import results_of
    from mastctl.experiment.approach import ApproachTask, one_approach
    from mastctl.experiment.approach_report import write_record, write_strip
    from mastctl.packaged import config_folder

    check_folder(args.out, "--out")
    true = load_rig(config_folder() / "sim" / "rocky8.yaml").rig
    believed = load_rig(args.mast or config_folder() / "masts" / "rocky8_simulated.yaml").rig
    if lacking := [pair for pair in true.stereo if pair not in believed.stereo]:
        raise output.WrongUse(f"--mast {args.mast} has no stereo pair '{lacking[0]}'")
    runs: dict[int, ApproachRun] = {}
    console = Console(stderr=True, quiet=args.json)

    def done(one: ApproachRun) -> None:
        told = one.error or ("kept" if one.kept else f"lost: {one.stops[-1].reason}" if one.stops else "lost")
        console.print(f"seed {one.seed}: {told}", markup=False)
        runs[one.seed] = one
        if args.out is not None and not args.task:  # after every run: what is interrupted leaves its record
            write_record([runs[seed] for seed in sorted(runs)], args.out)
            write_strip(one, args.out)

    tasks = [ApproachTask(true, believed, args.seed + index, args.on) for index in range(args.runs)]
    found = results_of(args, "approaches", one_approach, tasks, _label, done=done)
    if found is None:
        return 0
    return _tell(args, found)


def _label(task: ApproachTask) -> str:
    return f"on {task.on}, seed {task.seed}"


def _tell(args: argparse.Namespace, runs: list[ApproachRun]) -> int:
    from mastctl.experiment.approach_report import approach_table, counted, summary

    if args.json:
        output.print_json(summary(runs))
    else:
        notes = [counted(runs)]
        notes += ["3 times the rms, along the line of sight, to its right and below it, in the rover frame"]
        notes += [f"record: {args.out}"] if args.out is not None else []
        output.print_table(
            f"Approach from 10 m to 1 m, targets on {args.on}, simulated rover", *approach_table(runs), notes
        )
    return 0 if any(one.kept for one in runs) else 1
