"""Deadlines of commands on a simulated head that never arrives, and stops in between."""

from __future__ import annotations

import threading
from collections.abc import Iterator

import pytest

from hil_tests.mastctl.service.test_rover_time import configured
from hil_tests.waiting import until
from mastctl.client import Client
from mastctl.daemon import RunningDaemon
from mastctl.devices.limits import Limits
from mastctl.motion.requests import AnglesTarget, PointRequest
from mastctl.service.steering import usual_s

FAR = {"pan_rad": 1.2, "tilt_rad": 0.2}


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
def test_a_head_that_does_not_arrive_in_time_is_stopped_and_the_deadline_is_told(
    rover: tuple[RunningDaemon, Client], word: str, how: dict[str, float]
) -> None:
    daemon, client = rover
    client.set_fault("pan_tilt", word, **how)
    began_s = client.simulation_time()["now_s"]
    record = client.wait(client.point(**FAR, deadline_s=1.0))
    assert (record["state"], record["error"]["code"]) == ("failed", "deadline_passed")
    assert "1 s it was given" in record["error"]["message"]
    assert record["ended_s"] - began_s == pytest.approx(1.0, abs=0.3)
    client.advance(30.0)  # a slow head brakes slowly too
    until(lambda: rests(daemon), "the head rests")
    assert daemon.service.devices.read().pan_rad < 0.5
    client.clear_faults()
    assert client.wait(client.point(**FAR))["state"] == "done"


def test_the_loops_own_deadline_says_more_and_comes_before_the_usual_one(
    rover: tuple[RunningDaemon, Client],
) -> None:
    rover[1].set_fault("pan_tilt", "stuck")
    record = rover[1].wait(rover[1].point(**FAR))
    assert record["error"]["code"] == "did_not_arrive"


def test_a_stop_before_the_deadline_is_what_is_told(rover: tuple[RunningDaemon, Client]) -> None:
    daemon, client = rover
    client.set_fault("pan_tilt", "slow", factor=0.001)
    service = daemon.service
    with service.clock.at_work():  # no time passes: neither the deadline nor the loop's own comes
        operation = service.steering.point(PointRequest(AnglesTarget(**FAR)), {}).id
        service.operations.end_within(operation, 3600.0, 3600.0)
        service.stopping.stop()
    assert client.wait(operation)["error"]["code"] == "stopped"
    watch = f"deadline of {operation}"
    until(lambda: all(one.name != watch for one in threading.enumerate()), "the watch's end")
    assert daemon.service.operations.running is None


def test_a_deadline_is_of_its_own_operation_and_not_of_the_next(
    rover: tuple[RunningDaemon, Client],
) -> None:
    client = rover[1]
    for _ in range(5):
        client.wait(client.point(pan_rad=0.05, tilt_rad=0.0, deadline_s=30.0))
        client.wait(client.point(pan_rad=0.0, tilt_rad=0.0, deadline_s=30.0))
    client.advance(60.0)
    assert client.wait(client.point(**FAR))["state"] == "done"


def test_the_usual_time_is_from_the_longest_way_and_the_speed() -> None:
    limits = Limits((-2.0, 2.0), (-1.0, 1.0), 0.5)
    assert usual_s(limits, 0) == pytest.approx(6.0 / 0.5 + 15.0)
    assert usual_s(limits, 2) == pytest.approx(2 * (12.0 + 120.0) + 15.0)
