"""Deadlines of commands on a simulated head that never arrives, and stops in between."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import pytest

from hil_tests.mastctl.service.test_rover_time import configured
from hil_tests.waiting import present, until
from mastctl.client import Client
from mastctl.daemon import RunningDaemon

FAR: dict[str, Any] = {"pan_rad": 1.2, "tilt_rad": 0.2}


@pytest.fixture(scope="module")
def rover() -> Iterator[tuple[RunningDaemon, Client]]:
    with RunningDaemon(configured("max")) as daemon, Client(daemon.url) as client:
        yield daemon, client


@pytest.fixture(autouse=True)
def healthy(rover: tuple[RunningDaemon, Client]) -> Iterator[None]:
    rover[1].clear_faults()
    rover[1].wait(rover[1].point(pan_rad=0.0, tilt_rad=0.0))
    yield
    rover[1].clear_faults()


def rests(daemon: RunningDaemon) -> bool:
    return not daemon.service.devices.read().moving


@pytest.mark.parametrize(("word", "how"), [("stuck", {}), ("slow", {"factor": 0.02})])
def test_a_head_that_does_not_arrive_in_time_is_stopped(
    rover: tuple[RunningDaemon, Client], word: str, how: dict[str, float]
) -> None:
    daemon, client = rover
    client.set_fault("pan_tilt", word, **how)
    began_s = client.simulation_time()["now_s"]
    record = client.wait(client.point(**FAR, deadline_s=1.0))
    assert (record["state"], present(record["error"])["code"]) == ("failed", "deadline_passed")
    assert "1 s it was given" in present(record["error"])["message"]
    assert present(record["ended_s"]) - began_s == pytest.approx(1.0, abs=0.3)
    client.advance(30.0)  # a slow head brakes slowly too
    until(lambda: rests(daemon), "the head rests")
    assert daemon.service.devices.read().pan_rad < 0.5
    client.clear_faults()
    assert client.wait(client.point(**FAR))["state"] == "done"
