"""A clock that is turned, for the devices and their fakes."""

from __future__ import annotations

import pytest

from hil_tests.mastctl.devices.turned import Turned


@pytest.fixture
def clock() -> Turned:
    return Turned()
