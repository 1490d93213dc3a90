"""Connections without a whole request are bounded in time and in number."""

from __future__ import annotations

import asyncio
import contextlib
import resource
import socket
from collections.abc import AsyncIterator
from pathlib import Path
from typing import Any

import pytest
import uvicorn
from uvicorn.server import ServerState

from hil_tests.mastctl.outside_daemon import daemon_process, line, write_config
from hil_tests.waiting import NET_S
from mastctl.client import Client
from mastctl.http.waiting import SILENT_S, SilentConnections

pytestmark = pytest.mark.anyio
HEAD = b"POST / HTTP/1.1\r\nHost: a\r\nContent-Length: 1\r\n\r\n"
ALMOST_S = SILENT_S - 0.1


@pytest.fixture
def anyio_backend() -> str:
    return "asyncio"


class Served:
    """uvicorn's protocol with these bounds, on a clock turned by hand; its answers wait to be released."""

    def __init__(self, most: int | None = None) -> None:
        self.now_s = 0.0
        self.came, self.released = asyncio.Event(), asyncio.Event()
        self.silent = SilentConnections(most, lambda: self.now_s)

    async def app(self, scope: Any, receive: Any, send: Any) -> None:
        self.came.set()
        while (await receive()).get("more_body"):
            pass
        await self.released.wait()
        await send({"type": "http.response.start", "status": 200, "headers": [(b"content-length", b"0")]})
        await send({"type": "http.response.body", "body": b""})

    @contextlib.asynccontextmanager
    async def port(self) -> AsyncIterator[int]:
        config, state = uvicorn.Config(self.app, interface="asgi3", log_config=None), ServerState()
        loop = asyncio.get_running_loop()
        async with await loop.create_server(
            lambda: self.silent.protocol(config=config, server_state=state, app_state={}), "127.0.0.1", 0
        ) as server:
            yield server.sockets[0].getsockname()[1]

    def later(self, duration_s: float) -> None:
        self.silent.close_old()
        self.now_s += duration_s
        self.silent.close_old()


async def is_open(reader: asyncio.StreamReader) -> bool:
    with contextlib.suppress(ConnectionError, TimeoutError):
        async with asyncio.timeout(0.05):
            return await reader.read(1) != b""
    return reader.exception() is None


async def test_a_client_has_a_time_for_headers_for_a_body_and_for_its_next_request() -> None:
    served = Served()
    async with served.port() as port:
        reader, writer = await asyncio.open_connection("127.0.0.1", port)
        writer.write(HEAD[:9])
        assert await is_open(reader)
        served.later(ALMOST_S)
        writer.write(HEAD[9:])
        await asyncio.wait_for(served.came.wait(), NET_S)
        served.later(ALMOST_S)
        writer.write(b"x")
        assert await is_open(reader)
        served.later(10 * SILENT_S)
        assert await is_open(reader), "it waits for the answer, not for its client"
        served.released.set()
        await reader.readuntil(b"\r\n\r\n")
        served.later(ALMOST_S)
        assert await is_open(reader)
        served.later(SILENT_S - ALMOST_S)
        assert not await is_open(reader)


@pytest.mark.parametrize("request_before", [False, True])
async def test_of_too_many_those_without_any_request_are_closed_first(request_before: bool) -> None:
    served = Served(most=2)
    served.released.set()
    async with served.port() as port:
        first, writer = await asyncio.open_connection("127.0.0.1", port)
        if request_before:
            writer.write(HEAD + b"x")
            await first.readuntil(b"\r\n\r\n")
        second, _kept = await asyncio.open_connection("127.0.0.1", port)
        assert await is_open(second)
        served.now_s += 1.0
        third, _kept_too = await asyncio.open_connection("127.0.0.1", port)
        stay = [await is_open(one) for one in (first, second, third)]
        assert stay == [request_before, not request_before, True]


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
