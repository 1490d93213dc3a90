"""The scene of docs/how-to/simulation.md, from outside: seen exactly, pointed at, refused when it fails."""

from __future__ import annotations

import importlib
import json
import logging
import re
import sys
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from calib.geometry.cahvor import CameraModel
from calib.geometry.rigid import Rigid, rot_y
from drivers.errors import BadOptions, DriverError
from drivers.sim.outside_scene import OutsideRenderer, OutsideScene, outside_scene
from drivers.sim.settings import scene_settings
from mastctl.cli.main import main
from mastctl.config import load_config
from mastctl.daemon import RunningDaemon
from mastctl.experiment.simulated import own_config

EYE_M = np.array([0.0, 0.1, -1.5])
BROKEN = """
class Scene:
    def __init__(self, fault): self.fault = fault
    def look(self, origins_m, directions, pitch_rad):
        if self.fault == "raises": raise RuntimeError("no such mesh")
        n = len(origins_m) + (self.fault == "long")
        range_m = -2.0 if self.fault == "behind" else 1.0
        return [range_m] * n, [float("nan") if self.fault == "nan" else 90.0] * n
class Blind: pass
class Slow:
    told = None
    def look(self, origins_m, directions, pitch_rad):
        assert Slow.told.wait(60), "nobody was told"
        return [1.0] * len(origins_m), [90.0] * len(origins_m)
def opened(seed, fault): return Blind() if fault == "blind" else Slow() if fault == "slow" else Scene(fault)
"""


