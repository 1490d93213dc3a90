"""Connections as the daemon takes them: many, silent, slow or stalled ones never keep the next one out.

uvicorn bounds neither how many connections there are nor how long one may be silent before its first request.
Here the descriptors of the process are shared out: some stay free, the rest is the most connections. Beyond
it the oldest connection that waits for a request is closed for each new one; where every one is at work,
the new one is served for stop and status only. Some are kept by nobody for long: a request
must have come whole within some seconds, and a client that takes no bytes for some seconds is left.
"""

from __future__ import annotations

import asyncio
import resource
from collections.abc import Iterable
from pathlib import Path
from typing import Any, cast

from starlette.types import ASGIApp, Receive, Scope, Send
from uvicorn.protocols.http.h11_impl import H11Protocol

from mastctl.web.guard import error_response

REQUEST_S = 10.0  # for a request to come whole, from the connection's beginning or the answer before
STALLED_S = 10.0  # for a client that does not read its answer
SWEEP_S = 1.0
MOST = 200
LEAST = 8
FREE_DESCRIPTORS = 24  # for devices that come back, mast files, and what is accepted before it is counted
ACCEPTED_AT_ONCE = 4  # connections taken in one turn of the event loop
WAITING_IN_KERNEL = 128  # connections that the kernel keeps for us meanwhile
ALWAYS = ("/stop", "/estop", "/status")  # how a path ends that is served to whoever comes


def most_connections() -> int:
    """Return how many connections this process can keep, by its limit of descriptors and those in use."""
    limit, _ = resource.getrlimit(resource.RLIMIT_NOFILE)
    in_use = sum(1 for _ in Path("/proc/self/fd").iterdir())
    return max(LEAST, min(MOST, limit - in_use - FREE_DESCRIPTORS))


class Connection(H11Protocol):
    """One connection, which knows how long it has waited for a request, and for its client to read.

    Attributes
    ----------
    most
        How many there may be.
    """

    most = MOST

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        super().connection_made(transport)
        self._waits_since_s = self.loop.time()
        self._stalled_since_s: float | None = None
        if len(self.connections) > self.most and not self._room_made():
            self.app = cast(Any, _Crowded(cast(ASGIApp, self.app)))

    def on_response_complete(self) -> None:
        self._waits_since_s = self.loop.time()
        super().on_response_complete()

    def pause_writing(self) -> None:
        super().pause_writing()
        self._stalled_since_s = self.loop.time()

    def resume_writing(self) -> None:
        super().resume_writing()
        self._stalled_since_s = None

    @property
    def waits(self) -> bool:
        """Whether no whole request is here."""
        return self.cycle is None or self.cycle.response_complete or self.cycle.more_body

    def overdue(self, now_s: float) -> bool:
        """Whether its request, or its client's reading, has taken too long."""
        stalled_s = self._stalled_since_s
        if stalled_s is not None and now_s - stalled_s > STALLED_S:
            return True
        return self.waits and now_s - self._waits_since_s > REQUEST_S

    def leave(self) -> None:
        """Close it at once, whatever its client still expects."""
        self.transport.abort()

    def _room_made(self) -> bool:
        """Close the connection that has waited longest for a request; return whether there was one."""
        others = [
            one for one in cast("Iterable[Connection]", self.connections) if one is not self and one.waits
        ]
        if not others:
            return False
        oldest = min(others, key=lambda one: one._waits_since_s)
        self.connections.discard(oldest)  # counted no longer, although its closing takes a turn of the loop
        oldest.leave()
        return True


async def sweep(connections: Iterable[Any]) -> None:
    """Leave overdue connections, again and again, until cancelled."""
    while True:
        await asyncio.sleep(SWEEP_S)
        now_s = asyncio.get_running_loop().time()
        for one in list(connections):
            if one.overdue(now_s):
                one.leave()


class _Crowded:
    """The application for who comes when every other connection is at work."""

    def __init__(self, app: ASGIApp) -> None:
        self._app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["path"].endswith(ALWAYS):
            await self._app(scope, receive, send)
            return
        response = error_response(
            503,
            "too_many",
            "every connection of the daemon is at work; ask again later",
            headers={"Retry-After": "1", "Connection": "close"},
        )
        await response(scope, receive, send)
