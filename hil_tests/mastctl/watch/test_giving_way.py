"""A lease that gives way, on a daemon: who comes is obeyed at once, also while the head moves for it."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from hil_tests.mastctl.watch.small_rover import small_rover
from hil_tests.waiting import until
from mastctl.client import Client, ClientError
from mastctl.daemon import RunningDaemon

BOUND_S = 60.0  # only ends a failing test
FAR_RAD = 1.6
"""Where the sentinel sends a head that would take minutes to get there."""


@pytest.fixture(scope="module")
def daemon(repository: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[RunningDaemon]:
    with small_rover(repository, tmp_path_factory.mktemp("giving way"), speed=1.0) as made:
        yield made


@pytest.fixture
def ana(daemon: RunningDaemon) -> Iterator[Client]:
    with Client(daemon.url, name="ana") as client:
        yield client
        client.use_lease(None)
        client.clear_faults()
        if client.status()["estop"] is not None:
            client.reset(reason="the test is over", name="ana")


@pytest.fixture
def moving(daemon: RunningDaemon, ana: Client) -> Iterator[tuple[Client, str]]:
    """A client under a lease that gives way, and its move, which is far from its goal."""
    ana.set_fault("pan_tilt", "slow", factor=0.02)
    with (
        Client(daemon.url, name="the sentinel's process") as sentinel,
        sentinel.lease("sentinel", for_s=60.0, preemptible=True),
    ):
        operation = sentinel.point(pan_rad=FAR_RAD, tilt_rad=-0.1)
        until(lambda: ana.status()["moving"], "the sentinel's move")
        ana.clear_faults()
        yield sentinel, operation


def refused(client: Client) -> str:
    with pytest.raises(ClientError) as refusal:
        client.point(pan_rad=-FAR_RAD, tilt_rad=-0.1)
    assert refusal.value.code == "lease_over"
    return str(refusal.value)


@pytest.mark.parametrize("by", ["point", "jog", "lease", "take"])
def test_who_comes_while_the_head_moves_is_obeyed_and_that_move_is_stopped(
    by: str, ana: Client, moving: tuple[Client, str]
) -> None:
    sentinel, operation = moving
    if by == "point":
        own = ana.point(pan_rad=0.1, tilt_rad=0.1)
        assert ana.wait(own, BOUND_S)["state"] == "done"
        joints = ana.status()["joints"]
        assert joints is not None and joints["pan_rad"] == pytest.approx(0.1, abs=0.01)
    elif by == "jog":
        with ana.jog() as jog:
            jog.rates(0.05, 0.0)
            until(lambda: sentinel.operation(operation)["state"] == "stopped", "the stop")
    else:
        granted = ana.acquire_lease(take_over="it is my turn" if by == "take" else None)
        ana.use_lease(granted["lease_id"])
    record = ana.wait(operation, BOUND_S)
    assert record["state"] == "stopped"
    assert "ana" in record["error"]["message"]
    assert "ana" in refused(sentinel)
    if by in ("lease", "take"):
        ana.release_lease()


@pytest.mark.parametrize("stop", ["stop", "estop"])
def test_a_stop_ends_it_too(stop: str, ana: Client, moving: tuple[Client, str]) -> None:
    sentinel, operation = moving
    getattr(ana, stop)()
    assert ana.wait(operation, BOUND_S)["state"] == "stopped"
    assert ana.control() is None
    assert "the head was stopped" in refused(sentinel)
