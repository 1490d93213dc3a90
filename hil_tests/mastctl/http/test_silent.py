"""Connections without a whole request are bounded in time and in number."""

from __future__ import annotations

import asyncio
import contextlib
import resource
import socket
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from hil_tests.mastctl.outside_daemon import daemon_process, line, write_config
from hil_tests.waiting import NET_S
from mastctl.client import Client
from mastctl.http.waiting import SILENT_S, SilentConnections


@pytest.fixture
def pair() -> Iterator[tuple[socket.socket, socket.socket]]:
    ends = socket.socketpair()
    with ends[0], ends[1]:
        ends[1].setblocking(False)
        yield ends


def is_open(client: socket.socket) -> bool:
    try:
        return client.recv(1) != b""
    except BlockingIOError:
        return True


def test_a_whole_request_keeps_its_connection_and_its_end_begins_the_time_anew(
    pair: tuple[socket.socket, socket.socket],
) -> None:
    now_s = 0.0
    silent = SilentConnections(now_s=lambda: now_s)
    parts = iter([True, True, False])

    async def receive() -> Any:  # an upload of three parts, each of which comes just in time
        nonlocal now_s
        now_s += SILENT_S - 0.1
        silent.close_old()
        assert is_open(pair[1])
        return {"type": "http.request", "body": b"1", "more_body": next(parts)}

    async def app(_: Any, receive: Any, __: Any) -> None:
        while (await receive())["more_body"]:
            pass
        nonlocal now_s
        now_s += 10 * SILENT_S
        silent.close_old()
        assert is_open(pair[1])

    silent.add(pair[0], ("a", 1))
    asyncio.run(silent.around(app)({"type": "http", "client": ("a", 1)}, receive, None))  # type: ignore[arg-type]
    silent.close_old()
    assert is_open(pair[1])
    now_s += SILENT_S
    silent.close_old()
    assert not is_open(pair[1])


def test_of_too_many_the_oldest_is_closed(pair: tuple[socket.socket, socket.socket]) -> None:
    silent = SilentConnections(most=1)
    silent.add(pair[0], ("a", 1))
    silent.add(pair[1], ("a", 2))
    assert not is_open(pair[1])


@pytest.mark.parametrize(
    "begun",
    [
        "POST /api/v1/stop HTTP/1.1\r\nHost:",
        "POST /api/v1/point HTTP/1.1\r\nHost: 127.0.0.1\r\nContent-Length: 9\r\n\r\n{",
    ],
    ids=["headers", "body"],
)
def test_stalled_requests_leave_descriptors_for_a_stop(tmp_path: Path, begun: str) -> None:
    with daemon_process(tmp_path, write_config(tmp_path)) as daemon, contextlib.ExitStack() as stack:
        url = line(daemon)
        host, _, port = url.removeprefix("http://").rpartition(":")
        resource.prlimit(daemon.pid, resource.RLIMIT_NOFILE, (200, 200))
        for _ in range(250):
            one = stack.enter_context(socket.create_connection((host, int(port)), NET_S))
            one.sendall(begun.encode())
        with Client(url) as client:
            assert client.stop()["stopped"] is True
