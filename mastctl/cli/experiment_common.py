"""What the commands of experiments share: numbers of options, and how a report is written and told."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from pathlib import Path
from typing import Any

from mastctl.cli import output

at_least_one = output.at_least(1)
seed = output.at_least(0)


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


def check_writable(folder: Path) -> None:
    """Refuse an impossible --out before the minutes of the run, not after them."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        probe = folder / ".writable"
        probe.touch()
        probe.unlink()
    except OSError as error:
        raise output.CommandError("file_system", f"--out {folder}: {error.strerror}", exit_code=2) from error
