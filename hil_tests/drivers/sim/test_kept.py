"""What the simulator keeps on disk: compiled code and scenes, never stale, never needed."""

from __future__ import annotations

import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from drivers.sim import kept, quick_start
from drivers.sim.kept import digest_of, keep_newest, kept_folder
from drivers.sim.quick_start import FACTS, folder_of, kept_scene
from drivers.sim.scene import Scene, SceneSettings
from hil_tests.drivers.sim.small_scenes import build_small_scene

SETTINGS = SceneSettings(seed=1, rocks=10, bricks=3)


@pytest.fixture(scope="module")
def built() -> Scene:
    return build_small_scene(SETTINGS)


@pytest.fixture
def home(tmp_path: Path, built: Scene, monkeypatch: pytest.MonkeyPatch) -> list[SceneSettings]:
    """A cache of its own; what was built is listed, and is the one scene in truth."""
    asked: list[SceneSettings] = []
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setattr(quick_start, "build_scene", lambda settings: asked.append(settings) or built)
    return asked


def same(one: Scene, other: Scene) -> bool:
    pairs = zip(quick_start.parts(one.world, ""), quick_start.parts(other.world, ""), strict=True)
    return all(a[0] == b[0] and np.array_equal(a[1], b[1]) for a, b in pairs)


def test_a_scene_is_built_once_and_read_to_the_last_bit(home: list[SceneSettings], built: Scene) -> None:
    assert kept_scene(SETTINGS) is built
    found = kept_scene(SETTINGS)
    assert found is not built and home == [SETTINGS]
    assert same(found, built) and found.settings == SETTINGS
    for one, other in zip(found.bricks, built.bricks, strict=True):
        np.testing.assert_array_equal(one.corners_m, other.corners_m)
    down, north = [[0.0, 0.0, -1.5]], [[1.0, 0.1, 0.4]]
    np.testing.assert_array_equal(found.cast(down, north), built.cast(down, north))


@pytest.mark.parametrize("change", [{"seed": 2}, {"relief_m": 0.2}, {"sun_elevation_rad": 0.7000001}])
def test_any_other_setting_is_another_scene(home: list[SceneSettings], change: dict[str, float]) -> None:
    assert folder_of(replace(SETTINGS, **change)) != folder_of(SETTINGS)  # type: ignore[arg-type]


def test_changed_sources_are_another_scene(
    home: list[SceneSettings], monkeypatch: pytest.MonkeyPatch
) -> None:
    before = folder_of(SETTINGS)
    monkeypatch.setattr(quick_start.kernels(), "SOURCES", "changed")
    assert folder_of(SETTINGS) != before


@pytest.mark.parametrize("harm", ["cut short", "gone", "no numbers", "not numbers"])
def test_a_damaged_scene_is_built_again(home: list[SceneSettings], built: Scene, harm: str) -> None:
    kept_scene(SETTINGS)
    folder = folder_of(SETTINGS)
    victim = folder / "world.broad.texels.npy"
    if harm == "cut short":
        victim.write_bytes(victim.read_bytes()[:5000])
    elif harm == "gone":
        victim.unlink()
    else:
        (folder / FACTS).write_text("{}" if harm == "no numbers" else "[")
    assert kept_scene(SETTINGS) is built
    assert len(home) == 2
    assert same(kept_scene(SETTINGS), built) and len(home) == 2


def test_where_nothing_can_be_written_scenes_are_built_each_time(
    home: list[SceneSettings], built: Scene, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    (tmp_path / "file").touch()
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "file"))
    assert kept_scene(SETTINGS) is built and kept_scene(SETTINGS) is built


def test_writing_into_a_scene_that_was_read_changes_nobody_elses(home: list[SceneSettings]) -> None:
    kept_scene(SETTINGS)
    mine, yours = kept_scene(SETTINGS), kept_scene(SETTINGS)
    mine.world.broad.texels[:] = 0
    assert yours.world.broad.texels.any() and kept_scene(SETTINGS).world.broad.texels.any()


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


def test_any_changed_file_changes_the_digest(tmp_path: Path) -> None:
    files = [tmp_path / "a.py", tmp_path / "b.py"]
    for file in files:
        file.write_text("x = 1\n")
    before = digest_of(files)
    assert digest_of(reversed(files)) == before
    files[1].write_text("x = 2\n")
    assert digest_of(files) != before


NOISE = """
import sys
import numpy as np
from drivers.sim.kernels import noisy_levels
light = np.full(8, 100, np.float32)
noisy_levels(light, light, np.zeros(65536, np.float32), np.uint64(1), np.empty(8, np.uint8))
print(sum(noisy_levels.stats.cache_hits.values()))
"""


def compiled_before(cache: Path) -> int:
    environment = {"XDG_CACHE_HOME": str(cache), "PATH": "/usr/bin", "HOME": str(cache)}
    done = subprocess.run(
        [sys.executable, "-c", NOISE],
        capture_output=True,
        text=True,
        env=environment,
        check=True,
        timeout=300,
    )
    return int(done.stdout)


def test_compiled_code_is_found_by_the_next_process_and_a_damaged_one_is_made_again(tmp_path: Path) -> None:
    assert compiled_before(tmp_path) == 0
    assert compiled_before(tmp_path) == 1
    for file in tmp_path.rglob("*.noisy_levels*"):
        file.write_bytes(b"")
    assert compiled_before(tmp_path) == 0


def test_where_compiled_code_cannot_be_kept_it_is_compiled_each_time(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    assert compiled_before(tmp_path / "file") == 0
