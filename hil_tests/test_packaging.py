"""The sdist and the wheel, as somebody else installs them: clean environment, other folder, no network."""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
import tempfile
import zipfile
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import pytest

from hil_tests.waiting import until

TIMEOUT_S = 600.0
WHOLE = pytest.mark.long(1, "the whole demo and a whole project on the installed package")


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
        timeout_s=TIMEOUT_S,
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


@dataclass(frozen=True)
class Installed:
    """An environment with nothing but the wheel and pytest in it."""

    folder: Path
    environ: dict[str, str]

    def program(self, name: str) -> Path:
        return self.folder / "bin" / name

    def processes(self) -> list[str]:
        """What runs from it."""
        lines = []
        for file in Path("/proc").glob("[0-9]*/cmdline"):
            with suppress(OSError):
                lines.append(file.read_bytes().replace(b"\0", b" ").decode(errors="replace"))
        return [line for line in lines if str(self.folder) in line]


@pytest.fixture(scope="module")
def installed(wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> Installed:
    """The wheel, installed from a folder of wheels into an environment of its own."""
    wheels = Path(sys.prefix) / "wheels"
    if not wheels.is_dir():
        pytest.skip(f"no folder of wheels at {wheels}: tools/setup makes it")
    environment = tmp_path_factory.mktemp("installed") / "environment"
    run(sys.executable, "-m", "venv", environment, timeout_s=TIMEOUT_S)
    clean = {
        key: value
        for key, value in os.environ.items()
        if not key.startswith(("PYTHON", "PYTEST", "PIP_", "VIRTUAL_"))
    }
    clean["PIP_DISABLE_PIP_VERSION_CHECK"] = "1"
    run(
        environment / "bin" / "pip", "install", "-q", "--no-compile", "--no-index", "--find-links", wheels,
        f"{wheel}[sim,report]", "pytest", "pytest-xdist",
        timeout_s=TIMEOUT_S, env=clean,
    )  # fmt: skip
    return Installed(environment, clean)


@pytest.mark.long(2, "an environment of its own from the built wheel")
def test_the_installed_command_points_a_small_rover_and_checks_it(
    installed: Installed, tmp_path: Path
) -> None:
    mastctl, how = installed.program("mastctl"), {"env": installed.environ, "cwd": tmp_path}
    assert "usage: mastctl" in run(mastctl, "--help", timeout_s=TIMEOUT_S, **how).stdout
    rig = ("sim", "new", "rig", "--size", "320x240", "--view-deg", "40", "--speed", "max")
    run(mastctl, *rig, timeout_s=TIMEOUT_S, **how)
    config = tmp_path / "rig" / "config.yaml"
    config.write_text(config.read_text().replace("port: 8420", "port: 0"))
    daemon = subprocess.Popen(
        [mastctl, "run", "--config", config], stdout=subprocess.PIPE, text=True, env=installed.environ
    )
    with daemon:
        try:
            assert daemon.stdout is not None
            url = daemon.stdout.readline().strip()
            words = ("--url", url, "--targets", "1", "--distances", "6", "--out", "pointed", "--json")
            pointed = json.loads(
                run(mastctl, "experiment", "pointing", *words, timeout_s=TIMEOUT_S, **how).stdout
            )
            words = ("conform", url, "--junit", "report.xml", "--json")
            told = json.loads(run(mastctl, *words, timeout_s=TIMEOUT_S, **how).stdout)
        finally:
            daemon.terminate()
    assert [(row["distance_m"], row["targets"], row["failed"]) for row in pointed["distances"]] == [
        (6.0, 1, 0)
    ]
    assert_report(tmp_path / "pointed" / "report.html")
    assert told["conforms"] and told["passed"] > 10 and told["failed"] == 0
    assert (tmp_path / "report.xml").stat().st_size > 1000


def assert_report(path: Path) -> None:
    page = path.read_text(encoding="utf-8")
    assert page.endswith("</html>\n") and "Every target" in page and 'src="data:image/png;base64,' in page


@WHOLE
def test_installed_wheel_runs_the_demo_from_another_folder(installed: Installed, tmp_path: Path) -> None:
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    done = run(
        installed.program("mastctl"), "demo", "--targets", "1", "--out", "demo", "--json",
        timeout_s=TIMEOUT_S, env=installed.environ, cwd=elsewhere,
    )  # fmt: skip
    distances = json.loads(done.stdout)["distances"]
    assert [row["distance_m"] for row in distances] == [10.0, 6.0, 2.0]
    assert all(row["targets"] == 1 for row in distances)
    assert_report(elsewhere / "demo" / "report.html")


@WHOLE
def test_the_installed_command_checks_a_driver(installed: Installed, tmp_path: Path) -> None:
    only = ("--only", "head.reading", "--only", "head.move")
    done = run(
        installed.program("mastctl"), "conform", "--driver", "sim", "--head", *only, "--json",
        timeout_s=TIMEOUT_S, env=installed.environ, cwd=tmp_path,
    )  # fmt: skip
    told = json.loads(done.stdout)
    assert told["conforms"] and told["passed"] == 2


FAULT_ROW = re.compile(r"^\| `(\w+)` \| `([^`]+)` \| `?([\w.]+)`? \|$", re.MULTILINE)

FAULT_TABLE = """
import pytest
from mastctl.client import ClientError

ROWS = {rows}


@pytest.mark.parametrize("device, words, ends_with", ROWS)
def test_row(mast_client, fault, device, words, ends_with):
    word, *numbers = words.split()
    shot = mast_client.snapshot("navcam_left")
    fault(device, word, **{{name: float(value) for name, value in (one.split("=") for one in numbers)}})
    record = mast_client.wait(mast_client.point(pixel=("navcam_left", shot.frame_id, 400, 300)))
    if record["state"] == "done":
        assert max(map(abs, record["residual_px"])) < float(ends_with)
    else:
        assert record["error"]["code"] == ends_with
"""

STAYS = """

def test_stays(mast_daemon):
    print(mast_daemon, flush=True)
    time.sleep(600)
"""


@pytest.fixture
def project(repository: Path, tmp_path: Path) -> Path:
    """The project of docs/how-to/testing-with-mastctl.md, with a test for each row of its table of faults."""
    page = (repository / "docs" / "how-to" / "testing-with-mastctl.md").read_text()
    blocks = re.findall(r"(?:`([\w/]+\.py)`)?[^\n`]*:\n\n```python\n(.*?)```", page, re.DOTALL)
    named = {name: text for name, text in blocks if name}
    assert set(named) == {"lookout.py", "test_lookout.py"} and len(blocks) == 4
    for name, text in named.items():
        (tmp_path / name).write_text(text)
    head = named["test_lookout.py"].partition("def test")[0]
    (tmp_path / "test_further.py").write_text(head + "".join(text for name, text in blocks if not name))
    rows = FAULT_ROW.findall(page.partition("## Faults, and how")[2].partition("\n## ")[0])
    assert len(rows) > 12
    (tmp_path / "test_faults.py").write_text(FAULT_TABLE.format(rows=rows))
    (tmp_path / "pytest.ini").write_text("[pytest]\naddopts = --strict-markers --strict-config\n")
    return tmp_path


@WHOLE
def test_an_outside_project_is_tested_in_parallel_and_nothing_is_left(
    installed: Installed, project: Path
) -> None:
    with tempfile.TemporaryDirectory(dir="/tmp", prefix="p") as short:  # room for sockets
        done = run(
            installed.program("pytest"), "-n", "2", "--durations=8",
            timeout_s=TIMEOUT_S, env={**installed.environ, "TMPDIR": short}, cwd=project,
        )  # fmt: skip
    assert re.search(r"\b\d\d passed in", done.stdout), done.stdout
    assert installed.processes() == []


@WHOLE
@pytest.mark.parametrize("workers", ["0", "1"])
def test_nothing_is_left_when_pytest_is_killed(installed: Installed, tmp_path: Path, workers: str) -> None:
    (tmp_path / "test_stays.py").write_text(STAYS)
    log = tmp_path / "log.txt"
    with log.open("w") as out:
        pytest_process = subprocess.Popen(
            [installed.program("pytest"), "-s", "-n", workers, "--basetemp", tmp_path / "base"],
            stdout=out, stderr=out, env=installed.environ, cwd=tmp_path,
        )  # fmt: skip
    with pytest_process:
        try:
            until(
                lambda: pytest_process.poll() is not None or serving(installed),
                "the daemon serves",
                TIMEOUT_S,
            )
            assert pytest_process.poll() is None, log.read_text()
        finally:
            pytest_process.send_signal(signal.SIGKILL)
    until(lambda: not installed.processes(), "nothing runs any more")


def serving(installed: Installed) -> bool:
    return any("mastctl.testing.serve" in line for line in installed.processes())
