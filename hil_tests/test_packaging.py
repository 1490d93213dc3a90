"""The sdist and the wheel, as somebody else installs them: clean environment, other folder, no network."""

from __future__ import annotations

import email
import json
import os
import re
import subprocess
import sys
import tempfile
import zipfile
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
from markdown_it import MarkdownIt

from tools import dist
from tools.page_tables import page_text

TIMEOUT_S = 600.0
WHOLE = pytest.mark.long(1, "the whole demo and a whole project on the installed package")


def run(*command: str | Path, timeout_s: float, **options: Any) -> subprocess.CompletedProcess[str]:
    """Run a command; on failure the assertion shows what it printed."""
    done = subprocess.run(
        [str(part) for part in command], capture_output=True, text=True, timeout=timeout_s, **options
    )
    assert done.returncode == 0, (
        f"{command} exited {done.returncode}\n{done.stdout[-4000:]}\n{done.stderr[-4000:]}"
    )
    return done


@pytest.fixture(scope="module")
def built(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """The sdist, the wheel that was built from it, and the client's wheel, from this checkout."""
    return dist.build(tmp_path_factory.mktemp("dist"))


@pytest.fixture(scope="module")
def wheel(built: list[Path]) -> Path:
    return built[1]


@pytest.fixture(scope="module")
def client_wheel(built: list[Path]) -> Path:
    return built[2]


def test_wheel_holds_three_packages_and_the_configs(wheel: Path, repository: Path) -> None:
    with zipfile.ZipFile(wheel) as archive:
        names = archive.namelist()
    tops = {name.split("/")[0] for name in names}
    assert {top for top in tops if not top.endswith(".dist-info")} == {"mastctl", "drivers", "calib"}
    assert "mastctl/configs/default.yaml" in names
    templates = {f"mastctl/report/templates/{name}" for name in ("base.html", "style.css", "pointing.html")}
    assert templates <= set(names)
    built = (repository / "docs/_build/html/index.html").is_file()
    assert ("mastctl/site/index.html" in names) == built, "the site is in the wheel where tools/docs built it"


def readme_of(wheel: Path) -> str:
    """What an index of packages shows of a wheel."""
    with zipfile.ZipFile(wheel) as archive:
        (name,) = (one for one in archive.namelist() if one.endswith(".dist-info/METADATA"))
        return str(email.message_from_bytes(archive.read(name)).get_payload())


def test_an_index_is_given_no_link_that_works_in_a_checkout_only(built: list[Path], repository: Path) -> None:
    readme = (repository / "README.md").read_text()
    at = dist.for_an_index(readme, "https://example.org/mastctl/", "v1")
    assert "https://example.org/mastctl/raw/v1/docs/img/page.jpg" in targets(at)
    assert "https://example.org/mastctl/blob/v1/docs/index.md" in targets(at)
    assert len(targets(at)) == len(targets(readme)) > 10
    for page in (at, *map(readme_of, built[1:])):
        assert [target for target in targets(page) if not target.startswith("https://")] == []
    assert "[The suite]" not in readme_of(built[1]) and "The suite says" in readme_of(built[1])


def targets(readme: str) -> list[str]:
    """Where its links and pictures lead, by a parser of Markdown."""
    flat = [token for block in MarkdownIt().parse(readme) for token in (block, *(block.children or ()))]
    found = [token.attrs.get("href") or token.attrs.get("src") for token in flat]
    return [str(target) for target in found if target]


CLIENT_ALONE = """
import importlib, pkgutil, sys

class Refuse:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in {refused}:
            raise ImportError(f"{{name}} is not there")

sys.meta_path.insert(0, Refuse())
sys.path.insert(0, sys.argv[1])
import mastctl
for module in pkgutil.walk_packages(mastctl.__path__, "mastctl."):
    importlib.import_module(module.name)
    assert sys.modules[module.name].__file__.startswith(sys.argv[1]), module.name
    print(module.name)
"""


def test_the_client_alone_needs_nothing_of_the_daemon(client_wheel: Path, tmp_path: Path) -> None:
    with zipfile.ZipFile(client_wheel) as archive:
        archive.extractall(tmp_path)
    (path_file,) = tmp_path.glob("*.pth")
    apart = tmp_path / path_file.read_text().strip()
    assert {one.name for one in tmp_path.iterdir() if not one.name.endswith(".dist-info")} == {
        path_file.name, apart.name,
    }  # fmt: skip
    refused = {"calib", "drivers", "numpy", "cv2", "scipy", "yaml", "pydantic", "fastapi", "serial"}
    done = run(sys.executable, "-c", CLIENT_ALONE.format(refused=refused), apart, timeout_s=TIMEOUT_S)
    assert {"mastctl.client.client", "mastctl.answers.status"} <= set(done.stdout.split())


@pytest.mark.long(3, "builds everything once more")
def test_the_same_checkout_gives_the_same_bytes(
    built: list[Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("TZ", "Pacific/Auckland")
    before = os.umask(0o077)
    try:
        again = dist.build(tmp_path)
    finally:
        os.umask(before)
    assert [file.name for file in again] == [file.name for file in built]
    for one, other in zip(built, again, strict=True):
        assert one.read_bytes() == other.read_bytes(), one.name


@dataclass(frozen=True)
class Installed:
    """An environment with nothing but the wheel and pytest in it."""

    folder: Path
    environ: dict[str, str]

    def program(self, name: str) -> Path:
        return self.folder / "bin" / name

    def install(self, *what: str | Path) -> None:
        """Install from the folder of wheels, without a network."""
        run(
            self.program("pip"), "install", "-q", "--no-index", "--find-links",
            Path(sys.prefix) / "wheels", *what,
            timeout_s=TIMEOUT_S, env=self.environ,
        )  # fmt: skip

    def processes(self) -> list[str]:
        """What runs from it."""
        lines = []
        for file in Path("/proc").glob("[0-9]*/cmdline"):
            with suppress(OSError):
                lines.append(file.read_bytes().replace(b"\0", b" ").decode(errors="replace"))
        return [line for line in lines if str(self.folder) in line]


def environment(folder: Path, *what: str | Path) -> Installed:
    """Make an environment and install from the folder of wheels into it."""
    wheels = Path(sys.prefix) / "wheels"
    if not wheels.is_dir():
        pytest.skip(f"no folder of wheels at {wheels}: tools/setup makes it")
    run(sys.executable, "-m", "venv", folder, timeout_s=TIMEOUT_S)
    clean = {
        key: value
        for key, value in os.environ.items()
        if not key.startswith(("PYTHON", "PYTEST", "PIP_", "VIRTUAL_"))
    }
    clean["PIP_DISABLE_PIP_VERSION_CHECK"] = "1"
    made = Installed(folder, clean)
    made.install(*what)
    return made


@pytest.fixture(scope="module")
def installed(wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> Installed:
    """The wheel, installed into an environment of its own."""
    folder = tmp_path_factory.mktemp("installed") / "environment"
    return environment(folder, "--no-compile", f"{wheel}[sim,report]", "pytest", "pytest-xdist")


@pytest.mark.long(2, "an environment of its own from the built wheel")
def test_the_installed_command_points_a_small_rover_and_checks_it(
    installed: Installed, tmp_path: Path
) -> None:
    mastctl, how = installed.program("mastctl"), {"env": installed.environ, "cwd": tmp_path}
    assert "usage: mastctl" in run(mastctl, "--help", timeout_s=TIMEOUT_S, **how).stdout
    rig = ("rig", "sim", "new", "rig", "--size", "320x240", "--view-deg", "40", "--speed", "max")
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
            conform = ("conform", url, "--json")
            report = json.loads(run(mastctl, *conform, timeout_s=TIMEOUT_S, **how).stdout)
        finally:
            daemon.terminate()
    assert [(row["distance_m"], row["targets"], row["failed"]) for row in pointed["distances"]] == [
        (6.0, 1, 0)
    ]
    assert_report(tmp_path / "pointed" / "report.html")
    assert report["conforms"] and report["passed"] > 7 and report["failed"] == 0


def assert_report(path: Path) -> None:
    page = path.read_text(encoding="utf-8")
    assert page.endswith("</html>\n") and "Every target" in page and 'src="data:image/png;base64,' in page


@WHOLE
def test_a_first_contact_points_three_distances_where_nothing_was_compiled(
    wheel: Path, tmp_path: Path
) -> None:
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    there = environment(tmp_path / "environment", f"{wheel}[sim]")
    clean = {**there.environ, "XDG_CACHE_HOME": str(tmp_path / "cache")}  # all is compiled anew
    clean.pop("NUMBA_CACHE_DIR", None)
    done = run(there.program("mastctl"), "demo", "--json", timeout_s=TIMEOUT_S, env=clean, cwd=elsewhere)
    distances = json.loads(done.stdout)["distances"]
    assert [(row["distance_m"], row["targets"], row["failed"]) for row in distances] == [
        (10.0, 3, 0), (6.0, 3, 0), (2.0, 3, 0),
    ]  # fmt: skip
    assert (elsewhere / "mastctl_demo" / "report.html").read_text().endswith("</html>\n")


CLIENT_ASKS = """
import sys
from mastctl.client import Client
with Client(sys.argv[1]) as client:
    shot = client.snapshot("navcam_left")
    assert shot.data.startswith(b"\\x89PNG")
    try:
        shot.image
    except ImportError as error:
        print(error)
    record = client.wait(client.point(pixel=("navcam_left", shot.frame_id, 400, 300)))
    print(record["state"], max(map(abs, record["residual_px"])) < 1.0)
    print(client.stop()["stopped"] is not None)
"""


@pytest.mark.long(2, "an environment of its own from the built client, and a daemon")
def test_the_client_by_itself_takes_a_picture_points_and_stops(
    client_wheel: Path, mast_daemon: str, tmp_path: Path
) -> None:
    alone = environment(tmp_path / "environment", client_wheel)
    packages = json.loads(
        run(alone.program("pip"), "list", "--format", "json", timeout_s=TIMEOUT_S, env=alone.environ).stdout
    )
    assert {one["name"] for one in packages} - {"pip", "setuptools"} == {
        "mastctl-client", "httpx", "httpcore", "h11", "anyio", "idna", "certifi", "annotated-types",
        "typing_extensions",
    }  # fmt: skip
    said = run(
        alone.program("python"), "-c", CLIENT_ASKS, mast_daemon,
        timeout_s=TIMEOUT_S, env=alone.environ, cwd=tmp_path,
    ).stdout.splitlines()  # fmt: skip
    assert "pip install opencv-python-headless" in said[0]
    assert said[1:] == ["done True", "True"]


FAULT_ROW = re.compile(r"^\| (\w+) \| ([\w. =]+) \| ([^|]*) \| ([^|]*) \| ([^|]*) \|$", re.MULTILINE)

FAULT_TABLE = """
import pytest
from mastctl.client import ClientError

ROWS = {rows}

def some(column):
    return pytest.mark.parametrize("row", [row for row in ROWS if row[column]], ids=lambda row: row[1])

@some(2)
def test_in_memory(mast_client, fault, row):
    check(mast_client, fault, *row[:2], row[2])

@pytest.mark.mastctl(wire="dynamixel")
@some(3)
def test_dynamixel(mast_client, fault, row):
    mast_client.wait(mast_client.point(pan_rad=0.0, tilt_rad=-0.1))  # the driver moves when it opens
    check(mast_client, fault, *row[:2], row[3])

@pytest.mark.mastctl(wire="flir_ptu")
@some(4)
def test_flir_ptu(mast_client, fault, row):
    mast_client.wait(mast_client.point(pan_rad=0.0, tilt_rad=-0.1))
    check(mast_client, fault, *row[:2], row[4])

def check(mast_client, fault, device, words, ends_with):
    word, *numbers = words.split()
    shot = mast_client.snapshot("navcam_left")
    fault(device, word, **{{name: float(value) for name, value in (one.split("=") for one in numbers)}})
    record = mast_client.wait(mast_client.point(pixel=("navcam_left", shot.frame_id, 400, 300)))
    if record["state"] == "done":
        assert max(map(abs, record["residual_px"])) < float(ends_with)
    else:
        assert record["error"]["code"] in ends_with.split(", ")
"""


@pytest.fixture
def project(repository: Path, tmp_path: Path) -> Path:
    """The project of docs/how-to/simulation.md, with a test for each row of its table of faults."""
    page = page_text(repository / "docs" / "how-to" / "simulation.md")
    blocks = re.findall(r"(?:`([\w/]+\.py)`)?[^\n`]*:\n\n```python\n(.*?)```", page, re.DOTALL)
    named = {name: text for name, text in blocks if name}
    assert set(named) == {"lookout.py", "test_lookout.py"} and len(blocks) == 4
    for name, text in named.items():
        (tmp_path / name).write_text(text)
    head = named["test_lookout.py"].partition("def test")[0]
    (tmp_path / "test_further.py").write_text(head + "".join(text for name, text in blocks if not name))
    table = page.partition("## Faults, and how")[2].partition("\n## ")[0].replace("`", "")
    rows = [[cell.strip() for cell in row] for row in FAULT_ROW.findall(table)[1:]]  # without the heading
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
