"""A Dask cluster of two workers comes to the same bits as processes of this machine."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator, Mapping
from concurrent.futures import Executor
from contextlib import nullcontext
from dataclasses import is_dataclass
from typing import Any

import numpy as np
import pytest

from calib.files.mast_file import load_rig
from hil_tests.mastctl.calibration.survey_world import RIG_FILE
from mastctl.experiment.tasks import Work, open_executor
from tools.campaigns import refine


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


def works_of(tasks: Mapping[Any, list[Any]]) -> list[Work[Any, Any]]:
    return [Work(function, pair, lambda _: "small") for function, pair in tasks.items()]


def test_campaigns_of_numbers(places: tuple[Executor, Executor]) -> None:
    rig = load_rig(RIG_FILE).rig
    works = works_of(
        {
            refine.run_block: [
                refine.RefineBlock(rig, (2.0, 2.0), 1.0, n, 1, 9, 0.2, 0.4, 1) for n in (0, 10)
            ],
        }
    )
    same(places, works)
