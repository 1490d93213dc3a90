"""Commands from outside: who steers, once and not twice, until when, and what is left of it."""

from __future__ import annotations

import json
import math
import socket
import threading
from collections.abc import Callable, Iterator
from datetime import datetime
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import httpx
import pytest

from hil_tests.mastctl.service_fakes import PLAIN, FakeHardware, ScriptedLoop, on_disk
from hil_tests.waiting import NET_S, present, until
from mastctl.client import Client, ClientError
from mastctl.daemon import RunningDaemon
from mastctl.errors import Stopped
from mastctl.safety.latch import MOST
from mastctl.safety.stop_socket import request

ANGLES: dict[str, Any] = {"pan_rad": 0.1, "tilt_rad": -0.1}
Pair = tuple[RunningDaemon, FakeHardware]


@pytest.fixture
def bench(pair: Pair) -> Iterator[Client]:
    with Client(pair[0].url, name="bench") as client:
        yield client


@pytest.fixture
def rover(pair: Pair) -> Iterator[Client]:
    with Client(pair[0].url, name="rover") as client:
        yield client


@pytest.fixture
def quiet(standing: Pair) -> Iterator[httpx.Client]:
    with httpx.Client(base_url=f"{standing[0].url}/api/v1", **PLAIN) as client:
        yield client


def refused(code: str, act: Callable[[], object]) -> ClientError:
    with pytest.raises(ClientError) as refusal:
        act()
    assert refusal.value.code == code
    return refusal.value


def waits(request: Any, record: Callable[[Any], None], cancelled: threading.Event, devices: Any) -> None:
    """A pointing that goes on until it is ended."""
    devices.move(0.1, -0.1)
    assert cancelled.wait(NET_S)
    raise Stopped("cancelled")


def moves(hardware: FakeHardware) -> int:
    return sum(call[0] == "move" for call in hardware.head.calls)


# Who steers


def test_while_one_program_has_the_lease_another_moves_nothing(
    bench: Client, rover: Client, pair: Pair
) -> None:
    with bench.lease(for_s=3600.0):
        for command in (
            lambda: rover.point(**ANGLES),
            lambda: rover.start_track(position_m=(5.0, 0.0, 0.0)),
            rover.look,
            rover.stop_track,
            lambda: rover.use_mast("little.yaml"),
            lambda: rover.request("POST", "/mast/back"),
            lambda: rover.acquire_lease(),
        ):
            error = refused("leased", command)
            assert error.detail is not None
            assert (error.detail["holder"], error.detail["kind"]) == ("bench", "lease")
        assert moves(pair[1]) == 0
        control = present(rover.status()["control"])
        assert (control["holder"], control["kind"]) == ("bench", "lease")
        assert 3600.0 - NET_S < present(control["for_s"]) <= 3600.0
        assert rover.control() is not None
        bench.wait(bench.point(**ANGLES))
    assert rover.status()["control"] is None
    rover.wait(rover.point(**ANGLES))
    assert moves(pair[1]) == 2


def test_a_stop_of_one_operation_leaves_others_and_their_leases_alone(
    monkeypatch: pytest.MonkeyPatch, pair: Pair, bench: Client, rover: Client
) -> None:
    ended = bench.point(**ANGLES)
    bench.wait(ended)
    monkeypatch.setattr(ScriptedLoop, "script", staticmethod(waits))
    with bench.lease(ends_with_stop=True):
        runs = bench.point(**ANGLES)
        stops = pair[1].head.calls.count(("stop",))
        assert rover.stop_operation(ended)["state"] == "done"
        assert pair[1].head.calls.count(("stop",)) == stops and bench.operation(runs)["state"] == "running"
        rover.stop_operation(runs)
        assert bench.wait(runs)["state"] == "stopped"
        assert pair[1].head.calls.count(("stop",)) > stops
        assert bench.control() is not None, "the lease goes on"
    refused("operation_unknown", lambda: rover.stop_operation("000009-none"))


