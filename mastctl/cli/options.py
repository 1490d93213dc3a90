"""Commands and their options as a table over argparse: each is declared once, beside its function.

An option is written as its usage shows it: ``--target X Y Z``, ``--role view|operate|admin``, ``-q,--quiet``,
and a positional argument as ``FILE``, ``[FILE]``, ``FILE...`` or ``[FILE...]``. The name of a value says how
it is read: `READERS`. A command returns an `mastctl.cli.output.Answer`, or an exit code where it has written
everything itself.
"""

from __future__ import annotations

import argparse
import math
import re
import shutil
import textwrap
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple, NoReturn

from mastctl.cli.output import Answer, WrongUse

Run = Callable[[argparse.Namespace], "Answer | int"]


def _number(text: str, expected: str, fits: Callable[[float], bool] = math.isfinite) -> float:
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not (math.isfinite(value) and fits(value)) or "_" in text:
        raise argparse.ArgumentTypeError(f"'{text}' where {expected} is expected")
    return value


def finite_number(text: str) -> float:
    """Read a value as a finite number (argparse ``type``)."""
    return _number(text, "a finite number")


def positive_number(text: str) -> float:
    """Read a value as a finite number above zero (argparse ``type``)."""
    return _number(text, "a number above zero", lambda value: value > 0)


def not_negative(text: str) -> float:
    """Read a value as a finite number of zero or more (argparse ``type``)."""
    return _number(text, "zero or more", lambda value: value >= 0)


def at_least(least: int) -> Callable[[str], int]:
    """Return what reads a value as a whole number of at least ``least`` (argparse ``type``)."""

    def read(text: str) -> int:
        if not (text.isascii() and text.isdigit() and len(text) < 19) or int(text) < least:
            raise argparse.ArgumentTypeError(f"'{text}' where a whole number of at least {least} is expected")
        return int(text)

    return read


def not_empty(text: str) -> str:
    """Read a value as a name (argparse ``type``); an empty one (a variable that is not set) is refused."""
    if not text.strip():
        raise argparse.ArgumentTypeError("the name is empty ('.' is the current folder)")
    return text


def path(text: str) -> Path:
    """Read a value as a path (argparse ``type``)."""
    return Path(not_empty(text))


ANY_NUMBER = ("RAD", "X", "Y", "Z", "U", "V", "NX", "NY", "NZ", "QW", "QX", "QY", "QZ", "LOW", "HIGH")
READERS: Mapping[str, Callable[[str], Any]] = {
    **dict.fromkeys(("S", "M", "MM", "PX", "DEG", "HZ"), positive_number),
    **dict.fromkeys((*ANY_NUMBER, "PAN", "TILT"), finite_number),
    **dict.fromkeys(("FILE", "DIR", "FOLDER", "IN", "OUT", "SURVEY"), path),
    "SEED": at_least(0),
    "N": at_least(1),
}
"""How a value is read by its name; one that ends with a suffix of files is a path, any other is a text."""


class Option(NamedTuple):
    """An option or argument as argparse takes it."""

    names: list[str]
    settings: dict[str, Any]


class OneOf(NamedTuple):
    """Options of which one at most may be given, or exactly one; `one_of` makes it."""

    options: tuple[Option, ...]
    required: bool


def one_of(*options: Option, required: bool = False) -> OneOf:
    """Return options of which one at most may be given, or exactly one."""
    return OneOf(options, required)


