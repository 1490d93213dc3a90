"""One device, one thread: calls go in one at a time, and no caller waits longer than a deadline.

A driver may block, hang or raise anything. Here that becomes a typed error for the caller and a fault that
the status shows, while the other devices go on. A result that came too late is dropped, which is logged. A
thread that hangs inside a driver cannot be ended from outside: it is left alone (it is a daemon
thread), calls to it fail at once, and it serves again when the driver returns.

The stops of a head go out whatever hangs, and no move goes out before all of them are back: a driver that
hangs may carry out an old stop much later, and a move that was sent meanwhile would end half-way without a
reason.

Deadlines and pacing run on a clock that goes on while a thread waits, whatever clock stamps the data.
"""

from __future__ import annotations

import logging
from collections import Counter, deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Generic, TypeVar

from drivers.clock import Clock, SystemClock
from drivers.errors import DriverError, LineLost, NoReply
from mastctl.control.machine import StandingFault
from mastctl.errors import MastctlError, Stopped, one_line

log = logging.getLogger(__name__)
T = TypeVar("T")
Check = Callable[[], None]

LONGEST_MESSAGE = 400  # of what a driver says went wrong
CHECKED_S = 0.02  # how late a stop is noticed by a caller that waits
AFTER_ERROR_S = 0.2  # before the device is tried again between calls

PATIENCE_S = 0.05  # how long a stop waits for the head's own thread before it goes out beside it
AT_ONCE_S = 0.002  # the same for a driver that is at its best beside a call under way
LATEST_SHARE = 1 / 8  # of the time that a head hangs already: a new stop waits no longer for its own thread
REST_S = 0.3  # after a move or a stop, before a reading that says rest is one of its end
MAY_MOVE = "the head may still move"
UNTIL = "a stop is confirmed, or the head is read at rest"


@dataclass(eq=False)
class ThreadCall(Generic[T]):
    """A call on its way, from `DeviceThread.submit`; ``given_up`` when its caller has stopped waiting."""

    name: str
    function: Callable[[], T]
    timeout_s: float
    first: bool
    noted: bool
    submitted_s: float
    began_s: float = 0.0
    outcome: tuple[Any, Exception | None] | None = None
    given_up: bool = False


