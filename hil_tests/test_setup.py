"""A demo's environment is a part of the developers', and becomes it without anything being fetched twice."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import tomllib
from importlib.metadata import PackageNotFoundError, requires
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

INPUTS = ("requirements.lock", "requirements-demo.txt", "pyproject.toml", "tools/setup")

PYTHON = """#!/bin/sh
echo "$*" >> "$LOG"
case "$*" in
    "-m venv .venv") mkdir -p .venv/bin && cp "$PYTHON" .venv/bin/python ;;
    "-m pip download"*) [ -z "$OFFLINE" ] && mkdir -p .venv/wheels ;;
esac
"""
"""Stands for Python and pip: writes down what it was asked for."""


@pytest.fixture
def checkout(repository: Path, tmp_path: Path) -> Path:
    (tmp_path / "tools").mkdir()
    for name in INPUTS:
        shutil.copy(repository / name, tmp_path / name)
    (tmp_path / "python").write_text(PYTHON)
    (tmp_path / "python").chmod(0o755)
    return tmp_path


def set_up(checkout: Path, *profile: str, offline: bool = False) -> list[str]:
    """Set up, and return what Python was asked for but to look whether it can do it."""
    log = checkout / "log"
    log.write_text("")
    environment = {"PATH": os.environ["PATH"], "PYTHON": str(checkout / "python"), "LOG": str(log)}
    done = subprocess.run(
        ["tools/setup", *profile], cwd=checkout, env=environment | ({"OFFLINE": "1"} if offline else {}),
        capture_output=True, timeout=60, check=False,
    )  # fmt: skip
    assert (done.returncode != 0) == offline, done.stderr
    return [line for line in log.read_text().splitlines() if re.match(r"-m (venv|pip)", line)]


def fetched(asked: list[str]) -> list[str]:
    """The lists of packages that were fetched."""
    return [line.split(" -r ")[1].split()[0] for line in asked if line.startswith("-m pip download")]


def test_a_demo_fetches_its_part_and_tests_add_theirs_to_it(checkout: Path) -> None:
    asked = set_up(checkout, "demo")
    assert asked[0] == "-m venv .venv" and fetched(asked) == [".venv/demo.lock"]
    assert (checkout / "log").read_text().endswith("\n-\n"), "at last it compiles what draws pictures"
    (checkout / ".venv/wheels/numba.whl").touch()
    assert set_up(checkout, "demo") == []
    asked = set_up(checkout)
    assert "-m venv .venv" not in asked and fetched(asked) == ["requirements.lock"]
    assert (checkout / ".venv/wheels/numba.whl").exists()  # pip finds it there, and fetches it no more
    assert set_up(checkout, "demo") == set_up(checkout, "dev") == []


def test_what_was_interrupted_is_taken_up_again(checkout: Path) -> None:
    set_up(checkout, "demo", offline=True)
    assert fetched(set_up(checkout, "demo")) == [".venv/demo.lock"]
    set_up(checkout, offline=True)
    assert set_up(checkout, "demo") == []
    assert fetched(set_up(checkout)) == ["requirements.lock"]


def test_a_demo_with_other_packages_leaves_developers_their_tools(checkout: Path) -> None:
    set_up(checkout)
    (checkout / "requirements.lock").write_text("# other packages\n")
    assert fetched(set_up(checkout, "demo")) == ["requirements.lock"]


@pytest.mark.parametrize("changed", INPUTS)
def test_with_other_packages_it_begins_anew(checkout: Path, changed: str) -> None:
    set_up(checkout)
    first, rest = (checkout / changed).read_text().split("\n", 1)
    (checkout / changed).write_text(f"{first}\n# changed\n{rest}")
    assert set_up(checkout, "demo")[0] == "-m venv .venv"


def test_a_setting_of_a_tool_sets_nothing_up_anew(checkout: Path) -> None:
    set_up(checkout)
    with (checkout / "pyproject.toml").open("a") as file:
        file.write('\n[tool.ruff.lint.isort]\nknown-first-party = ["tools"]\n')
    assert set_up(checkout) == []


def entries(text: str) -> dict[str, set[str]]:
    """Versions, marks and digests by name."""
    found: dict[str, set[str]] = {}
    for entry in re.split(r"^(?=[^\s#])", text, flags=re.MULTILINE)[1:]:
        lines = [line.strip() for line in entry.splitlines() if not line.strip().startswith("#")]
        found.setdefault(entry.split("==")[0], set()).add(" ".join(lines))
    return found


def test_what_a_demo_fetches_is_in_the_lock_to_the_digest(checkout: Path) -> None:
    set_up(checkout, "demo")
    part = entries((checkout / ".venv/demo.lock").read_text())
    whole = entries((checkout / "requirements.lock").read_text())
    assert set(part) == set((checkout / "requirements-demo.txt").read_text().split())
    assert part.items() <= whole.items() and len(part) < len(whole)


def test_a_demo_has_all_that_its_packages_require(repository: Path) -> None:
    """By what the installed packages say; tools/lock makes the list."""
    listed = set((repository / "requirements-demo.txt").read_text().split())
    project = tomllib.loads((repository / "pyproject.toml").read_text())["project"]
    extras = project["optional-dependencies"]
    todo = [*project["dependencies"], *extras["sim"], *extras["report"], "hatchling", "editables"]
    seen: set[str] = set()
    while todo:
        requirement = Requirement(todo.pop())
        name = canonicalize_name(requirement.name)
        wanted = requirement.marker is None or requirement.marker.evaluate({"extra": ""})
        if wanted and name not in seen:
            seen.add(name)
            try:
                todo += requires(name) or []
            except PackageNotFoundError:
                pytest.fail(f"{name} is not installed")
    assert seen <= listed
