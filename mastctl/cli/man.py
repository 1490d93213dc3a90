"""Man pages from the parsers: mastctl(1), and one page for each command."""

from __future__ import annotations

import argparse
import re
from collections.abc import Iterator
from importlib.metadata import version

VERSION = f"mastctl {version('mastctl')}"


def man_pages(parser: argparse.ArgumentParser) -> dict[str, str]:
    """Return the pages by file name, in the language of man(7)."""
    commands = _verbs(parser)
    listed = [
        line for name, one in commands.items() for line in _listed(f"mastctl-{name}(1)", one.description)
    ]
    pages = {"mastctl.1": _page("mastctl", parser, [".SH COMMANDS", *listed])}
    for name, one in commands.items():
        rest = [line for verb in _verbs(one).values() for line in _section(verb)]
        pages[f"mastctl-{name}.1"] = _page(f"mastctl-{name}", one, rest)
    return pages


def _verbs(parser: argparse.ArgumentParser) -> dict[str, argparse.ArgumentParser]:
    """The commands of a parser, by name."""
    groups = [one for one in parser._actions if isinstance(one, argparse._SubParsersAction)]
    return {name.replace(" ", "-"): one for group in groups for name, one in group.choices.items()}


def _page(name: str, parser: argparse.ArgumentParser, rest: list[str]) -> str:
    """One page: name, synopsis, what it does, options, and what follows."""
    words = (parser.description or "").strip()
    first = re.split(r"\.\s", words)[0].rstrip(".")
    lines = [f'.TH {name.upper()} 1 "" "{VERSION}"']
    lines += [".SH NAME", _text(f"{name} - {first[:1].lower()}{first[1:]}")]
    lines += [".SH SYNOPSIS", *_usage(parser)]
    lines += [".SH DESCRIPTION", _text(words), *_options(parser)]
    if parser.epilog:
        lines += [".PP", _text(parser.epilog)]
    if name != "mastctl":
        rest = [*rest, ".SH SEE ALSO", r".BR mastctl (1)"]
    return "\n".join([*lines, *rest]) + "\n"


def _section(parser: argparse.ArgumentParser) -> list[str]:
    """A verb of a command as a section of its page, and the verbs in it."""
    lines = [f".SH {_text(parser.prog.removeprefix('mastctl ').upper())}", *_usage(parser)]
    lines += [".PP", _text(parser.description or ""), *_options(parser)]
    if parser.epilog:
        lines += [".PP", _text(parser.epilog)]
    return [*lines, *(line for verb in _verbs(parser).values() for line in _section(verb))]


def _usage(parser: argparse.ArgumentParser) -> list[str]:
    usage = " ".join(parser.format_usage().removeprefix("usage: ").split())
    return [".nh", _text(usage), ".hy"]


def _options(parser: argparse.ArgumentParser) -> list[str]:
    """Options and arguments, each with its help."""
    return [line for action in parser._actions for line in _option(action)]


def _option(action: argparse.Action) -> Iterator[str]:
    if isinstance(action, argparse._SubParsersAction) or action.help == argparse.SUPPRESS:
        return
    metavar = action.metavar if action.metavar is not None else action.dest.upper()
    value = metavar if isinstance(metavar, str) else " ".join(metavar)
    if action.choices and action.metavar is None:
        value = "|".join(map(str, action.choices))
    names = ", ".join(action.option_strings)
    shown = value if not names else names if action.nargs == 0 else f"{names} {value}"
    words = (action.help or "") % {**vars(action), "prog": ""} if action.help else ""
    yield from _listed(shown, words)


def _listed(term: str, words: str | None) -> list[str]:
    return [".TP", r"\fB" + _text(term) + r"\fR", _text(words or "")]


def _text(text: str) -> str:
    """Words as man(7) shows them unchanged: no line begins a request, hyphens stay those of options."""
    plain = " ".join(text.replace("%%", "%").split()).replace("\\", r"\e").replace("-", r"\-")
    return re.sub(r"^([.'])", r"\\&\1", plain)
