"""What the simulator keeps on disk: scenes, never stale, never needed."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest

from drivers.sim import kept, scene
from drivers.sim.kept import keep_newest, kept_folder
from drivers.sim.placed import SceneSettings
from drivers.sim.scene import Scene, folder_of, kept_scene
from drivers.sim.settings import scene_settings
from hil_tests.drivers.sim.small_scenes import build_small_scene

SETTINGS = scene_settings({"seed": 1, "rocks": 10, "bricks": 3, "boards": [{"x_m": 3, "y_m": 0}]})


@pytest.fixture(scope="module")
def built() -> Scene:
    return build_small_scene(SETTINGS)


@pytest.fixture
def home(tmp_path: Path, built: Scene, monkeypatch: pytest.MonkeyPatch) -> list[SceneSettings]:
    """A cache of its own; what was built is listed, and is the one scene in truth."""
    asked: list[SceneSettings] = []
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))

    def build(settings: SceneSettings) -> Scene:
        asked.append(settings)
        return built

    monkeypatch.setattr(scene, "build_scene", build)
    return asked


def same(one: Scene, other: Scene) -> bool:
    pairs = zip(scene.parts(one.world, ""), scene.parts(other.world, ""), strict=True)
    return all(a[0] == b[0] and np.array_equal(a[1], b[1]) for a, b in pairs)


def test_a_scene_is_built_once_and_read_to_the_last_bit(home: list[SceneSettings], built: Scene) -> None:
    assert kept_scene(SETTINGS) is built
    found = kept_scene(SETTINGS)
    assert found is not built and home == [SETTINGS]
    assert same(found, built) and found.settings == SETTINGS
    down, north = [[0.0, 0.0, -1.5]], [[1.0, 0.1, 0.4]]
    np.testing.assert_array_equal(found.cast(down, north), built.cast(down, north))


@pytest.mark.parametrize("harm", ["cut short", "no numbers"])
def test_a_damaged_scene_is_built_again(home: list[SceneSettings], built: Scene, harm: str) -> None:
    kept_scene(SETTINGS)
    folder = folder_of(SETTINGS)
    victim = folder / "world.broad.texels.npy"
    if harm == "cut short":
        victim.write_bytes(victim.read_bytes()[:5000])
    else:
        (folder / "world.inner.cells.npy").write_text("{}")
    assert kept_scene(SETTINGS) is built
    assert len(home) == 2
    assert same(kept_scene(SETTINGS), built) and len(home) == 2


def test_what_was_used_longest_ago_goes_when_there_is_too_much(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setitem(kept.MOST_BYTES, "scenes", 3500)
    folders = [kept_folder("scenes", f"{k:016d}") for k in range(6)]
    for k, folder in enumerate(folders):
        folder.mkdir(parents=True)
        (folder / "file").write_bytes(bytes(1000))
        os.utime(folder, (k, k))
    keep_newest(folders[0])  # made now, whatever its time says
    assert [folder.is_dir() for folder in folders] == [True, False, False, False, True, True]
    assert kept.kept_bytes("scenes") == 3000
    (folders[0] / "file").write_bytes(bytes(9000))
    keep_newest(folders[0])
    assert [folder for folder in folders if folder.is_dir()] == folders[:1]
