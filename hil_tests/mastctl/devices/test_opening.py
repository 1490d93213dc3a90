"""The one way to open a head: programs beside the daemon know its latch, keep-outs and the sun."""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from calib.files.mast_file import save_rig
from drivers.hardware import DeviceSettings, HardwareSettings, head_name
from hil_tests.mastctl.outside_daemon import daemon_process, line
from hil_tests.mastctl.safety.test_deaths import Bench, made
from hil_tests.mastctl.service_fakes import rig
from mastctl.cli.main import MODULES, build_parser, main
from mastctl.client import Client
from mastctl.safety import heads
from mastctl.safety.latch import Latch
from mastctl.safety.state_folder import StateFolder

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


LIMITS = {"pan_rad": [-0.97, 0.97], "tilt_rad": [-0.5, 0.35], "speed_rad_per_s": 0.5, "margin_rad": 0.02}
BOX = {"pan_rad": [0.1, 0.3], "tilt_rad": [-0.2, 0.2]}
SUN = {"azimuth_rad": 0.2, "elevation_rad": 0.0, "half_angle_rad": 0.1, "frame": "rover"}
BARRED = {"a keep-out": LIMITS | {"keep_out": {"antenna": BOX}}, "the sun": LIMITS | {"sun": SUN}}


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
        place = heads.take(name) if state is None else StateFolder.named(state)
        assert place is not None
        latch = Latch(place)
        latch.hold("sparks", "Ana")
        latch.head_told()
        assert latch.kept_within(60.0)
        latch.close()
        place.close()


