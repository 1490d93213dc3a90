"""A run of the suite that leaves something behind fails, and names it and the test."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
from contextlib import suppress
from pathlib import Path

import pytest

from hil_tests.waiting import until

CONFTEST = "from hil_tests.conftest import *\nfrom hil_tests.conftest import _tell_flaky\n"

TESTS = {
    "nothing": "def test_it(tmp_path):\n    (tmp_path / 'file').touch()\n",
    "folder": "import tempfile\ndef test_it():\n    tempfile.mkdtemp(prefix='mastctl-')\n",
    "process": """
import subprocess, sys
def test_it():
    code = "import subprocess; subprocess.Popen(['sleep', '600'], start_new_session=True)"
    subprocess.run([sys.executable, '-c', code], check=True, stdout=-3, stderr=-3)  # gone before the run ends
""",
}


@pytest.mark.parametrize(
    ("what", "workers"), [("nothing", 0), ("folder", 0), ("process", 0), ("folder", 1), ("nothing", 1)]
)
def test_what_is_left_behind_fails_the_run(repository: Path, tmp_path: Path, what: str, workers: int) -> None:
    (tmp_path / "conftest.py").write_text(CONFTEST)
    (tmp_path / "test_one.py").write_text(TESTS[what])
    (tmp_path / "temporary").mkdir()
    environment = {
        **os.environ,
        "PYTHONPATH": str(repository),
        "PYTEST_DEBUG_TEMPROOT": f"{tmp_path}/temporary",
    }
    words = [
        "-p",
        "no:cacheprovider",
        "-s",
        "-c",
        os.devnull,
        "--rootdir",
        ".",
        "-n",
        str(workers),
        "test_one.py",
    ]
    done = subprocess.run(
        [sys.executable, "-m", "pytest", *words],
        cwd=tmp_path, env=environment, capture_output=True, text=True, timeout=120, check=False,
    )  # fmt: skip
    told = [line for line in done.stdout.splitlines() if line.startswith("LEFT BEHIND")]
    for process in re.findall(r"process (\d+): sleep 600", done.stdout):
        os.kill(int(process), signal.SIGKILL)
    assert "1 passed" in done.stdout, done.stdout + done.stderr
    assert not [*tmp_path.glob("temporary/mastctl-*")]  # it clears away what it complains of
    if what == "nothing":
        assert done.returncode == 0 and told == []
    else:
        (line,) = told
        assert done.returncode == 1
        assert "sleep 600" in line if what == "process" else "/mastctl-" in line and "test_it" in line


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
