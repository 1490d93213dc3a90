"""A small rig, one scene for all tests of the simulated rover, and the package of docs/drivers.md."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest

from calib.files.mast_file import load_rig, save_rig
from calib.geometry.rig import Rig, RigCamera
from drivers.sim import rover
from drivers.sim.placed import SceneSettings
from drivers.sim.scene import Scene, kept_scene

SHRINK = 4


@pytest.fixture(scope="session")
def scene() -> Scene:
    """The scene of seed 1 with ten rocks, from disk where it was built before."""
    return kept_scene(SceneSettings(seed=1, rocks=10))


@pytest.fixture
def one_scene(scene: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    """Every simulated rover gets the same scene, whatever it asks for: building one takes seconds."""
    monkeypatch.setattr(rover, "kept_scene", lambda settings: scene)


@pytest.fixture(scope="session")
def small_rig(repository: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The shipped true rig with images a quarter as large, in a file of its own."""
    rig = load_rig(repository / "configs" / "sim" / "rocky8.yaml").rig
    cameras = {}
    for name, camera in rig.cameras.items():
        m = camera.model
        # The centre of the top-left pixel is (0, 0), so x = (x' + 0.5) / 4 - 0.5.
        size = (m.size_px[0] // SHRINK, m.size_px[1] // SHRINK)
        shift = (0.5 / SHRINK - 0.5) * m.A
        model = replace(m, size_px=size, H=m.H / SHRINK + shift, V=m.V / SHRINK + shift)
        cameras[name] = RigCamera(camera.on, model)
    path = tmp_path_factory.mktemp("rig") / "small.yaml"
    save_rig(Rig("small", rig.mast, cameras, rig.stereo), path)
    return path


@pytest.fixture(scope="session")
def sources(repository: Path) -> dict[str, str]:
    """File name to text of the package that the page shows."""
    package = repository / "docs" / "examples" / "bench_rig"
    names = ("pyproject.toml", "bench_rig/head.py", "bench_rig/camera.py")
    return {name: (package / name).read_text() for name in names}


@pytest.fixture(scope="session")
def installed(sources: dict[str, str], tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """The package, installed by pip into a folder of its own that is on the path."""
    project, target = tmp_path_factory.mktemp("project"), tmp_path_factory.mktemp("installed")
    for name, text in sources.items():
        path = project / name
        path.parent.mkdir(exist_ok=True)
        path.write_text(text)
    (project / "bench_rig" / "__init__.py").touch()
    options = "--quiet --no-deps --no-index --no-build-isolation --disable-pip-version-check"
    done = subprocess.run(
        [sys.executable, "-m", "pip", "install", *options.split(), "--target", str(target), str(project)],
        capture_output=True,
        text=True,
        timeout=120,
    )
    assert done.returncode == 0, done.stderr
    sys.path.insert(0, str(target))
    yield target
    sys.path.remove(str(target))
    for name in [name for name in sys.modules if name.split(".")[0] == "bench_rig"]:
        del sys.modules[name]
