"""Keep-outs in the whole service: a pointing goes round by corners, or says why it cannot."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import pytest

from hil_tests.waiting import until
from mastctl.config import load_config
from mastctl.devices.keep_out import Box, KeptOut
from mastctl.motion.requests import AnglesTarget, PointRequest
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


def pointed(service: Service, pan_rad: float, tilt_rad: float) -> dict[str, Any]:
    name = service.steering.point(PointRequest(AnglesTarget(pan_rad, tilt_rad)), {}).id
    until(lambda: service.operations.get(name).ended_s is not None, f"the end of operation {name}")
    return service.operations.get(name).told()


def test_a_pointing_goes_round_a_keep_out_and_arrives(service: Service) -> None:
    assert pointed(service, -0.8, -0.6)["state"] == "done"
    record = pointed(service, 0.8, -0.6)
    assert record["state"] == "done", record["error"]
    steps = [step["name"] for step in record["steps"]]
    assert steps.count("corner") == 2 and steps[-2:] == ["move", "settle"]
    for step in record["steps"]:
        if step["name"] == "corner":
            assert step["detail"]["tilt_rad"] >= -0.4 + 0.02
    reading = service.devices.read()
    assert (reading.pan_rad, reading.tilt_rad) == pytest.approx((0.8, -0.6), abs=1e-3)


def test_what_cannot_be_reached_is_said_with_the_keep_outs_names(service: Service) -> None:
    record = pointed(service, 2.0, 0.0)
    assert record["state"] == "failed" and record["error"]["code"] == "no_way"
    assert "(deck, wall) within the limits" in record["error"]["message"]
    with pytest.raises(KeptOut, match="keep-out deck"):
        service.steering.point(PointRequest(AnglesTarget(0.0, -0.5)), {})


def test_a_head_in_a_keep_out_is_a_fault_and_a_pointing_leads_it_out_first(service: Service) -> None:
    rover = service.hardware.simulation
    assert rover is not None
    rover.pan_tilt.move(0.2, -0.45)  # by hand
    service.clock.sleep(5.0)
    service.devices.read()
    assert "in_keep_out" in [fault.code for fault in service.devices.faults()]
    record = pointed(service, 0.0, 0.2)
    assert record["state"] == "done", record["error"]
    (corner,) = [step["detail"] for step in record["steps"] if step["name"] == "corner"]
    assert corner["pan_rad"] == pytest.approx(0.2, abs=1e-3) and corner["tilt_rad"] > -0.4
    assert "in_keep_out" not in [fault.code for fault in service.devices.faults()]
