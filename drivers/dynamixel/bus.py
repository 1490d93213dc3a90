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
from concurrent.futures import CancelledError, Future
from typing import Any, TypeVar

from drivers.errors import DriverError, NoReply

log = logging.getLogger(__name__)
T = TypeVar("T")


class Bus:
    """The owner thread of a bus.

    Parameters
    ----------
    name
        Of the thread and in errors.
    between
        Called in the thread whenever nothing is asked; returns the time of CLOCK_MONOTONIC, seconds, at
        which it wants to run again. What it raises is logged: it must keep its own state.
    """

    def __init__(self, name: str, between: Callable[[], float]) -> None:
        self._name = name
        self._between = between
        self._wake = threading.Condition()
        self._jobs: deque[tuple[Callable[[], Any], Future[Any]]] = deque()
        self._closing = False
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
        future: Future[T] = Future()
        with self._wake:
            if self._closing:
                raise NoReply(f"{self._name} is closed; {what} was not sent")
            (self._jobs.appendleft if first else self._jobs.append)((function, future))
            self._wake.notify()
        try:
            return future.result(timeout_s)
        except CancelledError:
            raise NoReply(f"{self._name} was closed before {what} was sent") from None
        except TimeoutError:
            words = "its turn did not come" if future.cancel() else "it is still under way"
            raise NoReply(f"{what} on {self._name} did not end within {timeout_s:g} s: {words}") from None

    def close(self, last: Callable[[], None], timeout_s: float) -> None:
        """Refuse what waits, run ``last`` in the thread and end it; never raises."""
        future: Future[None] = Future()
        with self._wake:
            if self._closing:
                return
            self._closing = True
            for _, waiting in self._jobs:
                waiting.cancel()
            self._jobs.clear()
            self._jobs.append((last, future))
            self._wake.notify()
        self._thread.join(timeout_s)
        if self._thread.is_alive():
            log.warning("%s: the bus thread hangs and is left behind", self._name)

    def _serve(self) -> None:
        again_s = time.monotonic()
        while True:
            with self._wake:
                while not self._jobs and (wait_s := again_s - time.monotonic()) > 0:
                    self._wake.wait(wait_s)
                job = self._jobs.popleft() if self._jobs else None
                last = self._closing and not self._jobs
            if job is None:
                again_s = self._round()
                continue
            function, future = job
            if future.set_running_or_notify_cancel():
                try:
                    future.set_result(function())
                except BaseException as error:  # whatever happens belongs to the caller, not to this thread
                    future.set_exception(error)
            del job, function, future
            if last:
                return

    def _round(self) -> float:
        try:
            return self._between()
        except DriverError as error:
            log.warning("%s: %s", self._name, error)
        except Exception:  # a defect must not end the thread that feeds the watchdogs
            log.exception("%s: the bus thread's own round failed", self._name)
        return time.monotonic() + 0.1
