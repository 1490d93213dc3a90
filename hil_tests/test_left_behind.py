"""A run of the suite that leaves something behind fails, and names it and the test."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
from pathlib import Path

import pytest

CONFTEST = """
import os, pwd
from hil_tests import left_behind
left_behind.ENDING_S = 1.0
pwd.getpwuid = lambda user, was=pwd.getpwuid: pwd.struct_passwd([*was(user)[:5], os.environ["USERS"], "sh"])
from hil_tests.conftest import *
"""

TESTS = {
    "nothing": "def test_it(tmp_path):\n    (tmp_path / 'file').touch()\n",
    "folder": "import tempfile\ndef test_it():\n    tempfile.mkdtemp(prefix='mastctl-')\n",
    "process": """
import subprocess, sys
def test_it():
    code = "import subprocess; subprocess.Popen(['sleep', '600'], start_new_session=True)"
    subprocess.run([sys.executable, '-c', code], check=True, stdout=-3, stderr=-3)  # gone before the run ends
""",
    "place of a head": """
import os, pathlib, pwd
def test_it():
    place = pathlib.Path(pwd.getpwuid(os.getuid()).pw_dir, ".local/state/mastctl/heads/usb-1234-left")
    place.mkdir(parents=True)
""",
    "place of another run": """
import os, pathlib
def test_it():
    pathlib.Path(os.environ["USERS"], ".local/state/mastctl/heads/outside_devices_Head").mkdir(parents=True)
""",
}

LEFT_BY_IT = {
    "folder": "/mastctl-",
    "process": "sleep 600",
    "place of a head": "/home/.local/state/mastctl/heads/usb-1234-left",
}


@pytest.mark.parametrize(
    ("what", "workers"),
    [
        ("nothing", 0),
        ("process", 0),
        ("place of a head", 0),
        ("place of another run", 0),
        ("folder", 1),
    ],
)
def test_what_is_left_behind_fails_the_run(repository: Path, tmp_path: Path, what: str, workers: int) -> None:
    (tmp_path / "conftest.py").write_text(CONFTEST)
    (tmp_path / "test_one.py").write_text(TESTS[what])
    (tmp_path / "temporary").mkdir()
    environment = {
        **os.environ,
        "USERS": f"{tmp_path}/user",
        "PYTHONPATH": str(repository),
        "PYTEST_DEBUG_TEMPROOT": f"{tmp_path}/temporary",
    }
    options = f"-p no:cacheprovider -s -c {os.devnull} --rootdir . -n {workers} test_one.py".split()
    done = subprocess.run(
        [sys.executable, "-m", "pytest", *options],
        cwd=tmp_path, env=environment, capture_output=True, text=True, timeout=120, check=False,
    )  # fmt: skip
    told = [line for line in done.stdout.splitlines() if line.startswith("LEFT BEHIND")]
    for process in re.findall(r"process (\d+): sleep 600", done.stdout):
        os.kill(int(process), signal.SIGKILL)
    assert " passed" in done.stdout and "failed" not in done.stdout, done.stdout + done.stderr
    assert not [*tmp_path.glob("temporary/mastctl-*")]  # it clears away what it complains of
    if what in ("nothing", "place of another run"):
        assert done.returncode == 0 and told == []
    else:
        (line,) = told
        assert done.returncode == 1
        assert LEFT_BY_IT[what] in line
        assert what != "folder" or re.search(r"\(first seen after .*test_one.py::test_it\b", line)


TOOL = """
import subprocess, tempfile, time
from tools.command import end
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
