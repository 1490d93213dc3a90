"""Pointing and hand-off on simulated rovers of their own: the same bits wherever they run."""

from __future__ import annotations

import json
from functools import partial
from pathlib import Path
from typing import Any

import pytest

from hil_tests.mastctl.experiment.dask_workers import two_dask_workers
from mastctl.cli.experiment_simulated import (
    HandoffTask,
    PointingTask,
    Rover,
    joined_handoffs,
    joined_pointings,
    one_handoff,
    one_pointing,
)
from mastctl.cli.main import main
from mastctl.experiment.executors import open_executor
from mastctl.experiment.tasks import Kept, Work

ROVER = Rover("ptu_d46_70", seed=5)
POINTINGS = tuple(PointingTask(ROVER, 2.0, index) for index in range(2))
HANDOFF = HandoffTask(ROVER, "navcam", 0, 0.2)


def results(executor: Any, pointings: tuple[PointingTask, ...], kept: Kept | None = None) -> dict[str, Any]:
    """What the tasks came to, as their records say it."""
    pointed = Work(one_pointing, pointings, str).run(executor, kept)
    handed = Work(one_handoff, [HANDOFF], str).run(executor, kept)
    by_index = sorted(pointed, key=lambda part: part.records[0].index)
    return {
        "pointing": joined_pointings(by_index).as_json(),
        "landings": [part.records[0].landings for part in by_index],
        "hand-off": joined_handoffs(handed).as_json(),
        "pixels": [[(one.geometric.pixel_px.tobytes(), one.refined.pixel_px.tobytes()) for one in r.handed]
                   for r in handed[0].records],
    }  # fmt: skip


def test_two_processes_and_a_cluster_of_two_workers_give_the_same_bits(tmp_path: Path) -> None:
    here = results(partial(open_executor, "local", 2), POINTINGS)
    with two_dask_workers() as address:
        there = results(partial(open_executor, f"dask:{address}"), POINTINGS[::-1])
    assert here == there
    assert here["pointing"]["distances"][0]["targets"] == 2
    assert here["pointing"]["distances"][0]["failed"] == 0
    first, second = here["landings"]
    assert first != second, "each target has its own draw"


@pytest.mark.parametrize("kind", ["pointing", "handoff"])
@pytest.mark.parametrize(
    "words",
    [["--executor", "dask:tcp://127.0.0.1:1"], ["--workers", "2"], ["--list-tasks"], ["--results", "kept"]],
)
def test_a_running_daemon_takes_no_executor(
    kind: str, words: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["experiment", kind, "--url", "http://127.0.0.1:9", *words, "--json"]) == 2
    error = json.loads(capsys.readouterr().out)["error"]
    assert f"{words[0]} belongs to --simulated" in error["message"]


@pytest.mark.parametrize("kind", ["pointing", "handoff"])
def test_simulated_rovers_are_no_running_daemon(kind: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["experiment", kind, "--simulated", "--url", "http://127.0.0.1:9", "--json"]) == 2
    assert "names a running daemon" in json.loads(capsys.readouterr().out)["error"]["message"]


def listed(capsys: pytest.CaptureFixture[str], *words: str) -> list[dict[str, Any]]:
    assert main(["experiment", *words, "--simulated", "--list-tasks", "--json"]) == 0
    return list(json.loads(capsys.readouterr().out)["tasks"])


def test_a_task_is_a_target_and_more_of_them_keep_their_names(capsys: pytest.CaptureFixture[str]) -> None:
    few = listed(capsys, "pointing", "--targets", "2", "--distances", "6", "2")
    assert [row["task"] for row in few] == [
        "6 m, target 0", "6 m, target 1", "2 m, target 0", "2 m, target 1"
    ]  # fmt: skip
    more = listed(capsys, "pointing", "--targets", "3", "--distances", "2", "6", "10")
    assert {row["id"] for row in few} < {row["id"] for row in more}
    others = listed(capsys, "pointing", "--targets", "3", "--head", "dynamixel_x")
    assert not {row["id"] for row in few} & {row["id"] for row in others}


def test_another_mast_file_is_another_task_by_its_content(
    tmp_path: Path, repository: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ("handoff", "--targets", "1", "--mast-file")
    packaged = (repository / "configs/masts/rocky8_simulated.yaml").read_text()
    names = []
    for name, text in (("a.yaml", packaged), ("b.yaml", packaged), ("c.yaml", f"# another\n{packaged}")):
        (tmp_path / name).write_text(text)
        names.append([row["id"] for row in listed(capsys, *words, str(tmp_path / name))])
    assert names[0] == names[1] != names[2]
    assert len(names[0]) == 2, "from Pancam and from Navcam"
