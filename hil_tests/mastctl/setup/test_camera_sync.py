"""``mastctl camera sync`` on the outside package of docs/drivers.md, with shifted stamps."""

from __future__ import annotations

import json
import math
import os
import re
import signal
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace

import pytest
import yaml

from drivers.clock import Clock
from hil_tests.drivers.turned import turned
from hil_tests.waiting import until
from mastctl.cli.main import main

SHIFTED = '''
"""The same cameras with stamps that are off by a known time; a picture never comes before its stamp."""

import dataclasses
import threading
import time

from bench_rig import head
from bench_rig.camera import FloorCamera


class Shifted(FloorCamera):
    def __init__(self, mast_file, name, early_s=0.0, uncertainty_s=None, plain=False, waits=True):
        super().__init__(mast_file, name)
        self.early_s, self.plain, self.waits = early_s, plain, waits
        if uncertainty_s is not None:
            self.uncertainty_s = uncertainty_s

    def next_frame(self, exposed_after_s, timeout_s):
        after_s = exposed_after_s + self.early_s if self.waits else time.monotonic()
        frame = super().next_frame(after_s, timeout_s)
        if self.plain:
            frame.image[:] = 90
        told = dataclasses.replace(frame, mid_exposure_s=frame.mid_exposure_s - self.early_s)
        if self.waits:
            time.sleep(max(0.0, told.mid_exposure_s + told.exposure_s - time.monotonic()))
        if hasattr(self, "uncertainty_s"):
            object.__setattr__(told, "mid_uncertainty_s", self.uncertainty_s)
        return told


class Hanging(FloorCamera):
    def next_frame(self, exposed_after_s, timeout_s):
        HANGS.set()
        time.sleep(600.0)


def head_that_tells():
    told = head.open_head(speed_rad_per_s=1.0)
    HEADS.append(told)
    return told


HEADS = []
HANGS = threading.Event()
'''


class TurnedEvent:
    """A `threading.Event` whose waits end by a turned clock."""

    def __init__(self, clock: Clock) -> None:
        self._signal, self._is_set = clock.signal(), False

    def set(self) -> None:
        with self._signal:
            self._is_set = True
            self._signal.notify_all()

    def is_set(self) -> bool:
        return self._is_set

    def wait(self, timeout_s: float) -> bool:
        with self._signal:
            return self._is_set or self._signal.wait(timeout_s)


