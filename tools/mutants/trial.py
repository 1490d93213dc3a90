"""One run of pytest in a copy of the checkout, in a fork of a process that holds the large libraries already.

The project's own modules are imported anew in each fork, from the copy. What counts against the limits is
processor time, so that a machine with other work does not kill what is only waiting for its turn.
"""

from __future__ import annotations

import importlib
import json
import os
import signal
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple, NoReturn

import pytest

from mastctl import signals
from tools.mutants.sites import PACKAGES, TESTS

LIBRARIES = ("cv2", "fastapi", "httpx", "hypothesis", "numba", "numpy.testing", "scipy.interpolate")
LIBRARIES += ("scipy.optimize", "scipy.spatial.transform", "scipy.stats", "uvicorn", "yaml")
NOTHING_TO_RUN = 5  # pytest's code where every test is skipped or left out: nobody objects
BROKEN = (2, 3, 4)  # pytest's codes for what ended before a test could judge: a module that fails on import


class MutantEnded(NamedTuple):
    """How a run ended.

    ``outcome`` is ``passed``, ``killed`` (a test objected), ``killed by timeout`` or ``broken`` (the tests
    could not be collected); ``test`` is who objected, ``cpu_s`` the processor time of the run and all that it
    started.
    """

    outcome: str
    test: str
    cpu_s: float


def run_change(
    file: Path, changed: str, copy: Path, tests: Sequence[str], allowed_s: float, patience_s: float
) -> MutantEnded:
    """Run test files on a changed file until one test objects, and put the file back.

    A test that objects must do so again, and must not without the change: else it failed by chance, by what
    keeps the machine busy, or always takes too long; it is left out, and the others go on.
    """
    source = file.read_text()
    doubtful: list[str] = []
    cpu_s = 0.0
    while True:
        try:
            file.write_text(changed)
            ended = run(copy, tests, allowed_s, patience_s, leave_out=doubtful)
            cpu_s += ended.cpu_s
            if ended.outcome in ("passed", "broken") or not ended.test:
                return ended._replace(cpu_s=cpu_s)
            again = ended
            if ended.outcome == "killed":
                again = run(copy, [ended.test], allowed_s, patience_s)
                cpu_s += again.cpu_s
        finally:
            file.write_text(source)
        without = run(copy, [ended.test], allowed_s, patience_s)
        cpu_s += without.cpu_s
        if again.outcome != "passed" and without.outcome == "passed":
            return ended._replace(cpu_s=cpu_s)
        doubtful.append(ended.test)


_running: list[int] = []
"""The process in which tests run now, and the number of its group."""


def end_with_tests(*_signal: object) -> NoReturn:
    """End this process at once, and the tests that it runs with all that they began (a signal's handler)."""
    for pid in _running:
        with suppress(ProcessLookupError):
            os.killpg(pid, signal.SIGKILL)
    os._exit(1)


def warm() -> None:
    """Import what nearly every test needs, once for all runs."""
    for name in LIBRARIES:
        importlib.import_module(name)


def run(
    copy: Path, tests: Sequence[str], allowed_s: float, patience_s: float, *, leave_out: Sequence[str] = ()
) -> MutantEnded:
    """Run test files, or single tests, in their order until one test objects.

    ``allowed_s`` is the processor time that a single test may take, ``patience_s`` what the whole may take by
    the clock on the wall; the tests in ``leave_out`` do not run.
    """
    said = copy.parent / "said"
    said.write_text("")
    pid = os.fork()
    if pid == 0:
        _in_the_fork(copy, said, tests, allowed_s, leave_out)
    _running[:] = [pid]
    until_s = time.monotonic() + patience_s
    ended, status, used = os.wait4(pid, os.WNOHANG)
    while not ended and time.monotonic() < until_s:
        time.sleep(0.02)
        ended, status, used = os.wait4(pid, os.WNOHANG)
    with suppress(ProcessLookupError):
        os.killpg(pid, signal.SIGKILL)  # and whatever the tests left running
    if not ended:
        _, status, used = os.wait4(pid, 0)
    _running.clear()
    return _judged(said, bool(ended), status, used.ru_utime + used.ru_stime)


def _judged(said: Path, in_time: bool, status: int, cpu_s: float) -> MutantEnded:
    lines = [json.loads(line) for line in said.read_text().splitlines()]
    begun = [line["begins"] for line in lines if "begins" in line]
    objected = [line["objects"] for line in lines if "objects" in line]
    last = (objected or begun or [""])[-1]
    code = os.waitstatus_to_exitcode(status)
    if not in_time or code == -signal.SIGPROF:
        return MutantEnded("killed by timeout", last, cpu_s)
    if code == NOTHING_TO_RUN:
        return MutantEnded("passed", "", cpu_s)
    if code in BROKEN or not begun:
        return MutantEnded("broken", last, cpu_s)
    return MutantEnded("killed" if code else "passed", last if code else "", cpu_s)


def _in_the_fork(
    copy: Path, said: Path, tests: Sequence[str], allowed_s: float, leave_out: Sequence[str]
) -> NoReturn:
    """Be the process that runs the tests."""
    code = 4
    try:
        for number in signals.ENDING:  # the tool's own handlers, which would end pytest in order
            signal.signal(number, signal.SIG_DFL)
        signal.signal(signal.SIGINT, signal.default_int_handler)
        os.setsid()
        os.chdir(copy)
        # it ends without clearing away: what it makes goes with the copy
        os.environ |= {"TMPDIR": str(copy.parent), "PYTEST_DEBUG_TEMPROOT": str(copy.parent)}
        tempfile.tempdir = None
        silence = os.open(os.devnull, os.O_RDWR)
        for stream in (0, 1, 2):
            os.dup2(silence, stream)
        for name in [*sys.modules]:
            if name.partition(".")[0] in (*PACKAGES, TESTS):
                del sys.modules[name]
        sys.modules["__main__"] = pytest  # this one's is the tool, not of the copy
        sys.path.insert(0, str(copy))
        sys.dont_write_bytecode = True
        with said.open("a", buffering=1) as file:
            without = [f"--deselect={test}" for test in leave_out]
            code = pytest.main(
                ["-x", "-q", "-p", "no:cacheprovider", *without, *tests],
                plugins=[_Watch(file.write, allowed_s)],
            )
    finally:
        os._exit(code)


class _Watch:
    """A pytest plugin: says which test runs and which objects, and lets none take too long."""

    def __init__(self, write: Callable[[str], object], allowed_s: float) -> None:
        self._write = write
        self._allowed_s = allowed_s

    def pytest_runtest_logstart(self, nodeid: str) -> None:
        self._say(begins=nodeid)
        signal.setitimer(signal.ITIMER_PROF, self._allowed_s)

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        if report.failed:
            self._say(objects=report.nodeid)

    def _say(self, **line: object) -> None:
        self._write(json.dumps(line) + "\n")
