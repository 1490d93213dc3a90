"""A jog and a stop from two clients: what was under way goes on for nobody until its client begins anew."""

from __future__ import annotations

import httpx
import pytest

from hil_tests.mastctl.service_fakes import FakeHardware
from hil_tests.waiting import NET_S, until
from mastctl.daemon import RunningDaemon
from mastctl.motion import jog as jog_module
from mastctl.safety.stop_socket import request

RATES = {"pan_rad_per_s": 0.2, "tilt_rad_per_s": 0.0}
Pair = tuple[RunningDaemon, FakeHardware]


@pytest.fixture
def endless(monkeypatch: pytest.MonkeyPatch) -> None:
    """However slow this machine is, heartbeats of one test follow each other in time."""
    monkeypatch.setattr(jog_module, "PATIENCE_S", NET_S)


def moves(hardware: FakeHardware) -> int:
    return sum(1 for call in hardware.head.calls if call[0] == "move")


def beat(web: httpx.Client, number: int) -> str:
    """Send a heartbeat without an id; return why it was refused, or ``''``."""
    answer = web.post("/jog", json={**RATES, "sequence": number})
    return "" if answer.status_code == 200 else str(answer.json()["error"]["code"])


@pytest.mark.usefixtures("endless")
def test_a_stop_by_its_socket_ends_a_jog_though_nameless_heartbeats_go_on(
    pair: Pair, web: httpx.Client
) -> None:
    socket = pair[0].service.stop_socket
    assert socket is not None
    before = moves(pair[1])
    assert beat(web, 1) == ""
    until(lambda: moves(pair[1]) > before, "the jog's first goal")
    assert request(socket.path, "stop")["stopped"]
    before = moves(pair[1])
    for number in range(2, 6):
        assert beat(web, number) in ("jog_ended", "stopping")
    assert moves(pair[1]) == before, "a heartbeat of the jog that was stopped moved the head"
