"""The one way to open a head: programs beside the daemon know its latch, keep-outs and the sun."""

from __future__ import annotations

import json
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from calib.files.mast_file import save_rig
from drivers.hardware import DeviceSettings, HardwareSettings, head_name
from hil_tests.mastctl.conform.conform_world import accepted
from hil_tests.mastctl.outside_daemon import daemon_process, line
from hil_tests.mastctl.safety.test_deaths import Bench, made
from hil_tests.mastctl.service_fakes import rig
from mastctl.cli.main import main
from mastctl.client import Client
from mastctl.safety.latch import Latch
from mastctl.safety.state_folder import VARIABLE, StateFolder, take_head

CAMERA = "navcam_left"
SOURCE = '''
import time
from types import SimpleNamespace

import numpy as np


class Camera:
    """Spots that stand still: something to follow, wherever the head looks."""

    spots = np.random.default_rng(1).integers(0, 255, (48, 64), np.uint8)
    picture = np.kron(spots, np.ones((10, 10), np.uint8))

    def next_frame(self, exposed_after_s, timeout_s):
        time.sleep(0.03)
        end_s = max(time.monotonic(), exposed_after_s + 0.01)
        time.sleep(max(0.0, end_s - time.monotonic()))
        return SimpleNamespace(
            image=self.picture, mid_exposure_s=end_s - 0.002, exposure_s=0.002, sequence=int(end_s * 100)
        )

    def close(self):
        pass
'''


LIMITS: dict[str, Any] = {
    "pan_rad": [-0.97, 0.97],
    "tilt_rad": [-0.5, 0.35],
    "speed_rad_per_s": 0.5,
    "margin_rad": 0.02,
}
BOX: dict[str, Any] = {"pan_rad": [0.1, 0.3], "tilt_rad": [-0.2, 0.2]}
SUN: dict[str, Any] = {"azimuth_rad": 0.2, "elevation_rad": 0.0, "half_angle_rad": 0.1, "frame": "rover"}


class Watched:
    """A head on a simulated line, its configuration with a camera on it, and where it truly was."""

    def __init__(self, bench: Bench) -> None:
        self.bench = bench
        self.config = str(bench.config)
        self.document: dict[str, Any] = json.loads(bench.config.read_text())
        self.port: str = self.document["pan_tilt"]["options"]["port"]
        self.began_s = time.monotonic()

    def configure(self, **sections: object) -> None:
        self.document |= sections
        self.bench.config.write_text(json.dumps(self.document))

    def path(self) -> np.ndarray[Any, np.dtype[np.float64]]:
        """Where the mechanism was since the beginning, (n, 2) radians."""
        moments_s = np.arange(self.began_s, time.monotonic(), 0.005)
        return np.array([self.bench.truth(moment_s) for moment_s in moments_s])

    @property
    def swept_rad(self) -> float:
        """How far either axis went."""
        return float(np.ptp(self.path(), axis=0).max())

    def latch(self, state: Path | None = None) -> None:
        """As a daemon left it that Ana stopped: in the head's place, or in a state folder."""
        head = DeviceSettings(self.bench.driver, self.document["pan_tilt"]["options"])
        name = head_name(HardwareSettings(head, {}))
        assert name is not None
        place = take_head(name) if state is None else StateFolder.of(state, state, None)
        assert place is not None
        latch = Latch(place)
        latch.add("sparks", "Ana")
        assert latch.keep(60.0)
        latch.close()
        place.close()


BOTH = pytest.mark.parametrize("watched", ["dynamixel", "flir_ptu"], indirect=True)


