"""Processes that are forked are as those that are started."""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from subprocess import PIPE

import pytest

from hil_tests import forks
from hil_tests.waiting import until

ELSEWHERE = """
import sys
from hil_tests import forks
made = forks.Popen([*forks.MASTCTL, "run", "--config", sys.argv[1]], stdout=-3)
print(made.pid, flush=True)
sys.stdin.read()
"""


@pytest.fixture
def fifo(tmp_path: Path) -> Path:
    """A configuration that nobody writes: a daemon reads it for ever, having opened nothing else."""
    os.mkfifo(tmp_path / "daemon.yaml")
    return tmp_path / "daemon.yaml"


@contextlib.contextmanager
def read_by_somebody(fifo: Path) -> Iterator[None]:
    def opened() -> int:
        with contextlib.suppress(OSError):  # ENXIO: nobody reads it yet
            return os.open(fifo, os.O_WRONLY | os.O_NONBLOCK)
        return 0

    writer = until(opened, "somebody reads the configuration")
    try:
        yield
    finally:
        os.close(writer)  # who reads it has read an empty one, and ends


@pytest.mark.parametrize("words", ["budget --json", "run --config nothing.yaml", "nonsense", "run --help"])
def test_it_says_and_ends_as_a_process_that_is_started(words: str, tmp_path: Path) -> None:
    command = [*forks.MASTCTL, *words.split()]
    started = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True)
    assert vars(forks.run(command, cwd=tmp_path)) == vars(started)


def test_it_holds_its_own_descriptors_and_ends_by_a_signal_as_a_child(fifo: Path) -> None:
    command = [*forks.MASTCTL, "run", "--config", fifo.name]
    with (
        forks.Popen(command, stdin=subprocess.DEVNULL, stdout=PIPE, stderr=PIPE, cwd=fifo.parent) as made,
        read_by_somebody(fifo),
    ):
        home = Path(f"/proc/{made.pid}")
        held = {int(link.name): str(link.readlink()) for link in (home / "fd").iterdir()}
        assert made.stdout is not None and made.stderr is not None
        ends = [str(Path(f"/proc/self/fd/{pipe.fileno()}").readlink()) for pipe in (made.stdout, made.stderr)]
        assert [held.pop(standard) for standard in range(3)] == ["/dev/null", *ends]
        assert set(held.values()) <= {str(fifo)}  # empty while it still opens it
        assert (home / "cwd").readlink() == fifo.parent
        assert f"\nPPid:\t{os.getpid()}\n" in (home / "status").read_text()
        made.kill()
        assert made.wait(60.0) == -signal.SIGKILL


def test_nobody_outlives_a_test_process_that_is_killed(fifo: Path) -> None:
    with subprocess.Popen(
        [sys.executable, "-c", ELSEWHERE, str(fifo)],
        stdin=PIPE,
        stdout=PIPE,
        text=True,
        cwd=forks.REPOSITORY,
    ) as asking:
        assert asking.stdout is not None
        daemon = Path("/proc") / asking.stdout.readline().strip()
        with read_by_somebody(fifo):
            asking.kill()
            until(lambda: not daemon.exists() or "\nState:\tZ" in (daemon / "status").read_text(), "its end")
