"""The sdist and the wheel, as somebody else installs them: clean environment, other folder, no network."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

INSTALL_TIMEOUT_S = 600
DEMO_TIMEOUT_S = 600


def run(*command: str | Path, timeout_s: float, **options: object) -> subprocess.CompletedProcess[str]:
    """Run a command; on failure the assertion shows what it printed."""
    done = subprocess.run(
        [str(part) for part in command], capture_output=True, text=True, timeout=timeout_s, **options
    )
    assert done.returncode == 0, (
        f"{command} exited {done.returncode}\n{done.stdout[-4000:]}\n{done.stderr[-4000:]}"
    )
    return done


@pytest.fixture(scope="module")
def wheel(repository: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The wheel, built from the sdist, which is built from this checkout."""
    out = tmp_path_factory.mktemp("dist")
    run(
        sys.executable, "-m", "build", "--no-isolation", "--outdir", out, repository,
        timeout_s=INSTALL_TIMEOUT_S,
    )  # fmt: skip
    assert len(list(out.glob("mastctl-*.tar.gz"))) == 1
    (built,) = out.glob("mastctl-*.whl")
    return built


def test_wheel_holds_three_packages_and_the_configs(wheel: Path) -> None:
    with zipfile.ZipFile(wheel) as archive:
        names = archive.namelist()
    tops = {name.split("/")[0] for name in names}
    assert {top for top in tops if not top.endswith(".dist-info")} == {"mastctl", "drivers", "calib"}
    assert "mastctl/configs/default.yaml" in names
    templates = {f"mastctl/report/templates/{name}" for name in ("base.html", "style.css", "pointing.html")}
    assert templates <= set(names)


def test_installed_wheel_runs_the_demo_from_another_folder(wheel: Path, tmp_path: Path) -> None:
    wheels = Path(sys.prefix) / "wheels"
    if not wheels.is_dir():
        pytest.skip(f"no folder of wheels at {wheels}: tools/setup makes it")
    environment = tmp_path / "environment"
    run(sys.executable, "-m", "venv", environment, timeout_s=INSTALL_TIMEOUT_S)
    clean = {
        key: value for key, value in os.environ.items() if not key.startswith(("PYTHON", "PIP_", "VIRTUAL_"))
    }
    clean["PIP_DISABLE_PIP_VERSION_CHECK"] = "1"
    run(
        environment / "bin" / "pip", "install", "-q", "--no-compile", "--no-index", "--find-links", wheels,
        f"{wheel}[sim,report]",
        timeout_s=INSTALL_TIMEOUT_S, env=clean,
    )  # fmt: skip
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    done = run(
        environment / "bin" / "mastctl", "demo", "--targets", "1", "--out", "demo", "--json",
        timeout_s=DEMO_TIMEOUT_S, env=clean, cwd=elsewhere,
    )  # fmt: skip
    distances = json.loads(done.stdout)["distances"]
    assert [row["distance_m"] for row in distances] == [10.0, 6.0, 2.0]
    assert all(row["targets"] == 1 for row in distances)
    page = (elsewhere / "demo" / "report.html").read_text(encoding="utf-8")
    assert page.endswith("</html>\n") and "Every target" in page and 'src="data:image/png;base64,' in page
