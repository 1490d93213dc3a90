"""One clock for everything: the machine's monotonic clock, or one that a test turns by hand.

Code that waits does so on the clock that it was given, also for another thread. `Clock.signal` is a condition
whose waits end by this clock; `Clock.thread` makes a thread that the clock knows. `drivers.simulation_clock`
says what a clock does with that which is not bound to real time.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from types import TracebackType
from typing import Any, Protocol


class Signal(Protocol):
    """A condition variable whose waits end by a clock."""

    def __enter__(self) -> Any:
        """Take its lock."""
        ...

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None, /
    ) -> Any:
        """Let go of its lock."""
        ...

    def wait(self, timeout_s: float | None = None, *, idle: bool = False) -> bool:
        """Let go of the lock, wait, and take it again; return whether it was notified.

        ``timeout_s``: seconds of the clock at most; None for as long as it takes. ``idle``: whether no thread
        waits for the work that follows: pacing, or a thread that waits for work. Such a wait alone makes no
        time pass on a clock that need not go on.
        """
        ...

    def notify_all(self) -> None:
        """Let all go on that wait; the lock is held."""
        ...


class Clock(Protocol):
    """Seconds of a monotonic clock, and waiting on it."""

    @property
    def runs(self) -> bool:
        """Whether time passes while a thread waits; else waits for other threads run in real time."""
        ...

    @property
    def stands_for_work(self) -> bool:
        """Whether it stands still while a thread that it knows computes, and so holds up all others."""
        ...

    def now_s(self) -> float:
        """Return the time now, seconds."""
        ...

    def sleep(self, duration_s: float) -> None:
        """Wait for ``duration_s`` seconds of this clock; nothing for zero or less."""
        ...

    def signal(self) -> Signal:
        """Return a new condition variable whose waits end by this clock."""
        ...

    def thread(self, target: Callable[[], None], name: str) -> threading.Thread:
        """Return a new daemon thread, not yet started, whose computing this clock waits for if it can."""
        ...

    def at_work(self) -> AbstractContextManager[None]:
        """Make the calling thread one whose computing this clock waits for if it can, inside the block."""
        ...


class _MachineSignal(threading.Condition):
    """A condition in real time."""

    def __init__(self) -> None:
        super().__init__(threading.Lock())

    def wait(self, timeout_s: float | None = None, *, idle: bool = False) -> bool:
        return super().wait(None if timeout_s is None else max(0.0, timeout_s))


class _MachineTime:
    """Signals and threads of a clock that waits for no thread's computing."""

    runs = True
    stands_for_work = False

    def signal(self) -> Signal:
        return _MachineSignal()

    def thread(self, target: Callable[[], None], name: str) -> threading.Thread:
        return threading.Thread(target=target, name=name, daemon=True)

    def at_work(self) -> AbstractContextManager[None]:
        return nullcontext()


class ClockLock:
    """A lock for threads that wait on a clock inside it; its holder may take it again. A context manager."""

    def __init__(self, clock: Clock) -> None:
        self._free = clock.signal()
        self._owner: int | None = None
        self._depth = 0

    def acquire(self, blocking: bool = True) -> bool:
        """Take it, and wait for it if ``blocking``; return whether the calling thread has it now."""
        me = threading.get_ident()
        with self._free:
            while self._owner not in (None, me):
                if not blocking:
                    return False
                self._free.wait()
            self._owner = me
            self._depth += 1
            return True

    def release(self) -> None:
        """Give it back, as often as it was taken."""
        with self._free:
            self._depth -= 1
            if self._depth == 0:
                self._owner = None
                self._free.notify_all()

    def __enter__(self) -> None:
        self.acquire()

    def __exit__(self, *raised: object) -> None:
        self.release()


class SystemClock(_MachineTime):
    """CLOCK_MONOTONIC."""

    def now_s(self) -> float:
        return time.monotonic()

    def sleep(self, duration_s: float) -> None:
        if duration_s > 0:
            time.sleep(duration_s)


class ManualClock(_MachineTime):
    """A clock that stands still until a thread sleeps on it or advances it: tests turn it by hand.

    Signals wait in real time, since no thread would turn the clock for them.
    """

    runs = False

    def __init__(self, start_s: float = 0.0) -> None:
        self._now_s = start_s
        self._lock = threading.Lock()

    def now_s(self) -> float:
        with self._lock:
            return self._now_s

    def sleep(self, duration_s: float) -> None:
        if duration_s > 0:
            self.advance(duration_s)

    def advance(self, duration_s: float) -> None:
        """Turn the clock forward."""
        with self._lock:
            self._now_s += duration_s


def deadlines_on(clock: Clock) -> Clock:
    """Return the clock that deadlines run on where ``clock`` stamps the data."""
    return clock if clock.runs else SystemClock()
