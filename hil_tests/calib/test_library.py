"""calib as a library: its names, what importing it costs, and every example of its page."""

from __future__ import annotations

import ast
import doctest
import re
import subprocess
import sys
from pathlib import Path

import pytest

import calib

HEAVY = ("numpy", "scipy", "cv2", "yaml")


def page(repository: Path) -> str:
    return (repository / "docs" / "reference" / "calib.md").read_text()


def in_blocks(text: str) -> str:
    """The text of the Python blocks alone, each on the lines that it has on the page."""
    lines, inside = [], False
    for line in text.split("\n"):
        if line.startswith("```"):
            inside = line == "```python"
            line = ""
        lines.append(line if inside else "")
    return "\n".join(lines)


def loaded_after(statement: str) -> set[str]:
    """Which of the heavy libraries a fresh interpreter has loaded after a statement."""
    code = f"import sys, calib; {statement}; print(*(set({HEAVY}) & sys.modules.keys()))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60)
    assert done.returncode == 0, done.stderr
    return set(done.stdout.split())


def test_importing_calib_loads_no_other_library() -> None:
    assert loaded_after("pass") == set()
    assert loaded_after("dir(calib)") == set()


def test_a_name_loads_no_more_than_it_needs() -> None:
    assert loaded_after("calib.solve, calib.triangulate, calib.hand_off, calib.CameraModel") == {"numpy"}
    assert loaded_after("calib.load_rig, calib.read_survey") == {"numpy", "yaml"}


def test_every_name_is_there_and_is_the_one_of_its_module() -> None:
    assert dir(calib) == sorted(set(dir(calib)))
    assert 20 < len(dir(calib)) < 35
    for name in dir(calib):
        found = getattr(calib, name)
        assert found.__name__ == name
        assert found.__doc__
        assert getattr(sys.modules[found.__module__], name) is found


def test_an_unknown_name_is_refused_as_any_module_does() -> None:
    with pytest.raises(AttributeError, match="module 'calib' has no attribute 'nothing'"):
        _ = calib.nothing  # type: ignore[attr-defined]


def test_a_type_checker_sees_the_same_names_from_the_same_modules() -> None:
    [block] = [node for node in ast.parse(Path(calib.__file__).read_text()).body if _for_types(node)]
    assert isinstance(block, ast.If)
    typed = {
        alias.asname: node.module
        for node in block.body
        if isinstance(node, ast.ImportFrom)
        for alias in node.names
        if alias.asname == alias.name  # else it is not handed on
    }
    assert typed == {name: getattr(calib, name).__module__ for name in dir(calib)}


def _for_types(node: ast.stmt) -> bool:
    return isinstance(node, ast.If) and isinstance(node.test, ast.Name) and node.test.id == "TYPE_CHECKING"


def test_the_page_shows_every_name_in_an_example(repository: Path) -> None:
    examples = in_blocks(page(repository))
    for name in dir(calib):
        assert re.search(rf"calib\.{name}\b", examples), name


def test_every_example_of_the_page_gives_what_it_says(
    repository: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "configs").symlink_to(repository / "configs")
    monkeypatch.chdir(tmp_path)
    text = in_blocks(page(repository))
    test = doctest.DocTestParser().get_doctest(
        text, {}, "docs/reference/calib.md", "docs/reference/calib.md", 0
    )
    assert len(test.examples) > 50
    told: list[str] = []
    runner = doctest.DocTestRunner()
    assert runner.run(test, out=told.append).failed == 0, "".join(told)


@pytest.mark.parametrize("name", dir(calib))
def test_the_example_of_a_docstring_gives_what_it_says(name: str) -> None:
    told: list[str] = []
    runner = doctest.DocTestRunner()
    for test in doctest.DocTestFinder(recurse=False).find(getattr(calib, name), name):
        assert runner.run(test, out=told.append).failed == 0, "".join(told)
