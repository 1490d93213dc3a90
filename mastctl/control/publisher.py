"""Each change of state published once, to listeners that get the newest and never hold anybody up.

A subscriber has at most one value of each topic and key waiting for it. One that is slow loses values in
between, never the newest, and is told how many it lost: `Publisher.publish` neither waits nor queues. A
listener that counts may ask for every value, up to a bound beyond which it loses the oldest.

    topic       key                 value
    state       "machine"           `mastctl.control.standing.Standing`
    joints      the head's name     `drivers.interfaces.Reading`
    operation   its id              `mastctl.control.records.Operation`, with the steps so far
    track       "track"             `mastctl.motion.track.TrackStatus`
    fault       of a device, file   tuple of `mastctl.control.standing.StandingFault`, empty when healthy
    frame       the camera's name   facts of its newest frame, without the picture
    mast        "in_use"            the mast file in use, as `GET /mast` tells it
    command     its number          the record of a command; under NUMBER.end how what it began has ended
    lease       "lease"             who steers
    bench       "run"               `mastctl.guided.told.GuidedRun`, the bench calibration as it is known
"""

from __future__ import annotations

import asyncio
import contextlib
import itertools
import threading
import time
from collections import deque
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from types import TracebackType
from typing import Any, ClassVar, Literal, Self, TypeVar, get_args
from weakref import WeakKeyDictionary, ref

from mastctl.control.in_turn import InTurn

Topic = Literal[
    "state", "joints", "operation", "track", "fault", "frame", "mast", "command", "lease", "bench"
]
TOPICS: frozenset[Topic] = frozenset(get_args(Topic))

_Subscription = TypeVar("_Subscription", bound="Subscription")

MOST_UNREAD = 10_000
"""Values that wait for a listener that hears every one."""

GONE: Any = object()


@dataclass(frozen=True, eq=False)
class Published:
    """A value of a topic and key, which is never edited.

    Attributes
    ----------
    sequence
        Grows with each value that is published, whatever its topic.
    """

    sequence: int
    topic: Topic
    key: str
    value: Any


class _NewestOfEach:
    """What a listener has not read: a newer value takes the place of one of the same topic and key."""

    def __init__(self) -> None:
        self._kept: dict[tuple[Topic, str], Published] = {}

    def put(self, one: Published) -> int:
        """Keep a value, or forget the one before; return how many are lost by that."""
        lost = self._kept.pop((one.topic, one.key), None) is not None
        if one.value is not GONE:
            self._kept[one.topic, one.key] = one
        return int(lost)

    def take(self) -> Iterable[Published]:
        """Hand over all."""
        kept, self._kept = self._kept, {}
        return kept.values()


class _EveryValue:
    """What a listener has not read of all values; the oldest gives way beyond ``MOST_UNREAD``."""

    def __init__(self) -> None:
        self._most = MOST_UNREAD
        self._kept = deque[Published](maxlen=self._most)

    def put(self, one: Published) -> int:
        """Keep a value, unless it is none; return how many are lost by that."""
        if one.value is GONE:
            return 0
        lost = len(self._kept) == self._most
        self._kept.append(one)
        return int(lost)

    def take(self) -> Iterable[Published]:
        """Hand over all."""
        kept, self._kept = self._kept, deque[Published](maxlen=self._most)
        return kept


class Subscription:
    """What one listener has not read yet. A context manager; one thread, or one coroutine, reads it.

    Attributes
    ----------
    lost
        How many values were replaced by newer ones before they were read, or found no room.
    """

    def __init__(
        self,
        topics: frozenset[Topic],
        keys: frozenset[str] | None,
        unread: _NewestOfEach | _EveryValue,
        wake: Callable[[], None],
        end: Callable[[Subscription], None],
    ) -> None:
        self.lost = 0
        self._topics = topics
        self._keys = keys
        self._wake = wake
        self._end = end
        self._lock = threading.Lock()  # held while a value is put in or all are handed over, never for longer
        self._unread = unread
        self._closed = False

    @property
    def closed(self) -> bool:
        """Whether no more will come: it was closed, or its publisher was."""
        return self._closed

    def close(self) -> None:
        """Hear no more; who waits is woken."""
        self._end(self)
        self._ended()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self.close()

    def _take_unread(self) -> list[Published]:
        with self._lock:
            unread = self._unread.take()
        return sorted(unread, key=lambda one: one.sequence)

    def _put(self, one: Published) -> None:
        if one.topic not in self._topics or (self._keys is not None and one.key not in self._keys):
            return
        with self._lock:
            self.lost += self._unread.put(one)
        if one.value is not GONE:
            self._wake()

    def _ended(self) -> None:
        self._closed = True
        self._wake()


class ThreadSubscription(Subscription):
    """A subscription that a thread waits on."""

    def __init__(
        self, topics: frozenset[Topic], end: Callable[[Subscription], None], every: bool = False
    ) -> None:
        self._something = threading.Event()
        unread = _EveryValue() if every else _NewestOfEach()
        super().__init__(topics, None, unread, self._something.set, end)

    def wait(self, timeout_s: float | None = None) -> list[Published]:
        """Return what is new since the last call, oldest first; wait for it for ``timeout_s`` real seconds.

        Empty if nothing came in that time, or `closed`. None waits for as long as it takes.
        """
        until_s = None if timeout_s is None else time.monotonic() + timeout_s
        while True:
            self._something.clear()
            unread = self._take_unread()
            left_s = None if until_s is None else until_s - time.monotonic()
            if unread or self._closed or (left_s is not None and left_s <= 0):
                return unread
            self._something.wait(left_s)