def option(usage: str, help: str, *, repeat: bool = False, **settings: Any) -> Option:
    """Return an option or a positional argument; ``usage`` as in the module's description.

    With ``repeat`` it may be given several times, and its value is a list. ``settings`` are argparse's own,
    over those that follow from ``usage``. A default stands in the help too.
    """
    name, *values = usage.split()
    default = settings.get("default")
    if default not in (None, "", False, []) and "(default" not in help:
        shown = " ".join(map(str, default)) if isinstance(default, (list, tuple)) else f"{default}"
        help = f"{help} (default {shown.removesuffix('.0')})"
    found: dict[str, Any] = {"help": help.replace("%", "%%")}
    if not name.startswith("-"):
        inner = name.strip("[]")
        found["nargs"] = {"[...": "*", "...": "+", "[": "?"}.get(
            ("[" if name != inner else "") + ("..." if inner.endswith("...") else "")
        )
        values = [inner.removesuffix("...")]
        name = settings.pop("dest", re.split(r"[^A-Za-z_]", values[0])[0].lower())
    elif not values:
        return Option(name.split(","), {**found, "action": "store_true", **settings})
    elif len(values) > 1:
        found["nargs"] = len(values)
    elif values[0].endswith("..."):
        found["nargs"], values = "+", [values[0].removesuffix("...")]
    if "|" in values[0]:
        found["choices"] = values[0].split("|")
        if values[0].replace("|", "").isdigit():
            found |= {"choices": [int(one) for one in found["choices"]], "type": int}
    else:
        found["metavar"] = tuple(values) if len(values) > 1 and "nargs" not in settings else " ".join(values)
        found["type"] = _reader(values)
    if repeat:
        found |= {"action": "append", "default": []}
    found |= settings
    return Option(name.split(","), {key: value for key, value in found.items() if key != "nargs" or value})


def _reader(values: list[str]) -> Callable[[str], Any]:
    readers = {path if re.search(r"\.[a-z]+$", value) else READERS.get(value, str) for value in values}
    return readers.pop() if len(readers) == 1 else str


class CommandLine(NamedTuple):
    """A command: its name after ``mastctl``, what it does, its options and an example of them."""

    name: str
    help: str
    options: tuple[Option | OneOf, ...]
    example: str
    about: str
    run: Run


DECLARED: dict[str, CommandLine] = {}
"""Every command of the modules that are imported, by its name."""

GROUPS: dict[str, str] = {}
"""What the groups of their commands are for, by their names."""


def command(
    name: str, *options: Option | OneOf, help: str = "", example: str = "", about: str = ""
) -> Callable[[Run], Run]:
    """Return a decorator that makes a function a command.

    ``help`` says what it does (of a command of one word `mastctl.cli.main.OVERVIEW` says it), ``about`` is
    the description of its own ``--help``, where that is too short. ``example`` are options and arguments
    that a shell would take.
    """

    def declare(run: Run) -> Run:
        DECLARED[name] = CommandLine(name, help, options, example, about, run)
        return run

    return declare


def add_options(parser: Any, *options: Option | OneOf) -> None:
    """Add declared options to a parser of argparse, or to a group of one."""
    for one in options:
        if isinstance(one, OneOf):
            add_options(parser.add_mutually_exclusive_group(required=one.required), *one.options)
        else:
            parser.add_argument(*one.names, **one.settings)


# argparse's own pattern knows -1 and -1.5 but takes -1e-3 for an option; "not finite" texts get our message.
_NEGATIVE_NUMBER = re.compile(r"^-(?:\d+\.?\d*|\.\d+)(?:e[-+]?\d+)?$|^-(?:inf|infinity|nan)$", re.IGNORECASE)


def _wrapped(line: str, width: int) -> str:
    if len(line) <= width + 1:
        return line
    indent = " " * (len(line) - len(line.lstrip()) + 1)
    return (
        textwrap.fill(line.replace(",", ", "), width, subsequent_indent=indent, break_long_words=False) + "\n"
    )


class Parser(argparse.ArgumentParser):
    """A parser that refuses in one line, reads any negative number, and gives each command --json."""

    def __init__(self, *args: Any, **settings: Any) -> None:
        settings.setdefault("allow_abbrev", False)
        super().__init__(*args, **settings)
        self._negative_number_matcher = _NEGATIVE_NUMBER
        self.add_argument(
            "--json",
            action="store_true",
            default=argparse.SUPPRESS,
            help="print one JSON document on stdout and nothing else",
        )

    def format_help(self) -> str:
        """Return the help within the terminal's width: argparse breaks no group of options and no choices."""
        width = shutil.get_terminal_size().columns - 1
        return "".join(_wrapped(line, width) for line in super().format_help().splitlines(keepends=True))

    def error(self, message: str) -> NoReturn:
        """Refuse wrong use; the caller prints the one line."""
        raise WrongUse(f"{message} (see '{self.prog} --help')")
