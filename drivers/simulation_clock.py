"""The simulation's clock: time that passes only while no thread computes, as fast as is wanted.

Threads that the clock knows of (`SimulationClock.thread`, `SimulationClock.at_work`) take turns: one
computes at a time, in an order that depends on nothing but what they did before. While one computes, time
stands still, however long a picture takes to render. When all of them wait, the clock goes to the earliest
moment that one of them waits for: at once (``speed`` infinite), or as fast as real time times ``speed``
would. So deadlines mean what they mean on a rover whose computer takes no time, and the same commands give
the same run to the last bit.

At infinite speed the clock stands still when no thread waits for a result, only for work or for the next
round (``idle``): between two commands no time passes, however long the next one lets wait. At a finite speed
it goes on.

Threads that the clock does not know may wait on it too, and time passes for them; it does not wait while
they compute. A thread at work must not wait for another such thread beside the clock: not in a
`threading.Thread.join`, and not for a lock that the other one keeps while it waits on the clock.
"""

from __future__ import annotations

import math
import threading
import time
import weakref
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from drivers.errors import BadOptions
from drivers.options import is_number

FASTEST = 1000.0
STILL_WANTED_S = 1.0  # how often a clock that is paced sees whether anybody has it still, real seconds
MAX = "max"


def simulation_speed(value: Any) -> float:
    """Return the speed that ``simulation.speed`` requests: seconds in a second, infinite for ``max``.

    Raises BadOptions for anything but a number from 0.1 to 1000 or ``max``.
    """
    if value == MAX:
        return math.inf
    if not is_number(value) or not 0.1 <= value <= FASTEST:
        raise BadOptions(
            f"simulation.speed is {value!r}, expected 1 (as life), up to {FASTEST:g} (so many times faster), "
            f"or {MAX} (nothing waits)"
        )
    return float(value)


class _Member:
    """A thread that takes turns; how many blocks of `SimulationClock.at_work` it is in."""

    depth = 1


class _Waiting:
    """A thread that waits: for the turn, for a moment, for a signal."""

    def __init__(
        self,
        member: _Member | None,
        until_s: float = math.inf,
        signal: SimulationSignal | None = None,
        idle: bool = False,
    ) -> None:
        self.member = member
        self.until_s = until_s
        self.signal = signal
        self.idle = idle
        self.notified = False
        self.gone_on = threading.Event()


