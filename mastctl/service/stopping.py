"""The stop, the emergency stop, and the reset: the head first, everything else after it.

Nothing comes before the head: no log, no file, and no lock that is kept for longer than a read.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from concurrent.futures import Future
from functools import partial
from queue import SimpleQueue
from typing import Any, TypeVar

from drivers.clock import Clock, SystemClock
from drivers.errors import DriverError
from mastctl.answers import EstopAnswer, ResetAnswer, StopAnswer
from mastctl.as_json import as_json
from mastctl.control.machine import Latched, StandingFault, StateMachine, latched_sentence
from mastctl.control.operations import STOP_REQUESTED, OperationRunner
from mastctl.devices.devices import Devices
from mastctl.errors import MastctlError, NotNow, Unable
from mastctl.motion.track import Tracker
from mastctl.safety.latch import Estopped, Latch

KEPT_S = 1.0  # what the disk is given before an emergency stop is answered without it
STRAGGLER_S = 1.0  # what a reset waits for stops that follow one that was confirmed already
THREADS = 4
OVERDUE_S = 1.5  # a stop is given 1 s by the devices

T = TypeVar("T")


class StopsHang(Unable):
    """As many stops as there are threads have not come back; another one could not be sent."""

    def __init__(self, message: str) -> None:
        super().__init__("stop_pending", message)


class StopThreads:
    """Daemon threads that exist from the start and run stops alone; safe to use from any thread.

    They wait for calls, never for ``clock``, by which a call is known to be overdue.
    """

    def __init__(self, threads: int = THREADS, clock: Clock | None = None) -> None:
        self._clock = clock or SystemClock()
        self._calls: SimpleQueue[tuple[Callable[[], Any], Future[Any]] | None] = SimpleQueue()
        self._began_s: list[float | None] = [None] * threads  # of the call that each is in
        for number in range(threads):
            threading.Thread(target=self._work, args=(number,), name=f"stop_{number}", daemon=True).start()

    def submit(self, function: Callable[[], T]) -> Future[T]:
        """Run a function in the next free thread and return its future result; returns at once.

        Raises StopsHang if every thread has been in its call for longer than a stop may take.
        """
        now_s = self._clock.now_s()
        under_way_s = [now_s - began_s for began_s in self._began_s if began_s is not None]
        if len(under_way_s) == len(self._began_s) and min(under_way_s) > OVERDUE_S:
            raise StopsHang(
                f"{len(under_way_s)} stops are under way, the oldest for {max(under_way_s):.1f} s, and none "
                "has come back; the head may still move: switch its power off"
            )
        future: Future[T] = Future()
        future.set_running_or_notify_cancel()  # a caller that waits no longer does not cancel the stop
        self._calls.put((function, future))
        return future

    def close(self) -> None:
        """Let the threads end after what is under way; does not wait."""
        for _ in self._began_s:
            self._calls.put(None)

    def _work(self, number: int) -> None:
        while (call := self._calls.get()) is not None:
            function, future = call
            self._began_s[number] = self._clock.now_s()
            end: Callable[[], None]
            try:
                end = partial(future.set_result, function())
            except BaseException as error:  # it belongs to the caller
                end = partial(future.set_exception, error)
            self._began_s[number] = None
            end()


class Stopping:
    """What ends every motion of one daemon; safe to use from any thread.

    ``latch`` is what outlives the daemon of emergency stops; what is found latched counts from the start.
    """

    def __init__(
        self,
        devices: Devices,
        operations: OperationRunner,
        tracker: Tracker,
        machine: StateMachine,
        latch: Latch,
    ) -> None:
        self._devices = devices
        self._operations = operations
        self._tracker = tracker
        self._machine = machine
        self._latch = latch
        devices.latched = self._refusal

    def stop(self, reason: str = STOP_REQUESTED) -> str | None:
        """Stop the mast, then what runs and the track; return the stopped operation's id.

        Raises DriverError.
        """
        return self._operations.stop(reason, lambda: self._tracker.stop(reason))

    def stop_answer(self) -> StopAnswer:
        """Stop as `stop`; return the answer of ``POST /stop``."""
        return {"stopped": True, "operation": self.stop()}

    def stop_track(self) -> None:
        """End the track, and stop the mast if it moves for it. Raises DriverError."""
        running = self._tracker.status.operation
        if running is not None and self._operations.running == running:
            self._operations.stop()  # the head first
        running = self._tracker.stop("the track was stopped")
        if running is not None and self._operations.running == running:
            self._operations.stop()

    def estop(self, reason: str | None = None, name: str | None = None) -> EstopAnswer:
        """Stop the mast, and let nothing move it before `reset`, across restarts too.

        The head first; then what runs and the track end; then the disk is waited for.

        Returns the answer of ``POST /estop``: ``latched``, ``kept`` (a restart would find it; else
        ``message`` says why not), ``operation``, and ``reason``, ``name`` and ``at`` of the stop that is
        latched. Raises Unable ``stop_unconfirmed`` if the head did not confirm; it is latched all the same.
        """
        stopped, unconfirmed = None, None
        with self._operations.stopping():
            cause = self.latch_estop(reason, name)
            try:
                given = f": {cause.reason} ({cause.name})" if reason or name else " was requested"
                stopped = self.stop(f"an emergency stop{given}")
            except (DriverError, MastctlError) as error:
                unconfirmed = error
        kept = self._latch.keep(KEPT_S)
        why = "" if kept else f"it would not survive a restart of the daemon: {self._latch.not_kept}"
        if unconfirmed is not None:
            message = f"the emergency stop is latched, but the head did not confirm it: {unconfirmed}"
            raise Unable("stop_unconfirmed", f"{message}; {why}" if why else message)
        answer: EstopAnswer = {
            "stopped": True,
            "latched": True,
            "kept": kept,
            "operation": stopped,
            "reason": cause.reason,
            "name": cause.name,
            "at": cause.at,
        }
        if why:
            answer["message"] = why
        return answer

    def latch_estop(self, reason: str | None, name: str | None) -> Latched:
        """Let no move out from now on; `estop` stops the head. Returns the cause that is latched."""
        with self._operations.stopping():
            cause = self._latch.add(reason, name)
            self._machine.estop_requested(lambda: self._latch.entries)
        return cause

    def reset(self, reason: str, name: str) -> ResetAnswer:
        """Release the emergency stop; nothing moves before a command comes.

        Returns the answer of ``POST /reset``: the first cause that is ``released``, and whether another came
        since.

        Raises NotNow ``not_estopped`` if none is latched, ``stopping`` if a stop is still under way after 1
        s; Unable ``not_saved`` if the disk refuses the release; ``closing``.
        """
        refusal = self._operations.refusal("latch")
        if refusal is not None:
            raise refusal
        if not self._devices.stops_returned(STRAGGLER_S):
            raise NotNow("stopping", "the mast is being stopped; an emergency stop is released after that")
        causes = self._latch.release(reason, name)
        self._machine.reset(name, reason, lambda: self._latch.entries)
        return {"latched": bool(self._latch.entries), "released": as_json(causes[0])}

    def _refusal(self) -> Estopped | None:
        """What refuses every move while anything is latched."""
        causes = self._latch.entries
        return Estopped(latched_sentence(causes)) if causes else None


def latch_faults(latch: Latch) -> Iterator[StandingFault]:
    """Yield what keeps an emergency stop from outliving the daemon, where it should."""
    if latch.not_kept and not latch.folder.is_temporary:
        message = f"an emergency stop is kept in memory only: {latch.not_kept}"
        yield StandingFault(
            "state", "latch_not_kept", message, latch.since_s, "the disk takes it, or a reset"
        )
