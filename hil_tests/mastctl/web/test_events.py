"""The event stream: begins with what is known, tells each change, holds nobody, ends with the daemon."""

from __future__ import annotations

import json
import socket
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import httpx
import jsonschema_rs
import pytest
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.frames import Frame, Opcode
from websockets.sync.client import ClientConnection, connect

from hil_tests.described_answers import closed
from hil_tests.mastctl.bench.operation_world import BEGUN, PLACE
from hil_tests.mastctl.service_fakes import HTTP, PLAIN, FakeHardware, ScriptedLoop, fake_daemon
from hil_tests.waiting import NET_S, joined, until
from mastctl import daemon as daemon_module
from mastctl.bench.runs import new_record
from mastctl.control.publisher import TOPICS
from mastctl.daemon import RunningDaemon
from mastctl.errors import Stopped

BOTH = tuple[RunningDaemon, FakeHardware]
UPGRADE = (
    "Upgrade: websocket\r\nConnection: Upgrade\r\n"
    "Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\nSec-WebSocket-Version: 13"
)


@contextmanager
def listening(url: str, query: str = "", **headers: str) -> Iterator[Iterator[dict[str, Any]]]:
    """The server-sent events of a daemon."""
    with (
        httpx.Client(**PLAIN) as http,
        http.stream("GET", f"{url}/api/v1/events{query}", headers=headers) as answer,
    ):
        assert answer.status_code == 200, answer.read()
        assert answer.headers["content-type"].startswith("text/event-stream")
        lines = answer.iter_lines()
        yield (json.loads(line.removeprefix("data: ")) for line in lines if line.startswith("data: "))


def socket_of(url: str, query: str = "", **options: Any) -> ClientConnection:
    """A WebSocket of a daemon."""
    address = f"ws{url.removeprefix('http')}/api/v1/events{query}"
    return connect(address, open_timeout=NET_S, close_timeout=2.0, proxy=None, **options)


def first(events: Iterator[dict[str, Any]], holds: Any) -> dict[str, Any]:
    """The first event of which something holds."""
    return next(event for event in events if holds(event))


def heard(line: ClientConnection) -> Iterator[dict[str, Any]]:
    while True:
        yield json.loads(line.recv(timeout=NET_S))


def test_it_begins_with_what_is_known_and_then_tells_each_change(pair: BOTH) -> None:
    daemon, _ = pair
    with listening(daemon.url, "?topics=state,mast,track,operation,command") as events:
        known = {event["topic"]: event for event in (next(events) for _ in range(3))}
        assert set(known) == {"state", "mast", "track"}
        assert known["mast"]["value"]["digest"] == daemon.service.stored.digest
        with httpx.Client(base_url=f"{daemon.url}/api/v1", **PLAIN) as http:
            begun = http.post("/point", json={"pan_rad": 0.1, "tilt_rad": 0.0}).json()["id"]
        ended = first(events, lambda e: e["topic"] == "operation" and e["value"]["state"] == "done")
        assert ended["key"] == ended["value"]["id"] == begun
        assert [step["name"] for step in ended["value"]["steps"]] == ["look", "measure"]


def test_each_topic_is_told_by_the_model_that_openapi_describes(pair: BOTH) -> None:
    daemon, _ = pair
    with httpx.Client(base_url=daemon.url, **PLAIN) as http:
        document = closed(http.get("/openapi.json").json())
        described = document["paths"]["/api/v1/events"]["get"]["responses"]["200"]["content"]
        event = described["text/event-stream"]["x-event"]
        validator = jsonschema_rs.Draft202012Validator({**event, "components": document["components"]})
        http.post("/api/v1/point", json={"pan_rad": 0.1, "tilt_rad": 0.0}, headers={"Mastctl-Client": "a"})
        http.post("/api/v1/lease", json={"for_s": 5.0}, headers={"Mastctl-Client": "a"})
        http.get("/api/v1/snapshot/navcam_left")
    publisher = daemon.service.machine.publisher
    publisher.publish("fault", "a device", ())
    publisher.publish(
        "bench", "run", {**new_record("20261122-120000", "Ana", "charuco", True), **BEGUN, **PLACE}
    )
    seen: set[str] = set()
    with socket_of(daemon.url) as line:
        for _ in range(200):
            one = json.loads(line.recv(timeout=NET_S))
            validator.validate(one)
            seen.add(one["topic"])
            if seen == TOPICS:
                break
    assert seen == TOPICS


def test_the_key_of_a_command_is_told_to_nobody_else(pair: BOTH) -> None:
    daemon, _ = pair
    with httpx.Client(base_url=f"{daemon.url}/api/v1", **PLAIN) as http:
        http.post("/lease", json={}, headers={"Idempotency-Key": "very-own", "Mastctl-Client": "a"})
    with listening(daemon.url, "?topics=command,lease") as events:
        told = next(events), next(events)
    assert {one["topic"] for one in told} == {"command", "lease"}
    assert "very-own" not in json.dumps(told)


