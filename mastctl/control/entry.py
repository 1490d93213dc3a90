"""The one entry: each command passes it, and is recorded with its client, lease, request and result.

The order of the checks: role, idempotency key, deadline, lease, state; then the act, then the record. A stop
goes the other way round (`CommandEntry.first`): it acts, and everything else follows.

A command that is sent twice with one key acts once. Answers are kept, and failures of a device or of the
program, which may have acted. A refusal changed nothing and is forgotten, so the same key may be sent again.
"""

from __future__ import annotations

import contextlib
import itertools
import json
import logging
from collections import deque
from collections.abc import Callable, Mapping
from contextlib import nullcontext
from dataclasses import dataclass, field
from datetime import UTC, datetime
from itertools import pairwise
from pathlib import Path
from typing import Any, TypeVar

from drivers.clock import Clock, SystemClock
from mastctl.answers import Role
from mastctl.as_json import append_line, writable
from mastctl.control.lease import ANONYMOUS, Caller, LeaseTable, StopCame
from mastctl.control.machine import Need, StandingFault
from mastctl.control.operations import OperationRunner
from mastctl.control.publisher import Publisher
from mastctl.errors import BadRequest, MastctlError, NotNow, Stopped, error_body, one_line

log = logging.getLogger(__name__)

Answer = TypeVar("Answer", bound=Mapping[str, Any])

KEPT_S = 600.0
KEPT = 4096  # keys; for more, the oldest is forgotten before its time
LONGEST_KEY = 200
WAIT_S = 30.0  # for the first of two, longer than any command takes that is accepted or refused
PUBLISHED = 256  # records that a new listener still gets
AUDIT, STRANGERS = "audit_log", "strangers_log"
WAITING = 1000  # lines that wait for the disk
FILE_BYTES = 4 << 20
FILES, STRANGERS_FILES = 8, 2  # 32 MiB: some 100,000 commands
LONGEST_LINE = 16384


@dataclass(frozen=True)
class Command:
    """A kind of command: its name in the record, the role that its caller needs, its need of the state.

    ``steers``: it is refused while another client steers; a fact about rover, sun or board is not.
    ``goes_on``: with an ``id`` it keeps an operation going, and is recorded only if it is refused.
    ``grants``: its answer has a lease's id, which proves the lease: never by a key of an anonymous client,
    and never of a lease that has ended.
    """

    name: str
    role: Role = "operate"
    steers: bool = False
    need: Need | None = None
    goes_on: bool = False
    grants: bool = False


STOP = Command("stop", "view")
ESTOP = Command("estop", "view")


@dataclass(frozen=True)
class CommandRequest:
    """One request for a command, which came at ``came_s`` of the daemon's clock with a lease's id and a key.

    ``deadline_s``: how long it is given from ``came_s`` on, seconds; None for the usual time. ``last_stop``:
    `mastctl.control.lease.LeaseTable.last_stop` when it came: what steers is not carried out after a later
    one; None if that is not known.
    """

    caller: Caller
    came_s: float = 0.0
    request: Mapping[str, Any] = field(default_factory=dict)
    lease: str | None = None
    key: str | None = None
    deadline_s: float | None = None
    last_stop: StopCame | None = None


@dataclass(eq=False)
class _Kept:
    """The request that came with a key, and its answer or its error."""

    request: Mapping[str, Any]
    since_s: float
    answer: Any = None
    error: BaseException | None = None

    @property
    def done(self) -> bool:
        return self.answer is not None or self.error is not None


class Answers:
    """The answers by their keys, forgotten by ``clock``; safe to use from any thread.

    The second of two waits on ``waits_on``, the service's clock, while the first is at work.
    """

    def __init__(self, clock: Clock, waits_on: Clock | None = None) -> None:
        self._clock = clock
        self._changed = (waits_on or SystemClock()).signal()
        self._kept: dict[tuple[str, str], _Kept] = {}  # oldest first

    def once(
        self, client: str, key: str, request: Mapping[str, Any], act: Callable[[], Answer]
    ) -> tuple[Answer, bool]:
        """Return what ``act()`` returns, or returned before, and whether it was before.

        A key is 1 to 200 signs of printable ASCII; another client's is another key, and ``request`` the same
        whenever the key is. Raises BadRequest ``key_reused`` if it came with another request, ``bad_request``
        for what is no key; NotNow ``key_in_use`` if the first is still at work after 30 s.
        """
        if not (0 < len(key) <= LONGEST_KEY and key.isascii() and key.isprintable()):
            expected = f"1 to {LONGEST_KEY} printable ASCII characters are expected"
            raise BadRequest("bad_request", f"Idempotency-Key is '{key[:40]}' where {expected}")
        place = client, key
        with self._changed:
            now_s = self._clock.now_s()
            for old, one in list(self._kept.items()):
                if one.done and (now_s - one.since_s >= KEPT_S or len(self._kept) >= KEPT):
                    del self._kept[old]
            known = self._kept.get(place)
            if known is not None:
                return self._answer_of(known, key, request), True
            mine = self._kept[place] = _Kept(request, now_s)
        try:
            mine.answer = act()
        except BaseException as error:
            mine.error = error
            raise
        finally:
            with self._changed:
                if isinstance(mine.error, MastctlError):
                    del self._kept[place]
                self._changed.notify_all()
        return mine.answer, False

    def _answer_of(self, known: _Kept, key: str, request: Mapping[str, Any]) -> Any:
        """Return the answer that the first got, or gets; the lock is kept."""
        if known.request != request:
            message = f"Idempotency-Key '{key[:40]}' came before with another request; take a new one"
            raise BadRequest("key_reused", message)
        until_s = self._clock.now_s() + WAIT_S
        while not known.done:
            left_s = until_s - self._clock.now_s()
            if left_s <= 0:
                message = f"the request that came first with Idempotency-Key '{key[:40]}' is still at work"
                raise NotNow("key_in_use", message)
            self._changed.wait(left_s, idle=True)
        if known.error is not None:
            raise known.error
        return known.answer


