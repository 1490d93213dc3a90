"""The stops of a head: each goes out whatever hangs, and no move goes out before all of them are back.

A driver that hangs may carry out an old stop much later. A move that was sent meanwhile would end half-way
without a reason, so moves are refused until every stop is back, and one that comes back late is a fault.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from drivers.clock import Clock, SystemClock
from drivers.errors import DriverError, LineLost, NoReply
from mastctl.control.machine import StandingFault
from mastctl.devices.thread import DeviceThread, log
from mastctl.errors import MastctlError, Stopped

PATIENCE_S = 0.05  # how long a stop waits for the head's own thread before it goes out beside it
AT_ONCE_S = 0.002  # the same for a driver that is at its best beside a call under way
LATEST_SHARE = 1 / 8  # of the time that a head hangs already: a new stop waits no longer for its own thread
MAY_MOVE = "the head may still move"
UNTIL = "a stop is confirmed, or a later move is taken and the head then rests"
UNTIL_LINE = "the line is back and the head rests, or a stop is confirmed"


@dataclass(frozen=True)
class _Inside:
    """A stop inside the driver: when it was requested, and when it went in."""

    requested_s: float
    began_s: float


class StopRequests:
    """Sends the stops of one head and knows which of them are still on their way; safe from any thread.

    A stop goes before everything that waits in the head's own thread. If that hangs in an earlier call, the
    stop also goes out beside it, from a thread of its own: a driver that is not made for two threads may then
    answer badly, but a stop that arrives is worth more than an answer. The one in the queue follows when the
    hanging call is back, since that may have been a move.

    ``thread``, ``device``, ``stop``: the head's own thread, its name, and the driver's stop; ``clock``: what
    deadlines run on; the machine's own by default; ``patience_s``: how long a stop waits for the head's own
    thread before it goes out beside it, seconds.
    """

    def __init__(
        self,
        thread: DeviceThread,
        device: str,
        stop: Callable[[], None],
        clock: Clock | None = None,
        patience_s: float = PATIENCE_S,
    ) -> None:
        self._patience_s = patience_s
        self._clock = clock or SystemClock()
        self._thread = thread
        self._device = device
        self._stop = stop
        self._changed = self._clock.signal()
        self._count = 0
        self._queued_s: float | None = None  # when the stop was requested that waits in the head's thread
        self._inside: list[_Inside] = []
        self._good_s = float("-inf")  # when a stop came back last that went well
        self._failed: tuple[_Inside, Exception] | None = None
        self._fault: StandingFault | None = None
        self._late_s = float("-inf")  # when a stop came back last that came too late
        self._overdue_s = float("inf")

    def ticket(self) -> int:
        """Return what a move hands to `check` later. Raises Stopped if a stop is overdue."""
        with self._changed:
            overdue = self._overdue(self._clock.now_s())
            if overdue:
                raise Stopped(overdue)
            return self._count

    def check(self, ticket: int) -> None:
        """Pass a move that may go out now, in the head's own thread. Raises Stopped."""
        with self._changed:
            if ticket != self._count:
                raise Stopped("a stop came before the move was sent")
            if self._inside:
                raise Stopped(self._message(self._inside[0].requested_s, self._clock.now_s()))

    def send(self, timeout_s: float) -> None:
        """Stop the head and return when that is confirmed, by this stop or by another on its way.

        Raises NoReply if no stop was confirmed within ``timeout_s`` seconds; the head may still move;
        DriverError, MastctlError if the driver refused it.
        """
        with self._clock.at_work():  # a simulation's second does not pass before the stop is queued
            self._confirmed(timeout_s)

    def _confirmed(self, timeout_s: float) -> None:
        requested_s = self._clock.now_s()
        try:
            self._send(requested_s, timeout_s)
        except (DriverError, MastctlError) as error:
            message = str(error) if MAY_MOVE in str(error) else f"{error}; {MAY_MOVE}"
            with self._changed:
                since_s = requested_s if self._fault is None else self._fault.since_s
                only_line = error.code == LineLost.code and (
                    self._fault is None or self._fault.until == UNTIL_LINE
                )  # a lost line takes nothing back of what another stop has left
                until = UNTIL_LINE if only_line else UNTIL
                self._fault = StandingFault(self._device, error.code, message, since_s, until)
            raise
        with self._changed:
            if self._late_s < requested_s:
                self._fault = None

    def returned(self, timeout_s: float) -> bool:
        """Return whether no stop is queued or inside the driver; wait ``timeout_s`` seconds for that.

        A stop that was confirmed beside the head's own thread still has one in that thread's queue.
        """
        deadline_s = self._clock.now_s() + timeout_s
        with self._changed:
            while self._queued_s is not None or self._inside:
                left_s = deadline_s - self._clock.now_s()
                if left_s <= 0.0:
                    return False
                self._changed.wait(left_s)
        return True

    def proved(self, ticket: int) -> None:
        """Take back what earlier stops left: the move of a later ticket was taken, and the head rests."""
        with self._changed:
            if ticket == self._count:
                self._fault = None

    def rests(self) -> None:
        """Take back a stop that a lost line kept from the head: the head was read, and rests."""
        fault = self._fault
        if fault is not None and fault.until == UNTIL_LINE:
            with self._changed:
                if self._fault is fault:
                    self._fault = None

    def faults(self) -> tuple[StandingFault, ...]:
        """Return what is wrong with the stops at this moment; takes no lock."""
        now_s = self._clock.now_s()
        fault, queued_s = self._fault, self._queued_s
        overdue = self._overdue(now_s)
        if overdue:
            since_s = min([one.requested_s for one in tuple(self._inside)] + [queued_s or now_s])
            message, until = f"{self._device}: {overdue}; {MAY_MOVE}", f"it is back, and then {UNTIL}"
            return (StandingFault(self._device, NoReply.code, message, since_s, until),)
        return () if fault is None else (fault,)

    def _send(self, requested_s: float, timeout_s: float) -> None:
        deadline_s = requested_s + timeout_s
        beside, alone = False, ""
        with self._changed:
            self._count += 1
            self._overdue_s = timeout_s
            if self._queued_s is None:
                self._thread.submit("stop", self._in_turn, timeout_s, first=True, noted=False)
                self._queued_s = requested_s
            while self._good_s < requested_s:
                now_s = self._clock.now_s()
                failed = self._failed is not None and self._failed[0].began_s >= requested_s
                if failed and self._failed is not None and (self._queued_s is None or now_s >= deadline_s):
                    raise self._failed[1]
                if now_s >= deadline_s:
                    message = f"stop did not end within its deadline{alone}; {MAY_MOVE}"
                    raise NoReply(message, device=self._device)
                again_s = deadline_s
                if self._queued_s is not None and not beside:
                    began_s = [one.began_s for one in self._inside]
                    at_s = max(requested_s + self._patience_s, next_try_s(began_s, timeout_s))
                    beside = now_s >= at_s
                    if beside:
                        alone = self._go_beside(requested_s, timeout_s)
                        continue
                    again_s = min(deadline_s, at_s)
                self._changed.wait(again_s - now_s)

    def _go_beside(self, requested_s: float, timeout_s: float) -> str:
        """Send a stop from a thread of its own; return why that cannot be done. The lock is kept."""
        inside = _Inside(requested_s, self._clock.now_s())
        thread = self._clock.thread(lambda: self._beside(inside, timeout_s), "stop beside")
        self._inside.append(inside)
        try:
            thread.start()
        except RuntimeError as error:  # no more threads: the one in the queue is what is left
            self._inside.remove(inside)
            return f", and none could be sent beside the call that hangs ({error})"
        return ""

    def _beside(self, inside: _Inside, timeout_s: float) -> None:
        try:
            self._into_driver(inside, timeout_s)
        except (DriverError, MastctlError) as error:
            log.warning("a stop beside a hanging call failed: %s", error)

    def _in_turn(self) -> None:
        """The stop in the head's own thread."""
        with self._changed:
            now_s = self._clock.now_s()
            inside = _Inside(now_s if self._queued_s is None else self._queued_s, now_s)
            self._queued_s = None
            self._inside.append(inside)
        self._into_driver(inside, self._overdue_s)

    def _into_driver(self, inside: _Inside, timeout_s: float) -> None:
        """Make one stop, and wake those that wait for one."""
        error: Exception | None = None
        try:
            self._stop()
        except BaseException as anything:  # a driver from outside may raise what it likes
            error = self._thread.typed("stop", anything)
        ended_s = self._clock.now_s()
        message = f"{self._device}: a stop requested {ended_s - inside.requested_s:.1f} s ago "
        message += "ended only now" if error is None else f"failed only now: {error}"
        with self._changed:
            self._inside.remove(inside)
            if error is None:
                self._good_s = ended_s
            else:
                self._failed = inside, error
            given_up = self._fault is not None and ended_s > inside.requested_s + timeout_s
            late = given_up or ended_s > inside.began_s + timeout_s
            if late:
                self._late_s = ended_s
                self._fault = StandingFault(self._device, NoReply.code, message, inside.requested_s, UNTIL)
            self._changed.notify_all()
        if late:
            log.warning("%s", message)
        if error is not None:
            raise error

    def _overdue(self, now_s: float) -> str:
        """Say which stop has not come back in time; empty if none."""
        good_s = self._good_s  # requests before that were answered, by another stop
        waiting_s = [
            one.requested_s
            for one in tuple(self._inside)
            if now_s >= (one.began_s if one.requested_s <= good_s else one.requested_s) + self._overdue_s
        ]
        return self._message(min(waiting_s), now_s) if waiting_s else ""

    @staticmethod
    def _message(requested_s: float, now_s: float) -> str:
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
