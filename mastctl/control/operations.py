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
from dataclasses import dataclass, field, replace
from typing import Any, Protocol

from calib.errors import CalibError
from drivers.clock import Clock, deadlines_on
from drivers.errors import DriverError
from mastctl.answers import LastResidual, OperationAnswer, OperationListed, OperationState
from mastctl.as_json import as_json
from mastctl.control.machine import CLOSING, Need, StateMachine
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


def last_residual(result: Any, name: str) -> LastResidual | None:
    """Return the residual that a result ends with, if it measured one."""
    last = as_json(_last_pointing(result))
    residual, sigma = last.get("residual_px"), last.get("residual_sigma_px")
    if not (residual and sigma and None not in residual and None not in sigma):
        return None
    return {"residual_px": residual, "residual_sigma_px": sigma, "operation": name}


def last_frame(result: Any) -> str | None:
    """Return the id of the image that a result ends with, None where it took none."""
    return _last_pointing(result).get("frame_id") or None


def _last_pointing(result: Any) -> Mapping[str, Any]:
    """The last pointing of a result that has some, an empty one of any other."""
    pointings = result.get("pointings") if isinstance(result, Mapping) else None
    return pointings[-1] if pointings else {}


class Mover(Protocol):
    """The part of `mastctl.devices.devices.Devices` that stops, and keeps stopped."""

    def stop(self) -> None: ...
    def block_moves(self, holder: object, reason: str) -> None: ...
    def allow_moves(self, holder: object) -> None: ...


Work = Callable[[Callable[[Any], None], threading.Event], Any]
OnEnd = Callable[[Operation], None]


