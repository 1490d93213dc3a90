"""Which real head the bench suite moves."""

from __future__ import annotations

import pytest

from hil_tests.bench import hardware_rig


def pytest_configure(config: pytest.Config) -> None:
    """Remember --hardware for the time when the tests are collected."""
    hardware_rig.CHOSEN = config.getoption("--hardware")
