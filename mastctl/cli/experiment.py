"""``mastctl experiment`` on any daemon, ``mastctl demo`` on the simulated rover.

``experiment pointing`` is here; the paper's other experiments are programs of a checkout, `STUDIES`.
"""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn

import mastctl
from mastctl.cli import output
from mastctl.cli.output import check_folder
from mastctl.cli.tasks import (
    add_run_options,
    add_task_options,
    at_least_one,
    refuse_task_options,
    results_of,
    run_bar,
    simulated_daemon,
    tell_report,
)

if TYPE_CHECKING:
    from mastctl.client import Client
    from mastctl.experiment.pointing import ClickTruth, PointingExperiment, TargetRecord

DEFAULT_TARGETS = 10
DEMO_TARGETS = 3  # a first contact: a minute with installation and compiling
DEFAULT_DISTANCES_M = (10.0, 6.0, 2.0)
HEADS = ("ptu_d46_70", "dynamixel_x", "ph42")
STUDIES = {
    "handoff": "hand targets over from Pancam to Navcam to Hazcam and measure the errors",
    "approach": "follow a rock from 10 m to 1 m on the simulated rover, beside the paper's Table I",
    "calibration": "simulated surveys of several sizes, beside the paper's Tables IV and V",
}
"""Experiments that are ``tools.studies.NAME`` in a checkout; their own ``--help`` has their options."""


def add_commands(subparsers: Any) -> None:
    """Add ``experiment`` and ``demo``."""
    experiment = subparsers.add_parser("experiment", help="the paper's experiments")
    kinds = experiment.add_subparsers(dest="experiment", metavar="EXPERIMENT", required=True)
    pointing = kinds.add_parser("pointing", help="point at random textured targets and measure the residuals")
    from mastctl.cli.service import add_daemon_options

    add_daemon_options(pointing)
    _add_common(
        pointing, out_help="folder for report.html, targets.csv and record.json; none is written without"
    )
    pointing.add_argument(
        "--distances", type=output.positive_number, nargs="+", default=list(DEFAULT_DISTANCES_M), metavar="M",
        help="ranges in metres (default 10 6 2)",
    )  # fmt: skip
    pointing.add_argument(
        "--simulated", action="store_true",
        help="on the packaged simulated rover, a fresh one for each target, compared with the truth",
    )  # fmt: skip
    pointing.add_argument(
        "--head", choices=HEADS, help="with --simulated: the simulated head (default ptu_d46_70)"
    )
    add_task_options(pointing)
    pointing.set_defaults(run=run_pointing)

    for name, summary in STUDIES.items():
        study = kinds.add_parser(name, help=f"{summary} (in a checkout)", add_help=False)
        study.set_defaults(run=lambda args: become_study(args.experiment, ()))

    demo = subparsers.add_parser("demo", help="the pointing experiment on the packaged simulated rover")
    _add_common(demo, "folder for the report (default mastctl_demo)", DEMO_TARGETS)
    demo.add_argument(
        "--config", type=Path, metavar="FILE",
        help="a simulated rig of one's own, with its own seed; --seed then chooses views and pixels only",
    )  # fmt: skip
    demo.add_argument(
        "--head", choices=HEADS,
        help="simulated head (default ptu_d46_70, or that of --wire)",
    )  # fmt: skip
    demo.add_argument(
        "--wire", metavar="DRIVER",
        help="drive the head through this real driver and a byte simulator (default: in memory)",
    )  # fmt: skip
    demo.add_argument(
        "--speed", type=_speed, metavar="N",
        help="1: the rover takes its time; 10: a tenth of it; max: nothing waits (default)",
    )  # fmt: skip
    demo.set_defaults(run=run_demo, out=Path("mastctl_demo"))


def _speed(text: str) -> float | str:
    """A number, or a word that the configuration judges."""
    try:
        return float(text)
    except ValueError:
        return text


def _add_common(parser: argparse.ArgumentParser, out_help: str, targets: int = DEFAULT_TARGETS) -> None:
    """Options that both commands take."""
    parser.add_argument(
        "--targets",
        type=at_least_one,
        default=targets,
        metavar="N",
        help=f"targets at each distance (default {targets})",
    )
    add_run_options(parser, "chooses views and pixels", out_help)


def study_of(words: Sequence[str]) -> tuple[str, list[str]] | None:
    """Return the study that a command line names, and its own options; None if it names none."""
    plain = [at for at, word in enumerate(words) if not word.startswith("-")][:2]
    if len(plain) < 2 or words[plain[0]] != "experiment" or words[plain[1]] not in STUDIES:
        return None
    return words[plain[1]], [word for at, word in enumerate(words) if at not in plain]


def become_study(name: str, options: Sequence[str]) -> NoReturn:
    """Replace this process by a study of the checkout.

    Raises
    ------
    WrongUse
        If mastctl was installed without one.
    """
    root = Path(mastctl.__file__).parents[1]
    if not (root / "tools" / "studies" / f"{name}.py").is_file():
        raise output.WrongUse(
            f"'experiment {name}' is a program of mastctl's source code, which is not in {root}; in a clone "
            f"of it, run tools/setup and then '.venv/bin/mastctl experiment {name}'"
        )
    path = os.pathsep.join(filter(None, (str(root), os.environ.get("PYTHONPATH"))))
    command = [sys.executable, "-P", "-m", f"tools.studies.{name}", *options]
    os.execve(command[0], command, os.environ | {"PYTHONPATH": path})


