"""Tasks of an experiment or campaign: named by all that decides their results, run anywhere, kept.

A task's name is a digest of its function, its inputs and the program: the source, the packaged rigs, and the
versions of what computes. After an upgrade every task has another name, so that no result of an old program
is taken for one of the new.

Processes of this machine or a Dask cluster run them. A task carries its own seed and results are put in the
order of the tasks, so the numbers are the same. To the last digit they are if linear algebra runs in one
thread everywhere, as it does in the workers of Dask and in those that are started here: more threads add up
in another order.
"""

from __future__ import annotations

import dataclasses
import hashlib
import importlib.metadata
import os
import pickle
import platform
import socket
import sys
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import BrokenExecutor, Executor, ProcessPoolExecutor, as_completed
from contextlib import AbstractContextManager, contextmanager, suppress
from datetime import date
from enum import Enum
from functools import cache
from multiprocessing import get_context, parent_process
from pathlib import Path
from typing import Any, Generic, TypeVar

import numpy as np

from calib.files.atomic import save_bytes
from mastctl.errors import MastctlError
from mastctl.packaged import config_folder

Task = TypeVar("Task")
Result = TypeVar("Result")

COMPUTES = ("numpy", "scipy", "opencv-python-headless", "numba")
"""Packages whose versions decide digits."""

OURS = ("mastctl", "drivers", "calib")
SUFFIX = ".task"


class TaskFailed(MastctlError):
    """A task ended without a result; what others came to is kept, if results are kept."""

    code = "task_failed"


class OtherProgram(MastctlError):
    """A worker runs another program than the one that asks: its numbers would go under a false name."""

    code = "other_program"
    exit_code = 2


class _Broke(Exception):
    """What went wrong in a task, in words."""


class Work(Generic[Task, Result]):
    """Tasks of one function, which decides by a task's value alone what it comes to.

    Parameters
    ----------
    function
        Of a module, so that another process finds it by its name.
    tasks
        Values of dataclasses, arrays, numbers, words and what holds them; the same value is the same task.
    label
        What a person calls a task.

    Attributes
    ----------
    ids
        Of the tasks, in their order.
    """

    def __init__(
        self, function: Callable[[Task], Result], tasks: Sequence[Task], label: Callable[[Task], str]
    ) -> None:
        self.function = function
        self.tasks = tuple(tasks)
        self.label = label
        self.program = program_of(function)
        name = f"{function.__module__}.{function.__qualname__}"
        self.ids = tuple(_digest((name, self.program, _plain(task))) for task in self.tasks)

    def run(
        self,
        executor: Callable[[], AbstractContextManager[Executor]],
        kept: KeptResults | None = None,
        done: Callable[[Task, Result], None] = lambda task, result: None,
    ) -> list[Result]:
        """Return the results in the order of the tasks.

        Parameters
        ----------
        executor
            Opens what runs them; not called where every result is there already.
        kept
            Results that are there need no run, and each that comes is kept at once.
        done
            Called here with each task and result as they come, first those that were there.

        Raises
        ------
        TaskFailed
            If a task raised an error, after all the others have ended; or if a process of the executor died.
        OtherProgram
            If a worker runs another version of the program.
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
        futures = {
            executor.submit(_one, self.function, task, self.program): name for name, task in todo.items()
        }
        failed: list[tuple[str, Exception]] = []
        for future in as_completed(futures):
            name = futures[future]
            try:
                result = future.result()
            except OtherProgram:
                raise
            except BrokenExecutor as error:
                raise TaskFailed(
                    f"a process that ran a task died (killed, or out of memory?): {error}"
                ) from None
            except Exception as error:
                failed.append((name, error))
                continue
            if kept is not None:
                kept.write(name, self.label(todo[name]), result)
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
        """Tell whether a whole result of a task is there."""
        return self._payload(name) is not None

    def read(self, name: str) -> Any | None:
        """Return the result of a task; None where there is none, or none that is whole."""
        payload = self._payload(name)
        return None if payload is None else pickle.loads(payload)

    def write(self, name: str, label: str, result: object) -> None:
        """Keep a result, unless it is there; raises BadFile."""
        if self.holds(name):
            return
        with suppress(FileExistsError):
            self.folder.mkdir(parents=True, exist_ok=True)
        payload = pickle.dumps(result, protocol=5)
        head = f"{hashlib.sha256(payload).hexdigest()} {' '.join(label.split())}\n"
        save_bytes(self._path(name), head.encode() + payload)

    def _payload(self, name: str) -> bytes | None:
        try:
            head, _, payload = self._path(name).read_bytes().partition(b"\n")
        except FileNotFoundError:
            return None
        whole = head.split(b" ", 1)[0] == hashlib.sha256(payload).hexdigest().encode()
        return payload if whole else None

    def _path(self, name: str) -> Path:
        return self.folder / f"{name}{SUFFIX}"


def _one(function: Callable[[Task], Result], task: Task, program: str) -> Result:
    """Run one task where this program is the one that asked."""
    here = program_of(function)
    if here != program:
        raise OtherProgram(
            f"the worker on {socket.gethostname()} runs another program ({here}) than this one ({program}); "
            "install the same version of everything there"
        )
    try:
        return function(task)
    except Exception as error:  # not every error survives the way between processes; its words do
        raise _Broke(f"{type(error).__name__}: {error}") from error


def program_of(function: Callable[..., Any]) -> str:
    """Return what decides numbers beside a task's inputs, in words: versions, and a digest of the source."""
    return _program(function.__module__.partition(".")[0])


