"""The event stream: begins with what is known, tells each change, holds nobody, ends with the daemon."""

from __future__ import annotations

import asyncio
import json
import socket
import threading
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import httpx
import jsonschema_rs
import pytest
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import ClientConnection, connect

from hil_tests.described_answers import closed
from hil_tests.mastctl.service_fakes import HTTP, PLAIN, FakeHardware, ScriptedLoop
from hil_tests.mastctl.web.network import NAME, Network, network_daemon
from hil_tests.waiting import NET_S, joined, until
from mastctl.control.publisher import TOPICS
from mastctl.daemon import RunningDaemon
from mastctl.errors import Stopped, Unable
from mastctl.guided.told import GuidedRun
from mastctl.guided.told import heard as bench_heard
from mastctl.http import connections as connections_module
from mastctl.http import sockets as sockets_module
from mastctl.http.waiting import Streams
from tools.campaigns import fuzz_daemon

BOTH = tuple[RunningDaemon, FakeHardware]


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


def socket_of(url: str, query: str = "", **options: Any) -> connect:
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


BENCH_BEGUN = b'{"event": "begun", "board_m": [0.5, 0.3], "cameras": {"a": [64, 48]}, "simulated": true}'


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
    run = bench_heard(GuidedRun("20261122-120000", "2026-11-22T12:00:00+00:00", "Ana"), BENCH_BEGUN)
    publisher.publish("bench", "run", run)
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


def strictly(text: str) -> Any:
    """JSON as the standard has it, without the words that Python adds."""
    return json.loads(text, parse_constant=lambda word: pytest.fail(f"{word} is not JSON: {text}"))


def test_a_number_that_no_float_holds_is_refused_and_blinds_no_listener(pair: BOTH) -> None:
    daemon, _ = pair
    body = b'{"position_m": [1, 0, 0], "board": {"square_m": 1e400}}'
    with httpx.Client(base_url=f"{daemon.url}/api/v1", **PLAIN) as http:
        kind = {"Content-Type": "application/json"}
        answer = http.post("/simulation/boards/b", content=body, headers=kind)
        assert answer.status_code == 422
        assert "1e400" in answer.json()["error"]["message"]
        http.post("/lease", json={})
    with listening(daemon.url, "?topics=state,command") as events:
        assert next(events)["topic"] == "state"
    audit = daemon.service.entry.audit
    assert audit.flush(NET_S)
    for line in (daemon.service.folder.path / "audit.jsonl").read_text().splitlines():
        strictly(line)


def test_a_value_that_is_no_json_is_told_as_text_and_ends_no_stream(pair: BOTH) -> None:
    daemon, _ = pair
    request = {"range_m": float("inf"), "what": Path("rock")}
    who = {"command": "pose", "who": "bench", "role": "admin", "via": "inside", "result": "ok"}
    told = {"number": 1, "time": "2026-11-22T12:00:00+00:00", "monotonic_s": 1.0, **who}
    with listening(daemon.url, "?topics=command") as events:
        daemon.service.machine.publisher.publish("command", "1", {**told, "request": request})
        assert next(events)["value"]["request"] == {"range_m": "inf", "what": "rock"}


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


def test_a_slow_reader_gets_the_newest_and_is_told_what_it_lost(pair: BOTH) -> None:
    daemon, _ = pair
    publisher = daemon.service.machine.publisher
    before = publisher.listeners
    with listening(daemon.url, "?topics=command") as events:
        until(lambda: publisher.listeners == before + 1, "somebody listens")
        record = {"number": 1, "time": "", "monotonic_s": 0.0, "command": "x", "who": "x", "role": "admin"}
        words = "long " * 2000  # soon more than a connection holds
        for number in range(3000):
            publisher.publish("command", "1", {**record, "number": number, "via": "test", "message": words})
        last = first(events, lambda e: e["value"]["number"] == 2999)
    assert last["lost"] > 1000


def test_a_listener_that_stalls_holds_nobody(pair: BOTH) -> None:
    daemon, _ = pair
    publisher = daemon.service.machine.publisher
    before = publisher.listeners
    with socket_of(daemon.url, "?topics=fault") as stalled, listening(daemon.url, "?topics=fault") as events:
        until(lambda: publisher.listeners == before + 2, "both listen")
        stalled.socket.settimeout(None)
        for _ in range(2000):
            publisher.publish("fault", "x" * 5000, ())
        publisher.publish("fault", "last", ())
        assert first(events, lambda e: e["key"] == "last")
        with httpx.Client(base_url=f"{daemon.url}/api/v1", **PLAIN) as http:
            assert http.post("/stop").status_code == 200


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