def run_pointing(args: argparse.Namespace) -> int:
    """Run the experiment on the daemon that --url or --config names, or on simulated rovers of its own."""
    from mastctl.cli.service import client_of

    check_folder(args.out, "--out")
    if args.simulated:
        return _run_simulated(args)
    if args.head is not None:
        raise output.WrongUse("--head belongs to --simulated; a running daemon has its own head")
    refuse_task_options(args)
    with client_of(args) as client:
        return _report(args, _run(args, client, tuple(args.distances), None, ()))


def _run_simulated(args: argparse.Namespace) -> int:
    """Run each target on a simulated rover of its own."""
    from mastctl.cli.service import refuse_daemon_options
    from mastctl.experiment.pointing_report import PICTURES_PER_DISTANCE
    from mastctl.experiment.simulated import PointingTask, Rover, joined_pointings, one_pointing

    refuse_daemon_options(args)
    rover = Rover(args.head or HEADS[0], args.seed)
    shown = PICTURES_PER_DISTANCE if args.out is not None else 0
    tasks = [
        PointingTask(rover, distance_m, index, index < shown)
        for distance_m in dict.fromkeys(args.distances)
        for index in range(args.targets)
    ]
    parts = results_of(
        args,
        "pointing",
        one_pointing,
        tasks,
        lambda task: f"{task.distance_m:g} m, target {task.index}",
        lambda part: part.records[0].error,
        found=lambda part: _residuals(part.records[0]),
    )
    return 0 if parts is None else _report(args, joined_pointings(parts))


def run_demo(args: argparse.Namespace) -> int:
    """Start a simulated rover behind a daemon on a free port, and run the experiment on it."""
    from mastctl.config import load_config
    from mastctl.experiment.pointing import head_pair
    from mastctl.experiment.simulated import SimulationTruth, demo_config, head_note, own_config

    check_folder(args.out, "--out")
    if args.config is None:
        config = demo_config(
            load_config(None), head=args.head, wire=args.wire, seed=args.seed, speed=args.speed
        )
    else:
        config = own_config(load_config(args.config), head=args.head, wire=args.wire, speed=args.speed)
    with simulated_daemon(args, config) as (daemon, client):
        rover = daemon.hardware.simulation
        assert rover is not None  # both configurations are of simulated rovers
        rig = daemon.service.stored.rig
        camera = head_pair(rig, set(config.hardware.cameras))[0]
        notes = (head_note(rover, rig, camera),)
        behind = f" behind {args.wire} bytes" if args.wire else ""
        output.tell(f"simulated rover at {daemon.url}, head {rover.settings.head.name}{behind}")
        truth = SimulationTruth(rover)
        experiment = _run(args, client, DEFAULT_DISTANCES_M, truth, notes)
    return _report(args, experiment)


def _run(
    args: argparse.Namespace,
    client: Client,
    distances_m: tuple[float, ...],
    truth: ClickTruth | None,
    notes: tuple[str, ...],
) -> PointingExperiment:
    """Run with a progress bar on stderr, one step a target."""

    from mastctl.experiment.pointing import run_pointing_experiment
    from mastctl.experiment.pointing_report import PICTURES_PER_DISTANCE

    with run_bar(args, "pointing", args.targets * len(distances_m)) as step:

        def show(record: TargetRecord) -> None:
            where = f"{record.distance_m:g} m, target {record.index}"
            doing, failure = (
                f"pointing at {record.distance_m:g} m",
                record.error and f"{where}: {record.error}",
            )
            step(doing, failure, f"{where}: {_residuals(record)}")

        return run_pointing_experiment(
            client,
            targets=args.targets,
            distances_m=distances_m,
            seed=args.seed,
            truth=truth,
            notes=notes,
            on_target=show,
            pictures=PICTURES_PER_DISTANCE if args.out is not None else 0,
        )


def _residuals(record: TargetRecord) -> str:
    """What each pointing at a target left, in one line."""
    left = (f"{x:+.2f}, {y:+.2f} px" for x, y in (landing.residual_px for landing in record.landings))
    return f"{record.range_m:.2f} m away, residual " + ", then ".join(left)


def _report(args: argparse.Namespace, experiment: PointingExperiment) -> int:
    """Write the report if asked, print the table or the document; 1 if no target at all landed."""
    from mastctl.experiment.pointing_report import pointing_table, write_pointing_report

    def show(notes: list[str]) -> None:
        hardware = experiment.status.get("hardware")
        output.print_table(
            f"Pointing residuals, rms px ({experiment.camera}, {hardware} hardware)",
            *pointing_table(experiment.summaries).turned(),
            [*experiment.notes, *notes],
        )

    tell_report(args, partial(write_pointing_report, experiment), experiment.as_json, show)
    return 0 if any(record.landings for record in experiment.records) else 1
