"""What a signal ends clears away what it made."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from contextlib import suppress
from pathlib import Path

import pytest

from hil_tests.waiting import until

TOOL = """
import subprocess, tempfile, time
from tools.arguments import end
def main():
    with tempfile.TemporaryDirectory() as folder, subprocess.Popen(["sleep", "600"], cwd=folder) as process:
        try:
            print("begun", process.pid, flush=True)
            process.wait()
        finally:
            process.kill()
end(main)
"""


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGHUP])
def test_a_tool_that_a_signal_ends_leaves_nothing_behind(
    repository: Path, tmp_path: Path, number: signal.Signals
) -> None:
    environment = {**os.environ, "PYTHONPATH": str(repository), "TMPDIR": str(tmp_path)}
    command = [sys.executable, "-c", TOOL]
    with subprocess.Popen(command, env=environment, stdout=subprocess.PIPE, text=True) as tool:
        assert tool.stdout is not None
        sleeping = Path("/proc") / tool.stdout.readline().split()[1]
        assert [*tmp_path.iterdir()] != [] and sleeping.exists()
        tool.send_signal(number)
        assert tool.wait(60) == 128 + number
    assert [*tmp_path.iterdir()] == [] and not sleeping.exists()


@pytest.mark.long(2, "copies and compiles the checkout for the sampler of mutants")
def test_mutants_that_a_signal_ends_leave_nothing_behind(repository: Path, tmp_path: Path) -> None:
    environment = {**os.environ, "TMPDIR": str(tmp_path)}
    command = [sys.executable, "-m", "tools.mutants", "calib/mast", "--mutants", "2", "--jobs", "1"]
    with subprocess.Popen(
        command, cwd=repository, env=environment, stdout=subprocess.DEVNULL, start_new_session=True
    ) as tool:
        until(lambda: [one for one in tmp_path.glob("*/*/said") if one.read_text()], "a test runs", 300)
        tool.send_signal(signal.SIGTERM)
        assert tool.wait(60) == 128 + signal.SIGTERM
    mark = str(tmp_path).encode()
    until(lambda: not [*processes_with(mark)], "all its processes have ended")
    assert [*tmp_path.iterdir()] == []


def processes_with(mark: bytes) -> list[Path]:
    """Processes that work in a folder."""
    found = []
    for folder in Path("/proc").glob("[0-9]*"):
        with suppress(OSError):
            if mark in bytes((folder / "cwd").readlink()):
                found.append(folder)
    return found
