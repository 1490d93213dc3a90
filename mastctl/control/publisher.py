"""Each change of state published once, to listeners that get the newest and never delay a publisher.

A subscriber has at most one value of each topic and key waiting for it. One that is slow loses values in
between, never the newest, and knows how many it lost: `Publisher.publish` neither waits nor queues. A
listener that counts may request every value, up to a bound beyond which it loses the oldest.

    topic       key                 value
    state       "machine"           `mastctl.control.machine.Standing`
    joints      the head's name     `drivers.interfaces.Reading`
    operation   its id              `mastctl.control.operations.Operation`, with the steps so far
    track       "track"             `mastctl.motion.track.TrackStatus`
    fault       of a device, file   tuple of `mastctl.control.machine.StandingFault`, empty when healthy
    frame       the camera's name   facts of its newest frame, without the picture
    mast        "in_use"            the mast file in use, as `GET /mast` has it
    command     its number          the record of a command; under NUMBER.end how what it began has ended
    lease       "lease"             the client that steers
    bench       "run"               `mastctl.answers.BenchRunRecord`, the bench calibration as it is known
"""

from __future__ import annotations

import asyncio
import contextlib
import itertools
import threading
import time
from collections.abc import Iterable
from dataclasses import dataclass
from types import TracebackType
from typing import Any, Literal, Self, TypeVar, get_args

Topic = Literal[
    "state", "joints", "operation", "track", "fault", "frame", "mast", "command", "lease", "bench"
]
TOPICS: frozenset[Topic] = frozenset(get_args(Topic))

_Subscription = TypeVar("_Subscription", bound="Subscription")

MOST_UNREAD = 10_000
"""Values that wait for one listener."""

GONE: Any = object()


@dataclass(frozen=True, eq=False)
class Published:
    """A value of a topic and key, never edited. ``sequence`` grows with each value, whatever its topic."""

    sequence: int
    topic: Topic
    key: str
    value: Any


class Subscription:
    """What one listener has not read yet. A context manager; one thread, or one coroutine, reads it.

    ``lost`` counts values that were replaced by newer ones before they were read, or found no room;
    ``closed`` says that no more will come: it was closed, or its publisher was.
    """

    def __init__(
        self, publisher: Publisher, topics: frozenset[Topic], keys: frozenset[str] | None, every: bool
    ) -> None:
        self.lost = 0
        self.closed = False
        self._publisher = publisher
        self._topics = topics
        self._keys = keys
        self._every = every
        self._most = MOST_UNREAD
        self._unread: dict[int | tuple[Topic, str], Published] = {}

    def close(self) -> None:
        """Receive no more; a reader that waits is woken."""
        self._publisher.leave(self)
        self.finish()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self.close()

    # For the publisher

    def put(self, one: Published) -> None:
        """Keep a value for the reader, in place of an older one of the same topic and key; under the lock."""
        if one.topic not in self._topics or (self._keys is not None and one.key not in self._keys):
            return
        place = one.sequence if self._every else (one.topic, one.key)
        self.lost += self._unread.pop(place, None) is not None
        if one.value is not GONE:
            self._unread[place] = one
        if len(self._unread) > self._most:
            del self._unread[next(iter(self._unread))]
            self.lost += 1
        if one.value is not GONE:
            self._wake()

    def finish(self) -> None:
        """State that no more will come."""
        self.closed = True
        self._wake()

    def _wake(self) -> None:
        raise NotImplementedError

    def _take_unread(self) -> list[Published]:
        with self._publisher.lock:
            unread, self._unread = self._unread, {}
        return sorted(unread.values(), key=lambda one: one.sequence)


class ThreadSubscription(Subscription):
    """A subscription that a thread waits on."""

    def __init__(self, publisher: Publisher, topics: frozenset[Topic], every: bool) -> None:
        self._something = threading.Event()
        super().__init__(publisher, topics, None, every)

    def wait(self, timeout_s: float | None = None) -> list[Published]:
        """Return what is new since the last call, oldest first; wait for it for ``timeout_s`` real seconds.

        Empty if nothing came in that time, or `closed`. None waits for as long as it takes.
        """
        until_s = None if timeout_s is None else time.monotonic() + timeout_s
        while True:
            self._something.clear()
            unread = self._take_unread()
            left_s = None if until_s is None else until_s - time.monotonic()
            if unread or self.closed or (left_s is not None and left_s <= 0):
                return unread
            self._something.wait(left_s)

    def _wake(self) -> None:
        self._something.set()