def test_a_lease_in_use_is_renewed_and_released_at_the_end(bench: Client, pair: Pair) -> None:
    def until_s() -> float:
        control = pair[0].service.leases.control()
        return datetime.fromisoformat(present(present(control)["until"])).timestamp()

    with bench.lease(for_s=4.0):
        first_s = until_s()
        until(lambda: until_s() > first_s + 1.5, "two renewals")
    assert bench.control() is None


# Once and not twice


@pytest.mark.parametrize(
    ("path", "body"),
    [
        ("/limits/sun", {"azimuth_rad": math.pi, "elevation_rad": 0.0, "half_angle_rad": 0.1}),
        ("/pose", {"position_m": [0, 0, 0], "quaternion": [1, 0, 0, 0]}),
    ],
)
def test_a_head_under_way_into_what_comes_to_be_kept_out_is_stopped(
    web: httpx.Client, pair: Pair, monkeypatch: pytest.MonkeyPatch, path: str, body: dict[str, Any]
) -> None:
    monkeypatch.setattr(ScriptedLoop, "script", staticmethod(waits))
    name = web.post("/point", json=ANGLES).json()["id"]
    until(lambda: web.get(f"/operations/{name}").json()["state"] == "running", "it runs")
    assert web.post(path, json=body).status_code == 200
    assert web.get(f"/operations/{name}").json()["state"] == "running"
    judge = pair[0].service.devices.judge
    monkeypatch.setattr(judge, "in_the_way", lambda reading: "sun")
    assert web.post(path, json=body).status_code == 200
    until(lambda: web.get(f"/operations/{name}").json()["state"] == "stopped", "it is stopped")
    assert "keep-out sun" in web.get(f"/operations/{name}").json()["error"]["message"]
    assert ("stop",) in pair[1].head.calls


@pytest.mark.parametrize("path", ["/lease", "/lease/take"])
def test_nobody_shares_a_lease_by_a_key_without_a_name(web: httpx.Client, path: str) -> None:
    body = {"reason": "work"} if path.endswith("take") else {}
    for _ in range(2):
        answer = web.post(path, json=body, headers={"Idempotency-Key": "1", "Mastctl-Client": "anonymous"})
        assert (answer.status_code, present(answer.json()["error"])["code"]) == (422, "bad_request")
        assert "Mastctl-Client" in present(answer.json()["error"])["message"]
        assert "lease_id" not in answer.text
    assert web.get("/lease").json() == {"control": None}


class Dropping:
    """A way to the daemon on which answers are lost: ``drop`` of them, after the request went through."""

    def __init__(self, url: str, drop: int) -> None:
        self.drop = drop
        self._to = urlsplit(url)
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.url = f"http://127.0.0.1:{self._listener.getsockname()[1]}"
        threading.Thread(target=self._work, daemon=True).start()

    def _work(self) -> None:
        while True:
            try:
                came, _ = self._listener.accept()
            except OSError:
                return
            with came, socket.create_connection((self._to.hostname, self._to.port)) as on:  # type: ignore[arg-type]
                request = b""
                while b"\r\n\r\n" not in request or not request.endswith(b"}"):
                    request += came.recv(65536)
                on.sendall(request.replace(b"keep-alive", b"close"))
                answer = b""
                while part := on.recv(65536):
                    answer += part
                if self.drop:
                    self.drop -= 1
                else:
                    came.sendall(answer)

    def close(self) -> None:
        self._listener.close()


def test_a_command_whose_answer_is_lost_is_sent_again_and_carried_out_once(pair: Pair) -> None:
    daemon, hardware = pair
    way = Dropping(daemon.url, drop=2)
    with Client(way.url, name="bench") as client:
        operation = client.point(**ANGLES)
    way.close()
    assert way.drop == 0
    with Client(daemon.url) as client:
        client.wait(operation)
    assert [one.id for one in daemon.service.operations.all()] == [operation]
    assert moves(hardware) == 1


# Until when


