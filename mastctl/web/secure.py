"""TLS: connections are counted from their first byte on, not from the end of their handshake.

asyncio tells a protocol of a TLS connection when its handshake is done. Until then nobody would know of it,
and silent ones would take every descriptor of the process. So each begins here as a plain connection that is
counted with the others, and becomes a `Connection` when its handshake is done.
"""

from __future__ import annotations

import asyncio
import ssl
from collections.abc import Callable
from typing import Any, cast

from mastctl.web.connections import Connection, room_for

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