@cache
def _program(package: str) -> str:
    source = hashlib.sha256()
    for name in dict.fromkeys((*OURS, package)):
        module = sys.modules[name] if name in sys.modules else __import__(name)
        # a folder without __init__.py may be found by two ways
        for root in sorted({Path(place).resolve() for place in getattr(module, "__path__", ())}):
            _feed(source, name, root, "*.py")
        if not hasattr(module, "__path__") and module.__file__ is not None:
            source.update(Path(module.__file__).read_bytes())
    _feed(source, "configs", config_folder(), "*.yaml")
    versions = [f"python {platform.python_version()} {platform.machine()}"]
    for name in COMPUTES:
        with suppress(importlib.metadata.PackageNotFoundError):
            versions.append(f"{name} {importlib.metadata.version(name)}")
    return ", ".join([*versions, f"source {source.hexdigest()[:12]}"])


def _feed(source: Any, name: str, root: Path, pattern: str) -> None:
    """Digest files of a folder, each with its name."""
    for path in sorted(root.rglob(pattern)):
        data = path.read_bytes()
        source.update(f"{name}/{path.relative_to(root).as_posix()} {len(data)}\n".encode() + data)


def _digest(plain: object) -> str:
    return hashlib.sha256(repr(plain).encode()).hexdigest()[:16]


def _plain(value: Any) -> Any:
    """A value as nested tuples of words and numbers whose ``repr`` tells any two values apart."""
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        fields = tuple((f.name, _plain(getattr(value, f.name))) for f in dataclasses.fields(value))
        return type(value).__module__, type(value).__qualname__, fields
    if isinstance(value, np.ndarray) and value.dtype != object:
        return "array", value.dtype.str, value.shape, value.tobytes()
    if isinstance(value, (np.generic, Enum)):
        return type(value).__name__, _plain(value.item() if isinstance(value, np.generic) else value.value)
    if isinstance(value, Mapping):
        return "mapping", tuple((_plain(key), _plain(one)) for key, one in value.items())
    if isinstance(value, (tuple, list)):
        return type(value).__name__, tuple(map(_plain, value))
    if value is None or type(value) in (bool, int, float, str, bytes):
        return value
    if isinstance(value, date):
        return "date", value.isoformat()
    raise TypeError(f"a task holds {type(value).__name__}, whose value no name can hold")


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
