"""A Dask cluster of this machine: a scheduler, and two workers in processes of their own."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from distributed import LocalCluster


@contextmanager
def two_dask_workers() -> Iterator[str]:
    """Yield the scheduler's address."""
    with LocalCluster(
        n_workers=2, threads_per_worker=1, processes=True, dashboard_address=None, host="127.0.0.1"
    ) as cluster:
        cluster.wait_for_workers(2, timeout=120)
        yield str(cluster.scheduler_address)
