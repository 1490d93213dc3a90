"""How a command tells its results and refusals: JSON for programs, tables for people, one line an error."""

from __future__ import annotations

import argparse
import json
import math
import pwd
import sys
import tempfile
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import AbstractContextManager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mastctl.report import tables

if TYPE_CHECKING:
    from rich.progress import Progress


class CommandError(Exception):
    """A command that cannot do what was asked.

    Parameters
    ----------
    code
        A word for programs, ``snake_case``.
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


def print_table(
    title: str, columns: Sequence[str], rows: Iterable[Sequence[str]], notes: Sequence[str] = ()
) -> None:
    """Write a table for people to stdout, numbers to the right and words to the left, notes under it."""
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text

    rows = list(rows)
    table = Table(title=Text(title), title_justify="left")
    for column, numeric in zip(columns, tables.Table(columns, rows).numeric, strict=True):
        table.add_column(Text(column), justify="right" if numeric else "left")
    for row in rows:
        table.add_row(*(Text(cell) for cell in row))
    console = Console(file=sys.stdout, soft_wrap=True)
    console.print(table)
    for note in notes:
        console.print(Text(note))


def print_lines(lines: Iterable[str], last: str, style: str) -> None:
    """Write lines for people to stdout, the last in a style of rich; a terminal breaks them at words."""
    from rich.console import Console
    from rich.text import Text

    console = Console(file=sys.stdout)
    for line, its in [*((line, "") for line in lines), (last, style)]:
        console.print(Text(one_line(line), style=its), soft_wrap=not console.is_terminal)


def tell(message: str) -> None:
    """Write one line for people to stderr."""
    sys.stderr.write(one_line(message) + "\n")


def one_line(text: str) -> str:
    """Return the text on one line, with control characters (a file may hold any) shown as escapes."""
    joined = " ".join(text.split())
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode("ascii") for c in joined)


def refuse(error: BaseException, as_json: bool) -> int:
    """Tell a refusal, as JSON on stdout or as one line on stderr, and return the exit code."""
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
    An error that nobody foresaw is ``internal``: its type and text on one line.
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
        told = detail if isinstance(detail, Mapping) else None
        return CommandError(_code_of(error), str(error), int(getattr(error, "exit_code", 1)), told)
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
    """Return a progress bar on stderr: what, how many of how many, since when. ``quiet`` shows nothing."""
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
    return Progress(*columns, console=Console(stderr=True, quiet=quiet))


def waiting(quiet: bool, what: str) -> AbstractContextManager[Any]:
    """Return what shows on stderr what a person is waiting for, meanwhile. ``quiet`` shows nothing."""
    from rich.console import Console

    return Console(stderr=True, quiet=quiet).status(what)


def finite_number(text: str) -> float:
    """Read an option's value as a finite number (argparse ``type``)."""
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not math.isfinite(value) or "_" in text:
        raise argparse.ArgumentTypeError(f"'{text}' where a finite number is expected")
    return value


def angle_rad(text: str) -> float:
    """Read an option's value as an angle of at most a full turn, radians (argparse ``type``)."""
    value = finite_number(text)
    if abs(value) > math.tau:
        raise argparse.ArgumentTypeError(
            f"'{text}' where radians are expected, at most {math.tau:.2f} (a full turn); "
            f"{value:g} degrees are {math.radians(value):.6g}"
        )
    return value


def positive_number(text: str) -> float:
    """Read an option's value as a finite number above zero (argparse ``type``)."""
    value = finite_number(text)
    if value <= 0:
        raise argparse.ArgumentTypeError(f"'{text}' where a number above zero is expected")
    return value


def not_negative(text: str) -> float:
    """Read an option's value as a finite number of zero or more (argparse ``type``)."""
    value = finite_number(text)
    if value < 0:
        raise argparse.ArgumentTypeError(f"'{text}' where zero or more is expected")
    return value


def at_least(least: int) -> Callable[[str], int]:
    """Return what reads an option's value as a whole number of at least ``least`` (argparse ``type``)."""

    def read(text: str) -> int:
        if not text.isascii() or not text.isdigit() or int(text) < least:
            raise argparse.ArgumentTypeError(f"'{text}' where a whole number of at least {least} is expected")
        return int(text)

    return read


def add_model(parser: Any) -> None:
    """Add ``--model`` to a parser or a group of one."""
    parser.add_argument(
        "--model",
        type=_model_kind,
        metavar="MODEL",
        help="camera model of all cameras: cahv, cahvor, cahvore, opencv4, opencv5, opencv8, opencv12, "
        "opencv14 or opencv_fisheye (default: as survey.yaml says)",
    )

    parser.add_argument(
        "--compare-models",
        action="store_true",
        help="also fit each camera as other models, compare them by pictures left out of the fit, and name "
        "the one that earns its parameters",
    )


def _model_kind(text: str) -> str:
    """Return a camera model's name as files have it; argparse tells the refusal."""
    from calib.geometry.cahvor import KINDS

    if text.upper() not in KINDS:
        known = ", ".join(kind.lower() for kind in KINDS)
        raise argparse.ArgumentTypeError(f"'{text}' is not a camera model; known are {known}")
    return text.upper()


def check_file(path: Path, option: str) -> None:
    """Refuse a file that cannot be written, by what is there now."""
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
    """Refuse a folder that cannot be made or written to; None is no folder."""
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
    """Write a nameless file there: permissions alone do not tell (read-only disks, root)."""
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
