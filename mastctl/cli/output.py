"""How a command shows results and refusals: JSON for programs, tables for people, one line an error."""

from __future__ import annotations

import argparse
import json
import pwd
import sys
import tempfile
from collections.abc import Iterable, Mapping, Sequence
from contextlib import AbstractContextManager
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from mastctl.report import tables

if TYPE_CHECKING:
    from rich.progress import Progress


class CommandError(Exception):
    """A command that failed.

    Parameters
    ----------
    code
        For programs, ``snake_case``.
    message
        One plain sentence.
    exit_code
        2 for wrong use or bad input, 1 for a failure.
    detail
        More for programs; must be JSON.
    """

    def __init__(
        self, code: str, message: str, exit_code: int = 1, detail: Mapping[str, Any] | None = None
    ) -> None:
        self.code = code
        self.exit_code = exit_code
        self.detail = detail
        super().__init__(message)


class WrongUse(CommandError):
    """Options or arguments that make no sense; exit code 2."""

    def __init__(self, message: str) -> None:
        super().__init__("wrong_use", message, exit_code=2)


def print_json(document: Mapping[str, Any]) -> None:
    """Write one JSON document to stdout; a value that is not finite is the caller's defect (ValueError)."""
    sys.stdout.write(json.dumps(document, allow_nan=False) + "\n")


class Shown(NamedTuple):
    """A table for people, with a title and notes under it."""

    title: str
    columns: Sequence[str]
    rows: Iterable[Sequence[str]]
    notes: Sequence[str] = ()


class Answer(NamedTuple):
    """The result of a command.

    Attributes
    ----------
    document
        For programs: the one JSON document.
    shown
        For people: a line, or lines and tables; None shows the document as `tables_of` has it.
    code
        The exit code.
    """

    document: Mapping[str, Any]
    shown: str | Shown | Iterable[str | Shown] | None = None
    code: int = 0


def show(args: argparse.Namespace, answer: Answer) -> int:
    """Print an answer at once, as JSON or for people, and return its exit code."""
    if args.json:
        from mastctl.as_json import as_json

        print_json(as_json(answer.document))
    else:
        shown = answer.shown
        for one in (
            tables_of(answer.document)
            if shown is None
            else [shown]
            if isinstance(shown, (str, Shown))
            else shown
        ):
            if isinstance(one, Shown):
                print_table(*one)
            else:
                indent = len(one) - len(one.lstrip(" "))
                sys.stdout.write(" " * indent + one_line(one) + "\n")
    sys.stdout.flush()
    return answer.code


def tables_of(document: Mapping[str, Any], title: str = "") -> list[Shown]:
    """Return any record as tables: its values by their keys, and each of its lists of records by itself."""
    if len(document) == 1 and not title:
        [(key, value)] = document.items()
        if isinstance(value, Mapping):
            return tables_of(value, key)
    lists = {key: value for key, value in document.items() if _is_rows(value)}
    rows = [row for key, value in document.items() if key not in lists for row in _rows(key, value)]
    found = [Shown(title, ("", ""), rows)] if rows else []
    for key, records in lists.items():
        columns = list(dict.fromkeys(name for record in records for name in record))
        cells = [[cell(record.get(name)) for name in columns] for record in records]
        found.append(Shown(key, [_plain(name) for name in columns], cells))
    return found


def _is_rows(value: Any) -> bool:
    return isinstance(value, (list, tuple)) and bool(value) and all(isinstance(one, Mapping) for one in value)


def _rows(key: str, value: Any) -> Iterable[tuple[str, str]]:
    if isinstance(value, Mapping) and value:
        for name, inner in value.items():
            yield from _rows(f"{key}.{name}" if key else str(name), inner)
    else:
        yield _plain(key), cell(value)


def _plain(key: str) -> str:
    return key.replace("_", " ")


def cell(value: Any) -> str:
    """Return a value of a record for a cell of a table."""
    if value is None or value == "" or value == [] or value == {}:
        return "-"
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        return f"{value:.6g}"
    if isinstance(value, Mapping):
        return ", ".join(f"{key} {cell(inner)}" for key, inner in value.items())
    if isinstance(value, (list, tuple)):
        return ", ".join(map(cell, value))
    return one_line(str(value))


def print_table(
    title: str, columns: Sequence[str], rows: Iterable[Sequence[str]], notes: Sequence[str] = ()
) -> None:
    """Write a table to stdout, numbers to the right and texts to the left, notes under it."""
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text

    rows = list(rows)
    table = Table(title=Text(title), title_justify="left", show_header=any(columns))
    for column, numeric in zip(columns, tables.Table(columns, rows).numeric, strict=True):
        table.add_column(Text(column), justify="right" if numeric else "left", overflow="fold")
    for row in rows:
        table.add_row(*(Text(one) for one in row))
    console = Console(file=sys.stdout, soft_wrap=True)
    console.print(table)
    for note in notes:
        console.print(Text(note))


