"""What the commands of experiments share: options, the simulated rover, the progress of a run, its report."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mastctl.cli import output

if TYPE_CHECKING:
    from mastctl.client import Client
    from mastctl.config import Config
    from mastctl.daemon import RunningDaemon

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
