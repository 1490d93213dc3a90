"""Exposures stay as they are while an operation runs: pictures of one measurement must be alike."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import pytest
from service_fakes import FakeHardware, rig

from drivers.clock import SystemClock
from mastctl.devices import Devices
from mastctl.limits import Limits


def test_cameras_that_can_hold_their_exposure_are_asked_to(monkeypatch: pytest.MonkeyPatch) -> None:
    hardware = FakeHardware()
    told: list[str] = []
    names = list(hardware.cameras)
    holding = hardware.cameras[names[0]]

    @contextmanager
    def exposure_held() -> Iterator[None]:
        told.append("held")
        try:
            yield
        finally:
            told.append("released")

    monkeypatch.setattr(holding, "exposure_held", exposure_held, raising=False)
    devices = Devices(hardware, Limits((-2.0, 2.0), (-1.0, 1.0), 0.5), "0" * 64, SystemClock(), rig())
    try:
        with pytest.raises(ZeroDivisionError), devices.exposure_held():
            assert told == ["held"]
            raise ZeroDivisionError
        assert told == ["held", "released"]
    finally:
        devices.close()
