"""Requests that wait: for a thread, a device, a picture, a change; and none for a daemon that ends.

The event loop itself never waits for a lock, a file or a device. What may, runs here in worker threads; a
request that waits when the daemon ends is refused at once, and what its thread still brings is dropped.
Pictures have a limit of their own for each camera, so that a dead camera, however often it is asked, takes
no thread from anything else. What computes for long does it in a few threads of the lowest standing.

What is no stop is taken up in turn, one piece in each turn of the event loop: however many ask at once, what
a stop still waits for is the work of a few of them, not of all.
"""

from __future__ import annotations

import asyncio
import contextlib
import os
import threading
from collections import deque
from collections.abc import Awaitable, Callable, Iterator
from concurrent.futures import CancelledError, Future, ThreadPoolExecutor
from contextlib import contextmanager
from typing import TypeVar

from drivers.clock import Clock, SystemClock
from mastctl.control.publisher import LoopSubscription, Publisher, Topic
from mastctl.errors import Unable

T = TypeVar("T")


class Turns:
    """What waits to be taken up on one event loop; used on that loop only."""

    def __init__(self) -> None:
        self._waiting: deque[Callable[[], None]] = deque()

    def call(self, function: Callable[[], None]) -> None:
        """Have a function called when all that came before has had a turn of the event loop."""
        self._waiting.append(function)
        if len(self._waiting) == 1:
            asyncio.get_running_loop().call_soon(self._next)

    async def turn(self) -> None:
        """Return when all that came before has had its turn."""
        mine: asyncio.Future[None] = asyncio.get_running_loop().create_future()
        self.call(lambda: None if mine.done() else mine.set_result(None))
        await mine

    def _next(self) -> None:
        try:
            self._waiting[0]()
        finally:
            self._waiting.popleft()  # now, so that what it has called comes a turn later
            if self._waiting:
                asyncio.get_running_loop().call_soon(self._next)


AT_ONCE = 40  # worker threads for everything but pictures
PICTURES_AT_ONCE = 4  # of one camera
PICTURE_QUEUE_S = 2.0  # how long a request waits for those before it
ENCODERS = 2
ENCODERS_NICE = 10  # a stop's threads, and the event loop, go first


class Waiting:
    """The waiting requests of one daemon; used on its event loop only.

    ``clock`` is the service's, which may have to wait while a request computes.
    """

    def __init__(self, clock: Clock | None = None) -> None:
        self._clock = clock or SystemClock()
        self._ending = asyncio.Event()
        self._asked: dict[tuple[str, bool], asyncio.Semaphore] = {}
        self._others = asyncio.Semaphore(AT_ONCE)
        self.turns = Turns()
        self._encoders = ThreadPoolExecutor(ENCODERS, "encoding", _give_way)

    def end(self) -> None:
        """Refuse what waits now and what will come."""
        self._ending.set()
        self._encoders.shutdown(wait=False, cancel_futures=True)

    def encode(self, function: Callable[[], T]) -> T:
        """Return what ``function()`` returns, which computes for long: a few at a time, and everybody else's
        work first. For a worker thread of `run` or `picture`.

        Raises
        ------
        Unable
            ``closing`` if the daemon ends.
        """
        try:
            asked = self._encoders.submit(function)
        except RuntimeError:  # the daemon ends
            asked = Future[T]()
            asked.cancel()
        try:
            return asked.result()
        except CancelledError:
            raise Unable("closing", "the daemon ends; the request will not be served") from None

    async def run(self, function: Callable[[], T]) -> T:
        """Return what ``function()`` returns, run in a worker thread.

        Raises
        ------
        Unable
            ``closing`` if the daemon ends before it returns, ``no_thread`` if the machine has none for it.
        """
        return await self._unless_ending(self._worked(function))

    async def picture(self, camera: str, function: Callable[[], T], kept: bool = False) -> T:
        """Return what ``function()`` returns, which takes a picture with a (known) camera, or encodes one
        that is ``kept``: as many of these at once, and none of them waits for the camera.

        Raises
        ------
        Unable
            ``too_many`` if so many others wait for this camera that it does not come to this one's turn in
            2 s; else as `run`.
        """
        return await self._unless_ending(self._in_turn(camera, function, kept))

    async def _worked(self, function: Callable[[], T]) -> T:
        async with self._others:
            return await _in_thread(self._at_work(function))

    async def _in_turn(self, camera: str, function: Callable[[], T], kept: bool) -> T:
        turn = self._asked.setdefault((camera, kept), asyncio.Semaphore(PICTURES_AT_ONCE))
        try:
            await asyncio.wait_for(turn.acquire(), PICTURE_QUEUE_S)
        except TimeoutError:
            raise Unable(
                "too_many",
                f"{PICTURES_AT_ONCE} pictures of {camera} are waited for, and none came in "
                f"{PICTURE_QUEUE_S:g} s; ask again later",
                PICTURE_QUEUE_S,
            ) from None
        try:
            return await _in_thread(self._at_work(function))
        finally:
            turn.release()

    def _at_work(self, function: Callable[[], T]) -> Callable[[], T]:
        def work() -> T:
            with self._clock.at_work():
                return function()

        return work

    async def _unless_ending(self, work: Awaitable[T]) -> T:
        call = asyncio.ensure_future(work)
        ending = asyncio.ensure_future(self._ending.wait())
        try:
            await asyncio.wait({call, ending}, return_when=asyncio.FIRST_COMPLETED)
            if call.done():
                return call.result()
            raise Unable("closing", "the daemon ends; the request will not be served")
        finally:
            for one in (call, ending):
                one.cancel()