def test_the_daemon_ends_by_events_whoever_is_connected(pair: BOTH, monkeypatch: pytest.MonkeyPatch) -> None:
    daemon, _ = pair
    slept_s: list[float] = []

    async def sleep(delay_s: float, result: Any = None) -> Any:
        slept_s.append(delay_s)
        await plain(delay_s)
        return result

    plain = asyncio.sleep
    with (
        httpx.Client(base_url=f"{daemon.url}/api/v1", trust_env=False) as waits,
        listening(daemon.url) as events,
        socket_of(daemon.url) as line,
    ):
        waits.get("/status")
        next(events)
        line.recv()
        monkeypatch.setattr(asyncio, "sleep", sleep)
        ending = threading.Thread(target=daemon.close)
        ending.start()
        list(events)
        with pytest.raises(ConnectionClosed):
            list(heard(line))
        ending.join(60.0)
    assert not ending.is_alive()
    assert [delay_s for delay_s in slept_s if delay_s != connections_module.SWEEP_S] == []


def test_not_everybody_may_listen_at_once(pair: BOTH, monkeypatch: pytest.MonkeyPatch) -> None:
    daemon, _ = pair
    streams = Streams(daemon.service.machine.publisher, 0)
    with pytest.raises(Unable, match="0 listen to events already"), streams.listening((), None):
        pass


def test_streams_of_one_daemon_are_counted_and_their_places_come_free(pair: BOTH) -> None:
    daemon, _ = pair
    publisher = daemon.service.machine.publisher
    HTTP.get(f"{daemon.url}/api/v1/status")  # the daemon's own listeners are there by then
    before = publisher.listeners
    for _ in range(3):
        with listening(daemon.url, "?topics=state") as events, socket_of(daemon.url, "?topics=state") as line:
            next(events), line.recv(timeout=NET_S)
            assert publisher.listeners == before + 2
        until(lambda: publisher.listeners == before, "nobody listens any more")


# Who may listen


@pytest.fixture(scope="module")
def net(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Network]:
    with pytest.MonkeyPatch.context() as patch, network_daemon(patch, tmp_path_factory.mktemp("net")) as made:
        yield made


def refusal(net: Network, query: str = "", **headers: str) -> tuple[int, str]:
    """What a WebSocket is refused with."""
    told = {"Host": f"{NAME}:{net.port}", **headers}
    request = "".join(f"{name}: {value}\r\n" for name, value in told.items())
    answer = net.raw(
        f"GET /api/v1/events{query} HTTP/1.1\r\n{request}Upgrade: websocket\r\nConnection: Upgrade\r\n"
        "Sec-WebSocket-Version: 13\r\nSec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\n\r\n"
    )
    head, _, body = answer.partition(b"\r\n\r\n")
    return int(head.split()[1]), json.loads(body)["error"]["code"]


def bearer(net: Network) -> str:
    return f"Bearer {net.token('view')}"


def test_a_websocket_asks_for_a_token_as_every_request_does(net: Network) -> None:
    assert refusal(net) == (401, "no_token")
    assert refusal(net, Authorization="Bearer wrong") == (401, "wrong_token")
    assert refusal(net, f"?token={net.token('view')}") == (400, "token_in_address")
    with socket_of(net.url, additional_headers={"Authorization": bearer(net)}) as line:
        assert json.loads(line.recv(timeout=NET_S))["sequence"] > 0


def test_another_sites_page_opens_no_websocket(net: Network) -> None:
    for origin in ("http://evil.example", "null", f"http://{NAME}:1", "http://"):
        assert refusal(net, Authorization=bearer(net), Origin=origin) == (403, "foreign_origin"), origin
    told = {"Authorization": bearer(net), "Sec-Fetch-Site": "cross-site"}
    assert refusal(net, **told) == (403, "foreign_origin")
    assert refusal(net, Authorization=bearer(net), Host="evil.example") == (403, "foreign_host")


