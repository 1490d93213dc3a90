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


def test_a_request_that_begins_before_the_one_before_has_returned_is_under_way(
    pair: tuple[socket.socket, socket.socket],
) -> None:
    now_s = 0.0
    silent = SilentConnections(now_s=lambda: now_s)
    silent.add(pair[0], ("a", 1))
    scope: Any = {"type": "http", "client": ("a", 1)}

    async def both() -> None:
        answered, over = asyncio.Event(), asyncio.Event()

        async def first(*_: Any) -> None:
            await answered.wait()

        async def second(*_: Any) -> None:
            await over.wait()

        stream: Any = None
        former = asyncio.ensure_future(silent.around(first)(scope, stream, stream))
        await asyncio.sleep(0)
        later = asyncio.ensure_future(silent.around(second)(scope, stream, stream))
        answered.set()
        await former
        nonlocal now_s
        now_s = 2 * SILENT_S
        silent.close_old()
        assert is_open(pair[1])
        over.set()
        await later

    asyncio.run(both())


@pytest.mark.parametrize(("kind", "stays"), [("new", False), ("served", True), ("next request", True)])
def test_of_too_many_those_without_any_request_are_closed_first(kind: str, stays: bool) -> None:
    async def app(*_: Any) -> None:
        pass

    silent = SilentConnections(most=1)
    with contextlib.ExitStack() as stack:
        ends = [stack.enter_context(one) for _ in range(2) for one in socket.socketpair()]
        for end in ends:
            end.setblocking(False)
        silent.add(ends[0], ("a", 1))
        if kind == "served":
            asyncio.run(silent.around(app)({"type": "http", "client": ("a", 1)}, None, None))  # type: ignore[arg-type]
        if kind == "next request":
            ends[1].send(b"GET")
        silent.add(ends[2], ("a", 2))
        assert (is_open(ends[1]), is_open(ends[3])) == (stays, not stays)


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
