"""Operations, events, mast file and faults on the command line; an example each."""

from __future__ import annotations

import argparse
import json
import shlex
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from calib.files.mast_file import save_rig
from hil_tests.mastctl.service_fakes import FakeHardware, rig
from mastctl.cli.main import _joined, build_parser, main
from mastctl.cli.options import DECLARED
from mastctl.client import Client
from mastctl.daemon import RunningDaemon

BOTH = tuple[RunningDaemon, FakeHardware]


@pytest.fixture
def operation(pair: BOTH) -> str:
    with Client(pair[0].url) as client:
        found = client.point(pan_rad=0.25, tilt_rad=-0.5)
        client.wait(found)
    return found


def said(capsys: pytest.CaptureFixture[str], *words: str) -> str:
    assert main(words) == 0, capsys.readouterr().err
    return capsys.readouterr().out


def test_operations_are_listed_shown_and_watched(
    pair: BOTH, operation: str, capsys: pytest.CaptureFixture[str]
) -> None:
    url = pair[0].url
    table = said(capsys, "status", "--operations", "--url", url)
    assert operation in table and "pan rad 0.25" in table and "0.25, -0.5" in table
    shown = said(capsys, "status", "--operation", operation, "--url", url)
    assert operation in shown and "look" in shown and "measure" in shown and "done" in shown
    assert (
        json.loads(said(capsys, "status", "--operation", operation, "--wait", "60", "--url", url, "--json"))[
            "id"
        ]
        == operation
    )
    line = said(capsys, "status", "--events", "operation", "--count", "1", "--url", url)
    assert line.startswith(f"operation {operation}: state done, request pan rad 0.25, tilt rad -0.5")
    assert main(["status", "--operation", "nothing", "--url", url]) == 2
    assert "operation nothing is not known" in capsys.readouterr().err


def test_events_are_a_line_each(pair: BOTH, operation: str, capsys: pytest.CaptureFixture[str]) -> None:
    url = pair[0].url
    assert (
        said(capsys, "status", "--events", "state", "--count", "1", "--url", url)
        == "state machine: state ready\n"
    )
    told = said(
        capsys, "status", "--events", "operation", "mast", "--count", "2", "--url", url, "--json"
    ).splitlines()
    assert {json.loads(line)["topic"] for line in told} == {"operation", "mast"}
    assert main(["status", "--events", "weather", "--url", url]) == 2
    assert "'weather' where some of" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("status --count 3", "--count goes with --events"),
        ("status --operations --wait 5", "--wait goes with the status alone or with --operation"),
    ],
)
def test_options_of_another_use_are_refused(
    words: str, message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(words.split()) == 2
    assert message in capsys.readouterr().err


def test_the_mast_file_is_replaced_and_put_back(
    pair: BOTH, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    url = ("--url", pair[0].url)
    save_rig(rig(), tmp_path / "other.yaml")
    assert said(capsys, "rig", "mast", "use", "other.yaml", *url).startswith("other.yaml (little")
    assert "before other.yaml" in said(capsys, "rig", "mast", "back", *url)
    assert main(["rig", "mast", "use", "none.yaml", *url]) == 2


def leaves(parser: argparse.ArgumentParser) -> Iterator[argparse.ArgumentParser]:
    inner: list[Any] = [one for one in parser._actions if isinstance(one, argparse._SubParsersAction)]
    if not inner:
        yield parser
    for one in inner:
        for below in one.choices.values():
            yield from leaves(below)


def test_the_help_of_each_command_shows_an_example_that_it_takes() -> None:
    parser = build_parser()
    known = {leaf.prog.removeprefix("mastctl "): leaf for leaf in leaves(parser)}
    assert set(DECLARED) == set(known)
    for words, command in DECLARED.items():
        example = f"mastctl {words} {command.example}".rstrip()
        assert f"example: {example}" in " ".join(known[words].format_help().split()), words
        assert "run" in parser.parse_args(_joined(shlex.split(example)[1:])[0]), example