class LoopSubscription(Subscription):
    """A subscription that a coroutine waits on, of the event loop on which it was made."""

    def __init__(self, publisher: Publisher, topics: frozenset[Topic], keys: frozenset[str] | None) -> None:
        self._loop = asyncio.get_running_loop()
        self._something = asyncio.Event()
        self._woken = False
        super().__init__(publisher, topics, keys, every=False)

    async def wait(self, timeout_s: float | None = None) -> list[Published]:
        """Return what is new since the last call, oldest first; wait for it for ``timeout_s`` seconds.

        Empty if nothing came in that time, or `closed`. None waits for as long as it takes.
        """
        until_s = None if timeout_s is None else self._loop.time() + timeout_s
        while True:
            self._something.clear()
            self._woken = False
            unread = self._take_unread()
            left_s = None if until_s is None else until_s - self._loop.time()
            if unread or self.closed or (left_s is not None and left_s <= 0):
                return unread
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(left_s):
                    await self._something.wait()

    def _wake(self) -> None:
        if not self._woken:
            self._woken = True
            with contextlib.suppress(RuntimeError):  # the loop has ended, and with it the reader
                self._loop.call_soon_threadsafe(self._something.set)


class Publisher:
    """Hands each value to every listener; safe to use from any thread.

    ``lock`` is kept while a value is handed over or a listener takes its values; it waits for no listener.
    """

    def __init__(self) -> None:
        self._numbers = itertools.count(1)
        self._newest: dict[tuple[Topic, str], Published] = {}
        self._subscriptions: tuple[Subscription, ...] = ()
        self._closed = False
        self.lock = threading.RLock()

    def publish(self, topic: Topic, key: str, value: Any) -> None:
        """Hand every listener of a topic the newest value of a key.

        Values reach each listener in the order in which they were published.
        """
        with self.lock:
            one = self._newest[topic, key] = Published(next(self._numbers), topic, key, value)
            for subscription in self._subscriptions:
                subscription.put(one)

    def forget(self, topic: Topic, key: str) -> None:
        """Drop a key's value, for later listeners too: it is one of many, and old."""
        with self.lock:
            self._newest.pop((topic, key), None)
            for subscription in self._subscriptions:
                subscription.put(Published(0, topic, key, GONE))

    def newest(self, topic: Topic, key: str) -> Any:
        """Return the newest value of a key, None before the first; takes no lock."""
        known = self._newest.get((topic, key))
        return None if known is None else known.value

    def subscribe(self, *topics: Topic, known: bool = True, every: bool = False) -> ThreadSubscription:
        """Return a subscription for a thread; without topics to all of them.

        It begins with the newest value of each key that is known already, unless ``known`` is False. With
        ``every`` no value takes another one's place and `forget` takes none back. Beyond ``MOST_UNREAD``
        unread values the oldest is lost, and counted in ``lost``.
        """
        return self._added(ThreadSubscription(self, _checked(topics), every), known)

    def subscribe_here(
        self, *topics: Topic, known: bool = True, keys: frozenset[str] | None = None
    ) -> LoopSubscription:
        """Return a subscription for a coroutine of the running event loop, to some keys only if they are
        given; else as `subscribe`.
        """
        return self._added(LoopSubscription(self, _checked(topics), keys), known)

    @property
    def listeners(self) -> int:
        """How many subscriptions there are."""
        return len(self._subscriptions)

    def close(self) -> None:
        """End every subscription, and each that is made later; publishing goes nowhere from then on."""
        with self.lock:
            self._closed = True
            subscriptions, self._subscriptions = self._subscriptions, ()
        for one in subscriptions:
            one.finish()

    def _added(self, subscription: _Subscription, known: bool) -> _Subscription:
        with self.lock:
            if self._closed:
                subscription.finish()
                return subscription
            self._subscriptions = (*self._subscriptions, subscription)
            for one in self._newest.values() if known else ():
                subscription.put(one)
        return subscription

    def leave(self, subscription: Subscription) -> None:
        """Drop a subscription."""
        with self.lock:
            self._subscriptions = tuple(one for one in self._subscriptions if one is not subscription)


def _checked(topics: Iterable[Topic]) -> frozenset[Topic]:
    chosen = frozenset(topics)
    if not chosen <= TOPICS:
        raise ValueError(f"{', '.join(sorted(chosen - TOPICS))}: there is no such topic")
    return chosen or TOPICS
