"""Names and paths of this repository in its pages, docstrings and comments are of things that are there."""

from __future__ import annotations

import ast
import importlib
import inspect
import io
import re
import subprocess
import tokenize
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from types import ModuleType

import pytest

PACKAGES = ("calib", "drivers", "mastctl", "tools", "hil_tests")
NAME = re.compile(rf"(?<![\w./@-])(?:{'|'.join(PACKAGES)})(?:\.[A-Za-z_]\w*)+(?![\w/@-])")
FOLDERS = (*PACKAGES, "configs", "docs")
PATH = re.compile(rf"(?<![\w./-])(?:{'|'.join(FOLDERS)})/(?!\w+/\d+\b)[\w./*-]*[\w*/]")
"""Not a schema's name, ``mastctl/mast/1``."""
OTHERS = re.compile(
    r"mastctl\.(service|heads|cameras|launch\.py|rules\.test\.yaml)|drivers\.md|tools\.(studies\.)?NAME|calib\.code"
)
"""A unit of systemd, groups of entry points, files; any tool; a module that a test writes."""
NOT_HERE = re.compile(
    r"docs/_build.*|docs/en/dxl/.*|docs/(reference|tutorials)/generated.*|mastctl/(configs|site)\b.*|configs/masts/(rover|none)\.yaml"
    r"|configs/schemas/NAME\.json"
)
"""What tools/docs makes; where the wheel has configs and the site; files of an example."""


def texts(repository: Path) -> Iterator[tuple[str, str]]:
    """Yield each page, and what each module says beside its code, with where it is."""
    listed = subprocess.run(["git", "ls-files"], cwd=repository, capture_output=True, text=True, check=True)
    for name in listed.stdout.split("\n"):
        file = repository / name
        if not file.is_file():
            continue
        if name.endswith((".md", ".toml", ".ipynb")) or name.startswith(".ci/"):
            yield name, file.read_text(encoding="utf-8")
        elif name.endswith(".py"):
            yield name, beside_code(file.read_text(encoding="utf-8"))


def beside_code(source: str) -> str:
    """Return the comments and the strings of several lines or words, each with what follows it on a line."""
    found = []
    for token in tokenize.generate_tokens(io.StringIO(source).readline):
        if token.type == tokenize.COMMENT or (token.type == tokenize.STRING and '"""' in token.string):
            found.append(token.string)
    return "\n".join(found)


@cache
def module(name: str) -> ModuleType | None:
    """Return a module of this repository, None if there is none of this name."""
    base = Path(__file__).parents[1].joinpath(*name.split("."))
    if not (base.with_suffix(".py").is_file() or base.is_dir()):
        return None
    try:
        return importlib.import_module(name)
    except ImportError:  # needs what is not installed here, such as rclpy
        return ModuleType(name)


def resolves(name: str) -> bool:
    """Return whether a dotted name is a module, or something in one."""
    parts = name.split(".")
    at = max(size for size in range(1, len(parts) + 1) if module(".".join(parts[:size])) is not None)
    found: object = module(".".join(parts[:at]))
    for part in parts[at:]:
        if isinstance(found, type) and is_attribute(found, part):
            return True
        if not hasattr(found, part):
            return False
        found = getattr(found, part)
    return True


def is_attribute(kind: type, name: str) -> bool:
    """Return whether a class's objects have an attribute: a field, or one that its methods set."""
    if any(name in vars(one).get("__annotations__", {}) for one in kind.__mro__):
        return True
    return any(
        f"self.{name}" in inspect.getsource(one)
        for one in kind.__mro__
        if one.__module__.split(".")[0] in PACKAGES
    )


def test_every_dotted_name_in_a_page_or_docstring_is_there(repository: Path) -> None:
    wrong, seen = [], 0
    for where, text in texts(repository):
        for name in NAME.findall(text):
            seen += 1
            if not OTHERS.fullmatch(name) and not resolves(name):
                wrong.append(f"{where}: {name}")
    assert seen > 400
    assert wrong == []


def test_every_path_in_a_page_or_docstring_is_there(repository: Path) -> None:
    wrong, seen = [], 0
    for where, text in texts(repository):
        for path in PATH.findall(text):
            seen += 1
            if not NOT_HERE.fullmatch(path) and not any(repository.glob(path.rstrip("/"))):
                wrong.append(f"{where}: {path}")
    assert seen > 200
    assert wrong == []


@pytest.mark.parametrize(
    ("name", "there"),
    [
        ("calib.adjust.solver.minimise", True),
        ("calib.adjust.solver.Problem", False),
        ("calib.survey.read_survey", False),
        ("mastctl.client.Client.point", True),
        ("mastctl.nowhere", False),
    ],
)
def test_a_name_that_is_gone_is_noticed(name: str, there: bool) -> None:
    assert resolves(name) == there


def test_no_public_class_of_the_product_has_anothers_name(repository: Path) -> None:
    found: dict[str, list[str]] = {}
    for path in (one for package in PACKAGES[:3] for one in (repository / package).rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
                found.setdefault(node.name, []).append(str(path.relative_to(repository)))
    assert {name: places for name, places in found.items() if len(places) > 1} == {}
