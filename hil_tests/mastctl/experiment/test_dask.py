"""A Dask cluster of two workers comes to the same bits as processes of this machine."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator

import numpy as np
import pytest

from calib.files.mast_file import load_rig
from hil_tests.mastctl.calibration.survey_world import RIG_FILE
from mastctl.experiment.tasks import open_executor, run_tasks
from tools.campaigns import refine


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


def test_a_campaign_on_a_cluster_comes_to_the_same_bits(address: str) -> None:
    rig = load_rig(RIG_FILE).rig
    blocks = [refine.RefineBlock(rig, (2.0, 2.0), 1.0, n, 1, 9, 0.2, 0.4, 1) for n in (0, 10)]
    with open_executor("local", 2) as local, open_executor(f"dask:{address}") as cluster:
        ours, theirs = (
            [[vars(case) for case in block] for block in run_tasks(place, refine.run_block, blocks)]
            for place in (local, cluster)
        )
    np.testing.assert_equal(theirs, ours)