def test_topics_and_keys_are_chosen(pair: BOTH) -> None:
    daemon, _ = pair
    publisher = daemon.service.machine.publisher
    before = publisher.listeners
    with socket_of(daemon.url, "?topics=fault&key=b") as line:
        until(lambda: publisher.listeners == before + 1, "somebody listens")
        for device in ("a", "b"):
            publisher.publish("fault", device, ())
        told = json.loads(line.recv(timeout=NET_S))
    assert (told["topic"], told["key"], told["value"], told["lost"]) == ("fault", "b", [], 0)


@pytest.mark.parametrize("query", ["?topics=state,weather", "?topic=state", "?key=" + "&key=".join("a" * 17)])
def test_what_is_no_topic_is_refused_in_a_sentence_both_ways(standing: BOTH, query: str) -> None:
    daemon, _ = standing
    answer = HTTP.get(f"{daemon.url}/api/v1/events{query}")
    assert answer.status_code == 422
    with pytest.raises(InvalidStatus) as refused, socket_of(daemon.url, query):
        pass
    assert refused.value.response.status_code == 422
    told = json.loads(refused.value.response.body or b"")["error"]
    assert told["code"] == answer.json()["error"]["code"] == "bad_request"
    if "weather" in query:
        assert told["message"] == answer.json()["error"]["message"]
        assert "'weather'" in told["message"] and "operation" in told["message"]


def test_it_ends_with_the_daemon_after_its_last_words(pair: BOTH, monkeypatch: pytest.MonkeyPatch) -> None:
    daemon, _ = pair

    def until_stopped(request: Any, record: Any, cancelled: threading.Event, devices: Any) -> None:
        assert cancelled.wait(NET_S)
        raise Stopped("stopped")

    monkeypatch.setattr(ScriptedLoop, "script", staticmethod(until_stopped))
    with httpx.Client(base_url=f"{daemon.url}/api/v1", **PLAIN) as http:
        http.post("/point", json={"pan_rad": 0.1, "tilt_rad": 0.0})
    with (
        listening(daemon.url, "?topics=operation") as events,
        socket_of(daemon.url, "?topics=operation") as line,
    ):
        assert next(events)["value"]["state"] in ("queued", "running")
        ending = threading.Thread(target=daemon.close)
        ending.start()
        assert [one["value"]["state"] for one in events][-1] == "stopped"
        with pytest.raises(ConnectionClosed) as ended:
            for one in heard(line):
                told = one["value"]["state"]
        assert told == "stopped", "its last words"
        assert ended.value.rcvd is not None and ended.value.rcvd.code == 1001
        joined(ending)
    assert not ending.is_alive()


# What a WebSocket may be sent


def sent(opcode: Opcode, data: bytes, mask: bool = True) -> bytes:
    return Frame(opcode, data).serialize(mask=mask)


def opened(line: socket.socket, path: str = "/api/v1/events") -> None:
    """Request a WebSocket and read the answer."""
    line.sendall(f"GET {path} HTTP/1.1\r\nHost: 127.0.0.1\r\n{UPGRADE}\r\n\r\n".encode())
    got = b""
    while b"\r\n\r\n" not in got:
        got += line.recv(4096) or b"\r\n\r\n"


@pytest.mark.parametrize(
    ("data", "code"),
    [
        (sent(Opcode.TEXT, b"hello"), 1003),
        (b"\x81\xff" + (1 << 40).to_bytes(8, "big") + bytes(4), 1009),  # a text of a terabyte, masked
        (sent(Opcode.TEXT, b"hello", mask=False), 1002),
        (sent(Opcode.CLOSE, b"\x03\xe8") + sent(Opcode.BINARY, b"more") * 3, 1000),
    ],
    ids=["text", "long", "unmasked", "close"],  # frames are masked at random: no names for workers
)
def test_what_a_client_sends_ends_its_websocket_and_says_why(pair: BOTH, data: bytes, code: int) -> None:
    daemon, _ = pair
    with socket.create_connection(("127.0.0.1", int(daemon.url.rpartition(":")[2])), timeout=NET_S) as line:
        opened(line, "/api/v1/events?topics=lease")
        line.sendall(data)
        got = b"".join(iter(lambda: line.recv(65536), b""))
    assert got.rpartition(b"\x88")[2][1:3] == code.to_bytes(2, "big"), got


def test_a_websocket_whose_client_does_not_read_is_left(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(daemon_module, "UNREAD_S", 0.2)
    with fake_daemon(monkeypatch, tmp_path) as (daemon, _):
        publisher = daemon.service.machine.publisher
        HTTP.get(f"{daemon.url}/api/v1/health/live")  # its own listeners are there by now
        before = publisher.listeners
        address = "127.0.0.1", int(daemon.url.rpartition(":")[2])
        with socket.create_connection(address, timeout=NET_S) as line:
            line.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
            opened(line)
            until(lambda: publisher.listeners == before + 1, "it listens")

            def left() -> bool:
                publisher.publish("fault", "x" * 200000, ())
                return publisher.listeners == before

            until(left, "it is left")
