"""Operations: one at a time, in a thread of its own, each with a record of what it did.

This module does not know how to point. It runs the work that it gets, keeps the record, and makes sure that a
stop is final: from its request until the operation has ended, no move goes out.

Records are read without a lock: they are a mapping that is replaced, never edited. The lock is for those that
write, and is not kept while anything else is waited for.
"""

from __future__ import annotations

import itertools
import logging
import secrets
import threading
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Any, Protocol

from calib.errors import CalibError
from drivers.clock import Clock, deadlines_on
from drivers.errors import DriverError
from mastctl.answers import OperationAnswer, OperationListed, OperationState
from mastctl.as_json import as_json
from mastctl.control.machine import CLOSING, Need, Residual, StateMachine
from mastctl.errors import MastctlError, NotKnown, NotNow, Stopped, Unable, error_body

log = logging.getLogger(__name__)

KEPT_OPERATIONS = 200
END_TIMEOUT_S = 5.0  # for a cancelled operation to notice, when the service closes
ENDS_SOON_S = 2.0  # a stopped operation ends its computation first; the next command waits for that

STOP_REQUESTED = "a stop was requested"


@dataclass(frozen=True, eq=False)
class Operation:
    """One operation's record so far; replaced as it goes on, never edited. Times of CLOCK_MONOTONIC."""

    id: str
    state: OperationState
    request: Mapping[str, Any]
    created_s: float
    started_s: float | None = None
    ended_s: float | None = None
    steps: tuple[Any, ...] = ()
    result: Any = None
    error: Mapping[str, Any] | None = None

    def listed(self) -> OperationListed:
        """Return the record as JSON without its steps; in front the last pointing's residual."""
        made = as_json(self.result)
        result = made if isinstance(made, dict) else {}
        pointings = result.get("pointings") or []
        last = pointings[-1] if pointings else {}
        record: OperationListed = {
            "id": self.id,
            "state": self.state,
            "request": as_json(self.request),
            "created_s": self.created_s,
            "started_s": self.started_s,
            "ended_s": self.ended_s,
            "error": as_json(self.error),
            "residual_px": last.get("residual_px"),
            "residual_sigma_px": last.get("residual_sigma_px"),
            "position_m": result.get("position_m"),
            "range_m": result.get("range_m"),
            "range_from": result.get("range_from", ""),
            "range_interval_m": result.get("range_interval_m"),
            "pointings": pointings,
        }
        if "ended_because" in result:
            record["ended_because"] = result["ended_because"]
        return record

    def as_json(self) -> OperationAnswer:
        """Return the record as JSON with its steps."""
        return {**self.listed(), "steps": as_json(self.steps)}


def last_residual(result: Any, name: str) -> Residual | None:
    """Return the residual that a result ends with, if it measured one."""
    last = as_json(_last_pointing(result))
    residual, sigma = last.get("residual_px"), last.get("residual_sigma_px")
    if not (residual and sigma and None not in residual and None not in sigma):
        return None
    return Residual((residual[0], residual[1]), (sigma[0], sigma[1]), name)


def last_frame(result: Any) -> str | None:
    """Return the id of the image that a result ends with, None where it took none."""
    return _last_pointing(result).get("frame_id") or None


def _last_pointing(result: Any) -> Mapping[str, Any]:
    """The last pointing of a result that has some, an empty one of any other."""
    pointings = result.get("pointings") if isinstance(result, Mapping) else None
    return pointings[-1] if pointings else {}


class Mover(Protocol):
    """What of `mastctl.devices.devices.Devices` is needed to stop and to keep stopped."""

    def stop(self) -> None: ...
    def block_moves(self, holder: object, reason: str) -> None: ...
    def allow_moves(self, holder: object) -> None: ...


Work = Callable[[Callable[[Any], None], threading.Event], Any]
OnEnd = Callable[[Operation], None]


