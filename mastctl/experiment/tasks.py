"""Tasks of an experiment or campaign, run by processes of this machine or by a Dask cluster.

A task carries its own seed and results are put in the order of the tasks, so the numbers are the same. To the
last digit they are if linear algebra runs in one thread everywhere, as it does in the workers of Dask and in
those that this program starts: more threads add up in another order.
"""

from __future__ import annotations

import os
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import BrokenExecutor, Executor, ProcessPoolExecutor, as_completed
from contextlib import contextmanager
from multiprocessing import get_context, parent_process
from typing import Any, TypeVar

import cv2

from mastctl.errors import MastctlError

Task = TypeVar("Task")
Result = TypeVar("Result")

DASK = "dask:"
ONE_THREAD = dict.fromkeys(("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"), "1")


class TaskFailed(MastctlError):
    """A task ended without a result."""

    code = "task_failed"


class NoExecutor(MastctlError):
    """The place where tasks should run cannot be used."""

    code = "no_executor"
    exit_code = 2


def run_tasks(
    executor: Executor,
    function: Callable[[Task], Result],
    tasks: Sequence[Task],
    label: Callable[[Task], str] = str,
    done: Callable[[Task, Result], None] = lambda task, result: None,
) -> list[Result]:
    """Return a module's function of each task, in the order of the tasks.

    ``label`` describes a task; ``done`` is called with each and its result as they come. Raises TaskFailed
    with the first error.
    """
    futures = {executor.submit(_one, function, task): task for task in tasks}
    for future in as_completed(futures):
        task = futures[future]
        try:
            done(task, future.result())
        except _Broke as error:
            raise TaskFailed(f"task {label(task)}: {error}") from error
    return [future.result() for future in futures]


class _Broke(Exception):
    """The error of a task, as a sentence: not every error survives between processes."""


def _one(function: Callable[[Task], Result], task: Task) -> Result:
    try:
        return function(task)
    except Exception as error:
        raise _Broke(f"{type(error).__name__}: {error}") from error


@contextmanager
def open_executor(name: str = "local", workers: int | None = None) -> Iterator[Executor]:
    """Open an executor by name, and close it at the end.

    ``local`` has so many ``workers`` (processes; by default one a processor); ``dask:ADDRESS`` is a running
    scheduler (``dask:tcp://host:8786``), whose workers have this package installed. Raises NoExecutor, and
    TaskFailed where a process dies.
    """
    if name == "local":
        # Started afresh: the threads of a progress bar run in this process, which a fork would copy half.
        context, processes = get_context("spawn"), workers or os.cpu_count() or 1
        with _environment(ONE_THREAD), ProcessPoolExecutor(processes, context, _begin) as pool:
            try:
                yield pool
            except BrokenExecutor as error:
                raise TaskFailed(
                    f"a process that ran a task died (killed, or out of memory?): {error}"
                ) from None
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
    before = dict(os.environ)
    os.environ.update(values)
    try:
        yield
    finally:
        for name in values:
            os.environ.pop(name)
        os.environ.update(before)


def _begin() -> None:
    """Have a worker use one thread, and end when the process that started it is gone."""
    cv2.setNumThreads(1)
    parent = parent_process()
    assert parent is not None

    def watch() -> None:
        parent.join()
        os._exit(1)

    threading.Thread(target=watch, name="end with parent", daemon=True).start()
