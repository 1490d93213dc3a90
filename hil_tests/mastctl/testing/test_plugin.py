"""The plug-in itself: what it costs those who do not use it, what it refuses, and how its process ends."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from drivers.errors import BadOptions
from hil_tests.waiting import until
from mastctl.packaged import config_folder
from mastctl.testing.daemons import config_for_a_test

HOLDER = """
import os, sys, threading, time
from pathlib import Path
from mastctl.testing.rover import RoverProcess

made = []
maker = threading.Thread(target=lambda: made.append(RoverProcess(Path(sys.argv[1]))))
maker.start()
maker.join()  # that the thread has ended is not that the process has
time.sleep(1.0)
assert made[0].alive
if sys.argv[2] == "forked" and os.fork() == 0:
    os.write(1, b"%d\\n" % os.getpid())  # holds the pipes open
    time.sleep(600)
os.write(1, b"%d\\n" % made[0].pid)  # whole lines, whoever of the two comes first
time.sleep(600)
"""


def runs(pid: int) -> bool:
    try:
        state = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]
    except OSError:
        return False
    return state not in ("Z", "X")


def test_pytest_loads_nothing_heavy_at_its_start() -> None:
    code = "import sys, pytest; before = set(sys.modules); import mastctl.testing.plugin; "
    code += "print(*(set(sys.modules) - before))"
    told = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    loaded = set(told.split())
    assert loaded == {"mastctl", "mastctl.testing", "mastctl.testing.plugin", "mastctl.testing.rover"}


@pytest.fixture(params=["alone", "forked"])
def holder(
    request: pytest.FixtureRequest, tmp_path: Path
) -> Iterator[tuple[subprocess.Popen[str], list[int]]]:
    """A process that holds a rover's process, and what it told: its id, and that of a fork with its pipes."""
    command = [sys.executable, "-c", HOLDER, str(tmp_path / "log"), request.param]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as made:
        assert made.stdout is not None
        pids = list[int]()
        try:
            for _ in range(1 if request.param == "alone" else 2):
                pids.append(int(made.stdout.readline()))
            yield made, pids
        finally:
            made.kill()
            for pid in filter(runs, pids):
                os.kill(pid, 9)


def test_its_process_ends_when_the_one_that_made_it_is_killed(
    holder: tuple[subprocess.Popen[str], list[int]],
) -> None:
    made, pids = holder
    serving = [pid for pid in pids if b"mastctl.testing.daemons" in Path(f"/proc/{pid}/cmdline").read_bytes()]
    assert len(serving) == 1
    made.kill()
    until(lambda: not runs(serving[0]), "its end")


def test_a_configuration_with_a_real_device_is_refused(tmp_path: Path) -> None:
    text = (config_folder() / "default.yaml").read_text()
    path = tmp_path / "bench.yaml"
    path.write_text(text.replace("pan_tilt: {driver: sim}", "pan_tilt: {driver: flir_ptu}"))
    with pytest.raises(BadOptions, match="pan_tilt has driver 'flir_ptu', expected a simulated device"):
        config_for_a_test(str(path), None, {}, tmp_path)
    path.write_text(text.replace("navcam_left: {driver: sim}", "navcam_left: {driver: v4l2}"))
    with pytest.raises(BadOptions, match="navcam_left has driver 'v4l2'"):
        config_for_a_test(str(path), None, {}, tmp_path)


def test_what_is_not_said_is_quick_and_what_is_said_holds(tmp_path: Path) -> None:
    def section(path: str | None, **said: object) -> tuple[object, object]:
        simulation = config_for_a_test(path, None, said, tmp_path).hardware.simulation
        return simulation["samples"], simulation["speed"]

    assert section(None) == (1, "max")
    assert section(None, samples=3, speed=10) == (3, 10)
    assert section(None, wire="dynamixel") == (1, 1), "bytes travel in real time"
    own = tmp_path / "own.yaml"
    own.write_text((config_folder() / "default.yaml").read_text().replace("samples: 2", "samples: 4"))
    assert section(str(own)) == (4, "max")
    assert config_for_a_test(None, None, {}, tmp_path).listen.port == 0


REFUSED = {
    'mark("x")': "takes keywords only, found 'x'",
    "mark(picture_width_px=5)": "picture_width_px is 5, expected a whole number",
    "mark(sped=2)": "simulation.sped: unknown key; the nearest known is 'speed'",
    "mark(config='nowhere.yaml')": "nowhere.yaml",
}


def test_a_bad_option_fails_its_test_alone_and_a_daemon_ends_with_its_test(tmp_path: Path) -> None:
    tests = ["import socket, urllib.parse", "import pytest", "mark = pytest.mark.mastctl"]
    tests += [f"@{mark}\ndef test_{number}(mast_daemon): pass" for number, mark in enumerate(REFUSED)]
    tests += ["def test_alive(mast_daemon): globals()['URL'] = urllib.parse.urlsplit(mast_daemon)"]
    tests += ["def test_ended():", "    with pytest.raises(ConnectionRefusedError):"]
    tests += ["        socket.create_connection((URL.hostname, URL.port))", ""]
    (tmp_path / "test_them.py").write_text("\n".join(tests))
    (tmp_path / "calib.py").write_text("raise SystemExit('this is the project's own')\n")
    (tmp_path / "pytest.ini").write_text("[pytest]\nmastctl_picture_width_px = 64\nmastctl_seed = 1\n")
    command = [
        sys.executable,
        "-m",
        "pytest",
        "-q",
        "-p",
        "no:cacheprovider",
        "-W",
        "error",
        "--strict-markers",
    ]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=300)
    assert "2 passed, 4 errors" in done.stdout, done.stdout
    assert "Traceback" not in done.stdout and "During handling" not in done.stdout
    for words in REFUSED.values():
        assert words in done.stdout
