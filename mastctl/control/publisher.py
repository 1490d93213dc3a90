"""Each change of state published once, to listeners that never delay a publisher.

A listener in a coroutine gets the newest value of each topic and key, and may lose values in between; one
that is a thread gets every value. Beyond a bound both lose the oldest. What is lost is counted:
`Publisher.publish` neither waits nor queues without bound.

    topic       key                 value
    state       "machine"           `mastctl.control.machine.Standing`
    joints      the head's name     `drivers.interfaces.Reading`
    operation   its id              `mastctl.control.operations.Operation`, with the steps so far
    track       "track"             `mastctl.motion.track.TrackStatus`
    fault       of a device, file   tuple of `mastctl.control.machine.StandingFault`, empty when healthy
    frame       the camera's name   facts of its newest frame, without the image
    mast        "in_use"            the mast file in use, as `GET /mast` has it
    command     its number          the record of a command, or of an operation's end
    lease       "lease"             the client that steers
    bench       "run"               `mastctl.answers.BenchRunRecord`, the bench calibration as it is known
"""

from __future__ import annotations

import asyncio
import contextlib
import itertools
import threading
from dataclasses import dataclass
from typing import Any, Literal, Self, get_args

Topic = Literal[
    "state", "joints", "operation", "track", "fault", "frame", "mast", "command", "lease", "bench"
]
TOPICS: frozenset[Topic] = frozenset(get_args(Topic))

MOST_UNREAD = 10_000
"""Values that wait for one listener."""


@dataclass(frozen=True, eq=False)
class Published:
    """A value of a topic and key, never edited. ``sequence`` grows with each value, whatever its topic."""

    sequence: int
    topic: Topic
    key: str
    value: Any


class Subscription:
    """What one listener has not read yet. A context manager; one thread, or one coroutine, reads it.

    ``lost`` counts values that came and cannot be read any more; ``closed`` says that no more will come.
    """

    def __init__(
        self, publisher: Publisher, topics: tuple[Topic, ...], keys: frozenset[str] | None, every: bool
    ) -> None:
        self.lost = 0
        self.closed = False
        self._publisher = publisher
        self._topics = frozenset(topics) or TOPICS
        self._keys = keys
        self._every = every
        self._unread: dict[int | tuple[Topic, str], Published] = {}

    def close(self) -> None:
        """Receive no more; a reader that waits is woken."""
        self._publisher.leave(self)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *raised: object) -> None:
        self.close()

    # For the publisher, which keeps its lock

    def end(self) -> None:
        """Have the reader know that no more will come."""
        self.closed = True
        self._wake()

    def put(self, one: Published) -> None:
        """Keep a value for the reader."""
        if one.topic not in self._topics or (self._keys is not None and one.key not in self._keys):
            return
        was_empty = not self._unread
        if not self._every:
            self.forget(one.topic, one.key)
        self._unread[one.sequence if self._every else (one.topic, one.key)] = one
        if len(self._unread) > MOST_UNREAD:
            self.lost += 1
            del self._unread[next(iter(self._unread))]
        if was_empty:
            self._wake()

    def forget(self, topic: Topic, key: str) -> None:
        """Drop the value of a key, unless the reader gets every value."""
        self.lost += self._unread.pop((topic, key), None) is not None

    def _wake(self) -> None:
        raise NotImplementedError

    def _take_unread(self) -> list[Published]:
        """Everything unread, oldest first."""
        unread, self._unread = self._unread, {}
        return list(unread.values())


class ThreadSubscription(Subscription):
    """A subscription that a thread waits on."""

    def __init__(self, publisher: Publisher, topics: tuple[Topic, ...]) -> None:
        super().__init__(publisher, topics, None, every=True)
        self._news = threading.Condition(publisher.lock)

    def wait(self, timeout_s: float | None = None) -> list[Published]:
        """Return what is new since the last call, oldest first; wait for it for ``timeout_s`` real seconds.

        Empty if nothing came in that time, or `closed`. None waits for as long as it takes.
        """
        with self._news:
            self._news.wait_for(lambda: self._unread or self.closed, timeout_s)
            return self._take_unread()

    def _wake(self) -> None:
        self._news.notify_all()


class LoopSubscription(Subscription):
    """A subscription that a coroutine waits on, of the event loop on which it was made."""

    def __init__(self, publisher: Publisher, topics: tuple[Topic, ...], keys: frozenset[str] | None) -> None:
        super().__init__(publisher, topics, keys, every=False)
        self._loop = asyncio.get_running_loop()
        self._something = asyncio.Event()

    async def wait(self, timeout_s: float | None = None) -> list[Published]:
        """Do the same as a coroutine."""
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(timeout_s):
                while not (self._unread or self.closed):
                    self._something.clear()  # the loop sets it, so never in between
                    await self._something.wait()
        with self._publisher.lock:
            return self._take_unread()

    def _wake(self) -> None:
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
        """Hand every listener of a topic the newest value of a key, in the order of publication."""
        with self.lock:
            one = self._newest[topic, key] = Published(next(self._numbers), topic, key, value)
            for subscription in self._subscriptions:
                subscription.put(one)

    def forget(self, topic: Topic, key: str) -> None:
        """Drop a key's value, for later listeners too: it is one of many, and old."""
        with self.lock:
            self._newest.pop((topic, key), None)
            for subscription in self._subscriptions:
                subscription.forget(topic, key)

    def subscribe(self, *topics: Topic) -> ThreadSubscription:
        """Return a subscription for a thread, without topics to all; it begins with what is known already."""
        subscription = ThreadSubscription(self, topics)
        self._add(subscription)
        return subscription

    def subscribe_here(self, *topics: Topic, keys: frozenset[str] | None = None) -> LoopSubscription:
        """Return the same for a coroutine of the running event loop, of some keys only if they are given."""
        subscription = LoopSubscription(self, topics, keys)
        self._add(subscription)
        return subscription

    @property
    def listeners(self) -> int:
        """How many subscriptions there are."""
        return len(self._subscriptions)

    def close(self) -> None:
        """End every subscription, and each that is made later; publishing goes nowhere from then on."""
        with self.lock:
            self._closed = True
            for one in self._subscriptions:
                self.leave(one)

    def leave(self, subscription: Subscription) -> None:
        """End a subscription."""
        with self.lock:
            self._subscriptions = tuple(one for one in self._subscriptions if one is not subscription)
            subscription.end()

    def _add(self, subscription: Subscription) -> None:
        with self.lock:
            if self._closed:
                subscription.end()
                return
            self._subscriptions = (*self._subscriptions, subscription)
            for one in sorted(self._newest.values(), key=lambda one: one.sequence):
                subscription.put(one)
