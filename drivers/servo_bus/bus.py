"""The one thread that talks on a bus; calls of other threads queue for it with a deadline.

Between calls the thread runs its own round (`Bus` is given the time of the next): reading the servos, feeding
their watchdogs, coming back after a lost line. No other thread touches the line.

A stop does not queue: it breaks off what is under way (`Bus.urgent` is queried by the line), and no move that
was called before it begins after it.
"""

from __future__ import annotations

import logging
import math
import threading
from collections import deque
from collections.abc import Callable
from typing import Any, TypeVar, cast

from drivers.clock import Clock, SystemClock
from drivers.errors import DriverError, NoReply
from drivers.servo_bus.port import Overtaken

log = logging.getLogger(__name__)

BREAK_OFF_S = 0.6  # for what is broken off to end; the opening of a line (0.5 s) cannot be
T = TypeVar("T")


class _Job:
    """A call on its way; what its caller waits on is its own, so that no other call can hold it up."""

    def __init__(
        self, function: Callable[[], Any], clock: Clock, *, first: bool = False, void: object = None
    ) -> None:
        self.function = function
        self.first = first
        self.void = void  # what has to be the last stop still when its turn comes; None: whatever
        self.result: Any = None
        self.error: BaseException | None = None
        self.claimed = threading.Lock()  # by the owner thread to run it, or by its caller to give it up
        self._ended = False
        self._signal = clock.signal()

    def run(self) -> None:
        """Run it, unless its caller gave it up."""
        if not self.claimed.acquire(blocking=False):
            return
        try:
            self.result = self.function()
        except BaseException as error:  # whatever happens belongs to the caller, not to this thread
            self.error = error
        with self._signal:
            self._ended = True
            self._signal.notify_all()

    def ends_within(self, timeout_s: float) -> bool:
        """Wait until it has been run; return whether that was within ``timeout_s``."""
        with self._signal:
            if not self._ended:
                self._signal.wait(timeout_s)  # notified once, and of nothing else
            return self._ended


class Bus:
    """The owner thread of a bus.

    ``between`` is called in the thread whenever no call waits, and returns the time of the clock, seconds, at
    which it wants to run again. It must keep what goes wrong itself; what it raises is only logged.
    """

    def __init__(self, name: str, between: Callable[[], float], clock: Clock | None = None) -> None:
        self._name = name
        self._between = between
        self._urgent_jobs: deque[_Job] = deque()
        self._jobs: deque[_Job] = deque()
        self._serving_urgent = False
        self._last_stop = object()  # replaced by each
        self._closing: _Job | None = None
        self._closing_until_s = math.inf
        self._clock = clock or SystemClock()
        self._called = self._clock.signal()
        self._thread = self._clock.thread(self._serve, f"bus {name}")

    def start(self) -> None:
        """Begin to serve; until then calls wait."""
        self._thread.start()

    def urgent(self) -> bool:
        """Whether what has the line is to break off: a call with ``first`` waits, or all time is over."""
        if self._clock.now_s() > self._closing_until_s:
            return True
        return bool(self._urgent_jobs) and not self._serving_urgent

    def call(
        self,
        what: str,
        function: Callable[[], T],
        timeout_s: float,
        *,
        first: bool = False,
        moves: bool = False,
    ) -> T:
        """Run ``function`` in the owner thread and return its result; it must end by itself in bounded time.

        With ``first`` it goes before everything that waits, and what is under way breaks off (see `urgent`):
        a stop. With ``moves`` it does not begin if a call with ``first`` came after it. Raises NoReply if it
        did not end in time, and if it had not begun then, it never will; or a stop broke it off; DriverError
        (what ``function`` raises).
        """
        if self._closing is not None:
            raise NoReply(f"{self._name} is closed; {what} was not sent")
        job = _Job(function, self._clock, first=first, void=self._last_stop if moves else None)
        if first:
            self._last_stop = object()
        (self._urgent_jobs if first else self._jobs).append(job)
        self._wake()
        if not job.ends_within(timeout_s):
            begun = not job.claimed.acquire(blocking=False)
            message = "it is still under way" if begun else "its turn did not come"
            raise NoReply(f"{what} on {self._name} did not end within {timeout_s:g} s: {message}")
        if isinstance(job.error, Overtaken):
            raise NoReply(f"{what} on {self._name} was {job.error}, since a stop came")
        if job.error is not None:
            raise job.error
        return cast(T, job.result)

    def close(self, last: Callable[[], None], timeout_s: float) -> None:
        """Run ``last`` in the thread as the last call of all and end the thread; never raises.

        It is broken off `BREAK_OFF_S` before ``timeout_s`` is over (see `urgent`). A second call waits for
        the first one's ``last``.
        """
        with self._called:
            job = self._closing
            if job is None:
                self._closing_until_s = self._clock.now_s() + timeout_s - BREAK_OFF_S
                self._closing = job = _Job(last, self._clock, first=True)
                self._last_stop = object()
                self._urgent_jobs.append(job)
                self._called.notify_all()
        if not job.ends_within(timeout_s):
            log.warning("%s: the bus thread hangs and is left behind", self._name)
            return
        self._thread.join(timeout_s)  # it waits for nothing any more
        if job.error is not None:
            log.warning("%s: %s", self._name, job.error)

    def _wake(self) -> None:
        """Have the thread look for calls; they are in their row already, so that `urgent` sees a stop."""
        with self._called:
            self._called.notify_all()

    def _serve(self) -> None:
        again_s = self._clock.now_s()
        while True:
            job = self._next()
            if job is None:
                wait_s = again_s - self._clock.now_s()
                if wait_s <= 0:
                    again_s = self._round()
                    continue
                with self._called:
                    if not (self._urgent_jobs or self._jobs):
                        self._called.wait(wait_s, idle=True)
                continue
            self._serving_urgent = job.first
            job.run()
            self._serving_urgent = False
            if job is self._closing:
                return
            del job

    def _next(self) -> _Job | None:
        """The call whose turn it is; the moves that a stop has overtaken end here."""
        if self._urgent_jobs:
            return self._urgent_jobs.popleft()
        if not self._jobs:
            return None
        job = self._jobs.popleft()
        if job.void is not None and job.void is not self._last_stop:
            job.function = _overtaken
        return job

    def _round(self) -> float:
        try:
            return self._between()
        except Overtaken:
            return self._clock.now_s()
        except DriverError as error:  # its owner keeps and reports it
            log.debug("%s: %s", self._name, error)
        except Exception:  # a defect must not end the thread that feeds the watchdogs
            log.exception("%s: the bus thread's own round failed", self._name)
        return self._clock.now_s() + 0.1


def _overtaken() -> None:
    """Stands in for a move that was still waiting when a stop came."""
    raise Overtaken("not begun; nothing was sent")