class OperationRunner:
    """The operations of this run of the service; safe to use from any thread.

    ``run`` is part of every id, so that an id from before a restart names nothing; random by default.
    ``on_ended`` gets the last record of each operation, in its thread, and must return at once. ``machine``
    gets what runs, and refuses what may not begin now.
    """

    def __init__(
        self,
        mover: Mover,
        clock: Clock,
        run: str | None = None,
        on_ended: OnEnd = lambda operation: None,
        machine: StateMachine | None = None,
    ) -> None:
        self._mover = mover
        self._machine = machine or StateMachine(clock)
        self._publisher = self._machine.publisher
        self._clock = clock
        self._time = deadlines_on(clock)
        self._ended = self._time.signal()
        self._lock = threading.Lock()
        self._records: Mapping[str, Operation] = {}  # oldest first
        self._numbers = itertools.count(1)
        self._run = run or secrets.token_hex(2)
        self._on_ended = on_ended
        self._current: tuple[str, threading.Event, threading.Thread] | None = None
        self._closed = False
        self._stops_of_its_own = 0  # under way, for operations beyond their deadline
        self._deadline: tuple[str, float, MastctlError] | None = None  # of an operation; what ends it then
        self._time.thread(self._watch, "deadlines").start()
        self._cancelled_because: MastctlError = Stopped(STOP_REQUESTED)

    @property
    def running(self) -> str | None:
        """Id of the running operation, None when none runs."""
        return self._machine.standing.operation

    def start(self, request: Mapping[str, Any], work: Work, on_end: OnEnd | None = None) -> Operation:
        """Start ``work(record_step, cancelled)`` in a thread and return its first record.

        ``on_end`` gets the last record, in the same thread, when the next operation may be started already.
        Waits for nothing: `let_stopped_end` does, before any lock is taken. Raises as `StateMachine.refusal`
        of ``motion``; Unable ``no_thread`` if the machine has none for it (the record says so too).
        """
        with self._lock:
            name = f"{next(self._numbers):06d}-{self._run}"
            self._machine.operation_began(name, request)
            operation = Operation(name, "queued", dict(request), self._clock.now_s())
            cancelled = threading.Event()
            thread = self._clock.thread(
                lambda: self._work(name, work, cancelled, on_end), f"operation {name}"
            )
            self._keep(operation)
            self._current = (name, cancelled, thread)
        try:
            thread.start()
        except RuntimeError as error:  # no thread to be had: nothing has moved, and the next may have one
            unable = Unable("no_thread", f"operation {name} was not started: {error}")
            self._end(name, "failed", None, error_body(unable))
            raise unable from None
        return operation

    @contextmanager
    def stopping(self) -> Iterator[None]:
        """Let no operation start and no move go out inside the block; waits for nothing."""
        holder = object()
        self._machine.stop_requested()
        self._mover.block_moves(holder, STOP_REQUESTED)
        try:
            yield
        finally:
            self._mover.allow_moves(holder)
            self._machine.stop_ended()

    def stop(self, reason: str = STOP_REQUESTED, also: Callable[[], object] = lambda: None) -> str | None:
        """Stop the mast, then the running operation, if any, and what ``also`` ends; return its id.

        The head comes first: nothing is written before its stop was sent. ``reason`` goes into the
        operation's record. Raises DriverError if the head did not confirm the stop; the operation is stopped
        all the same.
        """
        with self.stopping():
            running = self._current
            if running is not None:  # what ends from here on, ends by the stop
                self._cancelled_because = Stopped(reason)
                running[1].set()
            try:
                self._mover.stop()
            finally:
                with self._lock:
                    name = self._cancel(reason)
                also()
        if name is None and running is not None and self.get(running[0]).state == "stopped":
            name = running[0]
        log.info("stop%s", f": operation {name}" if name else "")
        return name

    def refusal(self, need: Need) -> MastctlError | None:
        """Return the refusal of a command, as `StateMachine.refusal`; what was stopped may end first."""
        self.let_stopped_end()
        return self._machine.refusal(need)

    def let_stopped_end(self) -> None:
        """Wait for an operation that is being ended, and for a deadline's stop; `ENDS_SOON_S` at most.

        Returns at once if there is none. A stop itself is answered when the head has confirmed it.
        """
        until_s = self._time.now_s() + ENDS_SOON_S
        with self._ended:
            while self._being_ended():
                left_s = until_s - self._time.now_s()
                if left_s <= 0:
                    return
                self._ended.wait(left_s)

    def _being_ended(self) -> bool:
        current = self._current
        return self._stops_of_its_own > 0 or (current is not None and current[1].is_set())

    def end_within(self, name: str, left_s: float, allowed_s: float) -> None:
        """Stop the mast and end an operation with ``deadline_passed`` if it runs longer than ``left_s``.

        ``allowed_s`` is how long altogether, for the message. A stop that comes before is the last word.
        """
        late = NotNow("deadline_passed", f"operation {name} did not end in the {allowed_s:g} s it was given")
        with self._ended:
            if (current := self._current) is not None and current[0] == name:
                self._deadline = name, self._time.now_s() + left_s, late
                self._ended.notify_all()

    def _watch(self) -> None:
        """End each operation at its deadline, in a thread of its own."""
        while True:
            with self._ended:
                if self._closed:
                    return
                if self._deadline is None:
                    self._ended.wait(idle=True)
                    continue
                name, until_s, late = self._deadline
                wait_s = until_s - self._time.now_s()
                if wait_s > 0.0:
                    self._ended.wait(wait_s, idle=True)
                    continue
                self._deadline = None
            self._end_by(name, late)

    def end_stopped(self, name: str, reason: str = STOP_REQUESTED) -> None:
        """Stop the mast and end an operation if it runs: it began after a stop, or is of no use any more."""
        self._end_by(name, Stopped(reason))

    def stop_one(self, name: str) -> None:
        """Stop the mast and one operation, if it runs; nothing where it has ended, or another one runs.

        Raises as `get`; DriverError if the head did not confirm the stop.
        """
        self.get(name)
        error = self._end_by(name, Stopped(STOP_REQUESTED))
        if error is not None:
            raise error

    def get(self, name: str) -> Operation:
        """Return one record. Raises NotKnown ``operation_unknown`` if it is not of this run, or not kept."""
        operation = self._records.get(name)
        if operation is None:
            message = f"operation {name[:80]} is not known; the newest {KEPT_OPERATIONS} of this run are kept"
            raise NotKnown("operation_unknown", message)
        return operation

    def all(self) -> list[Operation]:
        """Return the kept records, newest first."""
        return list(self._records.values())[::-1]

    def close(self) -> None:
        """Take no more, stop the mast and what runs, and wait some seconds for it to end; never raises.

        The second time nothing is done: the devices may be closed by then.
        """
        if self._closed:
            return
        with self._ended:
            self._closed = True
            self._ended.notify_all()
        self._machine.closing()
        self._mover.block_moves(self, CLOSING)
        self._stop_anyway("as the service closes")
        with self._lock:
            current = self._current
            self._cancel(CLOSING)
        if current is None:
            return
        current[2].join(END_TIMEOUT_S)
        if current[2].is_alive():
            log.error("operation %s did not end within %.0f s; it is given up", current[0], END_TIMEOUT_S)
            self._end(current[0], "stopped", None, error_body(Stopped(CLOSING)))

    def _end_by(self, name: str, error: MastctlError) -> BaseException | None:
        """End an operation with an error and stop the mast, unless it is being stopped already.

        Returns why the head did not confirm the stop, None if it did.
        """
        with self._lock:
            current = self._current
            if current is None or current[0] != name or current[1].is_set():
                return None
            with self._ended:
                self._stops_of_its_own += 1
            self._cancelled_because = error
            current[1].set()
            self._mover.block_moves(name, str(error))
        self._machine.stop_requested()
        unconfirmed = self._stop_anyway(f"when operation {name} was to end")
        self._machine.stop_ended()
        with self._ended:
            self._stops_of_its_own -= 1
            self._ended.notify_all()
        return unconfirmed

    def _stop_anyway(self, when: str) -> BaseException | None:
        """Stop the mast where no client waits for the answer; return what its driver raises."""
        try:
            self._mover.stop()
        except BaseException as error:
            log.error("the head did not confirm the stop %s: %s", when, error_body(error)["message"])
            return error
        return None

    def _keep(self, operation: Operation) -> None:
        """Keep a record, and forget the oldest; the lock is kept."""
        records = {**self._records, operation.id: operation}
        while len(records) > KEPT_OPERATIONS:
            oldest = next(iter(records))
            del records[oldest]
            self._publisher.forget("operation", oldest)
        self._records = records
        self._publisher.publish("operation", operation.id, operation)

    def _cancel(self, reason: str) -> str | None:
        """Have the running operation end and let no further move of it out; the lock is kept."""
        if self._current is None:
            return None
        name, cancelled, _ = self._current
        self._cancelled_because = Stopped(reason)
        cancelled.set()
        self._mover.block_moves(name, reason)
        return name

    def _work(self, name: str, work: Work, cancelled: threading.Event, on_end: OnEnd | None) -> None:
        """Run one operation, then hand over its last record."""
        self._run_to_end(name, work, cancelled)
        for hand_over in (self._on_ended, on_end):
            if hand_over is None:
                continue
            try:
                hand_over(self.get(name))
            except Exception:  # its record is closed
                log.exception("a step after operation %s met a defect of the program", name)

    def _run_to_end(self, name: str, work: Work, cancelled: threading.Event) -> None:
        """Run one operation to its end; whatever happens is in its record afterwards."""

        def record(step: Any) -> None:
            with self._lock:
                known = self._records.get(name)
                if known is not None:
                    self._keep(replace(known, steps=(*known.steps, step)))

        with self._lock:
            self._keep(replace(self._records[name], state="running", started_s=self._clock.now_s()))
        result: Any = None
        error: BaseException | None = None
        try:
            result = work(record, cancelled)
        except (MastctlError, DriverError, CalibError) as refusal:
            error = refusal
        except BaseException as defect:  # the one broad catch: nothing may leave the mast moving
            log.exception("operation %s met a defect of the program", name)
            error = defect
        if error is None:
            self._end(name, "done", result, None)
            log.info("operation %s done", name)
            return
        self._stop_anyway(f"after operation {name}")
        partial = getattr(error, "result", None)
        if cancelled.is_set():
            error = self._cancelled_because
        body = error_body(error)
        if isinstance(error, Stopped) and cancelled.is_set():
            self._end(name, "stopped", partial, body)
            log.info("operation %s stopped", name)
        else:
            self._end(name, "failed", partial, body)
            log.warning("operation %s failed: %s", name, body["message"])

    def _end(self, name: str, state: OperationState, result: Any, error: dict[str, Any] | None) -> None:
        """Close a record and make room for the next operation."""
        try:
            residual = last_residual(result, name)
        except Exception:  # a result that is none must not keep the next operation out
            log.exception("the result of operation %s holds no residual", name)
            residual, result = None, None
        with self._lock:
            if self._current is None or self._current[0] != name:
                return  # given up before
            self._mover.allow_moves(name)
            self._machine.operation_ended(name, residual)
            known = self._records.get(name)
            if known is not None:  # last, since it is what clients wait for
                ended_s = self._clock.now_s()
                self._keep(replace(known, state=state, result=result, error=error, ended_s=ended_s))
            self._current = None  # after the record, which a waiting client reads
        with self._ended:
            if self._deadline is not None and self._deadline[0] == name:
                self._deadline = None
            self._ended.notify_all()
