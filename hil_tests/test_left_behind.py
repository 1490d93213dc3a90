"""A run of the suite that leaves something behind fails, and names it and the test."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
import tempfile
import threading
from contextlib import suppress
from pathlib import Path

import pytest

from hil_tests.left_behind import held
from hil_tests.waiting import NET_S, until

CONFTEST = """
import os, pwd
pwd.getpwuid = lambda user, was=pwd.getpwuid: pwd.struct_passwd([*was(user)[:5], os.environ["USERS"], "sh"])
from hil_tests.conftest import *
from hil_tests.conftest import _tell_flaky
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
    place.with_name("10.0.0.5-another").mkdir()
    place.with_name("10.0.0.5-another").rmdir()
def test_after_it():
    pass
""",
    "state folder": """
import pathlib
def test_it():
    home = pathlib.Path.home() / ".local/state/mastctl"
    assert (home / "heads/of_before").is_dir()
    (home / "rover-left").mkdir()
""",
    "nothing of ours": """
import os, pathlib, subprocess, sys
HELD = "import fcntl, os, time; fcntl.flock(os.open('.', 0), fcntl.LOCK_EX); print(os.getpid(), flush=True); "
HELD = [sys.executable, "-c", HELD + "os.close(1); time.sleep(600)"]
def test_it():
    place = pathlib.Path.home() / ".local/state/mastctl/rover-of-others"
    place.mkdir()
    others = {name: value for name, value in os.environ.items() if name != "TMPDIR"}
    ends = [sys.executable, "-c", f"import subprocess; subprocess.Popen({HELD})"]
    (place / "pid").write_bytes(subprocess.run(ends, env=others, cwd=place, stdout=-1, stderr=-3).stdout)
""",
}

LEFT_BY_IT = {
    "folder": "/mastctl-",
    "process": "sleep 600",
    "place of a head": "/user/.local/state/mastctl/heads/usb-1234-left ",
    "state folder": "/home/.local/state/mastctl/rover-left ",
}


IN_WORKERS = pytest.mark.long(2, "four cases in workers of xdist; one is in the quick run")


@pytest.mark.parametrize(
    ("what", "workers"),
    [
        ("nothing", 0), ("folder", 0), ("process", 0), ("place of a head", 0), ("state folder", 0),
        ("nothing of ours", 0), ("folder", 1), pytest.param("nothing", 1, marks=IN_WORKERS),
        pytest.param("place of a head", 2, marks=IN_WORKERS),
        pytest.param("state folder", 1, marks=IN_WORKERS),
        pytest.param("nothing of ours", 1, marks=IN_WORKERS),
    ],
)  # fmt: skip
def test_what_is_left_behind_fails_the_run(repository: Path, tmp_path: Path, what: str, workers: int) -> None:
    (tmp_path / "conftest.py").write_text(CONFTEST)
    (tmp_path / "test_one.py").write_text(TESTS[what])
    (tmp_path / "temporary").mkdir()
    (tmp_path / "home/.local/state/mastctl/heads/of_before").mkdir(parents=True)
    environment = {
        **os.environ,
        "HOME": f"{tmp_path}/home",
        "USERS": f"{tmp_path}/user",
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
    for file in tmp_path.glob("home/.local/state/mastctl/*/pid"):
        os.kill(int(file.read_text()), signal.SIGKILL)
    assert " passed" in done.stdout and "failed" not in done.stdout, done.stdout + done.stderr
    assert not [*tmp_path.glob("temporary/mastctl-*")]  # it clears away what it complains of
    if what in ("nothing", "nothing of ours"):
        assert done.returncode == 0 and told == []
    else:
        (line,) = told
        assert done.returncode == 1
        assert LEFT_BY_IT[what] in line
        assert what == "process" or re.search(r"\(first seen after .*test_one.py::test_it\b", line)


def test_what_a_test_holds_is_new_and_what_others_let_go_is_not_missed(tmp_path: Path) -> None:
    ends = threading.Event()
    other = threading.Thread(target=ends.wait, args=(NET_S,))
    other.start()
    file = (tmp_path / "file").open("w")
    before = held()
    assert held() <= before
    ends.set()
    other.join()
    file.close()
    assert held() <= before and held() != before
    with (tmp_path / "another").open("w") as another:
        (left,) = held() - before
        assert left == (str(another.fileno()), tmp_path / "another")  # perhaps of the number that was let go
    mine = threading.Timer(NET_S, bool)
    mine.start()
    assert held() - before == {mine}
    mine.cancel()
    mine.join()
    assert held() <= before


@pytest.mark.parametrize(("name", "used"), [("t", None), ("a_name_that_leaves_no_room_for_sockets", "/tmp")])
def test_a_long_temporary_folder_leaves_room_for_sockets(
    repository: Path, name: str, used: str | None
) -> None:
    with tempfile.TemporaryDirectory(prefix=name, dir="/tmp") as folder:
        environment = {**os.environ, "TMPDIR": folder}
        environment.pop("PYTEST_DEBUG_TEMPROOT", None)
        code = "import os, hil_tests.conftest; print(os.environ['PYTEST_DEBUG_TEMPROOT'])"
        done = subprocess.run(
            [sys.executable, "-c", code],
            cwd=repository, env=environment, capture_output=True, text=True, check=True,
        )  # fmt: skip
        assert done.stdout.strip() == (used or folder)
        assert not [*Path(folder).iterdir()]


INTERRUPTED = """
import pathlib, subprocess
def test_it():
    subprocess.Popen(["sleep", "600"], start_new_session=True, cwd=pathlib.Path(__file__).parent)
    pathlib.Path(__file__).with_name("begun").touch()
    subprocess.run(["sleep", "600"])
"""


@pytest.mark.long(2, "waits for ten seconds, after which xdist ends its workers")
def test_a_run_that_is_interrupted_ends_what_its_workers_began(repository: Path, tmp_path: Path) -> None:
    (tmp_path / "conftest.py").write_text(CONFTEST)
    (tmp_path / "test_one.py").write_text(INTERRUPTED)
    (tmp_path / "temporary").mkdir()
    environment = {
        **{name: value for name, value in os.environ.items() if not name.startswith("PYTEST_")},
        "HOME": str(tmp_path),
        "USERS": f"{tmp_path}/user",
        "PYTHONPATH": str(repository),
        "PYTEST_DEBUG_TEMPROOT": f"{tmp_path}/temporary",
    }
    words = ["-p", "no:cacheprovider", "-c", os.devnull, "--rootdir", ".", "-n", "1", "test_one.py"]
    with subprocess.Popen(
        [sys.executable, "-m", "pytest", *words], cwd=tmp_path, env=environment, stdout=subprocess.DEVNULL
    ) as run:
        try:
            until((tmp_path / "begun").exists, "the test runs", 300)
            run.send_signal(signal.SIGINT)
            assert run.wait(300) == pytest.ExitCode.INTERRUPTED
        finally:
            run.kill()
    until(lambda: not processes_with(str(tmp_path).encode()), "all its processes have ended")
    assert [*(tmp_path / "temporary").glob("mastctl-*")] == []


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


@pytest.mark.long(2, "copies and compiles the checkout for the sampler of mutants")
def test_mutants_that_a_signal_ends_leave_nothing_behind(repository: Path, tmp_path: Path) -> None:
    environment = {**os.environ, "TMPDIR": str(tmp_path)}
    command = [sys.executable, "-m", "tools.mutants", "calib/geometry", "--mutants", "2", "--jobs", "1"]
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