def tell(message: str) -> None:
    """Write one line for people to stderr."""
    sys.stderr.write(one_line(message) + "\n")


def one_line(text: str) -> str:
    """Return the text on one line, with control characters (a file may hold any) shown as escapes."""
    joined = " ".join(text.split())
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode("ascii") for c in joined)


def refuse(error: BaseException, as_json: bool) -> int:
    """Print a refusal, as JSON on stdout or as one line on stderr, and return the exit code."""
    known = as_command_error(error)
    message = one_line(str(known)) or known.code
    if as_json:
        body: dict[str, Any] = {"code": known.code, "message": message}
        if known.detail:
            body["detail"] = dict(known.detail)
        print_json({"error": body})
        sys.stdout.flush()
    else:
        sys.stderr.write(f"mastctl: {message}\n")
    return known.exit_code


def as_command_error(error: BaseException) -> CommandError:
    """Return what a refusal says to the outside: code, message, exit code.

    Bad files and bad options end with 2, everything else with 1. An error that carries a ``code`` keeps it.
    An unforeseen error is ``internal``: its type and text on one line.
    """
    from calib.errors import BadFile, CalibError, Unreachable
    from drivers.errors import BadOptions, DriverError

    if isinstance(error, CommandError):
        return error
    if isinstance(error, BadFile):
        return CommandError("bad_file", str(error), 2, {"path": str(error.path), "place": error.place})
    if isinstance(error, Unreachable):
        return CommandError("unreachable", str(error), 1, {"reason": error.code})
    if isinstance(error, BadOptions):
        return CommandError("bad_options", str(error), 2)
    if isinstance(error, (CalibError, DriverError)) or isinstance(getattr(error, "code", None), str):
        detail = getattr(error, "detail", None)
        detail = detail if isinstance(detail, Mapping) else None
        return CommandError(_code_of(error), str(error), int(getattr(error, "exit_code", 1)), detail)
    if isinstance(error, OSError):
        where = f"{error.filename}: " if error.filename is not None else ""
        return CommandError("file_system", f"{where}{error.strerror or error}", 1)
    if isinstance(error, MemoryError):
        return CommandError("out_of_memory", "not enough memory for this input", 1)
    return CommandError("internal", f"a defect of the program: {type(error).__name__}: {error}", 1)


def _code_of(error: BaseException) -> str:
    """The error's own code, else its class name in snake_case."""
    code = getattr(error, "code", None)
    if isinstance(code, str) and code:
        return code
    name = type(error).__name__
    return "".join(f"_{c.lower()}" if c.isupper() and i else c.lower() for i, c in enumerate(name))


def progress_bar(quiet: bool) -> Progress:
    """Return a progress bar on stderr; ``quiet`` shows nothing."""
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
    return Progress(*columns, console=Console(stderr=True, quiet=quiet))


def waiting(quiet: bool, what: str) -> AbstractContextManager[Any]:
    """Return what shows on stderr what a person waits for; ``quiet`` shows nothing."""
    from rich.console import Console

    return Console(stderr=True, quiet=quiet).status(what)


def check_file(path: Path, option: str) -> None:
    """Refuse a file that cannot be written. Raises CommandError."""
    try:
        target = path.resolve()
        if not target.parent.is_dir():
            raise unusable(f"{option} {path}", f"there is no folder {path.parent}; make it first")
        if target.is_dir():
            raise unusable(f"{option} {path}", "is a folder; a file is expected")
        if target.exists() and not target.is_file():
            raise unusable(f"{option} {path}", "is no regular file; a file is expected")
        _try_to_write(target.parent, f"{option} {path}")
    except (OSError, ValueError) as error:
        raise unusable(f"{option} {path}", str(error)) from None


def check_folder(path: Path | None, option: str) -> None:
    """Refuse a folder that cannot be made or written to; None is no folder. Raises CommandError."""
    if path is None:
        return
    try:
        folder = path.resolve()
        while not folder.exists() and folder != folder.parent:
            folder = folder.parent
        if not folder.is_dir():
            raise unusable(f"{option} {path}", f"{folder} is a file; a folder is expected")
        _try_to_write(folder, f"{option} {path}")
    except (OSError, ValueError) as error:
        raise unusable(f"{option} {path}", str(error)) from None


def _try_to_write(folder: Path, what: str) -> None:
    """Write a nameless file there: permissions alone do not show it (read-only disks, root)."""
    try:
        with tempfile.TemporaryFile(dir=folder):
            pass
    except OSError as error:
        raise unusable(what, f"nothing can be written to {folder}: {error.strerror or error}") from None


def user_name(uid: int) -> str:
    """Return the name of a user of this machine, or the number of one without a name."""
    try:
        return pwd.getpwuid(uid).pw_name
    except KeyError:
        return str(uid)


def unusable(what: str, why: str) -> CommandError:
    """Return the refusal of a place where a command cannot write."""
    return CommandError("file_system", f"{what}: {why}", exit_code=2)
