"""What waits: requests for a thread, a device or an image, streams for a change, connections for a request.

The event loop itself never waits for a lock, a file or a device. Work that may wait runs in worker threads; a
request that waits when the daemon ends is refused at once, and its thread's result is dropped. Images have a
limit of their own for each camera, so that a dead camera, however often it is requested, takes no thread from
anything else. Long computations run in a few threads of the lowest priority.

The web server bounds neither how long a client takes to send a request nor how many connections it opens. A
hundred clients that send nothing, or headers without their body, could use up the descriptors of the process,
and then a stop over HTTP would not arrive. So a connection that waits for its client's request is closed
after a while, the oldest when they are many.
"""

from __future__ import annotations

import asyncio
import contextlib
import os
import resource
import socket
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import CancelledError, ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, TypeVar

from anyio import CancelScope, CapacityLimiter, move_on_after
from anyio.to_thread import run_sync
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from drivers.clock import Clock, SystemClock
from mastctl.control.publisher import LoopSubscription, Publisher, Topic
from mastctl.errors import Unable

T = TypeVar("T")

WORKERS = 40  # threads for everything but images
IMAGES_AT_ONCE = 4  # of one camera
IMAGE_QUEUE_S = 2.0  # how long a request waits for those before it
ENCODERS = 2
ENCODERS_NICE = 10  # a stop's threads, and the event loop, go first


class Waiting:
    """The waiting requests of one daemon; used on its event loop only.

    ``clock`` is the service's, which may have to wait while a request computes.
    """

    def __init__(self, clock: Clock | None = None) -> None:
        self._clock = clock or SystemClock()
        self._ended = False
        self._scopes: set[CancelScope] = set()
        self._turn = asyncio.Lock()
        self._workers = CapacityLimiter(WORKERS)
        self._images: dict[tuple[str, bool], CapacityLimiter] = {}
        self._encoders = ThreadPoolExecutor(ENCODERS, "encoding", _lower_priority)

    def end(self) -> None:
        """Refuse what waits now and what will come."""
        self._ended = True
        for scope in self._scopes:
            scope.cancel()
        self._encoders.shutdown(wait=False, cancel_futures=True)

    async def turn(self) -> None:
        """Return one turn of the event loop after the call before: what is no stop begins in turn.

        However many requests come at once, a stop waits for the work of a few of them only.
        """
        async with self._turn:
            await asyncio.sleep(0)

    def encode(self, function: Callable[[], T]) -> T:
        """Return the result of ``function()``, which computes for long: a few at once, after all other work.

        For a worker thread of `run` or `image`. Raises Unable ``closing``.
        """
        try:
            encoded = self._encoders.submit(function)
        except RuntimeError:  # the daemon ends
            raise _closing() from None
        try:
            return encoded.result()
        except CancelledError:
            raise _closing() from None

    async def run(self, function: Callable[[], T]) -> T:
        """Return the result of ``function()``, run in a worker thread. Raises Unable ``closing``."""
        return await self._unless_ending(function, self._workers)

    async def image(self, camera: str, function: Callable[[], T], kept: bool = False) -> T:
        """Return the result of ``function()``, which takes an image with a (known) camera, or encodes one
        that is ``kept``: as many of these at once, and none of them waits for the camera.

        Raises Unable ``too_many`` if this one's turn does not come in 2 s, ``closing``.
        """
        limiter = self._images.setdefault((camera, kept), CapacityLimiter(IMAGES_AT_ONCE))
        return await self._unless_ending(function, limiter, camera)

    async def _unless_ending(
        self, function: Callable[[], T], limiter: CapacityLimiter, camera: str = ""
    ) -> T:
        with CancelScope() as scope:
            self._scopes.add(scope)
            if self._ended:
                scope.cancel()
            try:
                with move_on_after(IMAGE_QUEUE_S if camera else None) as queue:
                    await limiter.acquire()
                if queue.cancelled_caught:
                    message = f"{IMAGES_AT_ONCE} images of {camera} are waited for, and none came in "
                    message += f"{IMAGE_QUEUE_S:g} s; send the request again later"
                    raise Unable("too_many", message, IMAGE_QUEUE_S)
                try:
                    one = CapacityLimiter(1)  # the place is taken already
                    return await run_sync(self._at_work, function, abandon_on_cancel=True, limiter=one)
                finally:
                    limiter.release()
            finally:
                self._scopes.discard(scope)
        raise _closing()

    def _at_work(self, function: Callable[[], T]) -> T:
        with self._clock.at_work():
            return function()


def _closing() -> Unable:
    return Unable("closing", "the daemon ends; the request will not be served")


def _lower_priority() -> None:
    """Let this thread come after all others; Linux counts niceness by thread."""
    os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), ENCODERS_NICE)


MOST_STREAMS = 100
RETRY_S = 1.0
END_S = 1.5  # for the last events to be sent


