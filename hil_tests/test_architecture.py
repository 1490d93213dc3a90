"""What docs/explanation/architecture.md says: its files exist, its tools answer, its picture is true."""

from __future__ import annotations

import ast
import re
import runpy
import sys
import tomllib
from pathlib import Path

import pytest

from tools.rooms import PACKAGES, Package, drawn, read_package

FOLDER = Path(__file__).resolve().parent.parent / "tools"
WORKERS = {"closed_loop.run", "against_others.mrcal_fit", "benchmarks.mrcal_worker"}
"""Started by a tool, not by people."""
TOOLS = sorted(
    {
        ".".join(file.relative_to(FOLDER).with_suffix("").parts).removesuffix(".__main__")
        for file in FOLDER.rglob("*.py")
        if 'if __name__ == "__main__"' in (text := file.read_text())
        and ("argparse" in text or "options(__doc__" in text)
    }
    - WORKERS
)


def page(repository: Path) -> str:
    return (repository / "docs" / "explanation" / "architecture.md").read_text()


def test_every_file_that_the_page_names_is_there(repository: Path) -> None:
    named = set(re.findall(r"`((?:[a-z_]+/)+[a-z_]+\.py)`", page(repository)))
    assert len(named) > 20
    for file in named:
        places = [repository / file, repository / "mastctl" / file]
        assert any(place.is_file() for place in places), file


def test_no_page_links_or_names_a_file_of_the_checkout_that_is_not_there(repository: Path) -> None:
    pages = [repository / "README.md", *sorted((repository / "docs").rglob("*.md"))]
    missing, seen = [], 0
    for one in pages:
        text = one.read_text()
        links = [link for link in re.findall(r"\]\(([^)#\s]+)", text) if "://" not in link]
        links = [link for link in links if "generated/" not in link]  # the build of the site checks those
        named = re.findall(r"`((?:calib|configs|docs|drivers|hil_tests|mastctl|tools)/[\w./-]+\.\w+)`", text)
        named = [name for name in named if "NAME" not in name]
        seen += len(links) + len(named)
        missing += [f"{one.name}: {link}" for link in links if not (one.parent / link).exists()]
        missing += [f"{one.name}: {name}" for name in named if not (repository / name).exists()]
    assert seen > 100
    assert missing == []


def test_the_page_lists_every_tool(repository: Path) -> None:
    listed = set()
    for cell in re.findall(r"^\| (`.*?) \|", page(repository).partition("## The tools")[2], re.MULTILINE):
        family = ""
        for name in re.findall(r"`([\w.]+)`", cell):
            family = family if name.startswith(".") else name.rpartition(".")[0]
            listed.add(family + name if name.startswith(".") else name)
    assert len(TOOLS) > 20
    assert listed == set(TOOLS)


def test_every_tools_parser_describes_the_tool() -> None:
    for tool in TOOLS:
        place = FOLDER.joinpath(*tool.split("."))
        tree = ast.parse((place / "__main__.py" if place.is_dir() else place.with_suffix(".py")).read_text())
        calls = [node for node in ast.walk(tree) if isinstance(node, ast.Call)]
        parsers = [call for call in calls if ast.unparse(call.func).endswith("ArgumentParser")]
        described = any(word.arg == "description" for parser in parsers for word in parser.keywords)
        assert described or any(ast.unparse(call).startswith("options(__doc__") for call in calls), tool


@pytest.mark.long(4, "each of 71 tools is run for its --help; the quick run looks at their parsers")
@pytest.mark.parametrize("tool", TOOLS)
def test_every_tool_says_how_it_is_used(
    tool: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(sys, "argv", [tool, "--help"])
    monkeypatch.delitem(sys.modules, f"tools.{tool}", raising=False)  # it is to run as its command does
    with pytest.raises(SystemExit) as ended:
        runpy.run_module(f"tools.{tool}", run_name="__main__")
    assert ended.value.code == 0
    usage, _, rest = capsys.readouterr().out.partition("\n\n")
    assert usage.startswith("usage:")
    assert not rest.startswith(("options:", "positional arguments:")), "it does not say what it does"


@pytest.mark.parametrize("room", ["dynamixel", "flir_ptu", "servo_bus"])
def test_a_driver_waits_on_the_clock_that_it_is_given_and_on_nothing_beside_it(
    room: str, repository: Path
) -> None:
    beside = re.compile(
        r"^import time$|^from (?:time|queue) |threading\.(?:Thread|Event|Condition|Timer|Semaphore)", re.M
    )
    files = sorted((repository / "drivers" / room).glob("*.py"))
    assert len(files) > 5
    assert {file.name: found for file in files if (found := beside.findall(file.read_text()))} == {}


@pytest.fixture(scope="module")
def packages() -> list[Package]:
    return [read_package(name) for name in PACKAGES]


def test_no_room_imports_upwards_or_in_a_circle(packages: list[Package]) -> None:
    for package in packages:
        assert package.circles == [], package.name


def test_the_picture_of_the_rooms_is_the_one_of_the_code(repository: Path, packages: list[Package]) -> None:
    picture = (repository / "docs" / "img" / "rooms.svg").read_text()
    assert picture == drawn(packages), "run python -m tools.rooms --svg"


def test_a_library_whose_inner_classes_are_subclassed_is_bounded_above(repository: Path) -> None:
    project = tomllib.loads((repository / "pyproject.toml").read_text())["project"]
    (server,) = [one for one in project["dependencies"] if one.startswith("uvicorn")]
    assert re.fullmatch(r"uvicorn>=0\.\d+,<0\.\d+", server), "a minor version may change what is inner"
