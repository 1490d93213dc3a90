"""One device, one thread: calls go in one at a time, and no caller waits longer than a deadline.

A driver may block, hang or raise anything. Here that becomes a typed error for the caller and a fault that
the status shows, while the other devices go on. A result that came too late is dropped, which is logged. A
thread that hangs inside a driver cannot be ended from outside: it is left alone (it is a daemon
thread), calls to it fail at once, and it serves again when the driver returns.

Deadlines and pacing run on a clock that goes on while a thread waits, whatever clock stamps the data.
"""

from __future__ import annotations

import logging
from collections import Counter, deque
from collections.abc import Callable, Mapping
from concurrent.futures import CancelledError, Future
from dataclasses import dataclass
from typing import Any, Generic, TypeVar

from drivers.clock import Clock, SystemClock
from drivers.errors import DriverError, LineLost, NoReply
from mastctl.control.machine import StandingFault
from mastctl.errors import MastctlError, one_line

log = logging.getLogger(__name__)
T = TypeVar("T")
Check = Callable[[], None]

LONGEST_MESSAGE, LONGEST_CODE = 400, 60  # of what a driver says went wrong
CHECKED_S = 0.02  # how late a stop is noticed by a caller that waits


@dataclass(frozen=True)
class CallFault:
    """How the fault of a failed call ends: a phrase that follows "until".

    ``late_is_fault``: an answer that came too late is a fault itself, because the call moves something; any
    other answer, however late, shows that the device works again.
    """

    until: str
    late_is_fault: bool = False


@dataclass(eq=False)
class ThreadCall(Generic[T]):
    """A call on its way, from `DeviceThread.submit`; ``given_up`` when its caller has stopped waiting."""

    what: str
    function: Callable[[], T]
    timeout_s: float
    first: bool
    noted: bool
    submitted_s: float
    future: Future[T]
    given_up: bool = False


@dataclass(frozen=True)
class _CallNow:
    """The call under way."""

    what: str
    first: bool
    began_s: float
    until_s: float