class AuditLog:
    """A file of JSON lines of mode 0600, and those before it, ``NAME.1`` to ``NAME.7``.

    ``later`` has a function called in a thread that may wait for the disk; nothing else waits, and nothing
    raises. Lines that do not fit or that the disk does not take are counted, and their number is recorded
    where they are missing. ``device`` is the name of its fault.
    """

    def __init__(
        self,
        path: Path,
        later: Callable[[Callable[[], None]], None],
        clock: Clock,
        files: int = FILES,
        device: str = AUDIT,
        file_bytes: int = FILE_BYTES,
    ) -> None:
        self._files = [path, *(Path(f"{path}.{number}") for number in range(1, files))]
        self._file_bytes = file_bytes
        self._later = later
        self._clock = clock
        self._device = device
        self._waiting = deque[Mapping[str, Any]]()
        self._lost = deque[None]()  # one for each lost line
        self._fault: StandingFault | None = None

    def put(self, record: Mapping[str, Any]) -> None:
        """Have a record written; returns at once."""
        if len(self._waiting) >= WAITING:
            self._lost.append(None)
        else:
            self._waiting.append(record)
            self._later(self._write)

    def faults(self) -> tuple[StandingFault, ...]:
        """Return what is wrong with the file now; takes no lock."""
        return tuple(one for one in (self._fault,) if one is not None)

    # In the thread that may wait

    def _write(self) -> None:
        """Write the oldest line that waits."""
        record, lost = self._waiting.popleft(), len(self._lost)
        try:
            lines = [{"time": datetime.now(UTC).isoformat(), "lost": lost}] if lost else []
            self._append("".join(f"{_line(one)}\n" for one in (*lines, record)).encode())
        except Exception as error:  # the disk's, or of a record that cannot be written; the next one may be
            self._lost.append(None)
            if self._fault is None:
                why = (error.strerror if isinstance(error, OSError) else None) or one_line(error, 200)
                message = f"commands are not recorded: {self._files[0]}: {why}"
                log.error("%s", message)
                until, now_s = "a command can be recorded again", self._clock.now_s()
                self._fault = StandingFault(self._device, "not_recorded", message, now_s, until)
            return
        if lost:
            for _ in range(lost):
                self._lost.popleft()
            log.warning("the audit log is written again; %d lines are missing in it", lost)
        self._fault = None

    def _append(self, text: bytes) -> None:
        """Append lines, in a new file where this one is full."""
        newest = self._files[0]
        newest.parent.mkdir(parents=True, exist_ok=True)
        if not append_line(newest, text, self._file_bytes, mode=0o600):
            for newer, older in reversed(list(pairwise(self._files))):
                with contextlib.suppress(FileNotFoundError):
                    newer.replace(older)
            append_line(newest, text, mode=0o600)


