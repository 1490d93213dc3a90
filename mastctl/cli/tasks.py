"""Options of every experiment and campaign that is made of tasks: where they run, where results are kept."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from mastctl.cli import output

if TYPE_CHECKING:
    from mastctl.client import Client
    from mastctl.config import Config
    from mastctl.daemon import RunningDaemon
    from mastctl.experiment.tasks import KeptResults, Work


Task = TypeVar("Task")
Result = TypeVar("Result")


def add_task_options(parser: argparse.ArgumentParser) -> None:
    """Add --executor, --workers, --results, --list-tasks and --task."""
    group = parser.add_argument_group(
        "tasks", "where they run, and how a run goes on (docs/how-to/simulation.md)"
    )
    group.add_argument(
        "--executor", default="local", metavar="WHERE",
        help="local: processes of this machine (default); dask:ADDRESS: a Dask cluster",
    )  # fmt: skip
    group.add_argument(
        "--workers", type=output.at_least(1), metavar="N", help="local processes (default: one a processor)"
    )
    group.add_argument(
        "--results", type=Path, metavar="DIR",
        help="keep each task's result there, and run none that is there (default: OUT/tasks with --out DIR)",
    )  # fmt: skip
    group.add_argument(
        "--list-tasks", action="store_true", help="only list the tasks: ID, whether it is done, what it is"
    )
    group.add_argument(
        "--task", action="append", metavar="ID",
        help="only run this task here and keep its result; may be given several times",
    )  # fmt: skip


def refuse_task_options(args: argparse.Namespace) -> None:
    """Refuse the options of tasks for a running daemon: it is one mast, whose targets come one by one."""
    given = {
        "--executor": args.executor != "local",
        "--workers": args.workers is not None,
        "--results": args.results is not None,
        "--list-tasks": args.list_tasks,
        "--task": bool(args.task),
    }
    for option, used in given.items():
        if used:
            raise output.WrongUse(
                f"{option} belongs to --simulated, which runs simulated rovers of its own; a running daemon "
                "is one mast, and its targets come one after another"
            )


def results_of(
    args: argparse.Namespace,
    what: str,
    function: Callable[[Task], Result],
    tasks: Sequence[Task],
    label: Callable[[Task], str],
    failure: Callable[[Result], str] = lambda _: "",
    done: Callable[[Result], None] = lambda _: None,
    found: Callable[[Result], str] = lambda _: "",
) -> list[Result] | None:
    """Run a command's tasks as its options say, with a progress bar on stderr.

    Parameters
    ----------
    what
        The tasks, for the progress bar.
    function, tasks, label
        As `mastctl.experiment.tasks.Work`.
    failure
        Why a result is a failure, which is then told as it comes; empty if it is none.
    done
        Called with each result as it comes, in any order.
    found
        A line for a result that is no failure; empty for none.

    Returns
    -------
    list or None
        The results in the order of the tasks; None where they were only listed, or some of them run.
    """
    from mastctl.cli.output import check_folder
    from mastctl.experiment.tasks import KeptResults, Work

    work = Work(function, tasks, label)
    folder: Path | None = args.results or _beside(getattr(args, "out", None))
    if folder is None and args.task:
        raise output.WrongUse("--task needs --results DIR, where its result is kept")
    check_folder(folder, "--results")
    kept = None if folder is None else KeptResults(folder)
    as_json = getattr(args, "json", False)
    if args.list_tasks:
        _list(work, kept, as_json)
        return None
    if args.task:
        work = _chosen(work, args.task)

    def tell(task: Task, result: Result) -> None:
        why = failure(result)
        told = found(result)
        step("", why and f"{label(task)}: {why}", told and f"{label(task)}: {told}")
        done(result)

    try:
        with run_bar(args, what, len(set(work.ids))) as step:
            results = work.run(_opened(args), kept, tell)
    except KeyboardInterrupt:
        if kept is not None:
            held = sum(map(kept.holds, set(work.ids)))
            of = len(set(work.ids))
            output.tell(f"{held} of {of} tasks are kept in {folder}; the same command goes on with the rest")
        raise
    if not args.task:
        return results
    _tell_chosen(work, folder, as_json)
    return None


def _beside(out: Any) -> Path | None:
    """Where results are kept without a word of it: in the report's folder, if there is one."""
    return None if not isinstance(out, Path) or out.suffix else out / "tasks"


def _opened(args: argparse.Namespace) -> Callable[[], AbstractContextManager[Any]]:
    from mastctl.experiment.tasks import open_executor

    if args.task:
        return partial(open_executor, "local", min(len(args.task), args.workers or 1))
    return partial(open_executor, args.executor, args.workers)


def _list(work: Work[Any, Any], kept: KeptResults | None, as_json: bool) -> None:
    rows = [
        {"id": name, "done": kept is not None and kept.holds(name), "task": work.label(task)}
        for name, task in zip(work.ids, work.tasks, strict=True)
    ]
    if as_json:
        output.print_json({"tasks": rows})
        return
    for row in rows:
        sys.stdout.write(f"{row['id']}  {'done' if row['done'] else 'to do'}  {row['task']}\n")


def _chosen(work: Work[Any, Any], names: Sequence[str]) -> Work[Any, Any]:
    """The tasks of these names."""
    from mastctl.experiment.tasks import Work

    for name in names:
        if name not in work.ids:
            raise output.WrongUse(
                f"--task {name} is none of these {len(work.tasks)} tasks; --list-tasks names them, and other "
                "options or another version of the program give other names"
            )
    tasks = [task for name, task in zip(work.ids, work.tasks, strict=True) if name in names]
    return Work(work.function, tasks, work.label)


def _tell_chosen(work: Work[Any, Any], folder: Path | None, as_json: bool) -> None:
    if as_json:
        output.print_json({"kept": list(work.ids), "results": str(folder)})
        return
    for name, task in zip(work.ids, work.tasks, strict=True):
        output.tell(f"task {name} ({work.label(task)}) is kept in {folder}")


at_least_one = output.at_least(1)


def add_run_options(parser: argparse.ArgumentParser, seed_help: str, out_help: str) -> None:
    """Add --seed and --out."""
    parser.add_argument(
        "--seed", type=output.at_least(0), default=1, metavar="S", help=f"{seed_help} (default 1)"
    )
    parser.add_argument("--out", type=Path, metavar="DIR", help=out_help)


@contextmanager
def simulated_daemon(args: argparse.Namespace, config: Config) -> Iterator[tuple[RunningDaemon, Client]]:
    """Start a simulated rover behind a daemon on a free port, with a client of it, and end it."""
    from mastctl.client import Client
    from mastctl.daemon import RunningDaemon

    with output.waiting(
        args.json, "building the simulated rover and its ground (the first time also compiling the renderer)"
    ):
        daemon = RunningDaemon(config)
    with daemon, Client(daemon.url) as client:
        yield daemon, client


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


def tell_report(
    args: argparse.Namespace,
    write: Callable[[Path], Path],
    document: Callable[[], dict[str, Any]],
    show: Callable[[list[str]], None],
) -> None:
    """Write the report if asked; print the document for programs, or have the tables shown, with its page."""
    page = None if args.out is None else write(args.out)
    if args.json:
        output.print_json(document() | ({} if page is None else {"report": str(page)}))
    else:
        show([] if page is None else [f"report: {page}"])