@pytest.fixture(scope="module")
def outside(repository: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """A folder with the page's example and a scene that fails, on the path."""
    folder = tmp_path_factory.mktemp("outside")
    page = (repository / "docs" / "how-to" / "simulation.md").read_text()
    (source,) = re.findall(r"`quarry\.py`.*?```python\n(.*?)```", page, re.DOTALL)
    assert len(source.splitlines()) < 60
    (folder / "quarry.py").write_text(source)
    (folder / "broken_scene.py").write_text(BROKEN)
    sys.path.insert(0, str(folder))
    yield folder
    sys.path.remove(str(folder))
    for name in ("quarry", "broken_scene"):
        sys.modules.pop(name, None)


def made(plugin: str, **options: Any) -> OutsideScene:
    return outside_scene(scene_settings({"plugin": plugin, "options": options, "seed": 3}, Path()))


def test_a_mesh_is_met_where_boxes_are(outside: Path) -> None:
    """By slabs, which know nothing of triangles."""
    scene = made("quarry:open_quarry", blocks=4)
    boxes = scene._seen.triangles_m.reshape(-1, 36, 3)
    rng = np.random.default_rng(5)
    directions = np.column_stack([np.ones(300), rng.uniform(-0.6, 0.6, 300), rng.uniform(-0.2, 0.5, 300)])
    directions /= np.linalg.norm(directions, axis=1)[:, None]
    expected = np.full(300, np.inf)
    for low, high in zip(boxes.min(axis=1), boxes.max(axis=1), strict=True):
        ends = np.sort([(low - EYE_M) / directions, (high - EYE_M) / directions], axis=0)
        near, far = ends[0].max(axis=1), ends[1].min(axis=1)
        expected = np.where((near <= far) & (near > 0), np.minimum(expected, near), expected)
    found = scene.cast(EYE_M, directions)
    np.testing.assert_array_equal(np.isnan(found), np.isinf(expected))
    np.testing.assert_allclose(found[~np.isnan(found)], expected[~np.isinf(expected)], rtol=1e-12)
    assert np.isnan(found).sum() > 20 and (found < 12).sum() > 50


def test_pixels_show_what_their_own_rays_see(outside: Path) -> None:
    scene = made("quarry:open_quarry")
    camera = CameraModel("CAHV", (64, 48), C=EYE_M, A=[1, 0, 0], H=[31.5, 60, 0], V=[23.5, 0, 60])
    pose = Rigid(rot_y(-0.1), np.zeros(3))
    renderer = OutsideRenderer(scene)
    picture = renderer.image(camera, pose, 1)
    lower = renderer.image(camera, pose, 1, (30, 48))
    renderer.close()
    x, y = np.meshgrid(np.arange(64), np.arange(48))
    rays = camera.ray(np.stack([x.ravel(), y.ravel()], axis=-1))
    light = scene._seen.look(pose.points(rays.origins_m), pose.vectors(rays.directions), 1 / 60)[1]
    np.testing.assert_allclose(picture.ravel(), light, atol=0.05)
    np.testing.assert_array_equal(lower[30:], picture[30:])


@pytest.mark.parametrize(
    ("plugin", "options", "told"),
    [
        ("nowhere.at_all:scene", {}, "cannot import 'nowhere.at_all'"),
        ("quarry:no_such", {}, "'quarry' has no 'no_such'"),
        ("quarry:WALLS", {}, "'WALLS' cannot be called"),
        ("quarry:open_quarry", {"rooms": 3}, "refuses the options {'rooms': 3}"),
        ("broken_scene:opened", {"fault": "blind"}, "made a Blind without look"),
        ("broken_scene:opened", {"fault": "raises"}, r"failed to look \(RuntimeError: no such mesh\)"),
        ("broken_scene:opened", {"fault": "long"}, r"ranges \(3,\) and brightness \(3,\) for 2 rays"),
        ("broken_scene:opened", {"fault": "nan"}, "a brightness that is not a number"),
        ("broken_scene:opened", {"fault": "behind"}, "the range -2 m, expected 0 or more, nan for sky"),
    ],
)
def test_a_scene_that_fails_is_refused_at_the_start(
    outside: Path, plugin: str, options: dict[str, Any], told: str
) -> None:
    with pytest.raises(BadOptions, match=told) as refused:
        made(plugin, **options)
    assert plugin in str(refused.value) and "\n" not in str(refused.value)


def test_a_first_look_that_takes_long_is_named_in_the_log_while_it_is_waited_for(
    outside: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("drivers.sim.outside_scene.LONG_S", 0.01)
    lines: list[str] = []
    heard = threading.Event()

    class Listening(logging.Handler):
        def emit(self, record: logging.LogRecord) -> None:
            lines.append(record.getMessage())
            heard.set()

    monkeypatch.setattr(importlib.import_module("broken_scene").Slow, "told", heard)
    log, handler = logging.getLogger("drivers.sim.outside_scene"), Listening()
    log.addHandler(handler)
    try:
        made("broken_scene:opened", fault="slow")
    finally:
        log.removeHandler(handler)
    assert lines[0].startswith("still waiting for the first look of scene 'broken_scene:opened'")


def test_a_scene_that_fails_later_is_a_drivers_error(outside: Path) -> None:
    scene = made("broken_scene:opened", fault="")
    scene._seen.fault = "raises"
    with pytest.raises(DriverError, match="'broken_scene:opened' failed to look"):
        scene.cast(EYE_M, [1.0, 0.0, 0.1])


def test_a_scene_from_outside_stands_alone() -> None:
    with pytest.raises(BadOptions, match=r"simulation\.scene\.rocks stands beside plugin"):
        scene_settings({"plugin": "a:b", "rocks": [{"x_m": 3, "y_m": 0}]}, Path())
    with pytest.raises(BadOptions, match="options stand without a plugin"):
        scene_settings({"options": {"blocks": 3}}, Path())


def test_the_mast_points_in_a_scene_from_outside(
    outside: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["sim", "new", str(tmp_path), "--size", "320x240", "--view-deg", "40", "--speed", "max"]) == 0
    config = yaml.safe_load((tmp_path / "config.yaml").read_text())
    config["simulation"] |= {"scene": {"plugin": "quarry:open_quarry"}, "samples": 1}
    (tmp_path / "config.yaml").write_text(yaml.safe_dump(config))
    capsys.readouterr()
    with RunningDaemon(own_config(load_config(tmp_path / "config.yaml"), head=None, wire=None)) as daemon:
        words = [
            "experiment",
            "pointing",
            "--url",
            daemon.url,
            "--targets",
            "1",
            "--distances",
            "5",
            "--json",
        ]
        assert main(words) == 0
    (distance,) = json.loads(capsys.readouterr().out)["distances"]
    assert distance["targets"] == 1 and max(distance["second_rms_px"]) < 0.5
