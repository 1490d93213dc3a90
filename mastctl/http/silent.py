"""TCP connections that wait for their client's request: closed after a while, the oldest when they are many.

The web server bounds neither how long a client takes to send a request nor how many connections it opens. A
hundred clients that send nothing, or headers without their body, could use up the descriptors of the process,
and then a stop over HTTP would not arrive.
"""

from __future__ import annotations

import asyncio
import contextlib
import resource
import socket
import time
from collections.abc import Callable
from typing import Any

from starlette.types import ASGIApp, Message, Receive, Scope, Send

SILENT_S = 20.0  # twice as long as the server keeps a connection for its next request
SWEEP_S = 1.0


class SilentConnections:
    """The connections whose client has to send: no request has come, or no whole one.

    There may be ``most``, by default a quarter of the process' descriptors. ``now_s`` is real time, since
    clients do not live in simulated time.
    """

    def __init__(self, most: int | None = None, now_s: Callable[[], float] = time.monotonic) -> None:
        self._most = most
        self._now_s = now_s
        self._since: dict[tuple[Any, ...], tuple[socket.socket, float]] = {}  # by client, the oldest first

    def add(self, connection: socket.socket, client: tuple[Any, ...]) -> None:
        """Note a connection that waits for its client; the oldest is closed if these are too many.

        ``client`` is the host and port of the client, as ASGI states them.
        """
        self._since[client] = (connection, self._now_s())
        most = self._most or max(resource.getrlimit(resource.RLIMIT_NOFILE)[0] // 4, 1)
        if len(self._since) > most:
            self.close_old()
        if len(self._since) > most:
            self._close(next(iter(self._since)))

    def close_old(self) -> None:
        """Close connections on which nothing came for ``SILENT_S``; forget those that have ended."""
        latest_s = self._now_s() - SILENT_S
        for client, (connection, since_s) in list(self._since.items()):
            if since_s <= latest_s or connection.fileno() < 0:
                self._close(client)

    async def watch(self) -> None:
        """Close old connections until the task is cancelled."""
        while True:
            await asyncio.sleep(SWEEP_S)
            self.close_old()

    def around(self, app: ASGIApp) -> ASGIApp:
        """Return an application that notes which connections have a whole request."""

        async def noted(scope: Scope, receive: Receive, send: Send) -> None:
            client = tuple(scope.get("client") or ())
            connection, _ = self._since.pop(client, (None, 0.0))
            whole = connection is None or scope["type"] != "http"

            async def part() -> Message:
                nonlocal whole
                if whole or connection is None:
                    return await receive()
                self.add(connection, client)
                try:
                    message = await receive()
                finally:
                    self._since.pop(client, None)
                whole = not message.get("more_body", False)
                return message

            try:
                await app(scope, part, send)
            finally:
                if connection is not None and connection.fileno() >= 0:
                    self.add(connection, client)

        return noted

    def _close(self, client: tuple[Any, ...]) -> None:
        connection, _ = self._since.pop(client)
        with contextlib.suppress(OSError):  # closed already
            connection.shutdown(socket.SHUT_RDWR)


class Listener(socket.socket):
    """A listening TCP socket that notes each connection as silent."""

    silent: SilentConnections | None = None

    def accept(self) -> tuple[socket.socket, Any]:
        """Accept a connection, as `socket.socket.accept`."""
        connection, address = super().accept()
        if self.silent is not None:
            self.silent.add(connection, tuple(address[:2]))
        return connection, address
