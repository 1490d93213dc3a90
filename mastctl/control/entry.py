"""The one entry: each command passes here, and is recorded with its client, lease, request and result.

The order of the checks: role, idempotency key, deadline, lease, state; then the act, then the record. A stop
goes the other way round (`CommandEntry.first`): it acts, and everything else follows.
"""

from __future__ import annotations

import itertools
import math
import threading
from collections import deque
from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, field
from datetime import UTC, datetime
from typing import Any, Protocol

from drivers.clock import Clock
from mastctl.answers import Role
from mastctl.as_json import writable
from mastctl.control.audit import AuditLog
from mastctl.control.caller import ANONYMOUS, NETWORK, Caller
from mastctl.control.idempotency import Answer, Answers
from mastctl.control.lease import LeaseTable, StopCame
from mastctl.control.machine import Need
from mastctl.control.publisher import Publisher
from mastctl.errors import BadRequest, MastctlError, NotNow, Stopped, error_body

LONGEST_DEADLINE_S = 3600.0
FOLLOWED = 256  # operations whose end is still recorded with the client that began them
PUBLISHED = 256  # records that a new listener still gets
PUBLISHED_OF_STRANGERS = 32  # beside them


@dataclass(frozen=True)
class Command:
    """A kind of command.

    Attributes
    ----------
    name
        Its name in the record.
    role
        The rights that its caller needs.
    steers
        Whether it is refused while another client steers.
    need
        What it needs of the daemon's state; None for nothing.
    goes_on
        Whether it is sent again and again to keep its operation going: then only the first is recorded, and
        what is refused.
    grants
        Whether its answer has a lease's id, which proves the lease: never by a key of an anonymous client,
        and never of a lease that has ended.
    """

    name: str
    role: Role = "operate"
    steers: bool = False
    need: Need | None = None
    goes_on: bool = False
    grants: bool = False


POINT = Command("point", steers=True, need="motion")
JOG = Command("jog", steers=True, goes_on=True)
TRACK = Command("track", steers=True, need="track")
TRACK_LOOK = Command("track.look", steers=True, need="motion")
TRACK_STOP = Command("track.stop", steers=True)
MAST = Command("mast", steers=True)  # the service checks whether the head is at rest, after reading it
MAST_BACK = Command("mast.back", steers=True)
RELOAD = Command("reload", "admin", steers=True)  # checked as a mast file is
CAMERA_SETTINGS = Command("camera.settings", steers=True, need="idle")
POSE = Command("pose")  # a fact about the rover; the track that uses it has its own holder
SUN = Command("limits.sun")  # a fact too
SUN_FORGET = Command("limits.sun.forget")
STOP = Command("stop", "view")
ESTOP = Command("estop", "view")
OPERATION_STOP = Command("operation.stop")  # of that one only: the client that steers by now is left alone
RESET = Command("reset", need="latch")
RECORD_START = Command("record.start")
RECORD_STOP = Command("record.stop")
RECORD_DELETE = Command("record.delete", "admin")  # of a fault, the evidence
PLACE_KEEP = Command("place.keep")
PLACE_FORGET = Command("place.forget")
BENCH = Command("bench", steers=True, need="track")
BENCH_STANDS = Command("bench.stands")  # a fact about the board
BENCH_LEAVE = Command("bench.leave")
BENCH_FORGET = Command("bench.forget")
LEASE = Command("lease", grants=True)
LEASE_RENEW = Command("lease.renew", grants=True)
LEASE_RELEASE = Command("lease.release")
LEASE_TAKE = Command("lease.take", grants=True)
SIMULATION_POSE = Command("simulation.pose")  # acts on the world, not on the head
SIMULATION_TIME = Command("simulation.time")
SIMULATION_BOARD = Command("simulation.board")
SIMULATION_BOARD_GONE = Command("simulation.board_gone")
SIMULATION_FAULT = Command("simulation.fault")
SIMULATION_FAULTS_OFF = Command("simulation.faults_off")


@dataclass(frozen=True)
class CommandRequest:
    """One request for a command.

    Attributes
    ----------
    came_s
        When it came, by the daemon's clock; needed for a deadline only.
    request
        The request itself, as JSON.
    lease, key
        The lease's id and the idempotency key that came with it.
    deadline_s
        How long it is given from ``came_s`` on, seconds of the daemon's clock; None for the usual time.
    last_stop
        `mastctl.control.lease.LeaseTable.last_stop` when it came: what steers is not carried out after a
        later one. None: that is not known.
    """

    caller: Caller
    came_s: float = 0.0
    request: Mapping[str, Any] = field(default_factory=dict)
    lease: str | None = None
    key: str | None = None
    deadline_s: float | None = None
    last_stop: StopCame | None = None

    def __post_init__(self) -> None:
        deadline_s = self.deadline_s
        if deadline_s is not None and not (
            math.isfinite(deadline_s) and 0.0 < deadline_s <= LONGEST_DEADLINE_S
        ):
            expected = f"more than 0 and at most {LONGEST_DEADLINE_S:g} s is expected"
            raise BadRequest("bad_request", f"deadline_s: {deadline_s:g} where {expected}")


