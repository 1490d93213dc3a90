"""Where stops run: threads that are there from the start, and that nothing else can keep busy."""

from __future__ import annotations

import threading
from collections.abc import Callable
from concurrent.futures import Future
from queue import SimpleQueue
from typing import TypeVar

from drivers.clock import Clock, SystemClock
from mastctl.errors import Unable

T = TypeVar("T")

THREADS = 4
OVERDUE_S = 1.5  # a stop is given 1 s by the devices


class StopsHang(Unable):
    """As many stops as there are threads have not come back; another one could not be sent."""

    def __init__(self, message: str) -> None:
        super().__init__("stop_pending", message)


class StopThreads:
    """Daemon threads that run one call after the other; safe to use from any thread.

    They wait for calls, never for ``clock``, by which a call is known to be overdue.
    """

    def __init__(self, threads: int = THREADS, clock: Clock | None = None) -> None:
        self._threads = threads
        self._clock = clock or SystemClock()
        self._calls: SimpleQueue[Callable[[], None] | None] = SimpleQueue()
        self._began_s: dict[object, float] = {}  # of the calls under way
        for number in range(threads):
            threading.Thread(target=self._work, name=f"stop_{number}", daemon=True).start()

    def submit(self, function: Callable[[], T]) -> Future[T]:
        """Run a function in the next free thread and return its future result; returns at once.

        Raises StopsHang if every thread has been in its call for longer than a stop may take.
        """
        now_s = self._clock.now_s()
        under_way_s = [now_s - began_s for began_s in self._began_s.copy().values()]
        if len(under_way_s) >= self._threads and min(under_way_s) > OVERDUE_S:
            raise StopsHang(
                f"{len(under_way_s)} stops are under way, the oldest for {max(under_way_s):.1f} s, and none "
                "has come back; the head may still move: switch its power off"
            )
        future: Future[T] = Future()
        future.set_running_or_notify_cancel()  # a caller that waits no longer does not cancel the stop

        def call() -> None:
            self._began_s[future] = self._clock.now_s()
            try:
                result = function()
            except BaseException as error:  # it belongs to the caller
                self._began_s.pop(future)
                future.set_exception(error)
            else:
                self._began_s.pop(future)
                future.set_result(result)

        self._calls.put(call)
        return future

    def close(self) -> None:
        """Let the threads end after what is under way; does not wait."""
        for _ in range(self._threads):
            self._calls.put(None)

    def _work(self) -> None:
        while (call := self._calls.get()) is not None:
            call()