class Streams:
    """The open event streams of one daemon; used on its event loop only."""

    def __init__(self, publisher: Publisher) -> None:
        self._publisher = publisher
        self._open: dict[LoopSubscription, str] = {}
        self._ended = False

    @contextmanager
    def listening(
        self, topics: tuple[Topic, ...], keys: frozenset[str] | None, credential: str
    ) -> Iterator[LoopSubscription]:
        """Listen inside the block to topics (empty: all) of some keys (None: all).

        ``credential`` is the digest of the client's token, with which the stream ends; empty for none. Raises
        Unable ``too_many``, ``closing``.
        """
        if self._ended:
            raise Unable("closing", "the daemon ends; no more events follow")
        if len(self._open) >= MOST_STREAMS:
            raise Unable("too_many", f"{MOST_STREAMS} event streams are open, the most there may be", RETRY_S)
        with self._publisher.subscribe_here(*topics, keys=keys) as news:
            self._open[news] = credential
            try:
                yield news
            finally:
                del self._open[news]

    def end_revoked(self, valid: Callable[[str], bool]) -> None:
        """End each stream whose token is no longer valid."""
        for news, credential in tuple(self._open.items()):
            if credential and not valid(credential):
                news.close()

    @property
    def ended(self) -> bool:
        """Whether the daemon ends."""
        return self._ended

    async def end(self) -> None:
        """Let every stream send its last events, and end; clients that do not read are not waited for."""
        self._ended = True
        for news in tuple(self._open):
            news.close()
        with move_on_after(END_S):
            while self._open:
                await asyncio.sleep(0.005)


SILENT_S = 20.0  # twice as long as the server keeps a connection for its next request
SWEEP_S = 1.0


@dataclass(eq=False)
class _Connection:
    """A client's connection: when its client last sent, its whole requests under way, whether one ended."""

    socket: socket.socket
    since_s: float
    requests: int = 0
    served: bool = False

    @property
    def is_closed(self) -> bool:
        return self.socket.fileno() < 0

    @property
    def has_bytes(self) -> bool:
        """Whether its next request, or a part of one, waits to be read."""
        try:
            return bool(self.socket.recv(1, socket.MSG_PEEK | socket.MSG_DONTWAIT))
        except OSError:
            return False


class SilentConnections:
    """The connections of a daemon, and which of them wait for their client: without a whole request.

    ``most`` may wait, by default a quarter of the process' descriptors; those beyond are closed, those that
    never had a whole request first. ``now_s`` is real time, since clients do not live in simulated time.
    """

    def __init__(self, most: int | None = None, now_s: Callable[[], float] = time.monotonic) -> None:
        self._most = most
        self._now_s = now_s
        self._by_client: dict[tuple[Any, ...], _Connection] = {}

    def add(self, connection: socket.socket, client: tuple[Any, ...]) -> None:
        """Note a new connection; ``client`` is the host and port of the client, as ASGI states them."""
        self._by_client[client] = _Connection(connection, self._now_s())
        self._bound()

    def close_old(self) -> None:
        """Close connections on which nothing came for ``SILENT_S``; forget those that have ended."""
        latest_s = self._now_s() - SILENT_S
        for client, one in list(self._by_client.items()):
            if one.is_closed or (not one.requests and one.since_s <= latest_s and not one.has_bytes):
                self._close(client)

    async def watch(self) -> None:
        """Close old connections until the task is cancelled."""
        while True:
            await asyncio.sleep(SWEEP_S)
            self.close_old()

    def around(self, app: ASGIApp) -> ASGIApp:
        """Return an application that notes which connections have a whole request."""

        async def noted(scope: Scope, receive: Receive, send: Send) -> None:
            one = self._by_client.get(tuple(scope.get("client") or ()))
            if one is None:  # of a Unix socket
                await app(scope, receive, send)
                return
            whole = scope["type"] != "http"

            async def part() -> Message:
                nonlocal whole
                if whole:
                    return await receive()
                self._waits(one)
                try:
                    message = await receive()
                finally:
                    one.requests += 1
                whole = not message.get("more_body", False)
                return message

            one.requests += 1
            try:
                await app(scope, part, send)
            finally:
                one.served = True
                self._waits(one)

        return noted

    def _waits(self, one: _Connection) -> None:
        one.requests -= 1
        one.since_s = self._now_s()
        self._bound()

    def _bound(self) -> None:
        """Close one connection that waits for its client if these are too many."""
        most = self._most or max(resource.getrlimit(resource.RLIMIT_NOFILE)[0] // 4, 1)
        if len(self._by_client) <= most:
            return
        self.close_old()
        silent = {client: one for client, one in self._by_client.items() if not one.requests}
        if len(silent) > most:
            for client in sorted(silent, key=lambda client: (silent[client].served, silent[client].since_s)):
                if not silent[client].has_bytes:
                    self._close(client)
                    return

    def _close(self, client: tuple[Any, ...]) -> None:
        one = self._by_client.pop(client)
        with contextlib.suppress(OSError):  # closed already
            one.socket.shutdown(socket.SHUT_RDWR)


class Listener(socket.socket):
    """A listening TCP socket that notes each connection."""

    silent: SilentConnections | None = None

    def accept(self) -> tuple[socket.socket, Any]:
        """Accept a connection, as `socket.socket.accept`."""
        connection, address = super().accept()
        if self.silent is not None:
            self.silent.add(connection, tuple(address[:2]))
        return connection, address
