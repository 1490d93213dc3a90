"""The measuring parts of tools/flight_validation.py, so that tests repeat what docs/validation.md reports."""

from __future__ import annotations

import importlib
import sys
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType

import pytest


@pytest.fixture(scope="session")
def flight_tools(repository: Path) -> Iterator[Path]:
    """The tools folder, importable while tests run."""
    folder = str(repository / "tools")
    sys.path.insert(0, folder)
    yield repository / "tools"
    sys.path.remove(folder)


@pytest.fixture(scope="session")
def msl(flight_tools: Path) -> ModuleType:
    """tools/flight_msl.py."""
    return importlib.import_module("flight_msl")


@pytest.fixture(scope="session")
def mer(flight_tools: Path) -> ModuleType:
    """tools/flight_mer.py."""
    return importlib.import_module("flight_mer")


@pytest.fixture(scope="session")
def msl_folder(shared_data: Path) -> Path:
    """Labels of Curiosity's Navcams."""
    return shared_data / "msl_navcam"


@pytest.fixture(scope="session")
def mer_folder(shared_data: Path) -> Path:
    """Frames of Opportunity's Navcam."""
    return shared_data / "mer_navcam"