class LoopSubscription(Subscription):
    """A subscription that a coroutine waits on, of the event loop on which it was made."""

    def __init__(
        self, topics: frozenset[Topic], keys: frozenset[str] | None, end: Callable[[Subscription], None]
    ) -> None:
        self._loop = asyncio.get_running_loop()
        self._wakes = _Wakes.of(self._loop)
        self._something = asyncio.Event()
        self._woken = False
        super().__init__(topics, keys, _NewestOfEach(), self._wake_loop, end)

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
            if unread or self._closed or (left_s is not None and left_s <= 0):
                return unread
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(left_s):
                    await self._something.wait()

    def _wake_loop(self) -> None:
        if not self._woken:
            self._woken = True
            self._wakes.wake(self._something)


class _Wakes:
    """Wakes those who wait on one event loop, one in each of its turns.

    However many listen, who publishes calls the loop once, and what else the loop has to do, a stop above
    all, comes between them.
    """

    _known: ClassVar[WeakKeyDictionary[asyncio.AbstractEventLoop, _Wakes]] = WeakKeyDictionary()

    @classmethod
    def of(cls, loop: asyncio.AbstractEventLoop) -> _Wakes:
        """Return the one of a loop; to be called on it."""
        if loop not in cls._known:
            cls._known[loop] = cls(loop)
        return cls._known[loop]

    def __init__(self, loop: asyncio.AbstractEventLoop) -> None:
        self._call = ref(loop)
        self._due: deque[asyncio.Event] = deque()
        self._called = False

    def wake(self, waiting: asyncio.Event) -> None:
        """Have an event set; from any thread."""
        self._due.append(waiting)
        if not self._called:
            self._called = True
            self._again()

    def _again(self) -> None:
        loop = self._call()
        with contextlib.suppress(RuntimeError):  # the loop has ended, and with it who would read
            if loop is not None:
                loop.call_soon_threadsafe(self._next)

    def _next(self) -> None:
        self._called = False  # first: what comes from now on calls again
        if self._due:
            self._due.popleft().set()
        if self._due and not self._called:
            self._called = True
            self._again()


class Publisher:
    """Hands each value to everyone who listens; safe to use from any thread, never blocks."""

    def __init__(self) -> None:
        self._numbers = itertools.count(1)
        self._newest: dict[tuple[Topic, str], Published] = {}
        self._subscriptions: tuple[Subscription, ...] = ()
        self._closed = False
        self._turns = InTurn[Callable[[], None]](lambda act: act())

    def publish(self, topic: Topic, key: str, value: Any) -> None:
        """Tell everyone who listens to a topic the newest value of a key.

        Values reach each listener in the order in which they were published.
        """
        self._turns.bring(lambda: self._hand_out(topic, key, value))

    def forget(self, topic: Topic, key: str) -> None:
        """Hold a key's value no longer, for nobody: it is one of many, and old."""
        self._turns.bring(lambda: self._hand_out(topic, key, GONE))

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
        return self._added(ThreadSubscription(_checked(topics), self._leave, every), known)

    def subscribe_here(
        self, *topics: Topic, known: bool = True, keys: frozenset[str] | None = None
    ) -> LoopSubscription:
        """Return a subscription for a coroutine of the running event loop, to some keys only if they are
        given; else as `subscribe`.
        """
        return self._added(LoopSubscription(_checked(topics), keys, self._leave), known)

    @property
    def listeners(self) -> int:
        """How many subscriptions there are."""
        return len(self._subscriptions)

    def close(self) -> None:
        """End every subscription, and each that is asked for later; publishing goes nowhere from then on."""

        def end() -> None:
            self._closed = True
            subscriptions, self._subscriptions = self._subscriptions, ()
            for one in subscriptions:
                one._ended()

        self._turns.bring(end)

    def _added(self, subscription: _Subscription, known: bool) -> _Subscription:
        def add() -> None:
            if self._closed:
                subscription._ended()
                return
            self._subscriptions = (*self._subscriptions, subscription)
            if known:
                for one in self._newest.values():
                    subscription._put(one)

        self._turns.bring(add)
        return subscription

    def _leave(self, subscription: Subscription) -> None:
        def remove() -> None:
            self._subscriptions = tuple(one for one in self._subscriptions if one is not subscription)

        self._turns.bring(remove)

    def _hand_out(self, topic: Topic, key: str, value: Any) -> None:
        one = Published(next(self._numbers), topic, key, value)
        if value is GONE:
            self._newest.pop((topic, key), None)
        else:
            self._newest[topic, key] = one
        for subscription in self._subscriptions:
            subscription._put(one)


def _checked(topics: Iterable[Topic]) -> frozenset[Topic]:
    asked = frozenset(topics)
    if not asked <= TOPICS:
        raise ValueError(f"{', '.join(sorted(asked - TOPICS))}: there is no such topic")
    return asked or TOPICS