def test_a_pages_session_opens_one_only_from_its_own_page(net: Network) -> None:
    token = {"token": net.token("view")}
    answer = net.ask("POST", "/login", json=token, headers={"Origin": net.origin})
    cookie = answer.headers["set-cookie"].partition(";")[0]
    assert refusal(net, Cookie=cookie) == (403, "foreign_origin")
    assert refusal(net, Cookie=cookie, Origin="http://evil.example") == (403, "foreign_origin")
    own = {"Cookie": cookie, "Host": f"{NAME}:{net.port}"}
    request = "".join(f"{name}: {value}\r\n" for name, value in own.items())
    with socket.create_connection(("127.0.0.1", net.port), timeout=NET_S) as line:
        line.sendall(
            f"GET /api/v1/events HTTP/1.1\r\n{request}Origin: {net.origin}\r\nUpgrade: websocket\r\n"
            "Connection: Upgrade\r\nSec-WebSocket-Version: 13\r\n"
            "Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\n\r\n".encode()
        )
        assert b" 101 " in line.recv(4096)


def test_a_websocket_anywhere_else_is_a_plain_request(net: Network) -> None:
    told = f"Host: {NAME}\r\nAuthorization: {bearer(net)}\r\n"
    told += "Upgrade: websocket\r\nConnection: Upgrade, close\r\n"
    for path in ("/api/v1/status", "/api/v1/nothing"):
        answer = net.raw(f"GET {path} HTTP/1.1\r\n{told}\r\n")
        assert answer.startswith((b"HTTP/1.1 200", b"HTTP/1.1 404")), answer[:100]
    answer = net.raw(f"POST /api/v1/events HTTP/1.1\r\n{told}Content-Type: application/json\r\n\r\n")
    assert answer.startswith((b"HTTP/1.1 405", b"HTTP/1.1 403"))


# What a WebSocket may be sent


def test_nothing_that_is_sent_into_a_websocket_harms_the_daemon(
    pair: BOTH, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    daemon, _ = pair
    monkeypatch.setattr(fuzz_daemon, "ATTACK_S", 0.5)
    publisher = daemon.service.machine.publisher
    before = publisher.listeners
    with ThreadPoolExecutor(4) as pool:
        done = fuzz_daemon.campaign(daemon.url, 0, 4 * len(fuzz_daemon.ATTACKS), pool)
    assert set(done.values()) == {4}
    until(lambda: publisher.listeners == before, "every attacker is forgotten")
    assert [record.getMessage() for record in caplog.records if record.levelname == "ERROR"] == []


@pytest.mark.parametrize(
    ("sent", "code"),
    [
        (fuzz_daemon.frame(1, b"hello"), 1003),
        (fuzz_daemon.frame(2, b"", last=False), 1003),
        (fuzz_daemon.frame(9, b"") * 100, 1008),
        (fuzz_daemon.frame(1, b"", told_bytes=1 << 40), 1009),
        (fuzz_daemon.frame(1, b"hello", masked=False), 1002),
        (b"\xff" * 20, 1002),
        (fuzz_daemon.frame(8, b"\x03\xe8") + fuzz_daemon.frame(2, b"more") * 3, 1000),
    ],
)
def test_what_a_client_sends_ends_its_websocket_and_says_why(pair: BOTH, sent: bytes, code: int) -> None:
    daemon, _ = pair
    with socket.create_connection(("127.0.0.1", int(daemon.url.rpartition(":")[2])), timeout=NET_S) as line:
        fuzz_daemon.opened(line, "/api/v1/events?topics=lease")
        line.sendall(sent)
        got = b"".join(iter(lambda: line.recv(65536), b""))
    assert got.rpartition(b"\x88")[2][1:3] == code.to_bytes(2, "big"), got


def test_a_websocket_whose_client_does_not_read_is_left(pair: BOTH, monkeypatch: pytest.MonkeyPatch) -> None:
    daemon, _ = pair
    monkeypatch.setattr(sockets_module, "STALLED_S", 0.2)
    publisher = daemon.service.machine.publisher
    before = publisher.listeners
    with socket.create_connection(("127.0.0.1", int(daemon.url.rpartition(":")[2])), timeout=NET_S) as line:
        line.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        fuzz_daemon.opened(line)
        until(lambda: publisher.listeners == before + 1, "it listens")
        began_s = time.monotonic()

        def left() -> bool:
            publisher.publish("fault", "x" * 200000, ())
            return publisher.listeners == before

        until(left, "it is left")
        assert time.monotonic() - began_s > sockets_module.STALLED_S, "it was given its time"
