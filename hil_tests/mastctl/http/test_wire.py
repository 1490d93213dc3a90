"""Requests that are slow, oversized or ambiguous, and the stop that passes all of them."""

from __future__ import annotations

import contextlib
import json
import socket
import threading
import time
from collections.abc import Iterator

import pytest

from hil_tests.mastctl.web.network import NAME, Network, network_daemon
from hil_tests.waiting import NET_S, joined
from mastctl.http import connections

STATUS = f"GET /api/v1/status HTTP/1.1\r\nHost: {NAME}\r\n"
STOP = f"POST /api/v1/stop HTTP/1.1\r\nHost: {NAME}\r\nConnection: close\r\n\r\n"


@pytest.fixture(scope="module")
def net(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Network]:
    with pytest.MonkeyPatch.context() as patch, network_daemon(patch, tmp_path_factory.mktemp("net")) as made:
        yield made


@contextlib.contextmanager
def lines(net: Network, count: int, data: bytes = b"") -> Iterator[list[socket.socket]]:
    """Connections that have sent some bytes and go on to say nothing."""
    with contextlib.ExitStack() as stack:
        made = []
        for _ in range(count):
            one = stack.enter_context(socket.create_connection(("127.0.0.1", net.port), timeout=NET_S))
            one.sendall(data)
            made.append(one)
        yield made


def refused(answer: bytes, status: int, code: str) -> None:
    """Check the one form of a refusal, whoever sent it, and that nothing follows it."""
    head, _, body = answer.partition(b"\r\n\r\n")
    assert head.startswith(f"HTTP/1.1 {status} ".encode()), answer[:200]
    assert json.loads(body)["error"]["code"] == code
    assert b"cross-origin-resource-policy: same-origin" in head.lower()
    assert b"connection: close" in head.lower()


def reset_where_unread(sent_bytes: int) -> contextlib.AbstractContextManager[None]:
    """What the daemon reads in one piece is answered; beyond it, what it left unread may end in a reset."""
    return contextlib.suppress(*((ConnectionResetError,) if sent_bytes > 4096 else ()))


@pytest.mark.parametrize(
    "junk",
    [
        b"\x00\x01\x02 GET\r\n\r\n",
        b"GET /api/v1/status HTTP/1.1\r\nHost: a\r\nHost: b\r\n\r\n",
        b"GET /" + b"a" * 70000,
        b"POST /api/v1/point HTTP/1.1\r\nHost: x\r\nContent-Length: +5\r\n\r\n",
        b"\x16\x03\x01\x02\x00\x01\x00\x01\xfc\x03\x03" + b"\x00" * 100 + b"\r\n\r\n",
    ],
    ids=lambda junk: repr(junk[:60]),
)
def test_bytes_that_are_no_http_are_refused_and_closed(net: Network, junk: bytes) -> None:
    with reset_where_unread(len(junk)):
        refused(net.raw(junk), 400, "not_http")
    assert net.raw(STOP).startswith(b"HTTP/1.1 200")


@pytest.mark.parametrize(
    "headers",
    [
        "Transfer-Encoding: chunked\r\nContent-Length: 4\r\n",
        "Authorization: Bearer a\r\nAuthorization: Bearer b\r\n",
        "Content-Length: 2\r\nContent-Length: 2\r\n",
        "Content-Length: 1, 2\r\n",
        "X: a\n b\r\n",
    ],
)
def test_a_request_of_two_readings_is_refused_and_closed(net: Network, headers: str) -> None:
    smuggled = "0\r\n\r\n" + STATUS + "\r\n"
    answer = net.raw(f"POST /api/v1/point HTTP/1.1\r\nHost: {NAME}\r\n{headers}\r\n{smuggled}")
    refused(answer, 400, "ambiguous")
    assert answer.count(b"HTTP/1.1") == 1, "what was smuggled is not answered"


DOUBTFUL = ("Content-Length: 2\r\nContent-Length: 2\r\n", "Content-Length: 2, 2\r\n", "X: a\r\n b\r\n")


@pytest.mark.parametrize(("path", "headers"), [*zip(("stop", "estop", "/stop/"), DOUBTFUL, strict=True)])
def test_a_stop_with_doubtful_headers_stops(net: Network, path: str, headers: str) -> None:
    body = "{}" if "Length" in headers else ""
    head = f"POST /api/v1/{path} HTTP/1.1\r\nHost: {NAME}\r\n{headers}Connection: close\r\n\r\n{body}"
    assert net.raw(head).startswith(b"HTTP/1.1 200")
    if path == "estop":
        why = {"reason": "a test", "name": "a test"}
        assert net.ask("POST", "/reset", "admin", json=why).status_code == 200