class DeviceThread:
    """The thread that alone talks to one device.

    ``faults``: until when the faults of its calls last, by their names. ``moves``: the call that moves
    something: an answer of it that came too late is a fault itself; any other, however late, shows that the
    device works again. ``clock``: what deadlines and pacing run on.
    """

    def __init__(
        self,
        device: str,
        *,
        faults: Mapping[str, str] | None = None,
        moves: str = "",
        clock: Clock | None = None,
    ) -> None:
        self._device = device
        self._clock = clock or SystemClock()
        self._poll: tuple[str, Callable[[], float | None], float] | None = None
        self._poll_s = 0.0  # when it is due
        self._until = dict(faults or {})
        self._moves = moves
        self._changed = self._clock.signal()
        self._waiting: deque[ThreadCall[Any]] = deque()
        self._closing = False
        self._current: ThreadCall[Any] | None = None
        self._errors: Counter[tuple[str, str]] = Counter()
        self._faults: Mapping[str, StandingFault] = {}  # replaced, never edited: read without a lock
        self._thread = self._clock.thread(self._serve, f"device {device}")
        self._thread.start()

    def poll(self, name: str, function: Callable[[], float | None], timeout_s: float) -> None:
        """Run ``function`` in the thread from now on, whenever no call waits, as a call of this name.

        It returns the seconds until it wants to run again, None for never; ``timeout_s`` is its deadline.
        """
        with self._changed:
            self._poll, self._poll_s = (name, function, timeout_s), self._clock.now_s()
            self._changed.notify_all()

    def submit(
        self,
        name: str,
        function: Callable[[], T],
        timeout_s: float,
        *,
        first: bool = False,
        noted: bool = True,
    ) -> ThreadCall[T]:
        """Queue a call and return at once; it may take ``timeout_s`` seconds in the thread.

        ``first``: before everything that waits; closing lets it go out too. That it hangs is its caller's to
        report. ``noted``: whether its errors become faults; otherwise they are its caller's to report.

        Raises NoReply: at once, if the device is closed.
        """
        call = ThreadCall(name, function, timeout_s, first, noted, self._clock.now_s())
        with self._changed:
            if self._closing:
                raise NoReply(f"{name} was requested after the device was closed", device=self._device)
            (self._waiting.appendleft if first else self._waiting.append)(call)
            self._changed.notify_all()
        return call

    def wait(self, call: ThreadCall[T], deadline_s: float, check: Check | None = None) -> T:
        """Return a call's result, or raise its error, waiting until ``deadline_s`` (of the clock) at most.

        ``check`` is called meanwhile, every `CHECKED_S`; what it raises ends the wait. Raises NoReply at once
        if the device is overdue with an earlier call, and if the call did not end in time: then it does not
        begin any more, or its late result is dropped.
        """
        with self._changed:
            overdue = self._overdue() if call in self._waiting else ""
            if overdue:
                self._drop(call)
                raise NoReply(overdue, device=self._device)
            while call.outcome is None:
                left_s = deadline_s - self._clock.now_s()
                if left_s <= 0:
                    call.given_up = True
                    self._drop(call)
                    break
                if check is not None:
                    try:
                        check()
                    except BaseException:
                        self._drop(call)
                        raise
                    left_s = min(left_s, CHECKED_S)
                self._changed.wait(left_s)
        if call.outcome is None:
            late = NoReply(f"{call.name} did not end within its deadline", device=self._device)
            if call.noted:
                self._note(call.name, late)
            raise late
        result, error = call.outcome
        if error is not None:
            raise error
        return result  # type: ignore[no-any-return]

    def call(self, name: str, function: Callable[[], T], timeout_s: float, *, noted: bool = True) -> T:
        """Run ``function`` in the thread and return its result within ``timeout_s`` seconds.

        Raises NoReply if it did not end in time; what ``function`` raises, as a DriverError or MastctlError.
        """
        deadline_s = self._clock.now_s() + timeout_s
        return self.wait(self.submit(name, function, timeout_s, noted=noted), deadline_s)

    def errors(self) -> dict[tuple[str, str], int]:
        """Return how often each call has failed since the start, by its name and the error's code."""
        with self._changed:
            return dict(self._errors)

    def faults(self) -> tuple[StandingFault, ...]:
        """Return what is wrong; a call that succeeds takes back its own fault, and every lost line."""
        faults, current, overdue = dict(self._faults), self._current, self._overdue()
        if overdue and current is not None and not current.first:
            faults[current.name] = self._fault(current.name, NoReply.code, overdue, current.began_s)
        return tuple(faults.values())

    def end(self) -> None:
        """Have the thread end, without waiting; calls that wait are refused, but those that go ``first``."""
        with self._changed:
            self._closing = True
            for call in [one for one in self._waiting if not one.first]:
                refusal = NoReply(f"{call.name} did not begin before the end", device=self._device)
                call.outcome = None, refusal
                self._waiting.remove(call)
            self._changed.notify_all()

    def close(self, timeout_s: float) -> None:
        """End the thread, and wait ``timeout_s`` seconds of real time for that.

        Not for a thread at work on the clock: the one that ends would wait for its turn meanwhile.
        """
        self.end()
        self._thread.join(timeout_s)
        if self._thread.is_alive():
            log.warning("%s: a call is still under way; its thread is left behind", self._device)

    def typed(self, name: str, error: BaseException) -> Exception:
        """Return what a driver raised as an error of the service's own kind, with the device's name."""
        if isinstance(error, MastctlError):
            return error
        message = one_line(error, LONGEST_MESSAGE)
        if isinstance(error, DriverError) and message:
            named = f"{self._device}: {message.removeprefix(f'{self._device}: ')}"
            error.args, error.device = (named,), self._device
            if str(error) == named:
                return error
        log.debug("%s: %s raised", self._device, name, exc_info=error)
        return DriverError(
            f"the driver failed in {name}: {type(error).__name__}{': ' + message if message else ''}",
            device=self._device,
        )

    def _overdue(self) -> str:
        """How late the call under way is; empty when it is not."""
        current, now_s = self._current, self._clock.now_s()
        if current is None or now_s < current.began_s + current.timeout_s:
            return ""
        return f"does not answer: {current.name} has been under way for {now_s - current.began_s:.1f} s"

    def _fault(self, name: str, code: str, message: str, since_s: float) -> StandingFault:
        until = self._until.get(name, f"{name} goes well again")
        return StandingFault(
            self._device, code, message, since_s, "the line is back" if code == LineLost.code else until
        )

    def _drop(self, call: ThreadCall[Any]) -> None:
        """Let a call not begin, if it has not; the lock is kept."""
        if call in self._waiting:
            self._waiting.remove(call)

    def _serve(self) -> None:
        while True:
            with self._changed:
                while not self._waiting and not self._closing:
                    wait_s = None if self._poll is None else self._poll_s - self._clock.now_s()
                    if wait_s is not None and wait_s <= 0.0:
                        break
                    self._changed.wait(wait_s, idle=True)
                call, poll = self._waiting.popleft() if self._waiting else None, self._poll
                if call is None and self._closing:
                    return
            if call is not None:
                self._run(call)
            elif poll is not None:
                name, function, timeout_s = poll
                now_s = self._clock.now_s()
                pause_s, error = self._run(ThreadCall(name, function, timeout_s, False, True, now_s))
                if error is not None:
                    pause_s = AFTER_ERROR_S
                if pause_s is None:
                    self._poll = None
                else:
                    self._poll_s = self._clock.now_s() + float(pause_s)

    def _run(self, call: ThreadCall[T]) -> tuple[Any, Exception | None]:
        """Make one call; whatever happens comes back as a result or a typed error."""
        call.began_s = self._clock.now_s()
        self._current = call
        result: Any = None
        error: Exception | None = None
        try:
            result = call.function()
        except BaseException as anything:  # a driver from outside may raise SystemExit or worse
            error = self.typed(call.name, anything)
        self._current = None
        ended_s = self._clock.now_s()
        if call.noted:
            late = call.given_up or ended_s > call.began_s + call.timeout_s
            self._note(call.name, error, ended_s - call.submitted_s if late else None)
        with self._changed:
            call.outcome = result, error
            self._changed.notify_all()
        return call.outcome

    def _note(self, name: str, error: Exception | None, late_s: float | None = None) -> None:
        """Remember a fault, or take it back after the same call succeeded; each change is logged once.

        ``late_s`` is how long ago a call was requested that ended when no caller waited for it any more.
        """
        if late_s is not None:
            ended = "ended only now" if error is None else f"failed only now: {error}"
            late = NoReply(f"a {name} requested {late_s:.1f} s ago {ended}", device=self._device)
            log.warning("%s", late)
            if error is None and name == self._moves:
                error = late
        if isinstance(error, MastctlError):
            return
        with self._changed:
            known = self._faults.get(name)
            if error is None:
                self._faults = {
                    other: fault
                    for other, fault in self._faults.items()
                    if other != name and fault.code != LineLost.code  # whichever call found the line gone
                }
            else:
                since_s = known.since_s if known else self._clock.now_s()
                code = getattr(error, "code", DriverError.code)
                self._errors[name, code] += 1
                self._faults = {**self._faults, name: self._fault(name, code, str(error), since_s)}
        if error is None and known:
            log.info("%s: %s works again", self._device, name)
        elif error is not None and not known and late_s is None:
            log.warning("%s", error)


