"""Tasks: results in order, errors named, no process left behind; a Dask cluster comes to the same bits."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import psutil
import pytest

from hil_tests.mastctl.experiment.toy_tasks import Draw, broken_when_odd, drawn
from mastctl.experiment.tasks import TaskFailed, open_executor, run_tasks


def test_results_come_in_the_order_of_the_tasks_not_of_their_ends() -> None:
    ended: list[int] = []
    with ThreadPoolExecutor(4) as pool:
        found = run_tasks(
            pool, drawn, [Draw(seed) for seed in range(8)], done=lambda task, _: ended.append(task.seed)
        )
    for seed, numbers in enumerate(found):
        np.testing.assert_array_equal(numbers, np.random.default_rng(seed).standard_normal(3))
    assert sorted(ended) == list(range(8))


def test_a_task_that_fails_is_named_with_its_error() -> None:
    tasks = [Draw(seed) for seed in (0, 1, 2)]
    with (
        ThreadPoolExecutor(1) as pool,
        pytest.raises(TaskFailed, match=r"task seed 1: ZeroDivisionError: no such luck"),
    ):
        run_tasks(pool, broken_when_odd, tasks, lambda task: f"seed {task.seed}")


LONG = """
from mastctl.experiment.tasks import open_executor, run_tasks
from calib.files.mast_file import load_rig
from hil_tests.mastctl.calibration.survey_world import RIG_FILE
from hil_tests.mastctl.experiment.toy_tasks import Draw, drawn_or_stuck

if __name__ == "__main__":
    with open_executor("local", 2) as pool:
        tasks = [Draw(1), Draw(2, scale=1e9)]
        run_tasks(pool, drawn_or_stuck, tasks, done=lambda *_: print("done", flush=True))
"""


def test_a_killed_run_leaves_no_process(tmp_path: Path) -> None:
    script = tmp_path / "long.py"
    script.write_text(LONG)
    environment = {**os.environ, "PYTHONPATH": str(Path(__file__).parents[3])}
    with subprocess.Popen([sys.executable, str(script)], stdout=subprocess.PIPE, env=environment) as run:
        assert run.stdout is not None and run.stdout.readline() == b"done\n"
        workers = psutil.Process(run.pid).children(recursive=True)
        run.send_signal(signal.SIGKILL)
        run.wait(60.0)
        gone, left = psutil.wait_procs(workers, timeout=60)
    assert gone and not left


@pytest.fixture
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


def test_a_cluster_comes_to_the_same_bits(address: str) -> None:
    tasks = [Draw(seed) for seed in range(4)]
    with open_executor("local", 2) as local, open_executor(f"dask:{address}") as cluster:
        ours, theirs = (run_tasks(place, drawn, tasks) for place in (local, cluster))
    np.testing.assert_equal(theirs, ours)