class JudgesAndEnds(Protocol):
    """What of `mastctl.control.operations.OperationRunner` refuses a command, and ends an operation."""

    def refusal(self, need: Need) -> MastctlError | None: ...
    def end_within(self, name: str, left_s: float, allowed_s: float) -> None: ...
    def end_stopped(self, name: str) -> None: ...


class CommandEntry:
    """The entry of one daemon; safe to use from any thread.

    Parameters
    ----------
    clock
        The clock of deadlines and records: the daemon's.
    operations
        Refuses what does not fit the state, and ends operations at their deadline.
    publisher
        Gets each record, and keeps the newest 256; one of its own by default.
    strangers
        The log for strangers, who may be many: they push no other record out of ``audit``.
    """

    def __init__(
        self,
        clock: Clock,
        leases: LeaseTable,
        answers: Answers,
        audit: AuditLog,
        operations: JudgesAndEnds,
        publisher: Publisher | None = None,
        strangers: AuditLog | None = None,
    ) -> None:
        self.leases = leases
        self.audit = audit
        self.strangers = strangers or audit
        self._clock = clock
        self._answers = answers
        self._operations = operations
        self._publisher = publisher or Publisher()
        # Keys, oldest first: of known clients, and of strangers.
        self._published: tuple[deque[str], deque[str]] = deque(), deque()
        self._numbers = itertools.count(1)
        self._matching = threading.Lock()
        self._began: dict[str, dict[str, Any]] = {}  # operation: the client that began it, until it has ended
        self._ended: dict[str, dict[str, Any]] = {}  # operation: how it ended, until its client is known

    def run(
        self, command: Command, sent: CommandRequest, act: Callable[[], Answer], usual_s: float | None = None
    ) -> Answer:
        """Carry out a command by ``act``; return its answer, whose ``id`` or ``operation`` names what runs.

        ``usual_s`` is the time allowed for an operation without a deadline, seconds.

        Raises NotAllowed ``role``; BadRequest ``key_reused``; ``bad_request`` for a key without a name where
        a lease is granted; NotNow ``deadline_passed`` if its time was over before it began; ``leased``,
        ``lease_over``, ``lease_unknown``; ``key_in_use``; ``stopped`` if a stop came since it was sent; what
        the state refuses.
        """
        again = False
        try:
            sent.caller.check_may(command.role, command.name)
            if command.grants and sent.key is not None and sent.caller.name == ANONYMOUS:
                message = "a lease with an Idempotency-Key needs a name (Mastctl-Client)"
                raise BadRequest("bad_request", message)
            if sent.key is None:
                answer = self._act(command, sent, act, usual_s)
            else:
                same = {"command": command.name, "request": sent.request}
                answer, again = self._answers.once(
                    sent.caller.name, sent.key, same, lambda: self._act(command, sent, act, usual_s)
                )
                if again and command.grants:
                    self._check_holds(answer["lease_id"])
        except BaseException as error:
            self._record(command, sent, None, error, again)
            raise
        self._record(command, sent, answer, None, again)
        return answer

    def first(
        self, command: Command, sent: CommandRequest, act: Callable[[], Answer], recorded: bool = True
    ) -> Answer:
        """Carry out a stop: it acts before anything is checked or written, and is ``recorded`` after."""
        by = sent.caller.name
        how = f"an emergency stop ({by})" if command is ESTOP else by
        self.leases.stop_came(f"the head was stopped by {how}")  # takes no lock
        answer, error = None, None
        try:
            answer = act()
            return answer
        except BaseException as failure:
            error = failure
            raise
        finally:
            if recorded:
                self.note(command, sent, answer, error)

    def note(
        self,
        command: Command,
        sent: CommandRequest,
        answer: Mapping[str, Any] | None,
        error: BaseException | None,
    ) -> None:
        """Record a stop that could not even be tried, or one whose reason came after it."""
        self._record(command, sent, answer, error, begins=False)

    def refused(self, caller: Caller, command: str, code: str, message: str) -> None:
        """Record a request that was refused before it was a command. It is not published."""
        line = {"number": next(self._numbers), **self._now(), **_by(command, caller), "request": {}}
        line |= {"result": code, "message": message}
        (self.strangers if caller.stranger else self.audit).put(line)

    def ended(self, operation: str, state: str, error: Mapping[str, Any] | None) -> None:
        """Record how an operation ended that a command began."""
        line = {**self._now(), "ended": operation, "state": state}
        if error is not None:
            line |= {"code": error.get("code"), "message": error.get("message")}
        self._matched(self._ended, operation, line)

    def _act(
        self, command: Command, sent: CommandRequest, act: Callable[[], Answer], usual_s: float | None
    ) -> Answer:
        """Carry it out if no check fails; its operation gets its deadline."""
        if sent.deadline_s is not None and self._left_s(sent, sent.deadline_s) <= 0.0:
            message = f"the {sent.deadline_s:g} s for {command.name} were over before it could begin"
            raise NotNow("deadline_passed", message)
        if self._stopped_since(command, sent):
            raise Stopped(
                f"{command.name} was requested before a stop, and is not carried out; send it again"
            )
        steering: AbstractContextManager[None] = nullcontext()
        if command.steers:
            steering = self.leases.steering(sent.caller, sent.lease)
        with steering:
            refusal = None if command.need is None else self._operations.refusal(command.need)
            if refusal is not None:
                raise refusal
            answer = act()
            operation = _operation_of(answer)
            if operation is not None and self._stopped_since(command, sent):
                self._operations.end_stopped(operation)
            allowed_s = usual_s if sent.deadline_s is None else sent.deadline_s
            if operation is not None and allowed_s is not None and operation not in self._began:
                self._operations.end_within(operation, self._left_s(sent, allowed_s), allowed_s)
            return answer

    def _check_holds(self, lease_id: str) -> None:
        """Pass a lease that was granted before and still holds. Raises NotNow."""
        try:
            self.leases.check(lease_id)
        except NotNow as over:
            raise NotNow(over.code, f"{over}, with another Idempotency-Key") from None

    def _stopped_since(self, command: Command, sent: CommandRequest) -> bool:
        """Whether a stop came after the request of a command that steers."""
        return command.steers and sent.last_stop not in (None, self.leases.last_stop)

    def _left_s(self, sent: CommandRequest, allowed_s: float) -> float:
        return sent.came_s + allowed_s - self._clock.now_s()

    def _record(
        self,
        command: Command,
        sent: CommandRequest,
        answer: Mapping[str, Any] | None,
        error: BaseException | None,
        again: bool = False,
        begins: bool = True,
    ) -> None:
        """Record a command's result; ``begins``: whether it began the operation that its answer names."""
        caller = sent.caller
        operation = None if answer is None else _operation_of(answer)
        if command.goes_on and error is None and (operation is None or operation in self._began):
            return
        by = _by(command.name, caller)
        number = next(self._numbers)
        line = {"number": number, **self._now(), **by, "request": writable(sent.request)}
        if sent.lease is not None:
            line["lease"] = sent.lease[:8]  # names it, without being it
        if sent.key is not None:
            line |= {"key": sent.key[:80], "again": again}
        if error is None:
            line |= {"result": "ok", "operation": operation}
        else:
            body = error_body(error)
            line |= {"result": body["code"], "message": body["message"]}
        self._write(line)
        if operation is not None and begins and not again:
            self._matched(self._began, operation, {"number": number, **by})

    def _matched(self, known: dict[str, dict[str, Any]], operation: str, line: dict[str, Any]) -> None:
        """Keep an operation's client, or how it ended; record the end when both are known."""
        with self._matching:
            known[operation] = line
            if operation in self._began and operation in self._ended:
                self._write({**self._began.pop(operation), **self._ended.pop(operation)})
            while len(known) > FOLLOWED:
                del known[next(iter(known))]

    def _write(self, line: dict[str, Any]) -> None:
        stranger = line["via"] == NETWORK
        (self.strangers if stranger else self.audit).put(line)
        key = f"{line['number']}.end" if "ended" in line else f"{line['number']}"
        self._publisher.publish("command", key, line)
        keys, most = self._published[stranger], PUBLISHED_OF_STRANGERS if stranger else PUBLISHED
        keys.append(key)
        while len(keys) > most:
            self._publisher.forget("command", keys.popleft())

    def _now(self) -> dict[str, Any]:
        return {"time": datetime.now(UTC).isoformat(), "monotonic_s": self._clock.now_s()}


def _by(command: str, caller: Caller) -> dict[str, Any]:
    """A command and its caller, as they are recorded."""
    by = {"command": command, "who": caller.name, "role": caller.role, "via": caller.via}
    return by | ({"address": caller.address} if caller.address else {})


def _operation_of(answer: Mapping[str, Any]) -> str | None:
    """The id of the operation that an answer names."""
    found = answer.get("id", answer.get("operation"))
    return found if isinstance(found, str) else None
