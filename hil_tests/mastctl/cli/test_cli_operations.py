"""Operations, events, mast file and lease on the command line; an example of each command."""

from __future__ import annotations

import argparse
import json
import shlex
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from calib.files.mast_file import save_rig
from hil_tests.mastctl.cli.conftest import Run
from hil_tests.mastctl.service_fakes import FakeHardware, rig
from mastctl.cli.main import _joined, build_parser, main
from mastctl.cli.options import DECLARED
from mastctl.client import Client
from mastctl.daemon import RunningDaemon

BOTH = tuple[RunningDaemon, FakeHardware]
ANGLES = ("--angles", "0.1", "-0.1")


@pytest.fixture
def operation(pair: BOTH) -> str:
    with Client(pair[0].url) as client:
        found = client.point(pan_rad=0.25, tilt_rad=-0.5)
        client.wait(found)
    return found


def test_operations_are_listed_shown_and_watched(run: Run, operation: str) -> None:
    table = run("status", "--operations")[1]
    assert operation in table and "pan rad 0.25" in table and "0.25, -0.5" in table
    shown = run("status", "--operation", operation)[1]
    assert operation in shown and "look" in shown and "measure" in shown and "done" in shown
    code, out, _ = run("status", "--operation", operation, "--wait", "60", "--json")
    assert (code, json.loads(out)["id"]) == (0, operation)
    line = run("status", "--events", "operation", "--count", "1")[1]
    assert line.startswith(f"operation {operation}: state done, request pan rad 0.25, tilt rad -0.5")
    code, _, log = run("status", "--operation", "nothing")
    assert code == 2 and "operation nothing is not known" in log


def test_events_are_a_line_each(run: Run, operation: str) -> None:
    assert run("status", "--events", "state", "--count", "1")[1] == "state machine: state ready"
    shown = run("status", "--events", "operation", "mast", "--count", "2", "--json")[1].splitlines()
    assert {json.loads(line)["topic"] for line in shown} == {"operation", "mast"}
    code, _, log = run("status", "--events", "weather")
    assert code == 2 and "'weather' where some of" in log


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


def test_the_mast_file_is_replaced_and_put_back(run: Run, tmp_path: Path) -> None:
    save_rig(rig(), tmp_path / "other.yaml")
    assert run("rig", "mast", "use", "other.yaml")[1].startswith("other.yaml (little")
    assert "before other.yaml" in run("rig", "mast", "back")[1]
    assert run("rig", "mast", "use", "none.yaml")[0] == 2


def test_a_lease_is_taken_used_shown_and_released(run: Run) -> None:
    assert "control" in run("rig", "lease", "show")[1]
    code, lease, _ = run("rig", "lease", "take", "--for", "600", "--name", "night shift")
    assert (code, len(lease)) == (0, 32)
    assert "night shift" in run("rig", "lease", "show")[1]
    assert "night shift" in run("status")[1]
    code, out, _ = run("point", *ANGLES, "--json")
    assert (code, json.loads(out)["error"]["code"]) == (1, "leased")
    assert run("point", *ANGLES, "--lease", lease, "--json")[0] == 0
    assert "Mastctl-Lease or --lease" in run("rig", "lease", "release")[2]
    assert run("rig", "lease", "release", "--lease", lease)[:2] == (0, "released")
    code, out, _ = run("rig", "lease", "release", "--lease", lease, "--json")
    assert (code, json.loads(out)["error"]["code"]) == (1, "lease_over")


def test_taking_over_needs_a_reason(run: Run, pair: BOTH) -> None:
    with Client(pair[0].url, name="bench") as client, client.lease():
        code, out, _ = run("rig", "lease", "take", "--json")
        assert (code, json.loads(out)["error"]["code"]) == (1, "leased")
        code, lease, _ = run("rig", "lease", "take", "--reason", "the bench is empty")
        assert code == 0
        assert run("point", *ANGLES, "--lease", lease)[0] == 0


def leaves(parser: argparse.ArgumentParser) -> Iterator[argparse.ArgumentParser]:
    inner: list[Any] = [one for one in parser._actions if isinstance(one, argparse._SubParsersAction)]
    if not inner:
        yield parser
    for one in inner:
        for below in one.choices.values():
            yield from leaves(below)


def test_the_help_of_each_command_shows_an_example_that_it_takes(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    parser = build_parser()
    known = {leaf.prog.removeprefix("mastctl "): leaf for leaf in leaves(parser)}
    assert set(DECLARED) == set(known)
    for words, command in DECLARED.items():
        example = f"mastctl {words} {command.example}".rstrip()
        help = known[words].format_help()
        assert f"example: {example}" in " ".join(help.split()), words
        assert max(map(len, help.splitlines())) < 80, words
        assert "run" in parser.parse_args(_joined(shlex.split(example)[1:])[0]), example