def _give_way() -> None:
    """Let this thread come after everybody else's; Linux counts niceness by thread."""
    os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), ENCODERS_NICE)


async def _in_thread(function: Callable[[], T]) -> T:
    """Return what a function returns, run in a daemon thread, which does not hold the process's end."""
    loop = asyncio.get_running_loop()
    answer: asyncio.Future[T] = loop.create_future()

    def tell(result: T | None, error: Exception | None) -> None:
        if answer.done():  # nobody waits any more
            return
        if error is not None:
            answer.set_exception(error)
        else:
            answer.set_result(result)  # type: ignore[arg-type]

    def run() -> None:
        result: T | None = None
        error: Exception | None = None
        try:
            result = function()
        except BaseException as raised:  # it belongs to the request that waits, which nothing else would end
            error = RuntimeError(f"{type(raised).__name__}: {raised}")
            if isinstance(raised, Exception) and not isinstance(raised, StopIteration):
                error = raised
        with contextlib.suppress(RuntimeError):  # the loop has ended already
            loop.call_soon_threadsafe(tell, result, error)

    try:
        threading.Thread(target=run, name="request", daemon=True).start()
    except RuntimeError as error:
        raise Unable("no_thread", f"the request was not begun: {error}") from None
    return await answer


MOST = 100
FULL_S = 1.0


class Streams:
    """Who listens to one daemon; used on its event loop only.

    Parameters
    ----------
    publisher
        What is listened to.
    most
        How many may listen at once, so that they leave connections for everybody else.
    """

    def __init__(self, publisher: Publisher, most: int = MOST) -> None:
        self._publisher = publisher
        self._most = most
        self._open: set[LoopSubscription] = set()
        self._ended = False

    @contextmanager
    def listening(self, topics: tuple[Topic, ...], keys: frozenset[str] | None) -> Iterator[LoopSubscription]:
        """Listen inside the block to topics, all of them if none is named, of some keys or of every one.

        Raises
        ------
        Unable
            ``too_many`` listen already, ``closing``.
        """
        if self._ended:
            raise Unable("closing", "the daemon ends; no more events follow")
        if len(self._open) >= self._most:
            words = f"{self._most} listen to events already, and no more may; ask again later"
            raise Unable("too_many", words, FULL_S)
        with self._publisher.subscribe_here(*topics, keys=keys) as news:
            self._open.add(news)
            try:
                yield news
            finally:
                self._open.discard(news)

    def end(self) -> None:
        """Let every stream tell what it has not told yet, and end."""
        self._ended = True
        for news in tuple(self._open):
            news.close()
