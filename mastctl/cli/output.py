"""How a command shows results and refusals: JSON for programs, tables for people, one line an error."""

from __future__ import annotations

import argparse
import json
import re
import sys
import tempfile
from collections.abc import Iterable, Mapping, Sequence
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any, NamedTuple


class CommandError(Exception):
    """A command that failed: ``code`` for programs, one plain sentence, and more ``detail``, which is JSON.

    ``exit_code`` is 2 for wrong use or bad input, 1 for a failure.
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


class Shown(NamedTuple):
    """A table for people, with a title and notes under it."""

    title: str
    columns: Sequence[str]
    rows: Iterable[Sequence[str]]
    notes: Sequence[str] = ()


class Answer(NamedTuple):
    """The result of a command: the JSON document for programs, what people see, and the exit code.

    ``shown`` is a line or a table, or several; None shows the whole document.
    """

    document: Mapping[str, Any]
    shown: str | Shown | Iterable[str | Shown] | None = None
    code: int = 0


def show(args: argparse.Namespace, answer: Answer) -> int:
    """Print an answer at once, as JSON or for people, and return its exit code."""
    if args.json:
        from mastctl.as_json import as_json

        _print_json(as_json(answer.document))
    else:
        shown = tables_at(answer.document) if answer.shown is None else answer.shown
        for one in [shown] if isinstance(shown, (str, Shown)) else shown:
            if isinstance(one, Shown):
                _print_table(one)
            else:
                indent = len(one) - len(one.lstrip(" "))
                sys.stdout.write(" " * indent + one_line(one) + "\n")
    sys.stdout.flush()
    return answer.code


def tables_at(document: Mapping[str, Any], keys: str = "", title: str = "") -> list[Shown]:
    """Return a record as tables: its values by their keys, and each of its lists of records by itself.

    ``keys`` are those of `chosen`; all of it without them.
    """
    from mastctl.as_json import as_json

    plain = as_json(document)
    plain = chosen(plain, keys) if keys else plain
    if len(plain) == 1 and not title:
        [(key, value)] = plain.items()
        if isinstance(value, Mapping):
            return tables_at(value, "", key)
    lists = {
        key: value for key, value in plain.items()
        if isinstance(value, list) and value and all(isinstance(one, Mapping) for one in value)
    }  # fmt: skip
    rows = [row for key, value in plain.items() if key not in lists for row in _rows(key, value)]
    found = [Shown(title, ("", ""), rows)] if rows else []
    for key, records in lists.items():
        columns = list(dict.fromkeys(name for record in records for name in record))
        cells = [[cell(record.get(name)) for name in columns] for record in records]
        found.append(Shown(key, [_plain(name) for name in columns], cells))
    return found


def chosen(document: Mapping[str, Any], keys: str) -> dict[str, Any]:
    """Return the values at these keys, those that are not there or null left out.

    ``mast.file`` is a value of a record in the document, or of each record of a list in it;
    ``cameras.*.age_s`` is one of each record in ``cameras``.
    """
    found: dict[str, Any] = {}
    for key in keys.split():
        name, _, rest = key.partition(".")
        if name == "*":
            found |= {each: found.get(each, {}) | chosen(inner, rest) for each, inner in document.items()}
            continue
        value = document.get(name)
        if rest and isinstance(value, Mapping):
            found[name] = found.get(name, {}) | chosen(value, rest)
        elif rest and isinstance(value, list):
            before = found.get(name) or [{} for _ in value]
            found[name] = [row | chosen(one, rest) for row, one in zip(before, value, strict=True)]
        elif not rest and value not in (None, "", [], {}):
            found[name] = value
    return {name: value for name, value in found.items() if value not in ([], {})}


def _rows(key: str, value: Any) -> Iterable[tuple[str, str]]:
    if isinstance(value, Mapping) and value:
        for name, inner in value.items():
            yield from _rows(f"{key}.{name}" if key else str(name), inner)
    else:
        yield _plain(key), cell(value)


def _plain(key: str) -> str:
    return key.replace("_", " ")


def cell(value: Any) -> str:
    """Return a value of a record for a cell of a table, or for a line."""
    if value is None or value == "" or value == [] or value == {}:
        return "-"
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        return f"{value:.6g}"
    if isinstance(value, Mapping):
        return ", ".join(f"{_plain(str(key))} {cell(inner)}" for key, inner in value.items())
    if isinstance(value, (list, tuple)):
        return ", ".join(map(cell, value))
    return one_line(str(value))


def _print_table(shown: Shown) -> None:
    """Write a table to stdout, numbers to the right and texts to the left, notes under it."""
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text

    from mastctl.report import pages

    rows = list(shown.rows)
    table = Table(title=Text(shown.title), title_justify="left", show_header=any(shown.columns))
    for column, numeric in zip(shown.columns, pages.Table(shown.columns, rows).numeric, strict=True):
        table.add_column(Text(column), justify="right" if numeric else "left", overflow="fold")
    for row in rows:
        table.add_row(*(Text(one) for one in row))
    console = Console(file=sys.stdout, soft_wrap=True)
    console.print(table)
    for note in shown.notes:
        console.print(Text(note))


def show_line(message: str) -> None:
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
        detail = {"detail": dict(known.detail)} if known.detail else {}
        _print_json({"error": {"code": known.code, "message": message, **detail}})
        sys.stdout.flush()
    else:
        sys.stderr.write(f"mastctl: {message}\n")
    return known.exit_code


def _print_json(document: Mapping[str, Any]) -> None:
    """Write one JSON document; a value that is not finite is the caller's defect (ValueError)."""
    sys.stdout.write(json.dumps(document, allow_nan=False) + "\n")