@pytest.fixture(params=["dynamixel", "flir_ptu"])
def watched(
    request: pytest.FixtureRequest, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> Iterator[Watched]:
    (tmp_path / "still_camera.py").write_text(SOURCE)
    monkeypatch.syspath_prepend(tmp_path)
    with made(request.param, tmp_path) as bench:
        save_rig(rig((640, 480)), tmp_path / "little.yaml")
        one = Watched(bench)
        one.configure(
            cameras={CAMERA: {"driver": "still_camera:Camera"}},
            limits=LIMITS,
        )
        yield one


def commands() -> dict[str, argparse.ArgumentParser]:
    """Every command that may reach a head: that takes a configuration, a driver or a line."""

    def leaves(parser: argparse.ArgumentParser, name: str) -> Iterator[tuple[str, argparse.ArgumentParser]]:
        groups = [one for one in parser._actions if isinstance(one, argparse._SubParsersAction)]
        if parser.get_default("run"):
            yield name, parser
        for group in groups:
            for word, below in group.choices.items():
                yield from leaves(below, f"{name} {word}".strip())

    found = {}
    for words in MODULES.values():
        for word in words:
            for name, leaf in leaves(build_parser(word.split()), ""):
                told = {one for action in leaf._actions for one in (*action.option_strings, action.dest)}
                if told & {"--config", "--driver", "port"}:
                    found[name] = leaf
    return found


STILL_RAD = 1e-3
MOVING = {"camera sync", "conform", "servo test", "servo set-id", "ptu home"}
DAEMONS = "run"  # is latched too: test_heads.py
LINES = {
    "servo scan": ["PORT"], "servo info": ["PORT", "1"], "servo set-id": ["PORT", "1", "7", "--torque-off"],
    "servo test": ["PORT", "1"], "ptu info": ["PORT"], "ptz info": ["PORT"],
    "ptu home": ["PORT", "--sweep-full-range"],
    "rig new": ["rig", "--port", "PORT"],
}  # fmt: skip
WORDS = {
    "point": ["--angles", "0.2", "0.1"],
    "jog": ["--rates", "0.1", "0"],
    "snapshot": [CAMERA, "--out", "out.png"],
    "token new": ["--name", "Ana", "--role", "view"],
    "token revoke": ["Ana"],
    "track start": ["--position", "3", "0", "0"],
    "track pose": ["--position", "0", "0", "0"],
    "operations show": ["1"],
    "operations watch": ["1"],
    "mast use": ["other.yaml"],
    "fault set": ["pan_tilt", "jam"],
    "fault clear": ["pan_tilt"],
    "reset": ["--reason", "looked", "--name", "Ben"],
    "camera check": [CAMERA, "--with-head", "--seconds", "0.3"],
    "camera grab": [CAMERA, "--out", "out.png"],
    "camera focus": [CAMERA, "--seconds", "0.3"],
    "camera settings": [CAMERA],
    "camera sync": ["--seconds", "3"],
    "conform": ["--head", "--motion", "--reach", "0.2"],
    "experiment pointing": ["--targets", "1", "--out", "out"],
    "demo": ["--targets", "1", "--out", "out"],
    "sentinel reference": ["--folder", "sentinel"],
    "sentinel look": ["--folder", "sentinel"],
    "sentinel watch": ["--folder", "sentinel"],
}


def test_no_command_moves_a_latched_head(
    watched: Watched, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    watched.latch()
    others = "ptu" if watched.bench.driver == "dynamixel" else "servo"
    said = {}
    for name in commands():
        if name == DAEMONS or name.startswith(others):
            continue
        more = [watched.port if word == "PORT" else word for word in LINES.get(name, WORDS.get(name, []))]
        main([*name.split(), *more, *([] if name in LINES else ["--config", watched.config])])
        said[name] = capsys.readouterr().err
    assert {name: text for name, text in said.items() if "--help')" in text} == {}  # each was really begun
    assert watched.swept_rad < STILL_RAD
    assert WORDS.keys() | {name for name in LINES if not name.startswith(others)} <= said.keys()
    for name in {name for name in MOVING if not name.startswith(others)}:
        assert "an emergency stop is latched (Ana: sparks)" in said[name], (name, said[name])


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
        monkeypatch.setenv(heads.VARIABLE, "/proc/nowhere")
    watched.latch(tmp_path / "state")
    for words in (
        ["camera", "sync", "--seconds", "1"],
        ["conform", "--head", "--motion", "--only", "head.move"],
    ):
        assert main([*words, "--config", watched.config]) == 1
        assert "an emergency stop is latched (Ana: sparks)" in capsys.readouterr().err
    assert watched.swept_rad < STILL_RAD


def in_the_bar(watched: Watched, bar: str) -> np.ndarray[Any, np.dtype[np.bool_]]:
    """At which moments the head was where it must not be, by its true joint history, (n,)."""
    path = watched.path()
    if bar == "a keep-out":
        (left, right), (low, high) = BOX["pan_rad"], BOX["tilt_rad"]
        return (left < path[:, 0]) & (path[:, 0] < right) & (low < path[:, 1]) & (path[:, 1] < high)
    towards = np.array([np.cos(SUN["azimuth_rad"]), np.sin(SUN["azimuth_rad"]), 0.0])
    sight = np.array([rig().camera_in_rover(CAMERA, pan, tilt).A for pan, tilt in path])
    return sight @ towards > np.cos(SUN["half_angle_rad"])


@pytest.mark.parametrize("bar", BARRED)
def test_a_sweep_across_what_is_kept_out_moves_nothing(
    watched: Watched, bar: str, capsys: pytest.CaptureFixture[str]
) -> None:
    watched.configure(limits=BARRED[bar])
    words = ["camera", "sync", "--config", watched.config, "--seconds", "1", "--amplitude"]
    assert main([*words, "0.2", "--json"]) == 1
    assert json.loads(capsys.readouterr().out)["error"]["code"] == "keep_out"
    assert watched.swept_rad < STILL_RAD
    main([*words, "0.03"])  # beside it is no cause to refuse
    assert watched.swept_rad > 0.05
    assert not in_the_bar(watched, bar).any()


@pytest.mark.parametrize("bar", BARRED)
def test_the_checks_of_a_driver_keep_its_head_out(
    watched: Watched, bar: str, capsys: pytest.CaptureFixture[str]
) -> None:
    watched.configure(limits=BARRED[bar])
    words = ["conform", "--config", watched.config, "--head", "--motion", "--reach", "0.3", "--json"]
    asked = ["head.move", "head.new_goal", "head.threads", "head.not_a_number", "head.close"]
    code = main([*words, *(word for name in asked for word in ("--only", name))])
    told = json.loads(capsys.readouterr().out)
    said = {one["name"]: one["message"] for one in told["checks"]}
    assert (code, told["passed"], told["skipped"]) == (0, len(asked) - 1, 1), said
    assert "keep-out" in said["head.not_a_number"]  # a driver that takes infinity could go to the limit
    assert watched.swept_rad > 0.2
    assert not in_the_bar(watched, bar).any()


def test_a_head_that_stands_in_a_keep_out_is_not_tried(
    watched: Watched, capsys: pytest.CaptureFixture[str]
) -> None:
    watched.configure(limits=LIMITS | {"keep_out": {"antenna": BOX | {"pan_rad": [-0.1, 0.1]}}})
    words = ["conform", "--config", watched.config, "--head", "--motion", "--json"]
    assert main([*words, "--only", "head.move"]) == 1
    assert "it stands in a keep-out" in capsys.readouterr().out
    assert watched.swept_rad < STILL_RAD


def test_a_latched_head_still_takes_pictures(
    watched: Watched, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    watched.latch()
    picture = tmp_path / "picture.png"
    assert main(["camera", "grab", CAMERA, "--config", watched.config, "--out", str(picture)]) == 0
    assert picture.exists() and watched.swept_rad < STILL_RAD


def test_what_may_move_a_head_is_refused_beside_its_daemon(
    watched: Watched, capsys: pytest.CaptureFixture[str]
) -> None:
    with daemon_process(watched.bench.folder, watched.bench.config) as daemon, Client(line(daemon)):
        lines = {"dynamixel": ["servo", "test", watched.port, "1"]}
        home = ["ptu", "home", watched.port, "--sweep-full-range"]
        for words in (
            ["camera", "sync", "--config", watched.config],
            ["conform", "--config", watched.config, "--head", "--motion"],
            ["conform", "--config", watched.config, "--head", "--no-motion"],
            lines.get(watched.bench.driver, home),
        ):
            assert main(words) == 1
            assert "is driven by another program" in capsys.readouterr().err
    assert watched.swept_rad < STILL_RAD
