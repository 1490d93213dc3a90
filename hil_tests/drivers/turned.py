"""What a test of a driver does on the clock that everything of it runs on: waiting, and threads beside it.

On a `SimulationClock` the test itself has to be ``at_work``; then nothing here takes any real time, and a run
is the same each time. On the machine's clock all of it works too, with the net of `hil_tests.waiting`.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TypeVar

from drivers.clock import Clock
from drivers.interfaces import PanTilt, Reading
from drivers.serial_line import ByteLine, OpenLine
from drivers.simulation_clock import SimulationClock
from hil_tests import waiting

START_S = 1000.0
T = TypeVar("T")


class Turned:
    """Waiting by a clock.

    Attributes
    ----------
    clock
        Everything runs on it.
    """

    clock: Clock

    def now_s(self) -> float:
        return self.clock.now_s()

    def until(self, true: Callable[[], T], what: str) -> T:
        """Wait for something that must come, and return it."""
        return waiting.until(true, what, clock=self.clock)

    def settled(self, head: PanTilt) -> Reading:
        """Return the first reading of a head that stands."""
        readings: list[Reading] = []

        def stands() -> bool:
            readings.append(head.read())
            return not readings[-1].moving

        self.until(stands, "rest")
        return readings[-1]

    def gate(self) -> Gate:
        return Gate(self.clock)

    def beside(self, target: Callable[[], object]) -> Gate:
        """Run ``target`` in a thread of its own; the gate opens when it has ended."""
        ended = self.gate()

        def run() -> None:
            try:
                target()
            finally:
                ended.set()

        self.clock.thread(run, "beside the test").start()
        return ended

    def outside(self, target: Callable[[], object]) -> None:
        """Run what joins threads of the clock in a thread that the clock does not know, and wait for its end.

        Time passes meanwhile only as far as that thread waits on the clock.
        """
        signal, ended = self.clock.signal(), []

        def run() -> None:
            try:
                target()
            finally:
                with signal:
                    ended.append(True)
                    signal.notify_all()

        with signal:
            threading.Thread(target=run, daemon=True).start()
            while not ended:
                signal.wait(idle=True)


@contextmanager
def turned() -> Iterator[Turned]:
    """A turned clock with nothing on it, at which the test is at work."""
    it = Turned()
    it.clock = SimulationClock(start_s=START_S)
    with it.clock.at_work():
        yield it


class Gate:
    """Closed until it is set; waiting at it is waiting on the clock."""

    def __init__(self, clock: Clock) -> None:
        self.is_open = False
        self._signal = clock.signal()

    def set(self) -> None:
        with self._signal:
            self.is_open = True
            self._signal.notify_all()

    def wait(self) -> None:
        """Wait until it is open; raises AssertionError after a minute of the clock."""
        with self._signal:
            while not self.is_open:
                assert self._signal.wait(waiting.NET_S), "the gate stayed closed"


class HangingHost:
    """Opens a driver's line so that the driver can be kept from writing, as in a process that hangs."""

    def __init__(self, open_line: OpenLine, clock: Clock) -> None:
        self._open_line = open_line
        self._free = Gate(clock)
        self._free.set()
        self._clock = clock

    def __call__(self, port: str, baud: int, device: str = "") -> ByteLine:
        line = self._open_line(port, baud, device)
        return _HangingLine(line, lambda: self._free)

    @contextmanager
    def hanging(self) -> Iterator[None]:
        """Every write waits until this ends."""
        self._free = Gate(self._clock)
        try:
            yield
        finally:
            self._free.set()


class _HangingLine:
    """A line on which writing waits at a gate."""

    def __init__(self, line: ByteLine, free: Callable[[], Gate]) -> None:
        self._line, self._free = line, free
        self.baud, self.byte_s = line.baud, line.byte_s

    def write(self, data: bytes) -> None:
        self._free().wait()
        self._line.write(data)

    def read(self, wait_s: float) -> bytes:
        return self._line.read(wait_s)

    def close(self) -> None:
        self._line.close()
