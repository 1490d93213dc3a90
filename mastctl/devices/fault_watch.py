"""What is wrong with the devices: each change of it published once."""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence

from drivers.clock import Clock
from mastctl.control.machine import StandingFault, StateMachine, same_faults

ENDS_S = 1.0
LOOK_S = 0.1  # a call is overdue by the clock alone; so late that may show


class FaultWatch:
    """Publishes what is wrong with each device or file, and informs the machine of the head's faults.

    ``faults`` returns what is wrong with any device now; it must not wait, nor may what `also` gets. Each
    change is published as ``("fault", device, tuple)``.
    """

    def __init__(
        self, faults: Callable[[], Sequence[StandingFault]], head: str, machine: StateMachine, clock: Clock
    ) -> None:
        self._sources: tuple[Callable[[], Sequence[StandingFault]], ...] = (faults,)
        self._head = head
        self._machine = machine
        self._published: dict[str, tuple[StandingFault, ...]] = {}
        self._lock = threading.Lock()
        self._changed = clock.signal()
        self._begun = self._closed = False
        self._thread = clock.thread(self._work, "faults")

    def also(self, faults: Callable[[], Sequence[StandingFault]]) -> None:
        """Watch another source from now on: the daemon's own files."""
        self._sources = (*self._sources, faults)

    def now(self) -> tuple[StandingFault, ...]:
        """Return all that is wrong now, and publish what has changed."""
        self.look()
        return tuple(fault for faults in self._sources for fault in faults())

    def begin(self) -> None:
        """Watch from now on: ``faults`` can be called."""
        self._begun = True
        self._thread.start()

    def look(self) -> None:
        """Publish what has changed; a look that is under way is not waited for."""
        if self._begun and self._lock.acquire(blocking=False):
            try:
                self._compare()
            finally:
                self._lock.release()

    def close(self) -> None:
        """Look once more, and end the thread."""
        self.look()
        with self._changed:
            self._closed = True
            self._changed.notify_all()
        self._thread.join(ENDS_S)

    def _work(self) -> None:
        while True:
            with self._changed:
                if not self._closed:
                    self._changed.wait(LOOK_S, idle=True)
                if self._closed:
                    return
            self.look()

    def _compare(self) -> None:
        by_device: dict[str, list[StandingFault]] = {}
        for fault in (one for faults in self._sources for one in faults()):
            by_device.setdefault(fault.device, []).append(fault)
        for device in {*self._published, *by_device}:
            now = tuple(by_device.get(device, ()))
            if same_faults(now, self._published.get(device, ())):
                continue
            self._published[device] = now
            self._machine.publisher.publish("fault", device, now)
            if device == self._head:
                self._machine.head_faults(now)
