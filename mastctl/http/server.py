"""uvicorn as the daemon runs it: without signals of its own, and with an end that waits for no tick.

asyncio tells a protocol of a TLS connection when its handshake is done. Until then nobody would know of it,
and silent ones would take every descriptor of the process. So each begins here as a plain connection that is
counted with the others, and becomes a `Connection` when its handshake is done.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import socket
import ssl
from collections.abc import Callable, Iterator
from typing import Any, cast

import uvicorn

from mastctl.http.connections import Connection, room_for

log = logging.getLogger(__name__)

DATE_S = 1.0  # how old the Date of an answer may be


class Server(uvicorn.Server):
    """A server that ends as soon as its connections have, used on one event loop.

    Parameters
    ----------
    settings
        How it serves; ``timeout_graceful_shutdown`` is how long connections are waited for, seconds.
    """

    def __init__(self, settings: uvicorn.Config) -> None:
        super().__init__(settings)
        self._open = _Open()
        self.server_state.connections = cast(Any, self._open)
        self._ending = asyncio.Event()
        self._forced = asyncio.Event()

    def end(self) -> None:
        """Take no more, and end when what is under way has been answered."""
        self.should_exit = True
        self._ending.set()

    def force(self) -> None:
        """Wait for nobody once it ends."""
        self._forced.set()

    @contextlib.contextmanager
    def capture_signals(self) -> Iterator[None]:
        """Leave signals alone: the mast is stopped first."""
        yield

    async def main_loop(self) -> None:
        """Keep the Date of answers until `end`."""
        while not await self.on_tick(0):
            with contextlib.suppress(TimeoutError):
                await asyncio.wait_for(self._ending.wait(), DATE_S)

    async def shutdown(self, sockets: list[socket.socket] | None = None) -> None:
        """Close what waits for a request at once, what is under way when it has been answered."""
        for listener in (*self.servers, *(sockets or ())):
            listener.close()
        for connection in list(self._open):
            connection.shutdown()
        jobs = [asyncio.ensure_future(job) for job in (self._nobody_left(), self._forced.wait())]
        limit_s = self.config.timeout_graceful_shutdown
        ended, _ = await asyncio.wait(jobs, timeout=limit_s, return_when=asyncio.FIRST_COMPLETED)
        for job in jobs:
            job.cancel()
        if not ended:
            tasks = self.server_state.tasks
            log.error("%d answers did not end within %s s; they are left behind", len(tasks), limit_s)
            for task in tasks:
                task.cancel()

    async def _nobody_left(self) -> None:
        while self._open:  # one that becomes a WebSocket is none of them for a moment
            await self._open.nobody.wait()
        if self.server_state.tasks:
            await asyncio.wait(self.server_state.tasks)


class _Open(set[Any]):
    """The open connections; ``nobody`` is set while there is none."""

    def __init__(self) -> None:
        super().__init__()
        self.nobody = asyncio.Event()

    def add(self, one: Any) -> None:
        super().add(one)
        self.nobody.clear()

    def discard(self, one: Any) -> None:
        super().discard(one)
        if not self:
            self.nobody.set()

    remove = discard


HANDSHAKE_S = 5.0


def arriving(kind: type[Connection], context: ssl.SSLContext) -> Any:
    """Return what makes uvicorn's protocol of each new connection: one that speaks TLS first."""

    def made(**options: Any) -> Arriving:
        return Arriving(kind(**options), context)

    return made


class Arriving(asyncio.Protocol):
    """A connection whose handshake is not done; among the connections it is one that waits.

    Parameters
    ----------
    becomes
        The connection that it becomes.
    context
        The daemon's certificate and key.
    """

    def __init__(self, becomes: Connection, context: ssl.SSLContext) -> None:
        self._becomes = becomes
        self._context = context
        self.waits_since_s = 0.0

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        self.transport = cast(asyncio.Transport, transport)
        self.transport.pause_reading()  # nothing is read as plain text
        self.waits_since_s = self._becomes.loop.time()
        self._becomes.connections.add(cast(Any, self))
        if not room_for(self, self._becomes.connections, self._becomes.most):
            self._gone()
            self.leave()
            return
        self._handshake = self._becomes.loop.create_task(self._shake_hands())

    def connection_lost(self, error: Exception | None) -> None:
        self._gone()

    waits = True

    def overdue(self, now_s: float) -> bool:
        """Whether its handshake has taken too long."""
        return now_s - self.waits_since_s > HANDSHAKE_S

    def leave(self) -> None:
        """Close it at once."""
        self.transport.abort()

    def end_reading(self, stands: Callable[[str], bool]) -> None:
        """Nobody was let in yet."""

    def shutdown(self) -> None:
        """Close it, as uvicorn asks of all when the daemon ends."""
        self.leave()

    async def _shake_hands(self) -> None:
        one = self._becomes
        try:
            secured = await one.loop.start_tls(
                self.transport,
                one,
                self._context,
                server_side=True,
                ssl_handshake_timeout=HANDSHAKE_S,
                ssl_shutdown_timeout=HANDSHAKE_S,
            )
        except (OSError, ssl.SSLError, TimeoutError):  # no client of ours; it was closed
            self._gone()
            return
        self._gone()
        if secured is None or secured.is_closing():
            return
        one.connection_made(secured)

    def _gone(self) -> None:
        self._becomes.connections.discard(cast(Any, self))