@dataclass(eq=False)
class _Running:
    """The operation that runs; ``ended_by`` is what its record says once it is ``cancelled``.

    ``late`` is the moment at which it is cancelled, and by what.
    """

    id: str
    thread: threading.Thread | None = None
    cancelled: threading.Event = field(default_factory=threading.Event)
    ended_by: MastctlError = field(default_factory=lambda: Stopped(STOP_REQUESTED))
    late: tuple[float, MastctlError] | None = None

    def end_by(self, error: MastctlError) -> None:
        self.ended_by = error
        self.cancelled.set()


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
        self.machine = machine or StateMachine(clock)
        self._publisher = self.machine.publisher
        self._clock = clock
        self._time = deadlines_on(clock)
        self._changed = self._time.signal()
        self._records: Mapping[str, Operation] = {}  # oldest first
        self._numbers = itertools.count(1)
        self._run = run or secrets.token_hex(2)
        self._on_ended = on_ended
        self._current: _Running | None = None
        self._closed = False
        self._time.thread(self._watch, "deadlines").start()

    @property
    def running(self) -> str | None:
        """Id of the running operation, None when none runs."""
        return self.machine.standing.operation

    def start(self, request: Mapping[str, Any], work: Work, on_end: OnEnd | None = None) -> Operation:
        """Start ``work(record_step, cancelled)`` in a thread and return its first record; waits for nothing.

        ``on_end`` gets the last record, in the same thread, when the next operation may be started already.
        Raises the refusal of ``motion``; Unable ``no_thread`` if the machine has none for it.
        """
        with self._changed:
            name = f"{next(self._numbers):06d}-{self._run}"
            self.machine.operation_began(name, request)
            operation = Operation(name, "queued", dict(request), self._clock.now_s())
            self._keep(operation)
            current = self._current = _Running(name)
        try:
            current.thread = self._clock.thread(
                lambda: self._work(current, work, on_end), f"operation {name}"
            )
            current.thread.start()
        except RuntimeError as error:  # no thread to be had: nothing has moved, and the next may have one
            unable = Unable("no_thread", f"operation {name} was not started: {error}")
            self._end(current, "failed", None, error_body(unable))
            raise unable from None
        return operation

    @contextmanager
    def stopping(self) -> Iterator[None]:
        """Let no operation start and no move go out inside the block; waits for nothing."""
        holder = object()
        self.machine.stop_requested()
        self._mover.block_moves(holder, STOP_REQUESTED)
        try:
            yield
        finally:
            self._mover.allow_moves(holder)
            self._stop_ended()

    def stop(self, reason: str = STOP_REQUESTED, also: Callable[[], object] = lambda: None) -> str | None:
        """Stop the mast, then the running operation, if any, and what ``also`` ends; return its id.

        The head comes first: nothing is written before its stop was sent. ``reason`` goes into the
        operation's record. Raises DriverError if the head did not confirm the stop; the operation is stopped
        all the same.
        """
        with self.stopping():
            running, stopped = self._current, Stopped(reason)
            if running is not None:  # what ends from here on, ends by the stop
                running.end_by(stopped)
            try:
                self._mover.stop()
            finally:
                with self._changed:
                    name = self._cancel(stopped)
                also()
        if name is None and running is not None and self.get(running.id).state == "stopped":
            name = running.id
        log.info("stop%s", f": operation {name}" if name else "")
        return name

    def stop_one(self, name: str, error: MastctlError | None = None) -> None:
        """Stop the mast and end one operation, unless it has ended or is being ended already.

        ``error`` goes into its record. Raises as `get`; DriverError if the head did not confirm the stop.
        """
        self.get(name)
        with self._changed:
            current = self._current
            if current is None or current.id != name or current.cancelled.is_set():
                return
            self.machine.stop_requested()
            self._cancel(error or Stopped(STOP_REQUESTED))
        try:
            self._mover.stop()
        finally:
            self._stop_ended()

    def end(self, name: str, error: MastctlError | None = None) -> None:
        """Do the same; what the head does not confirm is logged."""
        with self._logged(f"when operation {name} was to end"):
            self.stop_one(name, error)

    def end_within(self, name: str, left_s: float, allowed_s: float) -> None:
        """Stop the mast and end an operation that runs longer than ``left_s``, of ``allowed_s`` altogether.

        A stop that comes before is the last word; the first of several deadlines counts.
        """
        late = NotNow("deadline_passed", f"operation {name} did not end in the {allowed_s:g} s it was given")
        with self._changed:
            current = self._current
            if current is not None and current.id == name and current.late is None:
                current.late = self._time.now_s() + left_s, late
                self._changed.notify_all()

    def refusal(self, need: Need) -> MastctlError | None:
        """Return the refusal of a command, as `Standing.refusal`; what was stopped may end first."""
        self.let_stopped_end()
        return self.machine.standing.refusal(need)

    def let_stopped_end(self) -> None:
        """Wait for a stop, and for the operation that it ends; `ENDS_SOON_S` at most."""
        until_s = self._time.now_s() + ENDS_SOON_S
        with self._changed:
            while self.machine.standing.stopping and (left_s := until_s - self._time.now_s()) > 0:
                self._changed.wait(left_s)

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
        self.machine.closing()
        self._mover.block_moves(self, CLOSING)
        with self._logged("as the service closes"):
            self._mover.stop()
        closing = Stopped(CLOSING)
        with self._changed:
            self._closed, current = True, self._current
            self._changed.notify_all()
            self._cancel(closing)
        if current is None or current.thread is None or not current.thread.is_alive():
            return  # one that is about to start finds itself cancelled
        current.thread.join(END_TIMEOUT_S)  # in real time, whatever a simulated rover's clock does
        if current.thread.is_alive():
            log.error("operation %s did not end within %.0f s; it is given up", current.id, END_TIMEOUT_S)
            self._end(current, "stopped", None, error_body(closing))

    def _watch(self) -> None:
        """End each operation at its deadline, in a thread of its own."""
        while True:
            with self._changed:
                if self._closed:
                    return
                current = self._current
                late = None if current is None else current.late
                if current is None or late is None or current.cancelled.is_set():
                    self._changed.wait(idle=True)
                    continue
                if (left_s := late[0] - self._time.now_s()) > 0.0:
                    self._changed.wait(left_s, idle=True)
                    continue
            self.end(current.id, late[1])

    def _stop_ended(self) -> None:
        self.machine.stop_ended()
        with self._changed:
            self._changed.notify_all()

    @contextmanager
    def _logged(self, when: str) -> Iterator[None]:
        """Log why the head did not confirm a stop."""
        try:
            yield
        except BaseException as error:
            log.error("the head did not confirm the stop %s: %s", when, error_body(error)["message"])

    def _keep(self, operation: Operation) -> None:
        """Keep a record, and forget the oldest; the lock is kept."""
        records = {**self._records, operation.id: operation}
        if len(records) > KEPT_OPERATIONS:
            oldest = next(iter(records))
            del records[oldest]
            self._publisher.forget("operation", oldest)
        self._records = records
        self._publisher.publish("operation", operation.id, operation)

    def _cancel(self, error: MastctlError) -> str | None:
        """Have the running operation end and let no further move of it out; the lock is kept."""
        if self._current is None:
            return None
        self._current.end_by(error)
        self._mover.block_moves(self._current.id, str(error))
        return self._current.id

    def _work(self, current: _Running, work: Work, on_end: OnEnd | None) -> None:
        """Run one operation, then hand over its last record."""
        self._run_to_end(current, work)
        for hand_over in (self._on_ended, on_end):
            if hand_over is None:
                continue
            try:
                hand_over(self.get(current.id))
            except Exception:  # its record is closed
                log.exception("a step after operation %s met a defect of the program", current.id)

    def _run_to_end(self, current: _Running, work: Work) -> None:
        """Run one operation to its end; whatever happens is in its record afterwards."""
        name = current.id

        def record(step: Any) -> None:
            with self._changed:
                known = self._records.get(name)
                if known is not None:
                    self._keep(replace(known, steps=(*known.steps, step)))

        with self._changed:
            self._keep(replace(self._records[name], state="running", started_s=self._clock.now_s()))
        try:
            result = work(record, current.cancelled)
            self._end(current, "done", result, None, last_residual(result, name))
            log.info("operation %s done", name)
            return
        except (MastctlError, DriverError, CalibError) as refusal:
            error: BaseException = refusal
        except BaseException as defect:  # the one broad catch: nothing may leave the mast moving
            log.exception("operation %s met a defect of the program", name)
            error = defect
        with self._logged(f"after operation {name}"):
            self._mover.stop()
        partial = getattr(error, "result", None)
        if current.cancelled.is_set():
            error = current.ended_by
        body = error_body(error)
        if isinstance(error, Stopped) and current.cancelled.is_set():
            self._end(current, "stopped", partial, body)
            log.info("operation %s stopped", name)
        else:
            self._end(current, "failed", partial, body)
            log.warning("operation %s failed: %s", name, body["message"])

    def _end(
        self,
        current: _Running,
        state: OperationState,
        result: Any,
        error: dict[str, Any] | None,
        residual: LastResidual | None = None,
    ) -> None:
        """Close a record and make room for the next operation."""
        with self._changed:
            if self._current is not current:
                return  # given up before
            self._mover.allow_moves(current.id)
            self.machine.operation_ended(residual)
            ended_s = self._clock.now_s()  # the record last, since it is what clients wait for
            known = self._records[current.id]
            self._keep(replace(known, state=state, result=result, error=error, ended_s=ended_s))
            self._current = None  # after the record, which a waiting client reads
            self._changed.notify_all()
