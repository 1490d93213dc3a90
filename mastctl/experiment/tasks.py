"""Tasks of an experiment or campaign, run by processes of this machine or by a Dask cluster.

A task carries its own seed and results are put in the order of the tasks, so the numbers are the same. To the
last digit they are if linear algebra runs in one thread everywhere, as it does in the workers of Dask and in
those that this program starts: more threads add up in another order.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import BrokenExecutor, Executor, ProcessPoolExecutor, as_completed
from contextlib import contextmanager
from multiprocessing import get_context
from typing import Any, TypeVar, cast

import cv2

from mastctl import signals
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
    futures = {executor.submit(_result_or_error, function, task): task for task in tasks}
    for future in as_completed(futures):
        task, (result, error) = futures[future], future.result()
        if error:
            raise TaskFailed(f"task {label(task)}: {error}")
        done(task, cast(Result, result))
    return [cast(Result, future.result()[0]) for future in futures]


def _result_or_error(function: Callable[[Task], Result], task: Task) -> tuple[Result | None, str]:
    """A task's result, or its error as a sentence: not every error survives between processes."""
    try:
        return function(task), ""
    except Exception as error:
        return None, f"{type(error).__name__}: {error}"


@contextmanager
def open_executor(name: str = "local", workers: int | None = None) -> Iterator[Executor]:
    """Open an executor by name, and close it at the end.

    ``local`` has so many ``workers`` (processes; by default one a processor); ``dask:ADDRESS`` is a running
    scheduler (``dask:tcp://host:8786``), whose workers have this package installed. Raises NoExecutor, and
    TaskFailed where a process dies.
    """
    if name == "local":
        # Started afresh: the threads of a progress bar run in this process, which a fork would copy half.
        before = {key: os.environ.get(key) for key in ONE_THREAD}
        os.environ.update(ONE_THREAD)
        try:
            with ProcessPoolExecutor(workers or os.cpu_count(), get_context("spawn"), _begin) as pool:
                try:
                    yield pool
                except BaseException:
                    pool.shutdown(cancel_futures=True)
                    raise
        except BrokenExecutor as error:
            reason = f"a process that ran a task died (killed, or out of memory?): {error}"
            raise TaskFailed(reason) from None
        finally:
            for key, value in before.items():
                os.environ.pop(key)
                os.environ.update({} if value is None else {key: value})
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


def _begin() -> None:
    """Have a worker use one thread, and end when the process that started it is gone."""
    cv2.setNumThreads(1)
    signals.end_with_parent()