def test_the_shorter_of_the_deadlines_of_header_and_body_counts(
    web: httpx.Client, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(ScriptedLoop, "script", staticmethod(waits))
    for header, body in (("0.1", 60.0), ("60", 0.1)):
        answer = web.post("/point", json={**ANGLES, "deadline_s": body}, headers={"Deadline-S": header})
        operation = answer.json()["id"]
        until(lambda op=operation: web.get(f"/operations/{op}").json()["error"], "the deadline")  # type: ignore[misc]
        assert web.get(f"/operations/{operation}").json()["error"]["code"] == "deadline_passed"


@pytest.mark.parametrize(
    ("deadline", "right"),
    [
        ("0", "a number above 0"),
        ("3601", "a finite number up to 3600"),
        ("nan", "a finite number up to 3600"),
        ("soon", "a number"),
    ],
)
def test_a_bad_deadline_is_refused_by_a_command_and_not_by_a_stop(
    quiet: httpx.Client, standing: Pair, deadline: str, right: str
) -> None:
    answer = quiet.post("/point", json=ANGLES, headers={"Deadline-S": deadline})
    assert answer.status_code == 422
    message = present(answer.json()["error"])["message"]
    assert message.startswith("deadline-s: ") and message.endswith(f" where {right} is expected")
    assert moves(standing[1]) == 0
    headers = {"Deadline-S": deadline, "Mastctl-Lease": "none", "Idempotency-Key": "\x7f" * 300}
    assert quiet.post("/stop", headers=headers).json()["stopped"]


# What is left of it


def test_every_route_that_changes_something_passes_the_entry(
    pair: Pair, web: httpx.Client, monkeypatch: pytest.MonkeyPatch
) -> None:
    none = {"/session", "/point/preview"}  # of the client, not of the rover; and what changes nothing
    document = web.get(f"{pair[0].url}/openapi.json").json()
    asked = {
        (method, path.removeprefix("/api/v1"))
        for path, methods in document["paths"].items()
        for method in methods
        if method in ("post", "put", "patch", "delete")
    }
    assert len(asked) > 15
    for method, path in sorted(asked):
        if path in none:
            continue
        if path in ("/stop", "/estop"):
            continue  # the tests of the stop's way ask for their lines
        names = {
            one["name"].lower() for one in document["paths"][f"/api/v1{path}"][method].get("parameters", ())
        }
        headers = {"mastctl-client", "mastctl-lease", "idempotency-key", "deadline-s"}
        assert headers <= names, (method, path)


def test_stops_over_http_and_over_their_own_socket_leave_their_lines(
    pair: Pair, bench: Client, tmp_path: Path
) -> None:
    service = pair[0].service
    service.open_stop_socket()
    path = service.folder.path / "audit.jsonl"
    assert service.stop_socket is not None
    assert request(service.stop_socket.path, "stop")["stopped"]
    assert request(service.stop_socket.path, "estop rover: smoke")["latched"]
    bench.reset(reason="no fire", name="bench")
    bench.estop(reason="smoke again", name="bench")
    on_disk(service.journals)
    lines = [json.loads(line) for line in path.read_text().splitlines()]
    assert [(line["command"], line["via"], line["result"]) for line in lines] == [
        ("stop", "stop socket", "ok"),
        ("estop", "stop socket", "ok"),
        ("reset", "loopback", "ok"),
        ("estop", "loopback", "ok"),
    ]
    assert [line["request"].get("reason") for line in lines] == [None, "smoke", "no fire", "smoke again"]
    assert path.stat().st_mode & 0o777 == 0o600


def test_a_reset_allows_moves_again_however_many_stops_were_latched(pair: Pair, bench: Client) -> None:
    devices = pair[0].service.devices
    for number in range(2 * MOST):  # more than the log of causes has
        bench.estop(reason="smoke", name=f"client {number}")
    with pytest.raises(Stopped, match="smoke"):
        devices.move(0.1, 0.1)
    bench.reset(reason="no fire", name="bench")
    devices.move(0.1, 0.1)
