"""Requests that are oversized or no HTTP, and the stop that passes all of them."""

from __future__ import annotations

import contextlib
import socket
from collections.abc import Iterator

import pytest

from hil_tests.mastctl.web.network import NAME, Network, network_daemon
from hil_tests.waiting import NET_S

STATUS = f"GET /api/v1/status HTTP/1.1\r\nHost: {NAME}\r\n"
STOP = f"POST /api/v1/stop HTTP/1.1\r\nHost: {NAME}\r\nConnection: close\r\n\r\n"


@pytest.fixture(scope="module")
def net(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Network]:
    with pytest.MonkeyPatch.context() as patch, network_daemon(patch, tmp_path_factory.mktemp("net")) as made:
        yield made


@pytest.mark.parametrize(
    "junk",
    [
        b"\x00\x01\x02 GET\r\n\r\n",
        b"GET /api/v1/status HTTP/1.1\r\nHost: a\r\nHost: b\r\n\r\n",
        b"GET /" + b"a" * 70000,
        b"POST /api/v1/point HTTP/1.1\r\nHost: x\r\nContent-Length: +5\r\n\r\n",
        b"\x16\x03\x01\x02\x00\x01\x00\x01\xfc\x03\x03" + b"\x00" * 100 + b"\r\n\r\n",
        f"{STATUS}X: {'a' * 300000}\r\n\r\n".encode(),
        STATUS.encode() + b"X: a\r\n" * 50000 + b"\r\n",
    ],
    ids=["binary", "two_hosts", "long_address", "signed_length", "tls", "long_header", "many_headers"],
)
def test_bytes_that_are_no_http_or_too_long_are_refused(net: Network, junk: bytes) -> None:
    with contextlib.suppress(ConnectionResetError):  # by the bytes that were not read
        assert net.raw(junk).startswith(b"HTTP/1.1 400")
    assert net.raw(STOP).startswith(b"HTTP/1.1 200")


@pytest.mark.parametrize(
    "headers", ["Content-Length: 2\r\nContent-Length: 2\r\n", "X: a\r\n b\r\n"], ids=["length", "folded"]
)
def test_a_stop_with_doubtful_headers_stops(net: Network, headers: str) -> None:
    body = "{}" if "Length" in headers else ""
    head = f"POST /api/v1/stop HTTP/1.1\r\nHost: {NAME}\r\n{headers}Connection: close\r\n\r\n{body}"
    assert net.raw(head).startswith(b"HTTP/1.1 200")


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
    [("/api/v1/stop/", False), ("/api/v1/%73top/", False), ("//api/v1/estop/", True)],
    ids=["slash", "escaped", "estop"],
)
def test_a_stop_with_another_spelling_of_its_address_stops(net: Network, address: str, latches: bool) -> None:
    net.hardware.head.calls.clear()
    answer = net.raw(f"POST {address} HTTP/1.1\r\nHost: {NAME}\r\nConnection: close\r\n\r\n")
    assert answer.startswith(b"HTTP/1.1 200"), answer[:200]
    assert ("stop",) in net.hardware.head.calls
    assert bool(net.daemon.service.status()["estop"]) is latches
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
    answer = net.raw(f"{asked}Connection: close\r\n\r\n")
    assert answer.startswith(b"HTTP/1.1 403") and b"foreign_origin" in answer
    assert ("stop",) not in net.hardware.head.calls
