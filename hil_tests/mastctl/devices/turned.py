"""What a test of the devices needs on a turned clock: a hang, threads, and waits for what others do."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Any

from drivers.clock import Clock
from drivers.simulation_clock import SimulationClock
from hil_tests.waiting import until
from mastctl.devices.judge import Limits

LIMITS = Limits((-2.0, 2.0), (-1.0, 1.0), 0.5)
DIGEST = "0123456789abcdef" * 4


class Turned(SimulationClock):
    """A simulation's clock; the test is at work on it, so time passes in its own waits only."""

    def __init__(self) -> None:
        super().__init__(start_s=1000.0)

    def until(self, holds: Callable[[], Any], what: str) -> Any:
        return until(holds, what, clock=self)

    def begun(self, *targets: Callable[[], Any]) -> list[threading.Thread]:
        """Start threads."""
        threads = [self.thread(target, "test") for target in targets]
        for thread in threads:
            thread.start()
        return threads

    def ended(self, threads: list[threading.Thread]) -> None:
        """Wait for their end."""
        self.until(lambda: not any(thread.is_alive() for thread in threads), "the threads' end")


class Hang:
    """Something to hang in, on any clock: a call blocks until ``let_go``."""

    def __init__(self, clock: Clock) -> None:
        self._clock = clock
        self._changed = clock.signal()
        self._entered = self._free = False

    def __call__(self, *ignored: Any) -> None:
        with self._changed:
            self._entered = True
            while not self._free:
                self._changed.wait()

    def reached(self) -> None:
        """Wait until somebody hangs here."""
        until(lambda: self._entered, "somebody hangs", clock=self._clock)

    def let_go(self) -> None:
        """Let them go on, and wait a moment in which they do."""
        with self._changed:
            self._free = True
            self._changed.notify_all()
        self._clock.sleep(0.001)
