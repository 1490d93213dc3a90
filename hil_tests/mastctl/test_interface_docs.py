"""Every command and every route is where people look for it, and the client asks for every route."""

from __future__ import annotations

import argparse
from collections.abc import Iterator

from mastctl.cli.main import COMMANDS, build_parser


def parsers(
    parser: argparse.ArgumentParser, words: str = "mastctl"
) -> Iterator[tuple[str, str, argparse.ArgumentParser]]:
    """Every command with the words of its group and its parser: ``mastctl track``, ``look``."""
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            for name, inner in action.choices.items():
                further = [*parsers(inner, f"{words} {name}")]
                yield from further or [(words, name, inner)]


def commands() -> list[tuple[str, str]]:
    return [(words, name) for words, name, _ in parsers(build_parser())]


def test_every_command_says_what_it_does() -> None:
    assert [name for _, name, parser in parsers(build_parser()) if not parser.description] == []


def test_every_command_is_known_by_the_module_that_brings_it() -> None:
    first = {words.split()[1] if " " in words else name for words, name in commands()}
    assert first == set(COMMANDS)


def test_the_help_of_all_commands_fits_one_screen() -> None:
    parser = build_parser("")
    assert 24 <= len(parser.format_help().splitlines()) <= 40
    assert max(map(len, parser.format_help().splitlines())) < 80
    assert len({words.split()[0] for words in COMMANDS}) <= 23
