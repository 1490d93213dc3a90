"""Pointing on simulated rovers of their own: the same bits wherever they run."""

from __future__ import annotations

import json
from typing import Any

import pytest

from mastctl.cli.main import main


@pytest.mark.parametrize(
    "words",
    [["--executor", "dask:tcp://127.0.0.1:1"], ["--workers", "2"], ["--list-tasks"], ["--results", "kept"]],
)
def test_a_running_daemon_takes_no_executor(words: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["experiment", "pointing", "--url", "http://127.0.0.1:9", *words, "--json"]) == 2
    error = json.loads(capsys.readouterr().out)["error"]
    assert f"{words[0]} belongs to --simulated" in error["message"]


def test_simulated_rovers_are_no_running_daemon(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["experiment", "pointing", "--simulated", "--url", "http://127.0.0.1:9", "--json"]) == 2
    assert "names a running daemon" in json.loads(capsys.readouterr().out)["error"]["message"]


def listed(capsys: pytest.CaptureFixture[str], *words: str) -> list[dict[str, Any]]:
    assert main(["experiment", "pointing", *words, "--simulated", "--list-tasks", "--json"]) == 0
    return list(json.loads(capsys.readouterr().out)["tasks"])


def test_a_task_is_a_target_and_more_of_them_keep_their_names(capsys: pytest.CaptureFixture[str]) -> None:
    few = listed(capsys, "--targets", "2", "--distances", "6", "2")
    assert [row["task"] for row in few] == [
        "6 m, target 0", "6 m, target 1", "2 m, target 0", "2 m, target 1"
    ]  # fmt: skip
    more = listed(capsys, "--targets", "3", "--distances", "2", "6", "10")
    assert {row["id"] for row in few} < {row["id"] for row in more}
    others = listed(capsys, "--targets", "3", "--head", "dynamixel_x")
    assert not {row["id"] for row in few} & {row["id"] for row in others}
