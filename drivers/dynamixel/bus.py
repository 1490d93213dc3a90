"""The one thread that talks on a bus; calls of other threads queue for it with a deadline.

Between calls the thread runs its own round (`Bus` asks it when to come back): reading the servos, feeding
their watchdogs, coming back after a lost line. Nobody else ever touches the line.
"""

from __future__ import annotations

import logging
import threading
import time
from collections import deque
from collections.abc import Callable
from queue import Empty, SimpleQueue
from typing import Any, TypeVar, cast

from drivers.errors import DriverError, NoReply

log = logging.getLogger(__name__)
T = TypeVar("T")


class _Job:
    """A call on its way; plain locks, since a call waits for little more than the thread's turn."""

    def __init__(self, function: Callable[[], Any]) -> None:
        self.function = function
        self.result: Any = None
        self.error: BaseException | None = None
        self.claimed = threading.Lock()  # by the owner thread to run it, or by its caller to give it up
        self.done = threading.Lock()
        self.done.acquire()

    def run(self) -> None:
        """Run it, unless its caller gave it up."""
        if not self.claimed.acquire(blocking=False):
            return
        try:
            self.result = self.function()
        except BaseException as error:  # whatever happens belongs to the caller, not to this thread
            self.error = error
        self.done.release()


class Bus:
    """The owner thread of a bus.

    Parameters
    ----------
    name
        Of the thread and in errors.
    between
        Called in the thread whenever nothing is asked; returns the time of CLOCK_MONOTONIC, seconds, at
        which it wants to run again. It must keep what goes wrong itself; what it raises is only logged.
    """

    def __init__(self, name: str, between: Callable[[], float]) -> None:
        self._name = name
        self._between = between
        self._jobs: deque[_Job] = deque()
        self._wake: SimpleQueue[None] = SimpleQueue()
        self._closing: _Job | None = None
        self._thread = threading.Thread(target=self._serve, name=f"bus {name}", daemon=True)
        self._thread.start()

    def call(self, what: str, function: Callable[[], T], timeout_s: float, *, first: bool = False) -> T:
        """Run ``function`` in the owner thread and return its result.

        Parameters
        ----------
        what
            For errors.
        function
            Talks on the line; must end by itself in bounded time.
        timeout_s
            How long to wait in all, seconds.
        first
            Go before everything that waits.

        Raises
        ------
        NoReply
            If it did not end in time; if it had not begun, it never will.
        DriverError
            What ``function`` raises.
        """
        if self._closing is not None:
            raise NoReply(f"{self._name} is closed; {what} was not sent")
        job = _Job(function)
        (self._jobs.appendleft if first else self._jobs.append)(job)
        self._wake.put(None)
        if not job.done.acquire(timeout=timeout_s):
            begun = not job.claimed.acquire(blocking=False)
            words = "it is still under way" if begun else "its turn did not come"
            raise NoReply(f"{what} on {self._name} did not end within {timeout_s:g} s: {words}")
        if job.error is not None:
            raise job.error
        return cast(T, job.result)

    def close(self, last: Callable[[], None], timeout_s: float) -> None:
        """Run ``last`` in the thread as the last call of all and end the thread; never raises."""
        if self._closing is None:
            self._closing = job = _Job(last)
            self._jobs.append(job)
            self._wake.put(None)
            self._thread.join(timeout_s)
            if self._thread.is_alive():
                log.warning("%s: the bus thread hangs and is left behind", self._name)
            elif job.error is not None:
                log.warning("%s: %s", self._name, job.error)

    def _serve(self) -> None:
        again_s = time.monotonic()
        while True:
            if not self._jobs:
                wait_s = again_s - time.monotonic()
                if wait_s <= 0:
                    again_s = self._round()
                    continue
                try:
                    self._wake.get(timeout=wait_s)
                except Empty:
                    continue
            try:
                job = self._jobs.popleft()
            except IndexError:
                continue  # a wake-up for a call that was served already
            job.run()
            if job is self._closing:
                return
            del job

    def _round(self) -> float:
        try:
            return self._between()
        except DriverError as error:  # its owner keeps and tells it
            log.debug("%s: %s", self._name, error)
        except Exception:  # a defect must not end the thread that feeds the watchdogs
            log.exception("%s: the bus thread's own round failed", self._name)
        return time.monotonic() + 0.1