@pytest.fixture
def watched(
    request: pytest.FixtureRequest, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> Iterator[Watched]:
    """By default on simulated Dynamixel servos: what keeps a head out knows no driver."""
    (tmp_path / "still_camera.py").write_text(SOURCE)
    monkeypatch.syspath_prepend(tmp_path)
    with made(getattr(request, "param", "dynamixel"), tmp_path) as bench:
        save_rig(rig((640, 480)), tmp_path / "little.yaml")
        one = Watched(bench)
        one.configure(
            cameras={CAMERA: {"driver": "still_camera:Camera"}},
            limits=LIMITS,
        )
        yield one


STILL_RAD = 1e-3
OPENING = {
    "rig servo set-id": ["PORT", "1", "7", "--torque-off"],
    "rig ptu home": ["PORT", "--sweep-full-range"],
    "camera check": [CAMERA, "--seconds", "0.3", "--config", "CONFIG"],
    "camera sync": ["--seconds", "3", "--config", "CONFIG"],
    "rig sentinel reference": ["--folder", "sentinel", "--config", "CONFIG"],
}
"""Commands that open a head beside a daemon; import-linter keeps them few. Those that only read have tests
of their own that nothing moves."""
MOVING = {"camera sync", "rig servo set-id", "rig ptu home"}


@BOTH
def test_no_command_moves_a_latched_head(
    watched: Watched, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    watched.latch()
    others = "rig ptu" if watched.bench.driver == "dynamixel" else "rig servo"
    places = {"PORT": watched.port, "CONFIG": watched.config}
    for name, options in OPENING.items():
        if name.startswith(others):
            continue
        main([*name.split(), *(places.get(word, word) for word in options)])
        errors = capsys.readouterr().err
        assert "--help')" not in errors, f"{name} was not begun"
        assert watched.swept_rad < STILL_RAD, name
        assert name not in MOVING or "an emergency stop is latched (Ana: sparks)" in errors, (name, errors)
    done = accepted(tmp_path, "--rig", watched.config, "--motion", "--reach", "0.2", "-k", "head")
    assert done.returncode == 1 and "an emergency stop is latched (Ana: sparks)" in done.stdout
    assert watched.swept_rad < STILL_RAD


@pytest.mark.parametrize("place", ["can be made", "cannot be made"])
def test_a_latch_in_the_state_folder_alone_holds_too(
    watched: Watched,
    place: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """As a daemon left it that could not make the head's place, or that was of a version without one."""
    if place == "cannot be made":
        monkeypatch.setenv(VARIABLE, "/proc/nowhere")
    watched.latch(tmp_path / "state")
    assert main(["camera", "sync", "--seconds", "1", "--config", watched.config]) == 1
    assert "an emergency stop is latched (Ana: sparks)" in capsys.readouterr().err
    assert watched.swept_rad < STILL_RAD


def test_a_sweep_across_a_keep_out_moves_nothing(
    watched: Watched, capsys: pytest.CaptureFixture[str]
) -> None:
    watched.configure(limits=LIMITS | {"keep_out": {"antenna": BOX}})
    words = ["camera", "sync", "--config", watched.config, "--seconds", "1", "--amplitude"]
    assert main([*words, "0.2", "--json"]) == 1
    assert json.loads(capsys.readouterr().out)["error"]["code"] == "keep_out"
    assert watched.swept_rad < STILL_RAD
    main([*words, "0.03"])  # beside it is no cause to refuse
    assert watched.swept_rad > 0.05
    path, ((left, right), (low, high)) = watched.path(), (BOX["pan_rad"], BOX["tilt_rad"])
    inside = (left < path[:, 0]) & (path[:, 0] < right) & (low < path[:, 1]) & (path[:, 1] < high)
    assert not inside.any()


def test_the_acceptance_of_a_driver_keeps_its_head_from_the_sun(watched: Watched, tmp_path: Path) -> None:
    watched.configure(limits=LIMITS | {"sun": SUN})
    chosen = "test_move or new_goal or threads or not_a_number or test_close"
    words = ("--rig", watched.config, "--motion", "--reach", "0.3", "-k", f"test_head and ({chosen})")
    done = accepted(tmp_path, *words)
    assert done.returncode == 0 and "4 passed, 1 skipped" in done.stdout, done.stdout
    assert "keep-out" in done.stdout  # a driver that takes infinity could go to the limit
    assert watched.swept_rad > 0.05, "the free rectangle about its pose is shrunk evenly"
    towards = np.array([np.cos(SUN["azimuth_rad"]), np.sin(SUN["azimuth_rad"]), 0.0])
    sight = np.array([rig().camera_in_rover(CAMERA, pan, tilt).A for pan, tilt in watched.path()])
    assert (sight @ towards).max() <= np.cos(SUN["half_angle_rad"])


@BOTH
def test_what_may_move_a_head_is_refused_beside_its_daemon(
    watched: Watched, capsys: pytest.CaptureFixture[str]
) -> None:
    with daemon_process(watched.bench.folder, watched.bench.config) as daemon, Client(line(daemon)):
        home = ["rig", "ptu", "home", watched.port, "--sweep-full-range"]
        for words in (
            ["camera", "sync", "--config", watched.config],
            home if watched.bench.driver == "flir_ptu" else ["rig", "servo", "info", watched.port, "1"],
        ):
            assert main(words) == 1
            assert "by another program" in capsys.readouterr().err
        done = accepted(watched.bench.folder, "--rig", watched.config, "--motion", "-k", "test_head")
        assert done.returncode == 1 and "by another program" in done.stdout
    assert watched.swept_rad < STILL_RAD
