"""The lease on the command line: its id goes from one command to the next."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from hil_tests.mastctl.service_fakes import fake_daemon
from mastctl.cli.main import main
from mastctl.client import Client
from mastctl.daemon import RunningDaemon

Run = Callable[..., tuple[int, str, str]]
ANGLES = ("--angles", "0.1", "-0.1")


@pytest.fixture
def daemon(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Iterator[RunningDaemon]:
    with fake_daemon(monkeypatch, tmp_path) as (made, _):
        yield made


@pytest.fixture
def run(daemon: RunningDaemon, capsys: pytest.CaptureFixture[str]) -> Run:
    def call(*words: str) -> tuple[int, str, str]:
        capsys.readouterr()
        code = main([*words, "--url", daemon.url])
        out, log = capsys.readouterr()
        return code, out.strip(), log

    return call


def test_a_lease_is_taken_used_shown_and_released(run: Run) -> None:
    assert "control" in run("rig", "lease", "show")[1]
    code, lease, _ = run("rig", "lease", "take", "--for", "600", "--name", "night shift")
    assert (code, len(lease)) == (0, 32)
    assert "night shift" in run("rig", "lease", "show")[1]
    assert "night shift" in run("status")[1]
    code, out, _ = run("point", *ANGLES, "--json")
    assert (code, json.loads(out)["error"]["code"]) == (1, "leased")
    assert run("point", *ANGLES, "--lease", lease, "--json")[0] == 0
    assert run("rig", "lease", "release", "--lease", lease)[:2] == (0, "released")
    code, out, _ = run("rig", "lease", "release", "--lease", lease, "--json")
    assert (code, json.loads(out)["error"]["code"]) == (1, "lease_over")


def test_taking_over_needs_a_reason(run: Run, daemon: RunningDaemon) -> None:
    with Client(daemon.url, name="bench") as client, client.lease():
        code, out, _ = run("rig", "lease", "take", "--json")
        assert (code, json.loads(out)["error"]["code"]) == (1, "leased")
        code, lease, _ = run("rig", "lease", "take", "--reason", "the bench is empty")
        assert code == 0
        assert run("point", *ANGLES, "--lease", lease)[0] == 0
