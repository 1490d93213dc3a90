"""Every command and every route is where people look for it, and the client asks for every route."""

from __future__ import annotations

import argparse
import inspect
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

from hil_tests.mastctl.service_fakes import HTTP, fake_daemon
from mastctl.cli.main import MODULES, build_parser
from mastctl.client import calls, jog, keeping_calls, lease, simulation_calls
from mastctl.http import PREFIX


def plain(path: str) -> str:
    """A path with whatever is filled in left out."""
    return re.sub(r"\{[^}]*\}", "{}", path)


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
    return [(words, name) for words, name, _ in parsers(build_parser([]))]


def test_every_command_says_what_it_does() -> None:
    assert [name for _, name, parser in parsers(build_parser([])) if not parser.description] == []


def test_every_argument_of_every_command_has_a_help() -> None:
    everything = [("", "mastctl", build_parser([])), *parsers(build_parser([]))]
    arguments = [
        (f"{words} {name}", one)
        for words, name, parser in everything
        for one in parser._actions
        if not isinstance(one, argparse._SubParsersAction)
    ]
    assert len(arguments) > 300
    assert [
        f"{command}: {one.option_strings or one.dest}" for command, one in arguments if not one.help
    ] == []


def test_every_command_is_in_readme_or_docs(repository: Path) -> None:
    pages = [repository / "README.md", *(repository / "docs").rglob("*.md")]
    text = " ".join(" ".join(page.read_text(encoding="utf-8") for page in pages).split())
    missing = [
        f"{words} {name}"
        for words, name in commands()
        if not re.search(rf"{words} (?:[\w-]+\|)*{name}(?![\w-])", text)
    ]
    assert missing == []


def test_every_command_is_known_by_the_module_that_brings_it() -> None:
    first = {words.split()[1] if " " in words else name for words, name in commands()}
    assert first == {name for names in MODULES.values() for name in names}


@pytest.fixture
def routes(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> set[tuple[str, str]]:
    """Method and path of every route, as the daemon tells them."""
    with fake_daemon(monkeypatch, tmp_path) as (daemon, _):
        document = HTTP.get(f"{daemon.url}/openapi.json").json()
    found = {
        (method.upper(), plain(path.removeprefix(PREFIX)))
        for path, methods in document["paths"].items()
        for method in methods
    }
    assert len(found) > 15
    return found


def test_every_route_has_its_row_and_no_other(routes: set[tuple[str, str]], repository: Path) -> None:
    text = (repository / "docs" / "reference" / "http.md").read_text(encoding="utf-8").split("\n## ", 1)[0]
    told = set()
    for line in text.splitlines():
        methods: list[str] = []
        for words in re.findall(r"`([^`]+)`", line.split("|")[1]) if line.startswith("| `") else []:
            method, _, path = words.partition(" ")
            methods.append(method)
            if path:
                told |= {(one, plain(path)) for one in methods}
                methods = []
    assert told == routes


def test_the_client_asks_for_every_route(routes: set[tuple[str, str]]) -> None:
    source = "".join(map(inspect.getsource, (calls, jog, keeping_calls, lease, simulation_calls)))
    asked = re.findall(r'"(GET|POST|PATCH|DELETE)", f?"([^"]+)"', source)
    asked += [("GET", path) for path in re.findall(r'heard\("([^"]+)"', source)]
    monitors = {("GET", path) for path in ("/metrics", "/health/live", "/health/ready")}
    assert {(method, plain(path)) for method, path in asked} == routes - monitors
