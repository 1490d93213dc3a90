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
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import yaml

from calib.files.mast_file import load_rig, save_rig
from hil_tests.drivers.turned import turned
from hil_tests.waiting import until
from mastctl.cli.main import main
from mastctl.testing.daemons import resized

SHIFTED = '''
"""The same cameras with stamps that are off by a known time; a picture never comes before its stamp."""

import dataclasses

from bench_rig.camera import FloorCamera
from bench_rig.head import BenchHead
from drivers.registry import Driver

class Shifted(FloorCamera):
    def __init__(self, options, context):
        super().__init__(options, context)
        self.early_s = options.get("early_s", 0.0)

    def next_frame(self, exposed_after_s, timeout_s):
        frame = super().next_frame(exposed_after_s + self.early_s, timeout_s)
        told = dataclasses.replace(frame, mid_exposure_s=frame.mid_exposure_s - self.early_s)
        self._clock.sleep(max(0.0, told.mid_exposure_s + told.exposure_s - self._clock.now_s()))
        return told

def open_head(options, context):
    HEADS.append(BenchHead({}, context))
    return HEADS[-1]

HEAD, SHIFTED = Driver(open_head), Driver(Shifted)
HEADS = []
'''


@pytest.fixture
def turned_package(package: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """The package on a turned clock: pictures take no time, however busy the machine is."""
    with turned() as it:
        clock = it.clock
        camera = package / "bench_rig" / "camera.py"
        camera.write_text(camera.read_text().replace("PERIOD_S, EXPOSURE_S, TEXEL_M = 0.1,", ODD_PERIOD))
        monkeypatch.setattr("drivers.clock.SystemClock", lambda: clock)
        yield package


# Else each way of the head would show the same few phases of a pixel, and the same errors of the matcher.
ODD_PERIOD = "PERIOD_S, EXPOSURE_S, TEXEL_M = 0.0937,"


@pytest.fixture
def package(repository: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """The package of the page and the shifting driver, importable."""
    package = repository / "docs" / "examples" / "bench_rig"
    sources = {name: (package / name).read_text() for name in ("bench_rig/head.py", "bench_rig/camera.py")}
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
    rig = load_rig(repository / "configs" / "masts" / "rocky8_simulated.yaml").rig
    small = {name: replace(one, model=resized(one.model, 204)) for name, one in rig.cameras.items()}
    save_rig(replace(rig, cameras=small, fit={}), folder / "mast.yaml")
    text = {
        "schema": "mastctl/config/1",
        "mast_file": "mast.yaml",
        "pan_tilt": {"driver": "shifted_rig:HEAD"},
        "cameras": {
            name: {
                "driver": "shifted_rig:SHIFTED",
                "options": {"mast_file": str(folder / "mast.yaml"), "name": name}
                | {key: value for key, value in more.items() if key != "offset_s"},
            }
            | ({"offset_s": more["offset_s"]} if "offset_s" in more else {})
            for name, more in cameras.items()
        },
        "limits": {"pan_rad": [-pan, pan], "tilt_rad": [-1.2, 0.5], "speed_rad_per_s": 1.0},
    }
    (folder / "config.yaml").write_text(yaml.safe_dump(text))
    return str(folder / "config.yaml")


def sync(capsys: pytest.CaptureFixture[str], *words: str) -> tuple[int, dict[str, Any]]:
    code = main(["camera", "sync", "--json", *words])
    return code, json.loads(capsys.readouterr().out)


def test_offsets_are_measured_within_three_sigma_and_compared(
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


def test_a_signal_stops_the_head_where_it_is(
    package: Path, repository: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = config(package, repository, {"navcam_left": {}})

    def turns() -> bool:
        heads = getattr(sys.modules.get("shifted_rig"), "HEADS", ())  # the import may be under way
        return bool(heads) and abs(heads[-1].at(time.monotonic())[0]) > 0.02  # type: ignore[misc]

    def interrupt() -> None:
        until(turns, "the head turns")
        os.kill(os.getpid(), signal.SIGTERM)

    thread = threading.Thread(target=interrupt)
    thread.start()
    before = signal.getsignal(signal.SIGTERM)
    code, told = sync(capsys, "--config", file, "--seconds", "120")
    thread.join()
    assert code == 128 + signal.SIGTERM and told["error"]["code"] == "interrupted"
    pan_rad = sys.modules["shifted_rig"].HEADS[-1].at(time.monotonic())[0]
    time.sleep(0.05)
    assert sys.modules["shifted_rig"].HEADS[-1].at(time.monotonic())[0] == pan_rad != 0.0
    assert signal.getsignal(signal.SIGTERM) is before


def test_a_sweep_that_would_pass_a_limit_moves_nothing(
    package: Path, repository: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = config(package, repository, {"navcam_left": {}}, pan=0.05)
    code, told = sync(capsys, "--config", file, "--amplitude", "0.06")
    assert code == 1 and "0.06" in told["error"]["message"] and "limit" in told["error"]["message"]
    head = sys.modules["shifted_rig"].HEADS[-1]
    assert head.at(time.monotonic())[0] == 0.0