class DeviceThread:
    """The thread that alone talks to one device.

    ``between``: called in the thread whenever no call waits, as the call ``between_name`` with the deadline
    ``between_timeout_s``; returns the seconds until it wants to run again, None for never; ``faults``: how
    the faults of its calls end, by their names; ``clock``: what deadlines and pacing run on; the machine's
    own by default.
    """

    def __init__(
        self,
        device: str,
        *,
        between: Callable[[], float | None] | None = None,
        between_name: str = "read",
        between_timeout_s: float = 1.0,
        between_after_error_s: float = 0.2,
        faults: Mapping[str, CallFault] | None = None,
        clock: Clock | None = None,
    ) -> None:
        self._device = device
        self._clock = clock or SystemClock()
        self._between = between
        self._between_name = between_name
        self._between_timeout_s = between_timeout_s
        self._between_after_error_s = between_after_error_s
        self._kinds = dict(faults or {})
        self._wake = self._clock.signal()
        self._jobs: deque[ThreadCall[Any]] = deque()
        self._closing = False
        self._now: _CallNow | None = None
        self._errors: Counter[tuple[str, str]] = Counter()
        self._faults: Mapping[str, StandingFault] = {}  # replaced, never edited: read without a lock
        self._thread = self._clock.thread(self._serve, f"device {device}")
        self._thread.start()

    def submit(
        self,
        what: str,
        function: Callable[[], T],
        timeout_s: float,
        *,
        first: bool = False,
        anyway: bool = False,
        noted: bool = True,
    ) -> ThreadCall[T]:
        """Queue a call and return at once.

        Parameters
        ----------
        timeout_s
            How long it may take in the thread, seconds.
        first
            Before everything that waits, whatever the device does meanwhile; closing lets it go out too. That
            it hangs is its caller's to report.
        anyway
            Also behind a call that is overdue.
        noted
            Whether its errors become faults; otherwise they are its caller's to report.

        Raises NoReply: at once, if the device is already overdue with an earlier call, or closed.
        """
        call = ThreadCall(what, function, timeout_s, first, noted, self._clock.now_s(), Future[T]())
        with self._wake:
            if self._closing:
                raise NoReply(f"{what} was requested after the device was closed", device=self._device)
            overdue = self._overdue(self._now)
            if overdue and not first and not anyway:
                raise NoReply(overdue, device=self._device)
            (self._jobs.appendleft if first else self._jobs.append)(call)
            self._wake.notify_all()
        return call

    def wait(self, call: ThreadCall[T], deadline_s: float, check: Check | None = None) -> T:
        """Return a call's result, waiting until ``deadline_s`` (of the clock) at most.

        ``check`` is called meanwhile, every `CHECKED_S`; what it raises ends the wait.

        Raises NoReply if it did not end in time: it will not begin any more, or its late result will be
        dropped; DriverError, MastctlError: whatever of these it raised.
        """
        with self._wake:
            while not call.future.done():
                left_s = deadline_s - self._clock.now_s()
                if left_s <= 0:
                    break
                if check is not None:
                    try:
                        check()
                    except BaseException:
                        self._drop(call)
                        raise
                    left_s = min(left_s, CHECKED_S)
                self._wake.wait(left_s)
            if not call.future.done():
                call.given_up = True
                self._drop(call)
        if not call.given_up:
            try:
                return call.future.result(0)
            except CancelledError:
                raise NoReply(f"{call.what} did not begin before the end", device=self._device) from None
        error = NoReply(f"{call.what} did not end within its deadline", device=self._device)
        if call.noted:
            self._note(call.what, error)
        raise error

    def call(self, what: str, function: Callable[[], T], timeout_s: float, *, noted: bool = True) -> T:
        """Run ``function`` in the thread and return its result within ``timeout_s`` seconds.

        Raises NoReply if it did not end in time; DriverError, MastctlError: whatever of these ``function``
        raises; any other exception comes as a DriverError.
        """
        deadline_s = self._clock.now_s() + timeout_s
        return self.wait(self.submit(what, function, timeout_s, noted=noted), deadline_s)

    def errors(self) -> dict[tuple[str, str], int]:
        """Return how often each call has failed since the start, by its name and the error's code."""
        with self._wake:
            return dict(self._errors)

    def faults(self) -> tuple[StandingFault, ...]:
        """Return what is wrong at this moment; a call that succeeds takes back its own earlier fault.

        It also takes back every call's lost line.
        """
        faults = dict(self._faults)
        now = self._now
        overdue = self._overdue(now)
        if overdue and now is not None and not now.first:
            faults[now.what] = self._fault(now.what, NoReply.code, overdue, now.began_s)
        return tuple(faults.values())

    def end(self) -> None:
        """Have the thread end; waits for nothing.

        Waiting calls are refused, except those that go ``first``: they still go out before the end.
        """
        with self._wake:
            self._closing = True
            for call in self._jobs:
                if not call.first:
                    call.future.cancel()
            self._jobs = deque(call for call in self._jobs if call.first)
            self._wake.notify_all()

    def close(self, timeout_s: float) -> bool:
        """End the thread; return whether it ended within ``timeout_s`` seconds of real time.

        Not for a thread at work on the clock: the one that ends would wait for its turn meanwhile.
        """
        self.end()
        self._thread.join(timeout_s)
        if not self._thread.is_alive():
            return True
        # A simulated clock stands while another thread computes, a picture for example: then nothing hangs.
        why = "the driver hangs" if self._overdue(self._now) else "its last call is still under way"
        log.warning("%s: %s; its thread is left behind", self._device, why)
        return False

    def typed(self, what: str, error: BaseException) -> Exception:
        """Return what a driver raised as an error of the service's own kind, with the device's name."""
        if isinstance(error, MastctlError):
            return error
        message = one_line(error, LONGEST_MESSAGE)
        if isinstance(error, DriverError) and message:
            as_ours = getattr(error, "device", None) == self._device and message == str(error)
            return error if as_ours else _named(error, message, self._device)
        log.debug("%s: %s raised", self._device, what, exc_info=error)
        return DriverError(
            f"the driver failed in {what}: {type(error).__name__}{': ' + message if message else ''}",
            device=self._device,
        )

    def _overdue(self, now: _CallNow | None) -> str:
        """Return a sentence on how late the call under way is; empty when it is not."""
        now_s = self._clock.now_s()
        if now is None or now_s < now.until_s:
            return ""
        return f"does not answer: {now.what} has been under way for {now_s - now.began_s:.1f} s"

    def _fault(self, what: str, code: str, message: str, since_s: float) -> StandingFault:
        kind = self._kinds.get(what)
        until = f"{what} goes well again" if kind is None else kind.until
        return StandingFault(
            self._device, code, message, since_s, "the line is back" if code == LineLost.code else until
        )

    def _drop(self, call: ThreadCall[Any]) -> None:
        """Let a call not begin, if it has not; the lock is kept."""
        if call.future.cancel() and call in self._jobs:
            self._jobs.remove(call)

    def _serve(self) -> None:
        next_between_s = self._clock.now_s()
        while True:
            call: ThreadCall[Any] | None = None
            with self._wake:
                while not self._jobs and not self._closing:
                    wait_s = None if self._between is None else next_between_s - self._clock.now_s()
                    if wait_s is not None and wait_s <= 0.0:
                        break
                    self._wake.wait(wait_s, idle=True)
                if self._jobs:
                    call = self._jobs.popleft()
                elif self._closing:
                    return
            if call is not None:
                if call.future.set_running_or_notify_cancel():
                    self._answer(call)
            elif self._between is not None:
                name, timeout_s = self._between_name, self._between_timeout_s
                now_s = self._clock.now_s()
                pause_s, error = self._run(
                    ThreadCall(name, self._between, timeout_s, False, True, now_s, Future())
                )
                if error is None and pause_s is None:
                    self._between = None
                    continue
                next_between_s = self._clock.now_s() + (
                    float(pause_s) if error is None else self._between_after_error_s
                )

    def _answer(self, call: ThreadCall[Any]) -> None:
        """Make a call whose result a caller waits for."""
        result, error = self._run(call)
        with self._wake:
            if error is None:
                call.future.set_result(result)
            else:
                call.future.set_exception(error)
            self._wake.notify_all()

    def _run(self, call: ThreadCall[Any]) -> tuple[Any, Exception | None]:
        """Make one call; whatever happens comes back as a result or a typed error."""
        began_s = self._clock.now_s()
        with self._wake:
            self._now = _CallNow(call.what, call.first, began_s, began_s + call.timeout_s)
        result: Any = None
        error: Exception | None = None
        try:
            result = call.function()
        except BaseException as anything:  # a driver from outside may raise SystemExit or worse
            error = self.typed(call.what, anything)
        finally:
            with self._wake:
                self._now = None
        ended_s = self._clock.now_s()
        if call.noted:
            late = call.given_up or ended_s > began_s + call.timeout_s
            self._note(call.what, error, ended_s - call.submitted_s if late else None)
        return result, error

    def _note(self, what: str, error: Exception | None, late_s: float | None = None) -> None:
        """Remember a fault, or take it back after the same call succeeded; each change is logged once.

        ``late_s`` is how long ago a call was requested that ended when no caller waited for it any more.
        """
        if late_s is not None:
            ended = "ended only now" if error is None else f"failed only now: {error}"
            late = NoReply(f"a {what} requested {late_s:.1f} s ago {ended}", device=self._device)
            log.warning("%s", late)
            kind = self._kinds.get(what)
            if error is None and kind is not None and kind.late_is_fault:
                error = late
        if isinstance(error, MastctlError):
            return
        with self._wake:
            known = self._faults.get(what)
            if error is None:
                self._faults = {
                    other: fault
                    for other, fault in self._faults.items()
                    if other != what and fault.code != LineLost.code  # whichever call found the line gone
                }
            else:
                since_s = known.since_s if known else self._clock.now_s()
                code = getattr(error, "code", DriverError.code)
                self._errors[what, code] += 1
                fault = self._fault(what, code, str(error), since_s)
                self._faults = {**self._faults, what: fault}
        if error is None and known:
            log.info("%s: %s works again", self._device, what)
        elif error is not None and not known and late_s is None:
            log.warning("%s", error)


def _named(fault: DriverError, message: str, device: str) -> DriverError:
    """Return the same error with this message after the device's name, if its class can be made so."""
    message = message.removeprefix(f"{device}: ")
    try:
        return type(fault)(message, device=device, detail=fault.detail)
    except Exception:  # a class from outside may want other parameters
        named = DriverError(message, device=device)
        named.code = one_line(fault.code, LONGEST_CODE) or DriverError.code
        return named
