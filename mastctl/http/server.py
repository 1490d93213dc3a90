"""uvicorn as the daemon runs it: without signals of its own, and with an end that waits for no tick."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import socket
from collections.abc import Iterator
from typing import Any, cast

import uvicorn

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
