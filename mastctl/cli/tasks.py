"""Options of every experiment and campaign that is made of tasks: where they run, where results are kept."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

from mastctl.cli import output
from mastctl.cli.options import Group, option

if TYPE_CHECKING:
    pass


Task = TypeVar("Task")
Result = TypeVar("Result")


TASKS = Group(
    (
        option("--executor WHERE", "local: this machine's processes; dask:ADDRESS", default="local"),
        option("--workers N", "local processes (default: one a processor)"),
        option("--results DIR", "keep each task's result, and run none that is there (default: OUT/tasks)"),
    ),
    title="tasks",
    about="where they run, and how a run goes on (docs/how-to/simulation.md)",
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
    for name, usual in (("executor", "local"), ("workers", None), ("results", None)):
        if getattr(args, name) != usual:
            raise output.WrongUse(
                f"--{name} belongs to --simulated, which runs simulated rovers of its own; a running daemon "
                "is one mast, and its targets come one after another"
            )


def results_of(
    args: argparse.Namespace,
    what: str,
    function: Callable[[Task], Result],
    tasks: Sequence[Task],
    label: Callable[[Task], str] = str,
    failure: Callable[[Result], str] = lambda _: "",
    found: Callable[[Result], str] = lambda _: "",
) -> list[Result]:
    """Run a command's tasks as its options say, with a progress bar on stderr.

    Parameters
    ----------
    what
        The tasks, for the progress bar.
    function, tasks, label
        As `mastctl.experiment.tasks.Work`.
    failure
        The reason that a result is a failure, shown as it comes; empty if it is none.
    found
        A line for a result that is no failure; empty for none.

    Returns
    -------
    list
        The results in the order of the tasks.
    """
    from mastctl.experiment.tasks import KeptResults, Work, open_executor

    work = Work(function, tasks, label)
    out = getattr(args, "out", None)
    beside = None if not isinstance(out, Path) or out.suffix else out / "tasks"
    folder: Path | None = args.results or beside
    output.check_folder(folder, "--results")
    kept = None if folder is None else KeptResults(folder)

    def ended(task: Task, result: Result) -> None:
        why, line = failure(result), found(result)
        step("", why and f"{label(task)}: {why}", line and f"{label(task)}: {line}")

    try:
        with run_bar(args, what, len(set(work.ids))) as step:
            return work.run(partial(open_executor, args.executor, args.workers), kept, ended)
    except KeyboardInterrupt:
        if kept is not None:
            of = len(set(work.ids))
            count = sum(map(kept.holds, set(work.ids)))
            output.tell(f"{count} of {of} tasks are kept in {folder}; the same command goes on with the rest")
        raise


@contextmanager
def run_bar(args: argparse.Namespace, what: str, total: int | None) -> Iterator[Callable[..., None]]:
    """Show on stderr how far a run is.

    It yields a function that is called after each part with what is done now (empty: as before), why the
    part failed (empty: it did not), and what it found if that is worth a line.
    """
    with output.progress_bar(getattr(args, "json", False)) as progress:  # tools have no --json
        task = progress.add_task(what, total=total)

        def step(doing: str, failure: str, found: str = "") -> None:
            if failure:
                progress.console.print(failure, style="red", markup=False)
            elif found:
                progress.console.print(found, markup=False, highlight=False)
            progress.update(task, advance=1, description=doing or None)

        yield step