class SimulationClock:
    """A clock for the simulated rover, an instance of `drivers.clock.Clock`.

    ``speed`` is seconds of this clock in a second of real time, at most; infinite to wait for nothing.
    """

    runs = True
    stands_for_work = True

    def __init__(self, speed: float = math.inf, start_s: float = 0.0) -> None:
        if not speed > 0:
            raise ValueError(f"speed is {speed}, expected a positive number")
        self._speed = speed
        self._paced = math.isfinite(speed)
        self._now_s = start_s
        self._went_s = time.monotonic()  # real time when the clock began to go from _now_s
        self._central = threading.Condition(threading.Lock())
        self._known = threading.local()
        self._turn: _Member | None = None
        self._ready: deque[_Waiting] = deque()  # may go on, each at its turn
        self._guests: deque[_Waiting] = deque()  # want to be at work
        self._waiting: list[_Waiting] = []  # in the order in which they began
        if self._paced:
            threading.Thread(
                target=_pace, args=(weakref.ref(self), self._central), name="simulation clock", daemon=True
            ).start()

    @property
    def speed(self) -> float:
        """Seconds of this clock in a second of real time, at most."""
        return self._speed

    def now_s(self) -> float:
        """Return the time now, seconds; it stays the same while the calling thread is at work."""
        with self._central:
            return self._reached_s()

    def sleep(self, duration_s: float) -> None:
        """Wait for ``duration_s`` seconds of this clock; nothing for zero or less."""
        if duration_s > 0:
            self.end_wait(self.begin_wait(duration_s, None, False))

    def signal(self) -> SimulationSignal:
        """Return a new condition variable whose waits end by this clock."""
        return SimulationSignal(self)

    def thread(self, target: Callable[[], None], name: str) -> threading.Thread:
        """Return a new daemon thread that is at work from its start to its end, in the order of starts."""
        return _Thread(self, target, name)

    @contextmanager
    def at_work(self) -> Iterator[None]:
        """Let the calling thread compute in its turn inside the block; time stands still meanwhile.

        It gets its first turn when no thread that is at work already could go on at that moment.
        """
        member: _Member | None = getattr(self._known, "member", None)
        if member is not None:
            member.depth += 1
        else:
            member = self._known.member = _Member()
            guest = _Waiting(member)
            with self._central:
                self._stand()
                self._guests.append(guest)
                self._go_on()
            self.end_wait(guest)
        try:
            yield
        finally:
            member.depth -= 1
            if member.depth == 0:
                self._known.member = None
                with self._central:
                    self._give_up_turn(member)

    # For the threads and signals of this clock

    def enrol(self) -> _Waiting:
        """Let a thread that is about to start stand in the row of those at work."""
        newcomer = _Waiting(_Member())
        with self._central:
            self._stand()
            self._ready.append(newcomer)
        return newcomer

    def begin(self) -> None:
        """Let those at work go on after a thread was started."""
        with self._central:
            self._go_on()

    def dismiss(self, newcomer: _Waiting) -> None:
        """Take a thread out that could not start."""
        with self._central:
            if newcomer in self._ready:
                self._ready.remove(newcomer)
            assert newcomer.member is not None
            self._give_up_turn(newcomer.member)

    def work(self, newcomer: _Waiting, target: Callable[[], None]) -> None:
        """Run a thread's target in its turns."""
        member = self._known.member = newcomer.member
        assert member is not None
        newcomer.gone_on.wait()
        try:
            target()
        finally:
            with self._central:
                self._give_up_turn(member)

    def begin_wait(self, timeout_s: float | None, signal: SimulationSignal | None, idle: bool) -> _Waiting:
        """Let the calling thread wait for a moment or a signal, whose lock it has."""
        member: _Member | None = getattr(self._known, "member", None)
        with self._central:
            self._stand()
            until_s = math.inf if timeout_s is None else self._now_s + max(0.0, timeout_s)
            waiting = _Waiting(member, until_s, signal, idle)
            self._waiting.append(waiting)
            if member is None:
                self._go_on()
            else:
                self._give_up_turn(member)
        return waiting

    def end_wait(self, waiting: _Waiting) -> bool:
        """Return when the wait is over: whether by a notification."""
        try:
            waiting.gone_on.wait()
        except BaseException:  # Ctrl-C in the main thread: it waits no longer
            with self._central:
                for row in (self._waiting, self._ready, self._guests):
                    if waiting in row:
                        row.remove(waiting)
                if waiting.member is not None:  # its turn may have come in the same moment
                    self._give_up_turn(waiting.member)
            self._known.member = None
            raise
        return waiting.notified

    def notify(self, signal: SimulationSignal) -> None:
        """Let all go on that wait for a signal."""
        with self._central:
            self._stand()
            for waiting in [one for one in self._waiting if one.signal is signal]:
                waiting.notified = True
                self._release(waiting)
            self._go_on()

    # With the central lock held

    def _reached_s(self) -> float:
        """The time now."""
        if not self._paced or self._turn is not None or self._ready or self._guests:
            return self._now_s
        reached_s = self._now_s + (time.monotonic() - self._went_s) * self._speed
        due_s = min((one.until_s for one in self._waiting), default=math.inf)
        return max(self._now_s, min(reached_s, due_s))

    def _stand(self) -> None:
        """Let the clock go on from where it is now."""
        self._now_s = self._reached_s()
        self._went_s = time.monotonic()

    def _give_up_turn(self, member: _Member) -> None:
        if self._turn is member:
            self._turn = None
            self._went_s = time.monotonic()
        self._go_on()

    def _release(self, waiting: _Waiting) -> None:
        """Let a thread go on: a member at its turn, any other at once."""
        self._waiting.remove(waiting)
        if waiting.member is None:
            waiting.gone_on.set()
        else:
            self._ready.append(waiting)

    def _go_on(self) -> None:
        """Give the turn to the next, if none has it; let time pass if none can go on now."""
        while self._turn is None:
            if self._ready or self._guests:
                self._stand()
                follower = self._ready.popleft() if self._ready else self._guests.popleft()
                self._turn = follower.member
                follower.gone_on.set()
                return
            if self._paced:
                self._central.notify()  # `_pace` sees to what comes next
                return
            if all(one.idle for one in self._waiting):
                return
            first = min(self._waiting, key=_until_s)
            if first.until_s == math.inf:
                return
            self._now_s = max(self._now_s, first.until_s)
            self._release(first)

    def brought_s(self) -> float:
        """Let go on whom real time has brought the moment, and return how long until the next, at most."""
        while True:
            first = min(self._waiting, key=_until_s, default=None)
            at_work = self._turn is not None or self._ready or self._guests
            if at_work or first is None or first.until_s == math.inf:
                return STILL_WANTED_S
            gone_s = time.monotonic() - self._went_s
            left_s = (first.until_s - self._now_s) / self._speed - gone_s
            if left_s > 0:
                return min(left_s, STILL_WANTED_S)
            self._now_s = max(self._now_s, first.until_s)
            self._went_s = time.monotonic()
            self._release(first)
            self._go_on()


class SimulationSignal:
    """A condition variable on a `SimulationClock`, an instance of `drivers.clock.Signal`."""

    def __init__(self, clock: SimulationClock) -> None:
        self._clock = clock
        self._lock = threading.Lock()

    def __enter__(self) -> None:
        self._lock.acquire()

    def __exit__(self, *raised: object) -> None:
        self._lock.release()

    def wait(self, timeout_s: float | None = None, *, idle: bool = False) -> bool:
        """Let go of the lock, wait, and take it again; return whether it was notified."""
        waiting = self._clock.begin_wait(timeout_s, self, idle)
        self._lock.release()
        try:
            return self._clock.end_wait(waiting)
        finally:
            self._lock.acquire()

    def notify_all(self) -> None:
        """Let all go on that wait; the lock is held."""
        self._clock.notify(self)


class _Thread(threading.Thread):
    """A thread whose computing its clock waits for."""

    def __init__(self, clock: SimulationClock, target: Callable[[], None], name: str) -> None:
        super().__init__(name=name, daemon=True)
        self._clock = clock
        self._work = target
        self._newcomer: _Waiting | None = None

    def start(self) -> None:
        self._newcomer = self._clock.enrol()
        try:
            super().start()
        except RuntimeError:
            self._clock.dismiss(self._newcomer)
            raise
        self._clock.begin()

    def run(self) -> None:
        assert self._newcomer is not None
        self._clock.work(self._newcomer, self._work)


def _pace(wanted: weakref.ref[SimulationClock], central: threading.Condition) -> None:
    """Let real time bring the moments of a clock for as long as it is in use; in a thread of its own."""
    with central:
        while (clock := wanted()) is not None:
            left_s = clock.brought_s()
            del clock
            central.wait(left_s)


def _until_s(waiting: _Waiting) -> float:
    return waiting.until_s