@pytest.fixture
def turned_package(package: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """The package on a turned clock: pictures take no time, however busy the machine is."""
    with turned() as it:
        clock = it.clock
        shims = {
            "time": SimpleNamespace(monotonic=clock.now_s, sleep=clock.sleep),
            "threading": SimpleNamespace(Event=lambda: TurnedEvent(clock), Lock=threading.Lock),
        }
        monkeypatch.setitem(sys.modules, "turned_time", SimpleNamespace(**shims))
        for path in (*(package / "bench_rig").glob("*.py"), package / "shifted_rig.py"):
            text = path.read_text().replace("import threading\nimport time\n", IMPORTS)
            path.write_text(text.replace("PERIOD_S, EXPOSURE_S, TEXEL_M = 0.1,", ODD_PERIOD))
        monkeypatch.setattr("drivers.clock.SystemClock", lambda: clock)
        yield package


# Else each way of the head would show the same few phases of a pixel, and the same errors of the matcher.
ODD_PERIOD = "PERIOD_S, EXPOSURE_S, TEXEL_M = 0.0937,"
IMPORTS = "from turned_time import threading, time\n"


@pytest.fixture
def package(repository: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """The package of the page and the shifting driver, importable."""
    page = (repository / "docs" / "drivers.md").read_text()
    sources = dict(re.findall(r"`(bench_rig/\w+\.py)`[^\n]*:\n\n```\w+\n(.*?)```", page, re.DOTALL))
    (tmp_path / "bench_rig").mkdir()
    (tmp_path / "bench_rig" / "__init__.py").touch()
    for name, text in sources.items():
        (tmp_path / name).write_text(text)
    (tmp_path / "shifted_rig.py").write_text(SHIFTED)
    monkeypatch.syspath_prepend(tmp_path)
    yield tmp_path
    for name in [name for name in sys.modules if name.split(".")[0] in ("bench_rig", "shifted_rig")]:
        del sys.modules[name]


def config(folder: Path, repository: Path, cameras: dict[str, dict[str, object]], pan: float = 2.6) -> str:
    """A configuration whose pictures are small, so that the machine keeps up."""
    mast = yaml.safe_load((repository / "configs" / "masts" / "rocky8_simulated.yaml").read_text())
    for camera in mast["cameras"].values():  # every fifth pixel: the vectors H and V in its units
        width, height = camera["size_px"]
        camera["size_px"] = [width // 5, height // 5]
        for key, middle, new in (
            ("H", (width - 1) / 2, (width // 5 - 1) / 2),
            ("V", (height - 1) / 2, (height // 5 - 1) / 2),
        ):
            camera[key] = [
                (h - middle * a) / 5 + new * a for h, a in zip(camera[key], camera["A"], strict=True)
            ]
    mast.pop("fit", None)
    (folder / "mast.yaml").write_text(yaml.safe_dump(mast))
    text = {
        "schema": "mastctl/config/1",
        "mast_file": "mast.yaml",
        "pan_tilt": {"driver": "shifted_rig:head_that_tells"},
        "cameras": {
            name: {
                "driver": f"shifted_rig:{more.get('make', 'Shifted')}",
                "options": {"mast_file": str(folder / "mast.yaml"), "name": name}
                | {key: value for key, value in more.items() if key not in ("offset_s", "make")},
            }
            | ({"offset_s": more["offset_s"]} if "offset_s" in more else {})
            for name, more in cameras.items()
        },
        "limits": {"pan_rad": [-pan, pan], "tilt_rad": [-1.2, 0.5], "speed_rad_per_s": 1.0},
    }
    (folder / "config.yaml").write_text(yaml.safe_dump(text))
    return str(folder / "config.yaml")


def sync(capsys: pytest.CaptureFixture[str], *words: str) -> tuple[int, dict[str, dict[str, object]]]:
    code = main(["camera", "sync", "--json", *words])
    return code, json.loads(capsys.readouterr().out)


def test_both_eyes_offsets_are_measured_within_three_sigma_and_told_where_they_contradict(
    turned_package: Path, repository: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """One camera is right; the other's pictures are 31 ms later than stamped, of which 10 ms are known."""
    file = config(
        turned_package, repository, {"navcam_left": {}, "navcam_right": {"early_s": 0.031, "offset_s": 0.010}}
    )
    code, told = sync(capsys, "--config", file, "--seconds", "12")
    assert code == 0, told
    left, right = told["cameras"]["navcam_left"], told["cameras"]["navcam_right"]
    for camera, true_s in ((left, 0.0), (right, 0.031)):
        assert abs(camera["offset_s"] - true_s) < 3 * camera["sigma_s"] + 1e-4, told
        assert camera["sigma_s"] < 1e-3
    assert left["warning"] is None
    later = re.match(
        r"navcam_right: its pictures were taken (\d+\.\d) ms later than its stamps", right["warning"]
    )
    assert later and float(later[1]) == pytest.approx(21.0, abs=3e3 * right["sigma_s"] + 0.1)
    head = sys.modules["shifted_rig"].HEADS[-1]
    assert head.at(math.inf) == (0.0, 0.0), "the head is where it was"


def test_pictures_older_than_their_stamps_are_told_unless_the_driver_says_how_uncertain_it_is(
    turned_package: Path, repository: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """As a buffered capture does: one is silent about it, one states 0.2 s, one shows a plain wall."""
    file = config(
        turned_package,
        repository,
        {
            "navcam_left": {"early_s": -0.120},
            "navcam_right": {"early_s": -0.120, "uncertainty_s": 0.2},
            "pancam_left": {"plain": True},
        },
    )
    code, told = sync(capsys, "--config", file, "--seconds", "12", "--amplitude", "0.06", "--speed", "0.3")
    assert code == 0, told
    for name in ("navcam_left", "navcam_right"):
        camera = told["cameras"][name]
        assert abs(camera["offset_s"] + 0.120) < 3 * camera["sigma_s"] + 1e-4, told
    early = re.search(r"taken (\d+\.\d) ms earlier", told["cameras"]["navcam_left"]["warning"])
    assert early and float(early[1]) == pytest.approx(
        120.0, abs=3e3 * told["cameras"]["navcam_left"]["sigma_s"] + 0.1
    )
    assert told["cameras"]["navcam_right"]["warning"] is None
    assert told["cameras"]["pancam_left"]["offset_s"] is None
    assert "too plain" in told["cameras"]["pancam_left"]["failure"]


def test_a_signal_stops_the_head_where_it_is(
    package: Path, repository: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = config(package, repository, {"navcam_left": {}})

    def turns() -> bool:
        heads = getattr(sys.modules.get("shifted_rig"), "HEADS", ())  # the import may be under way
        return bool(heads) and abs(heads[-1].at(time.monotonic())[0]) > 0.02

    def interrupt() -> None:
        until(turns, "the head turns")
        os.kill(os.getpid(), signal.SIGTERM)

    thread = threading.Thread(target=interrupt)
    thread.start()
    before = signal.getsignal(signal.SIGTERM)
    code, told = sync(capsys, "--config", file, "--seconds", "120")
    thread.join()
    assert code == 1 and told["error"]["code"] == "stopped" and "stopped" in told["error"]["message"]
    pan_rad = sys.modules["shifted_rig"].HEADS[-1].at(time.monotonic())[0]
    time.sleep(0.05)
    assert sys.modules["shifted_rig"].HEADS[-1].at(time.monotonic())[0] == pan_rad != 0.0
    assert signal.getsignal(signal.SIGTERM) is before


def test_stamps_of_another_clock_are_told_as_that(
    turned_package: Path, repository: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Of the calendar's, and of one that something else started."""
    file = config(
        turned_package,
        repository,
        {
            "navcam_left": {"early_s": -1.7e9, "waits": False},
            "navcam_right": {"early_s": 5000.0, "waits": False},
        },
    )
    code, told = sync(capsys, "--config", file, "--seconds", "3")
    assert code == 1, told
    left, right = (told["cameras"][name]["failure"] for name in ("navcam_left", "navcam_right"))
    assert re.search(r"stamps are 1[67]\d{8}\.\d s later than the moments at which its frames came", left)
    assert re.search(r"stamps are 500\d\.\d s earlier than the moments at which its frames came", right)
    assert "CLOCK_MONOTONIC" in left


@pytest.fixture
def soon(package: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A camera's driver that does not come back is given up soon."""
    from mastctl.setup import sync_sweep as sweep

    monkeypatch.setattr(sweep, "FRAME_TIMEOUT_S", 0.5)
    monkeypatch.setattr(sweep, "GRACE_S", 0.5)


@pytest.mark.usefixtures("soon")
def test_a_camera_whose_driver_hangs_is_told_of_and_the_other_one_measured(
    turned_package: Path, repository: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = config(turned_package, repository, {"navcam_left": {"make": "Hanging"}, "navcam_right": {}})
    code, told = sync(capsys, "--config", file, "--seconds", "10")
    assert code == 0 and told["cameras"]["navcam_right"]["offset_s"] is not None, told
    assert "did not come back" in told["cameras"]["navcam_left"]["failure"]


@pytest.mark.usefixtures("soon")
def test_nothing_moves_where_no_camera_gives_a_picture(
    turned_package: Path, repository: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = config(turned_package, repository, {"navcam_left": {"make": "Hanging"}})
    moves: list[tuple[object, ...]] = []
    from mastctl.devices.devices import Devices

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Devices, "move", lambda self, *goal: moves.append(goal))
        code, told = sync(capsys, "--config", file, "--seconds", "10")
    assert code == 1 and "did not come back" in told["cameras"]["navcam_left"]["failure"]
    assert not moves


def test_a_signal_ends_it_while_a_cameras_driver_hangs(
    package: Path, repository: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    from mastctl.setup import sync_sweep as sweep

    monkeypatch.setattr(sweep, "FRAME_TIMEOUT_S", 300.0)
    monkeypatch.setattr(sweep, "END_S", 0.5)
    file = config(package, repository, {"navcam_left": {"make": "Hanging"}})

    def hangs() -> bool:
        event = getattr(sys.modules.get("shifted_rig"), "HANGS", None)
        return event is not None and event.is_set()

    def interrupt() -> None:
        until(hangs, "the driver hangs")
        os.kill(os.getpid(), signal.SIGTERM)

    thread = threading.Thread(target=interrupt)
    thread.start()
    code, told = sync(capsys, "--config", file)
    thread.join()
    assert code == 1 and told["error"]["code"] == "stopped"


def test_a_sweep_that_would_pass_a_limit_moves_nothing(
    package: Path, repository: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = config(package, repository, {"navcam_left": {}}, pan=0.05)
    code, told = sync(capsys, "--config", file, "--amplitude", "0.06")
    assert code == 1 and "0.06" in told["error"]["message"] and "limit" in told["error"]["message"]
    head = sys.modules["shifted_rig"].HEADS[-1]
    assert head.at(time.monotonic())[0] == 0.0


def test_a_camera_that_is_not_on_the_head_or_not_configured_is_refused(
    package: Path, repository: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = config(package, repository, {"navcam_left": {}, "hazcam_left": {}})
    for name, words in (("hazcam_left", "is not on the head"), ("navcam_rihgt", "is not configured")):
        code, told = sync(capsys, name, "--config", file)
        assert code == 2 and words in told["error"]["message"] and "navcam_left" in told["error"]["message"]
    assert "shifted_rig" not in sys.modules, "nothing was opened"
