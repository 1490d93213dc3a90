"""``mastctl experiment`` on any daemon, ``mastctl demo`` on the simulated rover.

``experiment pointing`` is here; the paper's other experiments are programs of a checkout, `STUDIES`.
"""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, NoReturn, TypeVar

import mastctl
from mastctl.cli import output
from mastctl.cli.daemon import DAEMON, client_of
from mastctl.cli.options import Group, command, option
from mastctl.cli.output import Answer, Shown, WrongUse, check_folder
from mastctl.cli.rig import HEADS, SPEED, WIRE

if TYPE_CHECKING:
    from mastctl.client import Client
    from mastctl.experiment.pointing import ClickTruth, PointingExperiment, TargetRecord

Task = TypeVar("Task")
Result = TypeVar("Result")

DEFAULT_DISTANCES_M = (10.0, 6.0, 2.0)
STUDIES = {
    "handoff": "hand targets over from Pancam to Navcam to Hazcam and measure the errors",
    "approach": "follow a rock from 10 m to 1 m on the simulated rover, beside the paper's Table I",
    "calibration": "simulated surveys of several sizes, beside the paper's Tables IV and V",
}
"""Experiments that are ``tools.studies.NAME`` in a checkout; their own ``--help`` has their options."""


TASKS = Group(
    (
        option("--executor WHERE", "local: this machine's processes; dask:ADDRESS", default="local"),
        option("--workers N", "local processes (default: one a processor)"),
    ),
    title="tasks",
    about="where they run (docs/how-to/simulation.md)",
)
SEED = option("--seed SEED", "chooses views and pixels", default=1)


def study_of(argv: Sequence[str]) -> tuple[str, list[str]] | None:
    """Return the study that a command line names, and its own options; None if it names none."""
    plain = [at for at, one in enumerate(argv) if not one.startswith("-")][:2]
    if len(plain) < 2 or argv[plain[0]] != "experiment" or argv[plain[1]] not in STUDIES:
        return None
    return argv[plain[1]], [one for at, one in enumerate(argv) if at not in plain]


def become_study(name: str, options: Sequence[str]) -> NoReturn:
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


def _study(name: str) -> Callable[[argparse.Namespace], int]:
    return lambda args: become_study(name, ())


for _name, _summary in STUDIES.items():
    command(f"experiment {_name}", help=f"{_summary} (in a checkout)")(_study(_name))


@command(
    "experiment pointing",
    *DAEMON,
    option("--targets N", "targets at each distance", default=10),
    SEED,
    option("--out DIR", "folder for report.html, targets.csv and record.json; none is written without"),
    option("--distances M...", "ranges in metres", default=list(DEFAULT_DISTANCES_M)),
    option(
        "--simulated", "on the packaged simulated rover, a fresh one for each target, compared with the truth"
    ),
    option(f"--head {HEADS}", "with --simulated: the simulated head (default ptu_d46_70)"),
    TASKS,
    help="point at random textured targets and measure the residuals",
    example="--targets 20 --out pointing",
)
def run_pointing(args: argparse.Namespace) -> Answer:
    """Run the experiment on the daemon that --url or --config names, or on simulated rovers of its own."""
    check_folder(args.out, "--out")
    check_place(args)
    if args.simulated:
        return _run_simulated(args)
    if args.head is not None:
        raise WrongUse("--head belongs to --simulated; a running daemon has its own head")
    with client_of(args) as client:
        return _report(args, _run(args, client, tuple(args.distances), None, ()))


def _run_simulated(args: argparse.Namespace) -> Answer:
    """Run each target on a simulated rover of its own."""
    from mastctl.experiment.pointing_report import PICTURES_PER_DISTANCE
    from mastctl.experiment.simulated import PointingTask, Rover, joined_pointings, one_pointing

    rover = Rover(args.head or HEADS.split("|")[0], args.seed)
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
    return _report(args, joined_pointings(parts))