def _line(record: Mapping[str, Any]) -> str:
    """A record as a line; a request that is too long for one is cut, which its key shows."""
    line = _json(record)
    if len(line) > LONGEST_LINE:
        line = _json({**record, "request": {"cut": _json(record["request"])[: LONGEST_LINE // 16]}})
    return line


def _json(value: Any) -> str:
    return json.dumps(writable(value), allow_nan=False, separators=(",", ":"))


class CommandEntry:
    """The entry of one daemon; safe to use from any thread.

    ``publisher`` gets each record, and keeps the newest; so do two files in ``folder``, of which that for
    strangers, who may be many, pushes no other record out. ``later`` is as of `AuditLog`.
    """

    def __init__(
        self,
        clock: Clock,
        leases: LeaseTable,
        answers: Answers,
        operations: OperationRunner,
        publisher: Publisher,
        folder: Path,
        later: Callable[[Callable[[], None]], None],
    ) -> None:
        self.leases = leases
        self._audit = AuditLog(folder / "audit.jsonl", later, clock)
        self._strangers = AuditLog(folder / "strangers.jsonl", later, clock, STRANGERS_FILES, STRANGERS)
        self._clock = clock
        self._answers = answers
        self._operations = operations
        self._publisher = publisher
        self._numbers = itertools.count(1)

    def faults(self) -> tuple[StandingFault, ...]:
        """Return what is wrong with the files of records; takes no lock."""
        return *self._audit.faults(), *self._strangers.faults()

    def run(
        self, command: Command, sent: CommandRequest, act: Callable[[], Answer], usual_s: float | None = None
    ) -> Answer:
        """Carry out a command by ``act``; return its answer, whose ``id`` or ``operation`` names what runs.

        ``usual_s`` is the time allowed for an operation without a deadline, seconds. Raises NotAllowed
        ``role``; NotNow ``deadline_passed`` if its time was over before it began, ``stopped`` if a stop came
        since it was sent; as `Answers.once` and `LeaseTable.steering`; what the state refuses.
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
                same = {"command": command.name, "request": sent.request, "lease": sent.lease}
                answer, again = self._answers.once(
                    sent.caller.name, sent.key, same, lambda: self._act(command, sent, act, usual_s)
                )
                if again and command.grants and not self.leases.holds(answer["lease_id"]):
                    message = "the lease of this Idempotency-Key has ended; acquire another with another key"
                    raise NotNow("lease_over", message)
        except BaseException as error:
            self.record(command, sent, None, error, again)
            raise
        self.record(command, sent, answer, None, again)
        return answer

    def first(self, command: Command, sent: CommandRequest, act: Callable[[], Answer]) -> Answer:
        """Carry out a stop: it acts before anything is checked or written, and is recorded after."""
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
            self.record(command, sent, answer, error)

    def refused(self, caller: Caller, command: str, code: str, message: str) -> None:
        """Record a request that was refused before it was a command. It is not published."""
        line = {**self._begun(), **_by(command, caller), "request": {}, "result": code, "message": message}
        (self._strangers if caller.stranger else self._audit).put(line)

    def ended(self, operation: str, state: str, error: Mapping[str, Any] | None) -> None:
        """Record how an operation ended."""
        line = {**self._begun(), "ended": operation, "state": state}
        if error is not None:
            line |= {"code": error.get("code"), "message": error.get("message")}
        self._write(self._audit, line)

    def record(
        self,
        command: Command,
        sent: CommandRequest,
        answer: Mapping[str, Any] | None,
        error: BaseException | None,
        again: bool = False,
    ) -> None:
        """Record a command's result."""
        operation = None if answer is None else _operation_of(answer)
        if command.goes_on and error is None and (operation is None or "id" in sent.request):
            return
        line = {**self._begun(), **_by(command.name, sent.caller), "request": writable(sent.request)}
        if sent.lease is not None:
            line["lease"] = sent.lease[:8]  # names it, without being it
        if sent.key is not None:
            line |= {"key": sent.key[:80], "again": again}
        if error is None:
            line |= {"result": "ok", "operation": operation}
        else:
            body = error_body(error)
            line |= {"result": body["code"], "message": body["message"]}
        self._write(self._strangers if sent.caller.stranger else self._audit, line)

    def _act(
        self, command: Command, sent: CommandRequest, act: Callable[[], Answer], usual_s: float | None
    ) -> Answer:
        """Carry it out if no check fails; its operation gets its deadline."""
        name = command.name
        if sent.deadline_s is not None and sent.came_s + sent.deadline_s <= self._clock.now_s():
            message = f"the {sent.deadline_s:g} s for {name} were over before it could begin"
            raise NotNow("deadline_passed", message)
        if self._stopped_since(command, sent):
            raise Stopped(f"{name} was requested before a stop, and is not carried out; send it again")
        with self.leases.steering(sent.caller, sent.lease) if command.steers else nullcontext():
            refusal = None if command.need is None else self._operations.refusal(command.need)
            if refusal is not None:
                raise refusal
            answer = act()
            operation = _operation_of(answer)
            if operation is not None and self._stopped_since(command, sent):
                self._operations.end(operation)
            allowed_s = usual_s if sent.deadline_s is None else sent.deadline_s
            if operation is not None and allowed_s is not None:
                left_s = sent.came_s + allowed_s - self._clock.now_s()
                self._operations.end_within(operation, left_s, allowed_s)
            return answer

    def _stopped_since(self, command: Command, sent: CommandRequest) -> bool:
        """Whether a stop came after the request of a command that steers."""
        return command.steers and sent.last_stop not in (None, self.leases.last_stop)

    def _write(self, log_of: AuditLog, line: dict[str, Any]) -> None:
        log_of.put(line)
        self._publisher.publish("command", str(line["number"]), line)
        self._publisher.forget("command", str(line["number"] - PUBLISHED))

    def _begun(self) -> dict[str, Any]:
        """The beginning of a line: its number and its time."""
        time = datetime.now(UTC).isoformat()
        return {"number": next(self._numbers), "time": time, "monotonic_s": self._clock.now_s()}


def _by(command: str, caller: Caller) -> dict[str, Any]:
    """A command and its caller, as they are recorded."""
    by = {"command": command, "who": caller.name, "role": caller.role, "via": caller.via}
    return by | ({"address": caller.address} if caller.address else {})


def _operation_of(answer: Mapping[str, Any]) -> str | None:
    """The id of the operation that an answer names."""
    found = answer.get("id", answer.get("operation"))
    return found if isinstance(found, str) else None
