"""Keep-outs in the whole service: a pointing through one is refused with the nearest free goal."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import pytest

from hil_tests.waiting import until
from mastctl.config import load_config
from mastctl.devices.keep_out import Box, KeptOut
from mastctl.motion.requests import PointRequest
from mastctl.service.service import Service

DECK = Box("deck", (-0.5, 0.5), (-1.2, -0.4))
WALL = Box("wall", (1.5, 1.6), (-1.3, 1.6))


@pytest.fixture
def service() -> Iterator[Service]:
    config = load_config()
    simulation = {**config.hardware.simulation, "speed": "max", "samples": 1}
    hardware = replace(config.hardware, simulation=simulation, cameras={})
    limits = replace(config.limits, margin_rad=0.02, keep_out=(DECK, WALL))
    made = Service.open(replace(config, hardware=hardware, limits=limits))
    yield made
    made.close()


def pointed(service: Service, pan_rad: float, tilt_rad: float) -> Any:
    name = service.steering.point(PointRequest(pan_rad=pan_rad, tilt_rad=tilt_rad)).id
    until(lambda: service.operations.get(name).ended_s is not None, f"the end of operation {name}")
    return service.operations.get(name).as_json()


def test_a_pointing_through_a_keep_out_names_it_and_a_free_goal(service: Service) -> None:
    before = service.devices.read()
    record = pointed(service, 2.0, 0.0)
    assert record["state"] == "failed" and record["error"]["code"] == "keep_out"
    assert "may pass the keep-out wall" in record["error"]["message"]
    assert "the nearest goal that is free from there is pan 1.478, tilt 0 rad" in record["error"]["message"]
    assert service.devices.read().pan_rad == before.pan_rad
    assert pointed(service, 1.478, 0.0)["state"] == "done"
    with pytest.raises(KeptOut, match="keep-out deck"):
        service.steering.point(PointRequest(pan_rad=0.0, tilt_rad=-0.5))


def test_a_head_in_a_keep_out_is_a_fault_and_may_only_leave_it(service: Service) -> None:
    rover = service.hardware.simulation
    assert rover is not None
    rover.pan_tilt.move(0.2, -0.45)  # by hand
    service.clock.sleep(5.0)
    pan_rad = service.devices.read().pan_rad
    assert "in_keep_out" in [fault.code for fault in service.devices.faults()]
    record = pointed(service, 0.0, 0.2)
    assert record["error"]["code"] == "keep_out"
    assert "the one move that is taken from there is out, to" in record["error"]["message"]
    assert pointed(service, pan_rad, 0.2)["state"] == "done"
    assert "in_keep_out" not in [fault.code for fault in service.devices.faults()]
