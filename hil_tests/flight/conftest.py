"""The measuring parts of `tools.flight.validation`, as docs/evidence/validation.md reports them."""

from __future__ import annotations

from pathlib import Path
from types import ModuleType

import pytest

from tools.flight import mer as mer_labels
from tools.flight import msl as msl_labels


@pytest.fixture(scope="session")
def msl() -> ModuleType:
    """What `tools.flight.msl` measures."""
    return msl_labels


@pytest.fixture(scope="session")
def mer() -> ModuleType:
    """What `tools.flight.mer` measures."""
    return mer_labels


@pytest.fixture(scope="session")
def msl_folder(reference_data: Path) -> Path:
    """Labels of Curiosity's Navcams."""
    return reference_data / "msl_navcam"


@pytest.fixture(scope="session")
def mer_folder(reference_data: Path) -> Path:
    """Frames of Opportunity's Navcam."""
    return reference_data / "mer_navcam"
