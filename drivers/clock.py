"""One clock for everything: the machine's monotonic clock, or one that a test turns by hand."""

from __future__ import annotations

import threading
import time
from typing import Protocol


class Clock(Protocol):
    """Seconds of a monotonic clock, and waiting on it."""

    def now_s(self) -> float:
        """Return the time now, seconds."""
        ...

    def sleep(self, duration_s: float) -> None:
        """Wait for ``duration_s`` seconds of this clock; nothing for zero or less."""
        ...


class SystemClock:
    """CLOCK_MONOTONIC."""

    def now_s(self) -> float:
        return time.monotonic()

    def sleep(self, duration_s: float) -> None:
        if duration_s > 0:
            time.sleep(duration_s)


class ManualClock:
    """A clock that stands still until somebody sleeps on it or advances it: tests turn it by hand."""

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
