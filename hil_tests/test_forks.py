"""Processes that are forked are as those that are started."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from subprocess import PIPE

import pytest

from hil_tests import forks
from hil_tests.waiting import until

ELSEWHERE = """
import sys
from hil_tests import forks
made = forks.Popen([*forks.MASTCTL, "run", "--listen", "127.0.0.1:0"], stdout=-3, stderr=-3)
print(made.pid, flush=True)
sys.stdin.read()
"""


@pytest.mark.parametrize("words", ["budget --json", "run --config nothing.yaml", "nonsense", "run --help"])
def test_it_says_and_ends_as_a_process_that_is_started(words: str, tmp_path: Path) -> None:
    command = [*forks.MASTCTL, *words.split()]
    started = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True)
    assert vars(forks.run(command, cwd=tmp_path)) == vars(started)


def test_no_process_outlives_a_test_process_that_is_killed() -> None:
    with subprocess.Popen(
        [sys.executable, "-c", ELSEWHERE], stdin=PIPE, stdout=PIPE, text=True, cwd=forks.REPOSITORY
    ) as asking:
        assert asking.stdout is not None
        daemon = Path("/proc") / asking.stdout.readline().strip()
        assert (daemon / "status").exists()
        asking.kill()
        until(lambda: not daemon.exists() or "\nState:\tZ" in (daemon / "status").read_text(), "its end")
