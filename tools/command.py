"""What the tools share: an orderly end, options of campaigns, cases as tasks, and tables.

A campaign has cases that are drawn, each a task of its own. What a case is stands in the campaign: a value
that carries its seed, and a function of it. The rest is here: the options that all have, the processes (or
the cluster) that carry cases out, and how results are printed.
"""

from __future__ import annotations

import argparse
import importlib
import json
import signal
import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, NoReturn, TypeVar

import numpy as np
from numpy.typing import ArrayLike

from calib.errors import CalibError
from drivers.errors import DriverError
from mastctl import signals
from mastctl.cli.experiment import run_bar
from mastctl.cli.options import at_least
from mastctl.cli.output import CommandError, WrongUse, as_command_error, one_line
from mastctl.errors import MastctlError

Task = TypeVar("Task")
Result = TypeVar("Result")
Row = Mapping[str, Any]


class _Options(argparse.ArgumentParser):
    """A parser whose refusal `end` prints, as JSON where that is wanted."""

    def error(self, message: str) -> NoReturn:
        """Refuse wrong use."""
        raise WrongUse(f"{self.prog}: {message}")


def options(
    doc: str | None,
    cases: int | None = None,
    of: str = "",
    *,
    seed: int | None = 1,
    as_json: bool = False,
    tasks: bool = True,
) -> argparse.ArgumentParser:
    """Return a tool's parser; by default a campaign's.

    Parameters
    ----------
    doc
        The module's docstring, which its help shows.
    cases, of
        Default of ``--cases``, and what a case is of; None: it has no such option.
    seed
        Default of ``--seed``; None: nothing is drawn.
    as_json
        Whether there is ``--json``.
    tasks
        Whether its cases are tasks (docs/how-to/simulation.md).
    """
    started = getattr(sys.modules["__main__"].__spec__, "name", "").removesuffix(".__main__")
    parser = _Options(
        prog=f"python -m {started}" if started.startswith("tools.") else None,
        description=doc,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    if cases is not None:
        words = f"{of or 'how many'} (default {cases})"
        parser.add_argument("--cases", type=at_least(1), default=cases, metavar="N", help=words)
    if seed is not None:
        words = f"of all that is drawn; cases with seeds of their own begin there (default {seed})"
        parser.add_argument("--seed", type=at_least(0), default=seed, metavar="S", help=words)
    if as_json:
        parser.add_argument("--json", action="store_true", help="one JSON document")
    if tasks:
        where = "local: this machine's processes; dask:ADDRESS (default local)"
        parser.add_argument("--executor", default="local", metavar="WHERE", help=where)
        processes = "local processes (default: one a processor)"
        parser.add_argument("--workers", type=at_least(1), metavar="N", help=processes)
    return parser


def results_of(
    args: argparse.Namespace,
    name: str,
    function: Callable[[Task], Result],
    tasks: Sequence[Task],
    label: Callable[[Task], str] = str,
    failure: Callable[[Result], str] = lambda _: "",
) -> list[Result]:
    """Run tasks as a campaign's options say, with a progress bar of this ``name`` on stderr.

    ``failure`` returns why a result is a failure, which is shown as it comes, or an empty text. The rest as
    `mastctl.experiment.tasks.run_tasks`.
    """
    from mastctl.experiment.tasks import open_executor, run_tasks

    def ended(task: Task, result: Result) -> None:
        reason = failure(result)
        step("", reason and f"{label(task)}: {reason}")

    with run_bar(args, name, len(tasks)) as step, open_executor(args.executor, args.workers) as executor:
        return run_tasks(executor, function, tasks, label, ended)


def show(args: argparse.Namespace, rows: Iterable[Row], columns: Mapping[str, str], below: str = "") -> None:
    """Print rows: one JSON document with ``--json``, else a table as docs have it.

    Parameters
    ----------
    columns
        Heading to a format of the row's keys, such as ``{rms_px:.2f}``; of a key that is not there, or is
        None, the cell stays empty.
    below
        A key of sentences that stand under their row.
    """
    if args.json:
        print(json.dumps(list(rows)))
        return
    print(heading(columns))
    for row in rows:
        print(line(*(_cell(form, row) for form in columns.values())), flush=True)
        for words in row.get(below) or ():
            print(f"    {words}")


def heading(columns: Iterable[str]) -> str:
    """Return the first two lines of a table."""
    names = tuple(columns)
    return f"{line(*names)}\n{'| --- ' * len(names)}|"


def line(*cells: object) -> str:
    """Return one line of a table."""
    return f"| {' | '.join(map(str, cells))} |"


def _cell(form: str, row: Row) -> str:
    try:
        return form.format_map(row)
    except (KeyError, TypeError, IndexError):
        return ""


def rms(values: Any) -> float:
    """Return the root mean square of all numbers; not-a-number of none."""
    numbers = np.asarray(values, dtype=float)
    return float(np.sqrt(np.mean(numbers**2))) if numbers.size else float("nan")


def held_percent(by_case: Sequence[ArrayLike]) -> tuple[float, float]:
    """Return the mean over cases of how many of a hundred hold in each, and its standard error.

    Errors of one case go together, so that the scatter of whole cases is what tells how sure a rate is.
    """
    rates = 100 * np.array([np.asarray(held).mean() for held in by_case])
    return float(rates.mean()), float(rates.std(ddof=1) / np.sqrt(len(rates))) if len(rates) > 1 else np.nan


def numbers(words: str) -> tuple[float, ...]:
    """Read numbers of 0 or more with commas between them (argparse ``type``)."""
    values = tuple(float(word) for word in words.split(","))
    if not all(0.0 <= value < np.inf for value in values):
        raise argparse.ArgumentTypeError(f"{words!r} where numbers of 0 or more are expected")
    return values


def end(main: Callable[[], int | None]) -> None:
    """Run a tool and exit with its code; a signal ends it in order, with its folders and processes.

    A refusal of the project's own is one sentence and the exit code that `mastctl` has for it; a file that
    cannot be read or written is one sentence and 2. What refuses in its own way carries its exit code.
    """
    try:
        with signals.raised():
            sys.exit(_by_its_name(main)())
    except KeyboardInterrupt as ended:
        sys.exit(128 + (ended.number if isinstance(ended, signals.Ended) else signal.SIGINT))
    except (CalibError, DriverError, MastctlError, CommandError) as error:
        refusal = as_command_error(error)
    except OSError as error:
        if error.filename is None:
            raise
        refusal = CommandError("file_system", f"{error.filename}: {error.strerror}", exit_code=2)
    if "--json" in sys.argv:
        sys.stdout.write(json.dumps({"error": {"code": refusal.code, "message": str(refusal)}}) + "\n")
    else:
        sys.stderr.write(f"{one_line(str(refusal))}\n")
    sys.exit(refusal.exit_code)


def _by_its_name(main: Callable[[], int | None]) -> Callable[[], int | None]:
    """The same function of the module's own name: tasks and results travel by it, and by no ``__main__``."""
    spec = main.__globals__.get("__spec__")
    if main.__module__ != "__main__" or spec is None:
        return main
    named: Callable[[], int | None] = getattr(importlib.import_module(spec.name), main.__name__)
    return named
