"""What the code imports is declared in pyproject.toml, and what only developers need is not in the wheel."""

from __future__ import annotations

import ast
import sys
import tomllib
from importlib.metadata import packages_distributions
from pathlib import Path
from typing import Any

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

PRODUCT = ("mastctl", "drivers", "calib")
DEVELOPMENT = ("hil_tests", "tools")
GIVEN = {
    *("rclpy", "builtin_interfaces", "diagnostic_msgs", "geometry_msgs", "sensor_msgs"),
    *("std_msgs", "std_srvs", "trajectory_msgs"),  # ROS 2 brings these
    "mrcal",  # Debian's package
    "bench_rig",  # a package that a test installs
}


@pytest.fixture(scope="module")
def project(repository: Path) -> dict[str, Any]:
    return tomllib.loads((repository / "pyproject.toml").read_text())


def imported(repository: Path, folders: tuple[str, ...]) -> dict[str, Path]:
    """Packages from outside that modules import, by the name that is imported, with one place of each."""
    own = {file.stem for folder in DEVELOPMENT for file in (repository / folder).rglob("*.py")}
    found = {}
    for file in (file for folder in folders for file in (repository / folder).rglob("*.py")):
        for node in ast.walk(ast.parse(file.read_bytes())):
            names = [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
            if isinstance(node, ast.ImportFrom) and node.level == 0:
                names = [node.module or ""]
            found.update({name.split(".")[0]: file for name in names})
    known = {*sys.stdlib_module_names, *PRODUCT, *DEVELOPMENT, *GIVEN, *own}
    return {name: file for name, file in found.items() if name not in known}


def names(*lists: list[str]) -> set[str]:
    return {canonicalize_name(Requirement(one).name) for each in lists for one in each}


def undeclared(packages: dict[str, Path], declared: set[str]) -> list[str]:
    by_import = {**packages_distributions(), "google": ["protobuf"]}
    return [
        f"{file.name}: {name}"
        for name, file in packages.items()
        if not declared & {canonicalize_name(one) for one in by_import.get(name, ())}
    ]


def test_each_package_that_the_product_imports_is_declared(repository: Path, project: dict[str, Any]) -> None:
    extras = project["project"]["optional-dependencies"].values()
    declared = names(project["project"]["dependencies"], *extras)
    found = imported(repository, PRODUCT)
    del found["pytest"]  # the plug-in: pytest itself loads it
    assert undeclared(found, declared) == []


def test_each_package_that_tests_and_tools_import_is_declared(
    repository: Path, project: dict[str, Any]
) -> None:
    extras = project["project"]["optional-dependencies"].values()
    declared = names(project["project"]["dependencies"], *extras, project["dependency-groups"]["dev"])
    assert undeclared(imported(repository, DEVELOPMENT), declared) == []


def test_the_package_has_no_extra_for_its_developers(project: dict[str, Any]) -> None:
    assert "dev" not in project["project"]["optional-dependencies"]
    extras = project["project"]["optional-dependencies"].values()
    assert not names(*extras) & {"pytest", "ruff", "mypy", "hatchling", "build"}


def test_the_lock_holds_every_requirement_by_its_digest(repository: Path, project: dict[str, Any]) -> None:
    lock = (repository / "requirements.lock").read_text()
    extras = project["project"]["optional-dependencies"].values()
    everything = names(project["project"]["dependencies"], *extras, project["dependency-groups"]["dev"])
    locked = {line.split("==")[0]: line for line in lock.splitlines() if "==" in line and line[0].isalnum()}
    assert everything <= set(locked)
    assert all(line.endswith("\\") for line in locked.values()), "digests follow"
