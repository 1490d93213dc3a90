"""A bench for heads on scripted units: in memory on a turned clock, or behind a pseudo terminal."""

from __future__ import annotations

import threading
from collections.abc import Callable
from contextlib import ExitStack
from typing import Any

from drivers.clock import Clock, SystemClock
from drivers.flir_ptu.head import FlirPtu, open_head
from drivers.serial_line import SerialLine
from drivers.sim.wire.line import PtyLine
from drivers.sim.wire.memory_line import MemoryLine
from drivers.simulation_clock import SimulationClock
from hil_tests.drivers.flir_ptu.scripted_ptu import OPTIONS, ScriptedPtu
from hil_tests.waiting import until


class Bench:
    """Lines with scripted units, and heads on them; bytes take no time on the wire.

    Attributes
    ----------
    clock
        What everything here waits on.
    """

    def __init__(self, stack: ExitStack, real: bool) -> None:
        self._stack = stack
        self.clock: Clock = SystemClock() if real else SimulationClock(start_s=10.0)
        stack.enter_context(self.clock.at_work())

    def __call__(self, unit: ScriptedPtu | None = None, **options: Any) -> tuple[FlirPtu, ScriptedPtu]:
        """Open a head on a unit; both are closed at the end."""
        unit = unit or ScriptedPtu()
        return self.head(self.line(unit), **options), unit

    def line(self, unit: ScriptedPtu) -> PtyLine | MemoryLine:
        kind = PtyLine if isinstance(self.clock, SystemClock) else MemoryLine
        return self._stack.enter_context(kind(unit, self.clock, wire_time=False))

    def head(self, line: PtyLine | MemoryLine, **options: Any) -> FlirPtu:
        opens = line.open if isinstance(line, MemoryLine) else SerialLine
        head = open_head({**OPTIONS, "port": line.path, **options}, self.clock, opens)
        self._stack.callback(head.close)
        return head

    def until(self, holds: Callable[[], Any], what: str) -> Any:
        return until(holds, what, clock=self.clock)

    def begun(self, *targets: Callable[[], Any]) -> list[threading.Thread]:
        """Start threads."""
        threads = [self.clock.thread(target, "test") for target in targets]
        for thread in threads:
            thread.start()
        return threads

    def ended(self, *threads: threading.Thread) -> None:
        """Wait for their end."""
        self.until(lambda: not any(thread.is_alive() for thread in threads), "the threads' end")
