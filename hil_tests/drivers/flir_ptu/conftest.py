"""Heads on scripted units."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack

import pytest

from hil_tests.drivers.flir_ptu.ptu_bench import Bench


@pytest.fixture
def opened(request: pytest.FixtureRequest) -> Iterator[Bench]:
    """A bench in memory, or of the kind that a test is parametrized with."""
    with ExitStack() as stack:
        yield Bench(stack, getattr(request, "param", "memory") == "pty")
