"""Where the tasks of a Monte Carlo run: processes of this machine, or a Dask cluster.

Whatever runs them, a task carries its own seed and results are put in the order of the tasks, so the numbers
are the same. To the last digit they are if linear algebra runs in one thread everywhere, as it does in
the workers of Dask and in those that are started here: more threads add up in another order.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Executor, ProcessPoolExecutor, as_completed
from contextlib import contextmanager
from multiprocessing import get_context
from typing import TypeVar, cast

from mastctl.errors import MastctlError

Task = TypeVar("Task")
Result = TypeVar("Result")

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
        with _environment(ONE_THREAD), ProcessPoolExecutor(workers or os.cpu_count() or 1, context) as pool:
            try:
                yield pool
            except BaseException:
                pool.shutdown(cancel_futures=True)
                raise
        return
    if not name.startswith(DASK) or name == DASK:
        raise NoExecutor(f"--executor is '{name[:80]}' where local or dask:ADDRESS is expected")
    try:
        from distributed import Client
    except ImportError:
        raise NoExecutor(
            "--executor dask needs the package distributed, which is not installed (pip install distributed)"
        ) from None
    address = name.removeprefix(DASK)
    try:
        client = Client(address, timeout=5)
    except (OSError, ValueError) as error:
        raise NoExecutor(f"no Dask scheduler answers at {address[:80]}: {error}") from None
    with client:
        yield cast(Executor, client.get_executor())


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


def run_all(
    executor: Executor,
    function: Callable[[Task], Result],
    tasks: Sequence[Task],
    done: Callable[[Result], None] = lambda _: None,
) -> list[Result]:
    """Return the results in the order of the tasks; ``done`` is called here with each as it comes."""
    futures = {executor.submit(function, task): index for index, task in enumerate(tasks)}
    results: dict[int, Result] = {}
    for future in as_completed(futures):
        results[futures[future]] = future.result()
        done(results[futures[future]])
    return [results[index] for index in range(len(tasks))]
