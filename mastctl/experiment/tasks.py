"""Tasks of an experiment or campaign: run on any executor, their results kept.

Processes of this machine or a Dask cluster run them. A task carries its own seed and results are put in the
order of the tasks, so the numbers are the same. To the last digit they are if linear algebra runs in one
thread everywhere, as it does in the workers of Dask and in those that this program starts: more threads add
up in another order.
"""

from __future__ import annotations

import hashlib
import json
import os
import pickle
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import BrokenExecutor, Executor, ProcessPoolExecutor, as_completed
from contextlib import AbstractContextManager, contextmanager, suppress
from importlib.metadata import version
from multiprocessing import get_context, parent_process
from pathlib import Path
from typing import Any, Generic, TypeVar

from calib.files.atomic import save_bytes
from mastctl.as_json import as_json
from mastctl.errors import MastctlError

Task = TypeVar("Task")
Result = TypeVar("Result")

SUFFIX = ".task"


class TaskFailed(MastctlError):
    """A task ended without a result; the results of others are kept, if results are kept."""

    code = "task_failed"


class _Broke(Exception):
    """The error of a task, as a sentence."""


class Work(Generic[Task, Result]):
    """Tasks of one function of a module, whose result depends on a task's value alone.

    Tasks are dataclasses of arrays, numbers and texts; ``label`` describes one. Their ``ids`` are in the same
    order, made of function, version of the program, and value: the same value is the same task.
    """

    def __init__(
        self, function: Callable[[Task], Result], tasks: Sequence[Task], label: Callable[[Task], str]
    ) -> None:
        self.function = function
        self.tasks = tuple(tasks)
        self.label = label
        self.ids = tuple(_id(function, task) for task in self.tasks)

    def run(
        self,
        executor: Callable[[], AbstractContextManager[Executor]],
        kept: KeptResults | None = None,
        done: Callable[[Task, Result], None] = lambda task, result: None,
    ) -> list[Result]:
        """Return the results in the order of the tasks.

        ``executor`` is not opened where every result is ``kept`` already. ``done`` is called with each task
        and result as they come, first those that were kept.

        Raises
        ------
        TaskFailed
            If a task raised an error, after all the others have ended; or if a process of the executor died.
        BadFile
            If a result cannot be kept.
        """
        found: dict[str, Result] = {}
        todo: dict[str, Task] = {}
        for name, task in zip(self.ids, self.tasks, strict=True):
            result = None if kept is None or name in found or name in todo else kept.read(name)
            if result is not None:
                found[name] = result
                done(task, result)
            elif name not in found:
                todo[name] = task
        if todo:
            with executor() as opened:
                for name, result in self._ended(opened, todo, kept):
                    found[name] = result
                    done(todo[name], result)
        return [found[name] for name in self.ids]

    def _ended(
        self, executor: Executor, todo: Mapping[str, Task], kept: KeptResults | None
    ) -> Iterator[tuple[str, Result]]:
        """Run tasks; their names and results as they come."""
        futures = {executor.submit(_one, self.function, task): name for name, task in todo.items()}
        failed: list[tuple[str, Exception]] = []
        for future in as_completed(futures):
            name = futures[future]
            try:
                result = future.result()
            except BrokenExecutor as error:
                raise TaskFailed(
                    f"a process that ran a task died (killed, or out of memory?): {error}"
                ) from None
            except Exception as error:
                failed.append((name, error))
                continue
            if kept is not None:
                kept.write(name, result)
            yield name, result
        if failed:
            name, first = failed[0]
            raise TaskFailed(
                f"{len(failed)} of {len(todo)} tasks failed; task {name} ({self.label(todo[name])}): "
                f"{first if isinstance(first, _Broke) else repr(first)}"
            ) from first


class KeptResults:
    """A folder of results, a file a task, each written whole or not at all; any number of runs may share it.

    A result is a pickle, which runs what it holds when it is read: the folder must be as trusted as the
    program.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def holds(self, name: str) -> bool:
        """Return whether the result of a task is kept."""
        return self._path(name).is_file()

    def read(self, name: str) -> Any | None:
        """Return the result of a task; None where there is none."""
        return pickle.loads(self._path(name).read_bytes()) if self.holds(name) else None

    def write(self, name: str, result: object) -> None:
        """Keep a result. Raises BadFile."""
        with suppress(FileExistsError):
            self.folder.mkdir(parents=True, exist_ok=True)
        save_bytes(self._path(name), pickle.dumps(result, protocol=5))

    def _path(self, name: str) -> Path:
        return self.folder / f"{name}{SUFFIX}"


def _one(function: Callable[[Task], Result], task: Task) -> Result:
    """Run one task."""
    try:
        return function(task)
    except Exception as error:  # not every error survives between processes; its sentence does
        raise _Broke(f"{type(error).__name__}: {error}") from error


def _id(function: Callable[[Task], Any], task: Task) -> str:
    """A name of a task that another run of the same version gives it too."""
    made_by = function.__module__, function.__qualname__, version("mastctl"), type(task).__qualname__
    return hashlib.sha256(json.dumps([*made_by, as_json(task)]).encode()).hexdigest()[:16]


DASK = "dask:"
ONE_THREAD = dict.fromkeys(("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"), "1")


class NoExecutor(MastctlError):
    """The place where tasks should run cannot be used."""

    code = "no_executor"
    exit_code = 2


@contextmanager
def open_executor(name: str, workers: int | None = None) -> Iterator[Executor]:
    """Open an executor by name, and close it at the end. Raises NoExecutor.

    ``local`` has so many ``workers`` (processes; by default one a processor); ``dask:ADDRESS`` is a running
    scheduler (``dask:tcp://host:8786``), whose workers have this package installed.
    """
    if name == "local":
        # Started afresh: the threads of a progress bar run in this process, which a fork would copy half.
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
