"""A Dask cluster of two workers comes to the same bits as processes of this machine."""

from __future__ import annotations

import json
import os
import tempfile
from collections.abc import Iterator, Mapping
from concurrent.futures import Executor
from contextlib import nullcontext, suppress
from dataclasses import is_dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from calib.files.mast_file import load_rig
from calib.survey.records import Sigma
from drivers.sim.heads import PRESETS
from hil_tests.mastctl.calibration.survey_world import RIG_FILE
from mastctl.experiment.simulated import PointingTask, Rover, one_pointing
from mastctl.experiment.tasks import Work, open_executor
from tools.campaigns import dots, keep_out, life, match_sigma, refine, render_bias
from tools.sim_survey.plan import SurveyPlan
from tools.studies.calibration import main
from tools.studies.calibration_survey import Variant, one_survey, survey_tasks
from tools.studies.handoff import HandoffTask, one_handoff

ROVER = Rover("ptu_d46_70", seed=5)
PLAN = SurveyPlan(sigma=Sigma(0.002, 0.1))


@pytest.fixture(scope="module")
def address() -> Iterator[str]:
    """The scheduler of a cluster of this machine: two workers in processes of their own."""
    import dask  # slow to load, and every worker loads this file
    from distributed import LocalCluster

    with (
        tempfile.TemporaryDirectory() as folder,
        dask.config.set(temporary_directory=folder),  # the scheduler's
        LocalCluster(
            n_workers=2, threads_per_worker=1, processes=True, dashboard_address=None, host="127.0.0.1",
            local_directory=folder,
        ) as cluster,
    ):  # fmt: skip
        cluster.wait_for_workers(2, timeout=120)
        yield str(cluster.scheduler_address)


@pytest.fixture(scope="module")
def places(address: str) -> Iterator[tuple[Executor, Executor]]:
    """Two processes of this machine, and the cluster."""
    with open_executor("local", 2) as here, open_executor(f"dask:{address}") as there:
        yield here, there


def values(result: Any) -> Any:
    """Nested lists of numbers, words and arrays; without times, which differ."""
    if is_dataclass(result):
        return [values(one) for name, one in vars(result).items() if name not in ("seconds", "fit_seconds")]
    if isinstance(result, Mapping):
        return [[str(key), values(one)] for key, one in result.items()]
    return [values(one) for one in result] if isinstance(result, (list, tuple)) else result


def same(places: tuple[Executor, Executor], works: list[Work[Any, Any]], of: Any = values) -> list[list[Any]]:
    """What works come to here, after it was found to be the same there."""
    here, there = (
        [[of(one) for one in work.run(lambda place=place: nullcontext(place))] for work in works]  # type: ignore[misc]
        for place in places
    )
    np.testing.assert_equal(there, here)
    return here


def record(experiment: Any) -> Any:
    """The document of a pointing or a hand-off, and every measured pixel to the last bit."""
    found = [
        values(row.landings) if hasattr(row, "landings") else
        [(one.geometric.pixel_px.tobytes(), one.refined.pixel_px.tobytes()) for one in row.handed]
        for row in experiment.records
    ]  # fmt: skip
    return experiment.as_json(), found


def test_linear_algebra_of_every_executor_has_one_thread(places: tuple[Executor, Executor]) -> None:
    for place in places:
        assert set(place.map(os.getenv, ["OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"])) == {"1"}


def test_surveys_of_the_calibration_study(places: tuple[Executor, Executor]) -> None:
    chosen = tuple(Variant("mast parameters", str(n), n, "paper", n, PLAN) for n in (4, 6))
    tasks = survey_tasks(load_rig(RIG_FILE).rig, surveys=1, targets=2, seed=3, chosen=chosen)
    ((four, six),) = same(places, [Work(one_survey, tasks, lambda task: task.variant.label)])
    assert str(four) != str(six)


