"""One device, one thread: calls go in one at a time, and nobody waits longer than a deadline.

A driver may block, hang or raise anything. Here that becomes a typed error for the caller and a fault that
the status shows, while the other devices go on. A call that came back too late is dropped. A thread that
hangs inside a driver cannot be ended from outside: it is left alone (it is a daemon thread), calls to it
fail at once, and it serves again when the driver returns.

Deadlines and pacing run on the machine's own clock, whatever clock stamps the data.
"""

from __future__ import annotations

import logging
import threading
import time
from collections import deque
from collections.abc import Callable
from concurrent.futures import Future
from dataclasses import dataclass
from typing import Any, TypeVar

from drivers.errors import DriverError, LineLost, NoReply
from mastctl.errors import MastctlError

log = logging.getLogger(__name__)
T = TypeVar("T")


@dataclass(frozen=True)
class Fault:
    """Something wrong with a device, in plain words; ``since_s`` is a time of CLOCK_MONOTONIC."""

    device: str
    code: str
    message: str
    since_s: float


@dataclass
class _Job:
    what: str
    function: Callable[[], Any]
    timeout_s: float
    future: Future[Any]


class DeviceThread:
    """The thread that alone talks to one device.

    Parameters
    ----------
    device
        Its name in errors and faults.
    between
        Called in the thread whenever nothing is asked, as the call ``between_name`` with the deadline
        ``between_timeout_s``; returns the seconds until it wants to run again, None for never.
    """

    def __init__(
        self,
        device: str,
        *,
        between: Callable[[], float | None] | None = None,
        between_name: str = "read",
        between_timeout_s: float = 1.0,
        between_after_error_s: float = 0.2,
    ) -> None:
        self._device = device
        self._between = between
        self._between_name = between_name
        self._between_timeout_s = between_timeout_s
        self._between_after_error_s = between_after_error_s
        self._wake = threading.Condition()
        self._jobs: deque[_Job] = deque()
        self._closing = False
        self._now: tuple[str, float, float] | None = None  # what, began, must end by
        self._faults: dict[str, Fault] = {}
        self._thread = threading.Thread(target=self._serve, name=f"device {device}", daemon=True)
        self._thread.start()

    def submit(
        self, what: str, function: Callable[[], T], timeout_s: float, *, first: bool = False
    ) -> Future[T]:
        """Queue a call and return at once; ``first`` puts it before everything that waits.

        Raises
        ------
        NoReply
            At once, if the device is already overdue with an earlier call, or closed.
        """
        job = _Job(what, function, timeout_s, Future())
        with self._wake:
            if self._closing:
                raise NoReply(f"{what} was asked after the device was closed", device=self._device)
            overdue = self._overdue()
            if overdue and not first:
                raise NoReply(overdue, device=self._device)
            (self._jobs.appendleft if first else self._jobs.append)(job)
            self._wake.notify()
        return job.future

    def wait(self, what: str, future: Future[T], deadline_s: float) -> T:
        """Return a call's result, waiting until ``deadline_s`` (of `time.monotonic`) at most.

        Raises
        ------
        NoReply
            If it did not end in time; its late result will be dropped.
        """
        try:
            return future.result(max(0.0, deadline_s - time.monotonic()))
        except TimeoutError:
            future.cancel()
            error = NoReply(f"{what} did not end within its deadline", device=self._device)
            self._note(what, error)
            raise error from None

    def call(self, what: str, function: Callable[[], T], timeout_s: float) -> T:
        """Run ``function`` in the thread and return its result within ``timeout_s`` seconds.

        Raises
        ------
        NoReply
            If it did not end in time.
        DriverError, MastctlError
            Whatever of these ``function`` raises; any other exception comes as a DriverError.
        """
        deadline_s = time.monotonic() + timeout_s
        return self.wait(what, self.submit(what, function, timeout_s), deadline_s)

    def faults(self) -> tuple[Fault, ...]:
        """Return what is wrong at this moment; a call that succeeds takes back its own earlier fault.

        It also takes back every call's lost line.
        """
        with self._wake:
            overdue = self._overdue()
            faults = dict(self._faults)
            if overdue and self._now:
                faults[self._now[0]] = Fault(self._device, NoReply.code, overdue, self._now[1])
        return tuple(faults.values())

    def close(self, timeout_s: float) -> bool:
        """End the thread; return whether it ended within ``timeout_s`` seconds. Waiting calls are refused."""
        with self._wake:
            self._closing = True
            for job in self._jobs:
                job.future.cancel()
            self._jobs.clear()
            self._wake.notify()
        self._thread.join(timeout_s)
        if self._thread.is_alive():
            log.warning("%s: the driver hangs; its thread is left behind", self._device)
        return not self._thread.is_alive()

    def _overdue(self) -> str:
        """Say in plain words how late the call under way is; empty when it is not."""
        if self._now is None or time.monotonic() <= self._now[2]:
            return ""
        what, began_s, _ = self._now
        return f"does not answer: {what} has been under way for {time.monotonic() - began_s:.1f} s"

    def _serve(self) -> None:
        next_between_s = time.monotonic()
        while True:
            job: _Job | None = None
            with self._wake:
                while not self._jobs and not self._closing:
                    wait_s = None if self._between is None else next_between_s - time.monotonic()
                    if wait_s is not None and wait_s <= 0.0:
                        break
                    self._wake.wait(wait_s)
                if self._closing:
                    return
                if self._jobs:
                    job = self._jobs.popleft()
            if job is not None:
                if job.future.set_running_or_notify_cancel():
                    result, error = self._run(job.what, job.function, job.timeout_s)
                    if error is None:
                        job.future.set_result(result)
                    else:
                        job.future.set_exception(error)
            elif self._between is not None:
                pause_s, error = self._run(self._between_name, self._between, self._between_timeout_s)
                if error is None and pause_s is None:
                    self._between = None
                    continue
                next_between_s = time.monotonic() + (
                    float(pause_s) if error is None else self._between_after_error_s
                )

    def _run(self, what: str, function: Callable[[], Any], timeout_s: float) -> tuple[Any, Exception | None]:
        """Make one call; whatever happens comes back as a result or a typed error."""
        began_s = time.monotonic()
        with self._wake:
            self._now = (what, began_s, began_s + timeout_s)
        result: Any = None
        error: Exception | None = None
        try:
            result = function()
        except MastctlError as ours:  # a refusal of the service's own: nothing is wrong with the device
            error = ours
        except DriverError as fault:
            error = fault if fault.device == self._device else _named(fault, self._device)
        except (
            BaseException
        ) as anything:  # a driver from outside may raise what it likes, SystemExit included
            log.debug("%s: %s raised", self._device, what, exc_info=True)
            words = " ".join(str(anything).split())[:200]
            error = DriverError(
                f"the driver failed in {what}: {type(anything).__name__}{': ' + words if words else ''}",
                device=self._device,
            )
        finally:
            with self._wake:
                self._now = None
        self._note(what, error)
        return result, error

    def _note(self, what: str, error: Exception | None) -> None:
        """Remember a fault, or take it back after the same call succeeded; say each change once."""
        if isinstance(error, MastctlError):
            return
        with self._wake:
            known = self._faults.get(what)
            if error is None:
                self._faults.pop(what, None)
                for other, fault in list(self._faults.items()):
                    if fault.code == LineLost.code:  # the line is back, whichever call found it gone
                        del self._faults[other]
            else:
                since_s = known.since_s if known else time.monotonic()
                code = getattr(error, "code", DriverError.code)
                self._faults[what] = Fault(self._device, code, str(error), since_s)
        if error is None and known:
            log.info("%s: %s works again", self._device, what)
        elif error is not None and not known:
            log.warning("%s", error)


def _named(fault: DriverError, device: str) -> DriverError:
    """Return the same error with the device's name in front, if its class can be made so."""
    try:
        named = type(fault)(str(fault), device=device)
    except TypeError:
        return fault
    return named