def as_command_error(error: BaseException) -> CommandError:
    """Return an error as a refusal with code, message and exit code.

    Bad files and bad options end with 2, everything else with 1. An error that carries a ``code`` keeps it.
    An unforeseen error is ``internal``: its type and text on one line.
    """
    from calib.errors import BadFile, CalibError, Unreachable
    from drivers.errors import BadOptions, DriverError

    if isinstance(error, CommandError):
        return error
    code, detail = getattr(error, "code", None), getattr(error, "detail", None)
    exit_code = 2 if isinstance(error, (BadFile, BadOptions)) else int(getattr(error, "exit_code", 1))
    if isinstance(error, BadFile):
        detail = {"path": str(error.path), "place": error.place}
    elif isinstance(error, Unreachable):
        code, detail = "unreachable", {"reason": error.code}
    if isinstance(error, (CalibError, DriverError)) or isinstance(code, str):
        snake = re.sub(r"(?<!^)([A-Z])", r"_\1", type(error).__name__).lower()
        return CommandError(
            code or snake, str(error), exit_code, detail if isinstance(detail, Mapping) else None
        )
    if isinstance(error, OSError):
        where = f"{error.filename}: " if error.filename is not None else ""
        return CommandError("file_system", f"{where}{error.strerror or error}")
    if isinstance(error, MemoryError):
        return CommandError("out_of_memory", "not enough memory for this input")
    return CommandError("internal", f"a defect of the program: {type(error).__name__}: {error}")


def waiting(quiet: bool, what: str) -> AbstractContextManager[Any]:
    """Return what shows on stderr what a person waits for; ``quiet`` shows nothing."""
    from rich.console import Console

    return Console(stderr=True, quiet=quiet).status(what)


def check_file(path: Path, option: str) -> None:
    """Refuse a file that cannot be written. Raises CommandError."""
    target = path.resolve()
    if target.exists() and not target.is_file():
        raise WrongUse(f"{option} {path}: is a folder or a device; a file is expected")
    if not target.parent.is_dir():
        raise WrongUse(f"{option} {path}: there is no folder {path.parent}; make it first")
    check_folder(target.parent, f"{option} {path}:")


def check_folder(path: Path | None, option: str) -> None:
    """Refuse a folder that cannot be made or written to; None is no folder. Raises CommandError."""
    if path is None:
        return
    folder = path.resolve()
    try:
        while not folder.exists() and folder != folder.parent:
            folder = folder.parent
        with tempfile.TemporaryFile(dir=folder):  # permissions alone do not show it (read-only disks, root)
            pass
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or str(error)
        raise WrongUse(f"{option} {path}: nothing can be written to {folder}: {reason}") from None
