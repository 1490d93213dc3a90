"""``mastctl experiment handoff``: the paper's hand-offs on a daemon, or on the packaged simulated rover."""

from __future__ import annotations

import argparse
import sys
from contextlib import ExitStack
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mastctl.cli import output

if TYPE_CHECKING:
    from mastctl.client import Client
    from mastctl.experiment.handoff_record import HandoffExperiment, HandoffRecord
    from mastctl.experiment.known_points import KnownPoints
    from mastctl.experiment.pointing import ClickTruth

PICTURES_PER_STEP = 4
TARGETS = {"ground": "textured ground", "corner": "bricks' corners", "face": "middles of bricks' faces"}
MOST_BRICKS = 24  # what a scene takes
MOST_POINTS = 9  # of one brick: its upper corners and its faces but the bottom


def add_parser(kinds: Any) -> None:
    """Add ``handoff`` to the experiments."""
    from mastctl.cli.experiment_common import add_run_options, at_least_one
    from mastctl.cli.service import add_daemon_options

    parser = kinds.add_parser(
        "handoff",
        help="hand targets from Pancam to Navcam at 6 m and on to Hazcam at 2 m, and measure the errors",
    )
    add_daemon_options(parser)
    parser.add_argument(
        "--simulated", action="store_true",
        help="start the packaged simulated rover for it, and compare with the truth",
    )  # fmt: skip
    parser.add_argument(
        "--mast-file", type=Path, metavar="MAST.yaml",
        help="with --simulated: the mast file that its daemon uses (default: the packaged one)",
    )  # fmt: skip
    parser.add_argument(
        "--targets", type=at_least_one, metavar="N",
        help="targets of each hand-off (default 10, with --bricks all that show)",
    )  # fmt: skip
    parser.add_argument(
        "--bricks", type=at_least_one, metavar="N",
        help="put N bricks (at most 24) into the simulation, by turns at 2 m and at 6 m; their corners and "
        "the middles of their faces are the targets",
    )  # fmt: skip
    parser.add_argument(
        "--click-px", type=output.not_negative, default=0.2, metavar="PX",
        help="sigma of the noise added to the clicks (default 0.2)",
    )  # fmt: skip
    out_help = "folder for report.html, targets.csv, handoffs.jsonl and record.json"
    add_run_options(parser, "chooses views and pixels", out_help)
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Run the experiment; 1 if no target at all was handed over."""
    from mastctl.cli.places import check_folder
    from mastctl.cli.service import client_of

    if args.mast_file is not None and not args.simulated:
        raise output.WrongUse("--mast-file belongs to --simulated; a running daemon has its own mast file")
    if args.bricks is not None and not (args.simulated and args.bricks <= MOST_BRICKS):
        raise output.WrongUse(f"--bricks {args.bricks}: 1 to {MOST_BRICKS} are possible, with --simulated")
    check_folder(args.out, "--out")
    with ExitStack() as stack:
        if args.simulated:
            client, truth, points = _simulated(args, stack)
        else:
            client, truth, points = stack.enter_context(client_of(args)), None, None
        experiment = _run(args, client, truth, points)
    return _tell(args, experiment)


def _simulated(args: argparse.Namespace, stack: ExitStack) -> tuple[Client, ClickTruth, KnownPoints | None]:
    """The packaged simulated rover behind a daemon on a free port, with its bricks if they are asked for."""
    from mastctl.cli.experiment_common import simulated_daemon
    from mastctl.config import load_config
    from mastctl.experiment.demo import SimulationTruth, demo_config
    from mastctl.experiment.known_points import BrickPoints

    config = demo_config(load_config(None), head="ptu_d46_70", seed=args.seed, bricks=args.bricks or 0)
    if args.mast_file is not None:
        config = replace(config, mast_file=args.mast_file)
    daemon, client = stack.enter_context(simulated_daemon(args, config))
    rover = daemon.hardware.simulation
    assert rover is not None  # the packaged configuration is a simulated rover
    points = BrickPoints(rover) if args.bricks else None
    return client, SimulationTruth(rover), points


def _run(
    args: argparse.Namespace, client: Client, truth: ClickTruth | None, points: KnownPoints | None
) -> HandoffExperiment:
    """Run with a progress bar on stderr, one step a target."""

    from mastctl.cli.experiment_common import run_bar
    from mastctl.experiment.handoff import STEPS, run_handoff_experiment

    targets = args.targets or (MOST_POINTS * args.bricks if args.bricks else 10)
    total = None if args.bricks else targets * len(STEPS)  # how many points show is not known before
    with run_bar(args, "hand-off", total) as step:

        def show(record: HandoffRecord) -> None:
            where = f"{record.step}, target {record.index}"
            step(record.step, record.error and f"{where}: {record.error}")

        return run_handoff_experiment(
            client,
            targets=targets,
            seed=args.seed,
            click_px=args.click_px,
            truth=truth,
            points=points,
            on_target=show,
            pictures=PICTURES_PER_STEP if args.out is not None else 0,
        )


def _tell(args: argparse.Namespace, experiment: HandoffExperiment) -> int:
    from mastctl.cli.experiment_common import tell_report
    from mastctl.experiment.handoff_report import bias_sentences, handoff_table, write_handoff_report

    def show(notes: list[str]) -> None:
        noise = f"clicks with {experiment.click_px:g} px of noise; lengths in px of the destination camera"
        kinds = list(dict.fromkeys(row.kind for row in experiment.summaries))
        if not kinds:
            sys.stdout.write("\n".join(["no target was found to hand over", *notes]) + "\n")
        for kind in kinds:
            table = handoff_table([row for row in experiment.summaries if row.kind == kind])
            title = f"Hand-off errors of {TARGETS[kind]}, px ({experiment.status.get('hardware')} hardware)"
            last = [noise, *bias_sentences(experiment), *notes] if kind == kinds[-1] else []
            output.print_table(title, *table.turned(), last)

    tell_report(args, partial(write_handoff_report, experiment), experiment.as_json, show)
    return 0 if any(record.handed for record in experiment.records) else 1