@dataclass(frozen=True)
class _Inside:
    """A stop inside the driver: when it was requested, and when it went in."""

    requested_s: float
    began_s: float


class HeadThread(DeviceThread):
    """The thread of a head, which also sends its stops and knows which of them are still on their way.

    A stop goes before everything that waits in the head's own thread. If that hangs in an earlier call, the
    stop also goes out beside it, from a thread of its own: a driver that is not made for two threads may then
    answer badly, but a stop that arrives is worth more than an answer. The one in the queue follows when the
    hanging call is back, since that may have been a move.

    ``stop`` is the driver's; ``patience_s`` how long one waits for the head's own thread, seconds.
    """

    def __init__(
        self,
        device: str,
        stop: Callable[[], None],
        patience_s: float,
        clock: Clock,
        faults: Mapping[str, str],
    ) -> None:
        self._stop = stop
        self._patience_s = patience_s
        self._stops_changed = clock.signal()
        self._count = 0
        self._queued_s: float | None = None  # when the stop was requested that waits in the head's thread
        self._inside: list[_Inside] = []
        self._good_s = float("-inf")  # when a stop came back last that went well
        self._failed = float("-inf"), Exception()  # when the last stop went in that failed, and how
        self._stop_fault: StandingFault | None = None
        self._overdue_s = float("inf")
        super().__init__(device, faults=faults, moves="move", clock=clock)

    def ticket(self) -> int:
        """Return what a move hands to `check` later. Raises Stopped if a stop is overdue."""
        with self._stops_changed:
            overdue = self._overdue_stop(self._clock.now_s())
            if overdue:
                raise Stopped(overdue)
            return self._count

    def check(self, ticket: int) -> None:
        """Pass a move that may go out now, in the head's own thread. Raises Stopped."""
        with self._stops_changed:
            if ticket != self._count:
                raise Stopped("a stop came before the move was sent")
            if self._inside:
                raise Stopped(self._on_its_way(self._inside[0].requested_s, self._clock.now_s()))

    def rests(self) -> None:
        """Note that the head was read at rest: what failed stops left is over."""
        fault = self._stop_fault
        if fault is not None and self._clock.now_s() - fault.since_s > REST_S:
            with self._stops_changed:
                if self._stop_fault is fault and not self._inside:
                    self._stop_fault = None

    def stop(self, timeout_s: float) -> None:
        """Stop the head and return when that is confirmed, by this stop or by another on its way.

        Raises NoReply if no stop was confirmed within ``timeout_s`` seconds, DriverError, MastctlError if the
        driver refused it; the head may still move.
        """
        try:
            with self._clock.at_work():  # a simulation's second does not pass before the stop is queued
                requested_s = self._clock.now_s()
                self._send(requested_s, timeout_s)
        except (DriverError, MastctlError) as error:
            message = str(error) if MAY_MOVE in str(error) else f"{error}; {MAY_MOVE}"
            with self._stops_changed:
                since_s = requested_s if self._stop_fault is None else self._stop_fault.since_s
                self._stop_fault = StandingFault(self._device, error.code, message, since_s, UNTIL)
            raise
        with self._stops_changed:
            self._stop_fault = None

    def stops_returned(self, timeout_s: float) -> bool:
        """Return whether no stop is queued or inside the driver; wait ``timeout_s`` seconds for that.

        A stop that was confirmed beside the head's own thread still has one in that thread's queue.
        """
        deadline_s = self._clock.now_s() + timeout_s
        with self._stops_changed:
            while self._queued_s is not None or self._inside:
                left_s = deadline_s - self._clock.now_s()
                if left_s <= 0.0:
                    return False
                self._stops_changed.wait(left_s)
        return True

    def faults(self) -> tuple[StandingFault, ...]:
        """Return what is wrong with calls and stops at this moment; takes no lock."""
        now_s = self._clock.now_s()
        fault = self._stop_fault
        overdue = self._overdue_stop(now_s)
        if overdue:
            since_s = min((one.requested_s for one in tuple(self._inside)), default=now_s)
            message, until = f"{self._device}: {overdue}; {MAY_MOVE}", f"it is back, and then {UNTIL}"
            fault = StandingFault(self._device, NoReply.code, message, since_s, until)
        return super().faults() + (() if fault is None else (fault,))

    def _send(self, requested_s: float, timeout_s: float) -> None:
        deadline_s = requested_s + timeout_s
        beside, alone = False, ""
        with self._stops_changed:
            self._count += 1
            self._overdue_s = timeout_s
            if self._queued_s is None:
                self.submit("stop", self._in_turn, timeout_s, first=True, noted=False)
                self._queued_s = requested_s
            while self._good_s < requested_s:
                now_s = self._clock.now_s()
                failed_s, error = self._failed
                if failed_s >= requested_s and (self._queued_s is None or now_s >= deadline_s):
                    raise error
                if now_s >= deadline_s:
                    message = f"stop did not end within its deadline{alone}; {MAY_MOVE}"
                    raise NoReply(message, device=self._device)
                again_s = deadline_s
                if self._queued_s is not None and not beside:
                    began_s = [one.began_s for one in self._inside]
                    at_s = max(requested_s + self._patience_s, next_try_s(began_s, timeout_s))
                    beside = now_s >= at_s
                    if beside:
                        alone = self._go_beside(requested_s)
                        continue
                    again_s = min(deadline_s, at_s)
                self._stops_changed.wait(again_s - now_s)

    def _go_beside(self, requested_s: float) -> str:
        """Send a stop from a thread of its own; return why that cannot be done. The lock is kept."""
        inside = _Inside(requested_s, self._clock.now_s())

        def go() -> None:
            try:
                self._into_driver(inside)
            except (DriverError, MastctlError) as error:
                log.warning("a stop beside a hanging call failed: %s", error)

        self._inside.append(inside)
        try:
            self._clock.thread(go, "stop beside").start()
        except RuntimeError as error:  # no more threads: the one in the queue is what is left
            self._inside.remove(inside)
            return f", and none could be sent beside the call that hangs ({error})"
        return ""

    def _in_turn(self) -> None:
        """The stop in the head's own thread."""
        with self._stops_changed:
            now_s = self._clock.now_s()
            inside = _Inside(now_s if self._queued_s is None else self._queued_s, now_s)
            self._queued_s = None
            self._inside.append(inside)
        self._into_driver(inside)

    def _into_driver(self, inside: _Inside) -> None:
        """Make one stop, and wake those that wait for one."""
        error: Exception | None = None
        try:
            self._stop()
        except BaseException as anything:  # a driver from outside may raise what it likes
            error = self.typed("stop", anything)
        ended_s = self._clock.now_s()
        with self._stops_changed:
            self._inside.remove(inside)
            if error is None:
                self._good_s = ended_s
            else:
                self._failed = inside.began_s, error
            self._stops_changed.notify_all()
        if ended_s > inside.requested_s + self._overdue_s:
            ended = "ended only now" if error is None else f"failed only now: {error}"
            log.warning(
                "%s: a stop requested %.1f s ago %s", self._device, ended_s - inside.requested_s, ended
            )
        if error is not None:
            raise error

    def _overdue_stop(self, now_s: float) -> str:
        """Say which stop has not come back in time; empty if none."""
        good_s = self._good_s  # requests before that were answered, by another stop
        waiting_s = [
            one.requested_s
            for one in tuple(self._inside)
            if now_s >= (one.began_s if one.requested_s <= good_s else one.requested_s) + self._overdue_s
        ]
        return self._on_its_way(min(waiting_s), now_s) if waiting_s else ""

    @staticmethod
    def _on_its_way(requested_s: float, now_s: float) -> str:
        overdue = f"a stop requested {now_s - requested_s:.1f} s ago has not come back from the driver yet"
        return f"{overdue}; no move goes out before it has"


def next_try_s(began_s: Sequence[float], timeout_s: float) -> float:
    """Return from when on one more stop may go into a driver in which others hang.

    The newest one must have hung for its deadline, or for an eighth of the time that the oldest hangs: so the
    number of threads grows with the logarithm of that time, and a stop is never long without its own try.
    ``began_s`` is when those inside went in, in any order, ``timeout_s`` the deadline of a stop.
    """
    if not began_s:
        return float("-inf")
    newest_s = max(began_s)
    return newest_s + max(timeout_s, LATEST_SHARE * (newest_s - min(began_s)))