def works_of(tasks: Mapping[Any, list[Any]]) -> list[Work[Any, Any]]:
    return [Work(function, pair, lambda _: "small") for function, pair in tasks.items()]


def test_campaigns_of_numbers(places: tuple[Executor, Executor]) -> None:
    rig, head = load_rig(RIG_FILE).rig, PRESETS["ptu_d46_70"]
    works = works_of(
        {
            refine.run_block: [
                refine.RefineBlock(rig, (2.0, 2.0), 1.0, n, 1, 9, 0.2, 0.4, 1) for n in (0, 10)
            ],
            life.offs: [life.LivedHead("few or more", head, moves, 1) for moves in (2, 3)],
            keep_out.run_case: [keep_out.KeepOutCase("suite/a", True)],
        }
    )
    same(places, works)


@pytest.mark.long(2, "draws and measures whole pictures twice; numbers and surveys are in the quick run")
def test_campaigns_of_pictures(places: tuple[Executor, Executor]) -> None:
    rig, stress = load_rig(RIG_FILE).rig, dots.STRESSES["none"]
    works = works_of(
        {
            dots.run_cell: [dots.Cell(1290.0, 3.0, tilt, 1, 1, stress, True) for tilt in (0.0, 30.0)],
            render_bias.run_row: [
                render_bias.BiasRow("flat", "hazcam turned", 2.0, n, 1, 2, 1) for n in (1, 2)
            ],
            match_sigma.run_look: [match_sigma.MatchLook(rig, 0.5, 1, number, 1) for number in (0, 1)],
        }
    )
    (first, second), *_ = same(places, works)
    assert str(first) != str(second)


@pytest.mark.long(4, "a rover is drawn here and on the cluster; numbers and surveys are in the quick run")
def test_a_pointing_on_a_rover_of_its_own(places: tuple[Executor, Executor]) -> None:
    (((document, _),),) = same(places, [Work(one_pointing, [PointingTask(ROVER, 2.0, 0)], str)], record)
    (distance,) = document["distances"]
    assert (distance["targets"], distance["failed"]) == (1, 0)


@pytest.mark.long(3, "six rovers, one after the other; numbers and surveys are in the quick run")
def test_pointings_and_a_handoff_each_with_its_own_draw(places: tuple[Executor, Executor]) -> None:
    works: list[Work[Any, Any]] = [
        Work(one_pointing, [PointingTask(ROVER, 2.0, index) for index in range(2)], str),
        Work(one_handoff, [HandoffTask(ROVER, "navcam", 0, 0.2)], str),
    ]
    ((_, first), (_, second)), _ = same(places, works, record)
    assert first != second


PRISMS = ["--study", "prisms", "--cases", "1", "--targets", "2", "--json"]


def told(capsys: pytest.CaptureFixture[str], *words: str) -> dict[str, Any]:
    with suppress(SystemExit):  # where tasks are only listed or run
        assert main([*PRISMS, *words]) == 0
    return dict(json.loads(capsys.readouterr().out))


@pytest.mark.long(
    3, "a cluster and every task by itself, 20 s of processor time; its parts are tested quickly beside it"
)
def test_tasks_run_one_by_one_give_the_same_document_as_a_cluster(
    address: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """As a batch system runs them; then all together on two workers of a cluster."""
    kept = ("--results", str(tmp_path / "kept"))
    listed = told(capsys, "--list-tasks", *kept)["tasks"]
    assert [row["done"] for row in listed] == [False, False]
    for row in reversed(listed):
        told(capsys, "--task", row["id"], *kept)
    assert [row["done"] for row in told(capsys, "--list-tasks", *kept)["tasks"]] == [True, True]
    documents = [told(capsys, *kept, "--executor", "dask:tcp://127.0.0.1:1")]  # nothing is left to run
    documents.append(told(capsys, "--executor", f"dask:{address}"))
    for document in documents:
        document.pop("seconds")
        for variant in document["variants"]:
            variant.pop("fit_seconds")
    assert documents[0] == documents[1]
