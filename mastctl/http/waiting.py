"""What waits: requests for a thread, a device or an image, streams for a change, connections for a request.

The event loop itself never waits for a lock, a file or a device. Work that may wait runs in worker threads; a
request that waits when the daemon ends is refused at once, and its thread's result is dropped. Images have a
limit of their own for each camera, so that a dead camera, however often it is requested, takes no thread from
anything else. Of long computations a few are at work at once.

The web server bounds neither how long a client takes to send a request nor how many connections it opens. A
hundred clients that send nothing, or headers without their body, could use up the descriptors of the process,
and then a stop over HTTP would not arrive. So a connection that waits for its client's request is closed
after a while, the oldest when they are many.
"""

from __future__ import annotations

import asyncio
import resource
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, TypeVar

from anyio import CancelScope, CapacityLimiter, move_on_after
from anyio.to_thread import run_sync
from uvicorn.protocols.http.h11_impl import H11Protocol

from drivers.clock import Clock, SystemClock
from mastctl.control.publisher import LoopSubscription, Publisher, Topic
from mastctl.errors import Unable

T = TypeVar("T")

WORKERS = 40  # threads for everything but images
IMAGES_AT_ONCE = 4  # of one camera
IMAGE_QUEUE_S = 2.0  # how long a request waits for those before it
ENCODERS = 2


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
        self.encoding = threading.BoundedSemaphore(ENCODERS)
        """For long computations in the threads of `image`: a few at once."""

    def end(self) -> None:
        """Refuse what waits now and what will come."""
        self._ended = True
        for scope in self._scopes:
            scope.cancel()

    async def turn(self) -> None:
        """Return one turn of the event loop after the call before: what is no stop begins in turn.

        However many requests come at once, a stop waits for the work of a few of them only.
        """
        async with self._turn:
            await asyncio.sleep(0)

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


MOST_STREAMS = 100
RETRY_S = 1.0
END_S = 1.5  # for the last events to be sent


class Streams:
    """The open event streams of one daemon; used on its event loop only."""

    def __init__(self, publisher: Publisher) -> None:
        self._publisher = publisher
        self._open: dict[LoopSubscription, str] = {}
        self.ended = False  # whether the daemon ends

    @contextmanager
    def listening(
        self, topics: tuple[Topic, ...], keys: frozenset[str] | None, credential: str
    ) -> Iterator[LoopSubscription]:
        """Listen inside the block to topics (empty: all) of some keys (None: all).

        ``credential`` is the digest of the client's token, with which the stream ends; empty for none. Raises
        Unable ``too_many``, ``closing``.
        """
        if self.ended:
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

    async def end(self) -> None:
        """Let every stream send its last events, and end; clients that do not read are not waited for."""
        self.ended = True
        for news in tuple(self._open):
            news.close()
        with move_on_after(END_S):
            while self._open:
                await asyncio.sleep(0.005)


SILENT_S = 20.0  # twice as long as the server keeps a connection for its next request
SWEEP_S = 1.0


class SilentConnections:
    """The connections that wait for their client, which owes a whole request: bounded in time and number.

    ``most`` of them may wait, by default a quarter of the process' descriptors. ``now_s`` is real time, since
    clients do not live in simulated time.
    """

    def __init__(self, most: int | None = None, now_s: Callable[[], float] = time.monotonic) -> None:
        self._most = most
        self._now_s = now_s
        self._seen: dict[H11Protocol, tuple[Any, float]] = {}
        """Of each connection its newest request, and since when it waits."""

    def protocol(self, **options: Any) -> H11Protocol:
        """Return uvicorn's protocol for a new connection, after closing another one if too many wait.

        It is what `uvicorn.Config` expects as ``http``.
        """
        most = self._most or max(resource.getrlimit(resource.RLIMIT_NOFILE)[0] // 4, 1)
        if len(self._seen) >= most and len(waiting := self._waiting()) >= most:
            # One that never had a request goes first, then the oldest.
            self._close(min(waiting, key=lambda one: (one.cycle is not None, waiting[one])))
        protocol = H11Protocol(**options)
        self._seen[protocol] = None, self._now_s()
        return protocol

    def close_old(self) -> None:
        """Close connections that have waited for ``SILENT_S``."""
        latest_s = self._now_s() - SILENT_S
        for one, since_s in self._waiting().items():
            if since_s <= latest_s:
                self._close(one)

    async def watch(self) -> None:
        """Close old connections until the task is cancelled."""
        while True:
            await asyncio.sleep(SWEEP_S)
            self.close_old()

    def _waiting(self) -> dict[H11Protocol, float]:
        """The open connections that wait for their client, and since when."""
        waiting: dict[H11Protocol, float] = {}
        for one, (request, since_s) in list(self._seen.items()):
            now = one.cycle
            if one.transport is None:  # not yet connected
                continue
            if one not in one.connections:  # closed, or a WebSocket
                del self._seen[one]
                continue
            under_way = now is not None and not now.response_complete and not now.more_body
            if under_way or now is not request:
                since_s = self._now_s()
                self._seen[one] = now, since_s
            if not under_way:
                waiting[one] = since_s
        return waiting

    def _close(self, one: H11Protocol) -> None:
        del self._seen[one]
        one.transport.abort()
