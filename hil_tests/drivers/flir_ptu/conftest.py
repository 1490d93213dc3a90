"""Heads on scripted units."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack

import pytest

from hil_tests.drivers.flir_ptu.scripted_ptu import Bench


@pytest.fixture
def opened() -> Iterator[Bench]:
    with ExitStack() as stack:
        yield Bench(stack)
