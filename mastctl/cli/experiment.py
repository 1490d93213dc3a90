"""``mastctl experiment`` on any daemon, ``mastctl demo`` on the simulated rover.

``experiment pointing`` is here; the paper's other experiments are programs of a checkout, `STUDIES`.
"""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn

import mastctl
from mastctl.cli import output
from mastctl.cli.daemon import DAEMON, client_of
from mastctl.cli.options import command, option
from mastctl.cli.output import Answer, Shown, WrongUse, check_folder
from mastctl.cli.rig import HEADS, SPEED, WIRE

if TYPE_CHECKING:
    from mastctl.client import Client
    from mastctl.experiment.pointing import ClickTruth, TargetRecord

STUDIES = {
    "handoff": "hand targets over from Pancam to Navcam to Hazcam and measure the errors",
    "approach": "follow a rock from 10 m to 1 m on the simulated rover, beside the paper's Table I",
    "calibration": "simulated surveys of several sizes, beside the paper's Tables IV and V",
}
"""Experiments that are ``tools.studies.NAME`` in a checkout; their own ``--help`` has their options."""

TARGETS = (
    option("--targets N", "targets at each distance", default=3),
    option("--seed SEED", "chooses views and pixels", default=1),
    option("--distances M...", "ranges in metres", default=[10.0, 6.0, 2.0]),
)


def become_study(name: str, options: Any) -> NoReturn:
    """Replace this process by a study of the checkout. Raises WrongUse where there is none."""
    root = Path(mastctl.__file__).parents[1]
    if not (root / "tools" / "studies" / f"{name}.py").is_file():
        raise WrongUse(
            f"'experiment {name}' is a program of mastctl's source code, which is not in {root}; in a clone "
            f"of it, run tools/setup and then '.venv/bin/mastctl experiment {name}'"
        )
    path = os.pathsep.join(filter(None, (str(root), os.environ.get("PYTHONPATH"))))
    command = [sys.executable, "-P", "-m", f"tools.studies.{name}", *options]
    os.execve(command[0], command, os.environ | {"PYTHONPATH": path})


for _name, _summary in STUDIES.items():
    command(f"experiment {_name}", help=f"{_summary} (in a checkout)")(partial(become_study, _name))


@command(
    "experiment pointing",
    *DAEMON,
    *TARGETS,
    option("--out DIR", "folder for report.html, targets.csv and record.json; none is written without"),
    help="point at random textured targets and measure the residuals",
    example="--targets 20 --out pointing",
)
def _pointing(args: argparse.Namespace) -> Answer:
    check_folder(args.out, "--out")
    with client_of(args) as client:
        return _run(args, client, None, ())


@command(
    "demo",
    *TARGETS,
    option("--out DIR", "folder for the report", default=Path("mastctl_demo")),
    option("--config FILE", "a simulated rig of one's own, whose seed is its own"),
    option(f"--head {HEADS}", "simulated head (default ptu_d46_70, or that of --wire)"),
    WIRE,
    SPEED,
    example="--out demo",
)
def _demo(args: argparse.Namespace) -> Answer:
    """Start a simulated rover behind a daemon on a free port, and run the experiment on it."""
    from drivers.simulation_clock import MAX
    from mastctl.client import Client
    from mastctl.config import load_config
    from mastctl.daemon import RunningDaemon
    from mastctl.experiment.pointing import head_pair
    from mastctl.experiment.simulated import head_note, simulated_config, simulation_truth

    check_folder(args.out, "--out")
    packaged = args.config is None
    config = simulated_config(
        load_config(args.config),
        head=args.head,
        wire=args.wire,
        speed=MAX if packaged and args.speed is None else args.speed,
        seed=args.seed if packaged else None,
    )
    compiles = "building the simulated rover and its ground (the first time also compiling the renderer)"
    with output.waiting(args.json, compiles):
        running = RunningDaemon(config)
    with running as daemon, Client(daemon.url) as client:
        rover = daemon.hardware.simulation
        assert rover is not None  # both configurations are of simulated rovers
        rig = daemon.service.stored.rig
        camera = head_pair(rig, set(config.hardware.cameras))[0]
        behind = f" behind {args.wire} bytes" if args.wire else ""
        output.show_line(f"simulated rover at {daemon.url}, head {rover.settings.head.name}{behind}")
        return _run(args, client, simulation_truth(rover), (head_note(rover, rig, camera),))


def _run(
    args: argparse.Namespace, client: Client, truth: ClickTruth | None, notes: tuple[str, ...]
) -> Answer:
    """Run, with a progress bar on stderr, and write the report if it is wanted; 1 if no target landed."""
    from mastctl.experiment.pointing import run_pointing_experiment
    from mastctl.experiment.pointing_report import (
        PICTURES_PER_DISTANCE,
        pointing_table,
        write_pointing_report,
    )

    with run_bar(args, "pointing", args.targets * len(args.distances)) as step:

        def show(record: TargetRecord) -> None:
            where = f"{record.distance_m:g} m, target {record.index}"
            left = (f"{x:+.2f}, {y:+.2f} px" for x, y in (one.residual_px for one in record.landings))
            found = f"{where}: {record.range_m:.2f} m away, residual {', then '.join(left)}"
            step(f"pointing at {record.distance_m:g} m", record.error and f"{where}: {record.error}", found)

        experiment = run_pointing_experiment(
            client,
            targets=args.targets,
            distances_m=tuple(args.distances),
            seed=args.seed,
            truth=truth,
            notes=notes,
            on_target=show,
            pictures=PICTURES_PER_DISTANCE if args.out is not None else 0,
        )
    page = None if args.out is None else write_pointing_report(experiment, args.out)
    shown = Shown(
        f"Pointing residuals, rms px ({experiment.camera}, {experiment.status.get('hardware')} hardware)",
        *pointing_table(experiment.summaries).turned(),
        [*experiment.notes, *([] if page is None else [f"report: {page}"])],
    )
    document = experiment.as_json() | ({} if page is None else {"report": str(page)})
    return Answer(document, shown, 0 if any(record.landings for record in experiment.records) else 1)


@contextmanager
def run_bar(args: argparse.Namespace, name: str, total: int | None) -> Iterator[Callable[..., None]]:
    """Show on stderr how far a run is.

    It yields a function that is called after each part with what is done now (empty: as before), why the
    part failed (empty: it did not), and what it found if that is worth a line.
    """
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
    console = Console(stderr=True, quiet=getattr(args, "json", False))  # tools have no --json
    with Progress(*columns, console=console) as progress:
        task = progress.add_task(name, total=total)

        def step(doing: str, failure: str, found: str = "") -> None:
            if failure:
                console.print(failure, style="red", markup=False)
            elif found:
                console.print(found, markup=False, highlight=False)
            progress.update(task, advance=1, description=doing or None)

        yield step
