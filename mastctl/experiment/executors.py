"""Where tasks run: processes of this machine, or a Dask cluster.

Whatever runs them, a task carries its own seed and results are put in the order of the tasks, so the numbers
are the same. To the last digit they are if linear algebra runs in one thread everywhere, as it does in
the workers of Dask and in those that are started here: more threads add up in another order.
"""

from __future__ import annotations

import os
import threading
from collections.abc import Iterator, Mapping
from concurrent.futures import Executor, ProcessPoolExecutor
from contextlib import contextmanager
from multiprocessing import get_context, parent_process
from typing import Any

from mastctl.errors import MastctlError

DASK = "dask:"
ONE_THREAD = dict.fromkeys(("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"), "1")


class NoExecutor(MastctlError):
    """The place where tasks should run cannot be used."""

    code = "no_executor"
    exit_code = 2


@contextmanager
def open_executor(name: str, workers: int | None = None) -> Iterator[Executor]:
    """Open an executor by name, and close it at the end.

    Parameters
    ----------
    name
        ``local``, or ``dask:ADDRESS`` of a running scheduler (``dask:tcp://host:8786``), whose workers have
        this package installed.
    workers
        Processes of a local executor; one for each processor by default.

    Raises
    ------
    NoExecutor
        If the name is another, Dask is not installed, or its scheduler does not answer.
    """
    if name == "local":
        # Started afresh: the threads of a progress bar run here, which a fork would copy half.
        context = get_context("spawn")
        processes = workers or os.cpu_count() or 1
        with _environment(ONE_THREAD), ProcessPoolExecutor(processes, context, _end_with_parent) as pool:
            try:
                yield pool
            except BaseException:
                pool.shutdown(cancel_futures=True)
                raise
        return
    if not name.startswith(DASK) or name == DASK:
        raise NoExecutor(f"--executor is '{name[:80]}' where local or dask:ADDRESS is expected")
    try:
        import distributed
    except ImportError:
        raise NoExecutor(
            "--executor dask needs the package distributed, which is not installed (pip install distributed)"
        ) from None
    address = name.removeprefix(DASK)
    try:
        connect: Any = distributed.Client
        client = connect(address, timeout=5)
    except (OSError, ValueError) as error:
        raise NoExecutor(f"no Dask scheduler answers at {address[:80]}: {error}") from None
    with client:
        yield client.get_executor()


@contextmanager
def _environment(values: Mapping[str, str]) -> Iterator[None]:
    """Variables that processes started meanwhile inherit."""
    before = {name: os.environ.get(name) for name in values}
    os.environ.update(values)
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value


def _end_with_parent() -> None:
    """End this process when the one that started it is gone: a killed run leaves none behind."""
    parent = parent_process()
    assert parent is not None

    def watch() -> None:
        parent.join()
        os._exit(1)

    threading.Thread(target=watch, name="end with parent", daemon=True).start()