@pytest.mark.parametrize("headers", ["X: " + "a" * 30000 + "\r\n", "X: a\r\n" * 500])
def test_too_many_headers_are_refused(net: Network, headers: str) -> None:
    with reset_where_unread(len(headers)):
        answer = net.raw(STATUS + headers + "\r\n")
        assert json.loads(answer.partition(b"\r\n\r\n")[2])["error"]["code"] in (
            "headers_too_large",
            "not_http",
        )
    assert net.raw(STOP).startswith(b"HTTP/1.1 200")


def test_a_bad_part_of_a_body_ends_the_connection_quietly(
    net: Network, caplog: pytest.LogCaptureFixture
) -> None:
    head = (
        f"POST /api/v1/point HTTP/1.1\r\nHost: {NAME}\r\nTransfer-Encoding: chunked\r\n"
        f"Authorization: Bearer {net.token('admin')}\r\nContent-Type: application/json\r\n\r\n"
    )
    for body in ("zz\r\n", "5\r\nabc", "FFFFFFFFFFFFFFFFFFFFFFFF\r\n", "1\r\nab\r\n"):
        with socket.create_connection(("127.0.0.1", net.port), timeout=NET_S) as line:
            line.sendall((head + body).encode())
            line.shutdown(socket.SHUT_WR)
            with contextlib.suppress(ConnectionResetError):
                while line.recv(65536):  # a refusal may come; then the end
                    pass
    assert net.raw(STOP).startswith(b"HTTP/1.1 200")
    assert not [one for one in caplog.records if one.exc_info or one.levelname == "ERROR"], caplog.text


@pytest.mark.parametrize(
    ("address", "latches"),
    [
        ("/api/v1/stop/", False),
        ("/api/v1/%73top/", False),
        ("HTTPS://elsewhere.example:8420//api/v1/stop/", False),
        ("/api/v1/estop/", True),
    ],
)
def test_a_stop_with_another_spelling_of_its_address_stops(net: Network, address: str, latches: bool) -> None:
    net.hardware.head.calls.clear()
    answer = net.raw(f"POST {address} HTTP/1.1\r\nHost: {NAME}\r\nConnection: close\r\n\r\n")
    assert answer.startswith(b"HTTP/1.1 200"), answer[:200]
    assert ("stop",) in net.hardware.head.calls
    assert bool(net.daemon.service.state().told()["estop"]) is latches
    if latches:
        net.daemon.service.stopping.reset("the test goes on", "test")


@pytest.mark.parametrize(
    "address",
    ["/api/v1/status/", "/api/v1/stop/stop", "/x/api/v1/stop"],
)
def test_nothing_but_a_stop_is_known_by_another_address(net: Network, address: str) -> None:
    bearer = f"Authorization: Bearer {net.token('operate')}\r\n"
    asked = f"POST {address} HTTP/1.1\r\nHost: {NAME}\r\nConnection: close\r\n{bearer}"
    net.hardware.head.calls.clear()
    answer = net.raw(f"{asked}Content-Type: application/json\r\nContent-Length: 2\r\n\r\n{{}}")
    assert not answer.startswith(b"HTTP/1.1 2"), answer[:200]
    assert ("stop",) not in net.hardware.head.calls


def test_another_sites_page_stops_nothing_by_another_address(net: Network) -> None:
    asked = f"POST //api/v1/stop/ HTTP/1.1\r\nHost: {NAME}\r\nOrigin: http://evil.example\r\n"
    net.hardware.head.calls.clear()
    refused(net.raw(f"{asked}Connection: close\r\n\r\n"), 403, "foreign_origin")
    assert ("stop",) not in net.hardware.head.calls


def test_headers_byte_by_byte_are_left_after_some_seconds(
    monkeypatch: pytest.MonkeyPatch, net: Network
) -> None:
    monkeypatch.setattr(connections, "REQUEST_S", 0.3)
    left, began_s = threading.Event(), time.monotonic()
    with lines(net, 1) as (line,):

        def trickle() -> None:
            with contextlib.suppress(OSError):
                for sign in STATUS * 1000:
                    line.sendall(sign.encode())
                    if left.wait(0.01):
                        return

        feeding = threading.Thread(target=trickle)
        feeding.start()
        with contextlib.suppress(ConnectionResetError):
            assert line.recv(1) == b"", "it was left, not answered"
        assert time.monotonic() - began_s > connections.REQUEST_S, "it was given its time"
        left.set()
        joined(feeding)
