"""A clock that is turned, fake hardware on it, and its devices."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from hil_tests.mastctl.devices.turned import DIGEST, LIMITS, Turned
from hil_tests.mastctl.service_fakes import FakeHardware, rig
from mastctl.devices.devices import Devices


@pytest.fixture
def clock() -> Turned:
    return Turned()


@pytest.fixture
def hardware(clock: Turned) -> FakeHardware:
    return FakeHardware(clock=clock)


@pytest.fixture
def devices(hardware: FakeHardware, clock: Turned) -> Iterator[Devices]:
    made = Devices(hardware.pan_tilt, hardware.cameras, LIMITS, DIGEST, clock, rig())
    with clock.at_work():
        made.read()
        yield made
    hardware.head.hook = lambda name: None
    made.close()
