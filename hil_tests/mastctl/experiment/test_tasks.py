"""Tasks: named by their inputs and the program, run once, kept whole, listed, run one by one."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from concurrent.futures import Executor, ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import psutil
import pytest

from hil_tests.mastctl.experiment.toy_tasks import Draw, broken_when_odd, calls, drawn, drawn_or_stuck
from mastctl.experiment.tasks import KeptResults, TaskFailed, Work


@contextmanager
def threads() -> Iterator[Executor]:
    with ThreadPoolExecutor(4) as pool:
        yield pool


@contextmanager
def nothing() -> Iterator[Executor]:
    raise AssertionError("an executor was opened")
    yield


def work(count: int, function: Callable[[Draw], Any] = drawn) -> Work[Draw, Any]:
    return Work(function, [Draw(seed) for seed in range(count)], lambda task: f"seed {task.seed}")


@pytest.fixture(autouse=True)
def _no_calls() -> None:
    calls.clear()


def test_results_come_in_the_order_of_the_tasks_not_of_their_ends() -> None:
    found = work(8).run(threads)
    for seed, numbers in enumerate(found):
        np.testing.assert_array_equal(numbers, np.random.default_rng(seed).standard_normal(3))


def test_what_is_kept_is_not_run_again_and_comes_back_to_the_last_bit(tmp_path: Path) -> None:
    first = work(4).run(threads, KeptResults(tmp_path))
    told: list[int] = []
    again = work(4).run(nothing, KeptResults(tmp_path), lambda task, _: told.append(task.seed))
    assert sorted(calls) == [0, 1, 2, 3] and told == [0, 1, 2, 3]
    for one, other in zip(first, again, strict=True):
        assert one.tobytes() == other.tobytes()


def test_another_value_or_function_is_another_task() -> None:
    assert len({*work(3).ids, *work(3, broken_when_odd).ids, *Work(drawn, [Draw(0, 4)], str).ids}) == 7
    assert work(2).ids == work(3).ids[:2]


def test_a_task_that_fails_takes_no_other_with_it(tmp_path: Path) -> None:
    some = work(4, broken_when_odd)
    with pytest.raises(TaskFailed, match=r"2 of 4 tasks failed; task \w+ \(seed [13]\): ZeroDivisionError"):
        some.run(threads, KeptResults(tmp_path))
    assert [KeptResults(tmp_path).holds(name) for name in some.ids] == [True, False, True, False]


LONG = """
import sys, time
from pathlib import Path
from mastctl.experiment.tasks import open_executor
from mastctl.experiment.tasks import KeptResults, Work
from hil_tests.mastctl.experiment.toy_tasks import Draw, drawn_or_stuck

if __name__ == "__main__":
    folder = Path(sys.argv[1])
    work = Work(drawn_or_stuck, [Draw(1), Draw(2, scale=1e9)], str)
    work.run(lambda: open_executor("local", 2), KeptResults(folder), lambda *_: print("kept", flush=True))
"""


def test_a_killed_run_keeps_what_was_done_and_leaves_no_process(tmp_path: Path) -> None:
    script = tmp_path / "long.py"
    script.write_text(LONG)
    environment = {**os.environ, "PYTHONPATH": str(Path(__file__).parents[3])}
    with subprocess.Popen(
        [sys.executable, str(script), str(tmp_path / "kept")], stdout=subprocess.PIPE, env=environment
    ) as run:
        assert run.stdout is not None and run.stdout.readline() == b"kept\n"
        workers = psutil.Process(run.pid).children(recursive=True)
        run.send_signal(signal.SIGKILL)
        run.wait(60.0)
        gone, left = psutil.wait_procs(workers, timeout=60)
    assert gone and not left
    done = Work(drawn_or_stuck, [Draw(1), Draw(2, scale=1e9)], str)
    assert [KeptResults(tmp_path / "kept").holds(name) for name in done.ids] == [True, False]