@command(
    "demo",
    option("--targets N", "targets at each distance", default=3),
    SEED,
    option("--out DIR", "folder for the report", default=Path("mastctl_demo")),
    option(
        "--config FILE",
        "a simulated rig of one's own, with its own seed; --seed then chooses views and pixels only",
    ),
    option(f"--head {HEADS}", "simulated head (default ptu_d46_70, or that of --wire)"),
    WIRE,
    SPEED,
    example="--out demo",
)
def run_demo(args: argparse.Namespace) -> Answer:
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
        notes = (head_note(rover, rig, camera),)
        behind = f" behind {args.wire} bytes" if args.wire else ""
        output.tell(f"simulated rover at {daemon.url}, head {rover.settings.head.name}{behind}")
        experiment = _run(args, client, DEFAULT_DISTANCES_M, simulation_truth(rover), notes)
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
    """The residuals of the pointings at a target, in one line."""
    left = (f"{x:+.2f}, {y:+.2f} px" for x, y in (landing.residual_px for landing in record.landings))
    return f"{record.range_m:.2f} m away, residual " + ", then ".join(left)


def _report(args: argparse.Namespace, experiment: PointingExperiment) -> Answer:
    """Write the report if it is wanted; 1 if no target at all landed."""
    from mastctl.experiment.pointing_report import pointing_table, write_pointing_report

    page = None if args.out is None else write_pointing_report(experiment, args.out)
    shown = Shown(
        f"Pointing residuals, rms px ({experiment.camera}, {experiment.status.get('hardware')} hardware)",
        *pointing_table(experiment.summaries).turned(),
        [*experiment.notes, *([] if page is None else [f"report: {page}"])],
    )
    document = experiment.as_json() | ({} if page is None else {"report": str(page)})
    return Answer(document, shown, 0 if any(record.landings for record in experiment.records) else 1)


def check_place(args: argparse.Namespace) -> None:
    """Refuse options of a running daemon beside --simulated, and of tasks without it. Raises WrongUse."""
    if args.simulated:
        for name in ("url", "config", "lease"):
            if getattr(args, name) is not None:
                raise WrongUse(f"--{name} names a running daemon; --simulated starts rovers of its own")
        return
    for name, usual in (("executor", "local"), ("workers", None)):
        if getattr(args, name) != usual:
            raise WrongUse(
                f"--{name} belongs to --simulated, which runs simulated rovers of its own; a running daemon "
                "is one mast, and its targets come one after another"
            )


def results_of(
    args: argparse.Namespace,
    name: str,
    function: Callable[[Task], Result],
    tasks: Sequence[Task],
    label: Callable[[Task], str] = str,
    failure: Callable[[Result], str] = lambda _: "",
    found: Callable[[Result], str] = lambda _: "",
) -> list[Result]:
    """Run a command's tasks as its options say, with a progress bar of this ``name`` on stderr.

    ``failure`` returns why a result is a failure, ``found`` a line for one that is none; either is shown as
    it comes, unless it is empty. The rest as `mastctl.experiment.tasks.run_tasks`.
    """
    from mastctl.experiment.tasks import open_executor, run_tasks

    def ended(task: Task, result: Result) -> None:
        reason, line = failure(result), found(result)
        step("", reason and f"{label(task)}: {reason}", line and f"{label(task)}: {line}")

    with run_bar(args, name, len(tasks)) as step, open_executor(args.executor, args.workers) as executor:
        return run_tasks(executor, function, tasks, label, ended)


@contextmanager
def run_bar(args: argparse.Namespace, name: str, total: int | None) -> Iterator[Callable[..., None]]:
    """Show on stderr how far a run is.

    It yields a function that is called after each part with what is done now (empty: as before), why the
    part failed (empty: it did not), and what it found if that is worth a line.
    """
    with output.progress_bar(getattr(args, "json", False)) as progress:  # tools have no --json
        task = progress.add_task(name, total=total)

        def step(doing: str, failure: str, found: str = "") -> None:
            if failure:
                progress.console.print(failure, style="red", markup=False)
            elif found:
                progress.console.print(found, markup=False, highlight=False)
            progress.update(task, advance=1, description=doing or None)

        yield step
