"""Tasks: named by their inputs and the program, run once, kept whole, listed, run one by one."""

from __future__ import annotations

import json
import os
import pickle
import signal
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Executor, ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import psutil
import pytest

from calib.files.mast_file import load_rig
from calib.geometry.rig import Rig
from hil_tests.mastctl.calibration.survey_world import RIG_FILE
from hil_tests.mastctl.experiment.toy_tasks import Draw, broken_when_odd, calls, drawn, drawn_or_stuck
from mastctl.cli.main import main
from mastctl.experiment import tasks
from mastctl.experiment.tasks import KeptResults, OtherProgram, TaskFailed, Work
from tools.studies.calibration_survey import one_survey, survey_tasks


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


def test_results_come_in_the_order_of_the_tasks_whatever_the_order_of_their_ends() -> None:
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


def test_more_tasks_go_on_from_the_ones_that_are_kept(tmp_path: Path) -> None:
    work(3).run(threads, KeptResults(tmp_path))
    work(5).run(threads, KeptResults(tmp_path))
    assert sorted(calls) == [0, 1, 2, 3, 4]


def test_the_same_task_twice_is_run_once() -> None:
    twice = Work(drawn, [Draw(1), Draw(2), Draw(1)], str)
    found = twice.run(threads)
    assert sorted(calls) == [1, 2] and len(found) == 3
    np.testing.assert_array_equal(found[0], found[2])


@pytest.mark.parametrize(
    "damage", [lambda data: data[: len(data) // 2], lambda data: data[:-1] + b"x", lambda data: b""]
)
def test_a_torn_result_is_run_again(tmp_path: Path, damage: Callable[[bytes], bytes]) -> None:
    one = work(1)
    whole = one.run(threads, KeptResults(tmp_path))[0]
    file = tmp_path / f"{one.ids[0]}.task"
    file.write_bytes(damage(file.read_bytes()))
    assert not KeptResults(tmp_path).holds(one.ids[0])
    np.testing.assert_array_equal(one.run(threads, KeptResults(tmp_path))[0], whole)
    assert calls == [0, 0] and KeptResults(tmp_path).holds(one.ids[0])


def test_two_runs_at_once_on_one_folder_agree(tmp_path: Path) -> None:
    found: list[list[np.ndarray]] = []
    runs = [
        threading.Thread(target=lambda: found.append(work(10).run(threads, KeptResults(tmp_path))))
        for _ in "ab"
    ]
    for run in runs:
        run.start()
    for run in runs:
        run.join()
    np.testing.assert_array_equal(found[0], found[1])
    assert all(KeptResults(tmp_path).holds(name) for name in work(10).ids)


# Names


def test_every_input_names_the_task() -> None:
    rig = load_rig(RIG_FILE).rig
    values: Sequence[Any] = (
        1.0, 1, "1", True, None, (1.0,), [1.0], {"a": 1.0}, {"b": 1.0}, np.ones(1), np.ones(1, np.float32),
        np.ones((1, 1)), np.nextafter(1.0, 2.0), -0.0, 0.0, b"1", Draw(1), rig,
    )  # fmt: skip
    names = Work(drawn, [Draw(1, 3, value) for value in values], str).ids
    assert len(set(names)) == len(values)


def test_an_equal_value_has_the_same_name_wherever_it_was_read(tmp_path: Path) -> None:
    def names(rig: Rig) -> tuple[str, ...]:
        return Work(one_survey, survey_tasks(rig, surveys=1, targets=2, seed=3), str).ids

    rig = load_rig(RIG_FILE).rig
    assert names(rig) == names(load_rig(RIG_FILE).rig) == names(pickle.loads(pickle.dumps(rig)))


def test_what_no_name_can_tell_is_no_input() -> None:
    with pytest.raises(TypeError, match="a task holds PosixPath"):
        Work(drawn, [Draw(1, 3, Path("rig.yaml"))], str)


def test_another_program_and_another_function_give_other_names(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """After an upgrade nothing old is taken for new."""
    before = work(1)
    before.run(threads, KeptResults(tmp_path))
    assert before.ids != work(1, broken_when_odd).ids
    monkeypatch.setattr(tasks, "_program", lambda package: "mastctl of tomorrow")
    assert before.ids != work(1).ids
    work(1).run(threads, KeptResults(tmp_path))
    assert calls == [0, 0]


def test_the_program_is_told_by_its_source_and_what_computes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    told = []
    for text in ("a = 1", "a = 2", "a = 1"):
        (tmp_path / "rover_rules").mkdir(exist_ok=True)
        (tmp_path / "rover_rules" / "rule.py").write_text(text)
        monkeypatch.syspath_prepend(tmp_path)
        tasks._program.cache_clear()
        told.append(tasks._program("rover_rules"))
    assert f"numpy {np.__version__}" in told[0]
    assert told[0] == told[2] != told[1]


def test_a_worker_with_another_program_is_refused() -> None:
    with pytest.raises(OtherProgram, match=r"runs another program .* than this one"):
        tasks._one(drawn, Draw(1), "mastctl of yesterday")
    assert not calls


# Failures


def test_a_task_that_fails_takes_no_other_with_it(tmp_path: Path) -> None:
    some = work(4, broken_when_odd)
    with pytest.raises(TaskFailed, match=r"2 of 4 tasks failed; task \w+ \(seed [13]\): ZeroDivisionError"):
        some.run(threads, KeptResults(tmp_path))
    assert [KeptResults(tmp_path).holds(name) for name in some.ids] == [True, False, True, False]


def test_a_folder_that_cannot_be_written_is_refused_in_words(tmp_path: Path, capsys: Any) -> None:
    (tmp_path / "file").write_text("")
    words = ["experiment", "pointing", "--simulated", "--results", str(tmp_path / "file"), "--json"]
    assert main(words) == 2
    assert "is a file; a folder is expected" in json.loads(capsys.readouterr().out)["error"]["message"]


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


# Commands

POINTING = ["experiment", "pointing", "--simulated", "--targets", "1", "--distances", "6", "2", "--json"]


def test_an_interrupted_run_says_what_is_kept_and_how_to_go_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def interrupted(self: Work[Any, Any], executor: Any, kept: KeptResults, done: Any) -> None:
        kept.write(self.ids[0], "first", 1)
        raise KeyboardInterrupt

    monkeypatch.setattr(Work, "run", interrupted)
    assert main([*POINTING[:-1], "--results", str(tmp_path)]) == 130
    said = capsys.readouterr().err
    assert f"1 of 2 tasks are kept in {tmp_path}; the same command goes on" in said


def test_an_unknown_task_and_one_without_a_place_are_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for words, reason in (
        (["--task", "0" * 16, "--results", str(tmp_path)], "is none of these 2 tasks"),
        (["--task", "0" * 16], "--task needs --results DIR"),
    ):
        assert main([*POINTING, *words]) == 2
        assert reason in json.loads(capsys.readouterr().out)["error"]["message"]
    assert not list(tmp_path.iterdir())
