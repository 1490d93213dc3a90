"""Options of every experiment and campaign that is made of tasks: where they run."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import TypeVar

from mastctl.cli import output
from mastctl.cli.options import Group, option

Task = TypeVar("Task")
Result = TypeVar("Result")


TASKS = Group(
    (
        option("--executor WHERE", "local: this machine's processes; dask:ADDRESS", default="local"),
        option("--workers N", "local processes (default: one a processor)"),
    ),
    title="tasks",
    about="where they run (docs/how-to/simulation.md)",
)


def check_place(args: argparse.Namespace) -> None:
    """Refuse options of a running daemon beside --simulated, and of tasks without it. Raises WrongUse."""
    if args.simulated:
        for name in ("url", "config", "lease"):
            if getattr(args, name) is not None:
                raise output.WrongUse(
                    f"--{name} names a running daemon; --simulated starts rovers of its own"
                )
        return
    for name, usual in (("executor", "local"), ("workers", None)):
        if getattr(args, name) != usual:
            raise output.WrongUse(
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
