"""Transactions with servos on one line, each answer proven to be of its question.

A `Link` belongs to one thread at a time. A reply names its sender, and not what was requested. What proves
that it is of its question:

- Where it holds the servo's millisecond counter, that shows the moment of the question (`Counter`).
- Where it does not, `Link.proven` reads twice around a silence and wants one answer; what is read for one
  register differs in length from what is read for another (`registers.Register.window`).
- Of a group read the replies come in the order requested, one of each servo, or none counts.
- A reply without data (to a write, a restart) proves nothing: what must be certain is read afterwards.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

from drivers.dynamixel.packets import (
    BROADCAST_ID,
    PING,
    READ,
    REBOOT,
    REFUSALS,
    SYNC_WRITE,
    WRITE,
    GroupAnswer,
    GroupQuestion,
    group_question,
    group_write_packet,
    instruction_packet,
    take_status,
    tick_at,
)
from drivers.dynamixel.registers import ControlItem
from drivers.errors import BadReply, DriverError, LineLost, Refused
from drivers.servo_bus.exchange import BusLink
from drivers.servo_bus.port import QUIET_S, PacketFormat, Part, StatusPacket

MODULUS_S = 32.768
STEP_S = 0.001
SLACK_S = 0.003  # the servo takes its counter and its other registers at different moments of its own loop
DRIFT = 0.03  # its oscillator against ours

MEETING_SHAPES = ((12, 0), (8, 2), (4, 4), (0, 2), (8, 4), (4, 2), (12, 2), (0, 4))
"""Bytes read before and after the counter to get to know it; no two of the same length in all."""


class Counter:
    """One servo's counter, from the first answer that showed it.

    That was requested at ``sent_s`` and came at ``received_s``, seconds of our clock.
    """

    def __init__(self, tick: int, sent_s: float, received_s: float) -> None:
        self._tick = tick
        self._earliest_s, self._latest_s = sent_s - STEP_S, received_s  # when it began to show that

    def mismatch(self, tick: int, sent_s: float, received_s: float) -> str:
        """Take an answer as of its question, or return why it cannot be and take nothing."""
        passed_s = sent_s - self._earliest_s
        advance_s = (tick - self._tick) * STEP_S
        advance_s += MODULUS_S * round((passed_s - advance_s) / MODULUS_S)
        drift_s = DRIFT * abs(advance_s)
        earliest_s = self._earliest_s + advance_s - drift_s
        latest_s = self._latest_s + advance_s + drift_s
        if latest_s + STEP_S + SLACK_S < sent_s or earliest_s - SLACK_S > received_s:
            off_ms = 1000 * ((earliest_s + latest_s) / 2 - sent_s)
            when = f"{abs(off_ms):.0f} ms {'before' if off_ms < 0 else 'after'} the question"
            return f"a reply from another moment (late, repeated, or the servo restarted), {when}"
        self._tick = tick
        self._earliest_s = min(max(earliest_s, sent_s - STEP_S), latest_s)
        self._latest_s = max(min(latest_s, received_s), earliest_s)
        return ""


class TickCounters:
    """The counters of the servos on a line; for the thread that has it."""

    def __init__(self, link: BusLink) -> None:
        self._link = link
        self._clock = link.clock
        self._known: dict[int, Counter] = {}

    def forget(self, servo_id: int) -> None:
        """Get to know a servo's counter anew: it restarts."""
        self._known.pop(servo_id, None)

    def learn(self, question: GroupQuestion) -> DriverError | None:
        """Get to know the counters of a group's servos; returns why that failed. Raises LineLost."""
        for servo_id, at in question.ticks.items():
            if servo_id not in self._known:
                try:
                    self._meet(servo_id, question.parts[servo_id].address + at)
                except LineLost:
                    raise
                except DriverError as error:
                    return error
        return None

    def mismatch(self, question: GroupQuestion, status: StatusPacket, sent_s: float) -> BadReply | None:
        """Return why a reply that just came is not to this question; None if it is, or holds no counter."""
        servo_id = status.servo_id
        if servo_id not in question.ticks:
            return None
        at = question.ticks[servo_id]
        tick = int.from_bytes(status.data[at : at + 2], "little")
        mismatch = self._known[servo_id].mismatch(tick, sent_s, self._clock.now_s())
        if not mismatch:
            return None
        self._link.note_unexpected(status)
        return self._bad(servo_id, "group read", mismatch)

    def _meet(self, servo_id: int, tick_address: int) -> None:
        """Get to know a counter: by two answers, each after a silence, that agree about it.

        No question is repeated, so that no reply that is some questions late is of another.
        """
        shapes = iter(MEETING_SHAPES)
        for shape in shapes:
            counter = Counter(*self._tick(servo_id, tick_address, shape))
            mismatch = counter.mismatch(*self._tick(servo_id, tick_address, next(shapes)))
            if not mismatch:
                self._known[servo_id] = counter
                return
        raise self._bad(servo_id, "read", f"no two replies are of the moments of their questions: {mismatch}")

    def _tick(self, servo_id: int, address: int, shape: tuple[int, int]) -> tuple[int, float, float]:
        """The counter in a reply of so many bytes around it, and when that was requested and came."""
        before, after = shape
        self._link.quiet(QUIET_S)
        sent_s = self._clock.now_s()
        data = self._link.read(servo_id, address - before, before + 2 + after, "realtime_tick")
        return int.from_bytes(data[before : before + 2], "little"), sent_s, self._clock.now_s()

    def _bad(self, servo_id: int, instruction: str, reason: str) -> BadReply:
        return BadReply(
            f"servo {servo_id} on {self._link.name}: {reason}",
            detail=self._link.where(servo_id, instruction, "realtime_tick"),
        )


PING_REPLY_BYTES = 14
FORMAT = PacketFormat(
    take_status,
    instruction_packet,
    2,
    group_write_packet,
    11,
    {PING: "ping", READ: "read", WRITE: "write", REBOOT: "reboot"},
    REFUSALS,
    instruction_packet(BROADCAST_ID, SYNC_WRITE, (64).to_bytes(2, "little") + (1).to_bytes(2, "little")),
)
AGREEING_TRIES = 5  # of two answers in a row that are to be the same


@dataclass(frozen=True)
class Pinged:
    """What a servo says to a ping."""

    servo_id: int
    model_number: int
    firmware: int
    alert: bool


class Link(BusLink):
    """One open line and its transactions; parameters, attributes and errors as of `BusLink`."""

    packets = FORMAT

    @cached_property
    def _counters(self) -> TickCounters:
        return TickCounters(self)

    def ping(self, servo_id: int) -> Pinged:
        """Return what a servo says of itself. Raises NoReply, BadReply, LineLost."""
        return _pinged(self.request(servo_id, PING, b"", 3))

    def ping_all(self) -> tuple[list[Pinged], int]:
        """Ping every servo on the line; takes its whole window of about a second. Raises LineLost.

        Returns those that answered, by id; and how many bytes came that were no reply (two servos of one
        id?).
        """
        port = self.port
        question = instruction_packet(BROADCAST_ID, PING)
        port.send(question, 0)
        port.deadline_s = self.clock.now_s() + port.reply_timeout_s + 253 * (0.003 + 14 * port.byte_s)
        found: dict[int, Pinged] = {}
        before, understood = port.received_bytes, len(question) * port.echoes
        while (status := port.receive()) is not None:
            understood += PING_REPLY_BYTES
            if len(status.data) == 3:
                found[status.servo_id] = _pinged(status)
        port.suspect = False
        noise = max(0, port.received_bytes - before - understood)
        return [found[servo_id] for servo_id in sorted(found)], noise

    def proven(self, servo_id: int, *registers: ControlItem) -> list[int]:
        """Return registers' values, each of an answer that is certainly of its question.

        Takes a silence of some 20 ms if any of the registers is not read with the servo's counter. Raises
        BadReply if answers contradict one another again and again, or are of another moment; NoReply,
        Refused, LineLost.
        """
        requested = {register.window: register for register in registers if tick_at(*register.window) is None}
        found = self._agreed(servo_id, requested)
        for register in registers:
            if register.window not in found:
                found[register.window] = self.block(Part(servo_id, *register.window)).statuses[servo_id].data
        return [register.decode_window(found[register.window]) for register in registers]

    def _agreed(
        self, servo_id: int, requested: dict[tuple[int, int], ControlItem]
    ) -> dict[tuple[int, int], bytes]:
        """What is said twice in a row, around a silence, of each window."""
        found: dict[tuple[int, int], bytes] = {}
        before = {window: self._outcome(servo_id, register) for window, register in requested.items()}
        tries_left = AGREEING_TRIES
        while requested:
            if not tries_left:
                names = " and ".join(register.name for register in requested.values())
                raise BadReply(
                    f"servo {servo_id} on {self.name} contradicts itself about {names}",
                    detail=self.where(servo_id, "read", names),
                )
            tries_left -= 1
            self.quiet(QUIET_S)
            for window, register in tuple(requested.items()):
                now = self._outcome(servo_id, register)
                if _same(now, before[window]):
                    del requested[window]
                    if isinstance(now, Refused):
                        raise now
                    found[window] = now
                before[window] = now
        return found

    def _outcome(self, servo_id: int, register: ControlItem) -> bytes | Refused:
        """One answer to a question for a register's window, or its refusal; raises NoReply, LineLost."""
        try:
            return self.read(servo_id, *register.window, register.name)
        except Refused as refused:
            return refused

    def reboot(self, servo_id: int) -> None:
        """Restart a servo: torque drops. Raises NoReply, BadReply, Refused, LineLost."""
        self._counters.forget(servo_id)
        self.request(servo_id, REBOOT, b"", 0)

    def block(self, part: Part) -> GroupAnswer:
        """Read one block of one servo, which is there. Raises as `group_read`, and what is missing."""
        answer = self.group_read([part])
        if answer.missing:
            raise answer.missing[part.servo_id]
        return answer

    def group_read(self, parts: Sequence[Part]) -> GroupAnswer:
        """Read one block of each of several servos in one transaction.

        Servos whose blocks have one address and length are read by Sync Read, others by Bulk Read. Each
        servo waits for the one before it, so one that is missing may silence those behind it. Blocks that
        hold the servo's counter are taken only if it shows this moment; a servo whose counter is not known
        yet is read for it first. Raises LineLost, BadReply if the line is gone or never quiet; everything
        else stands in the answer's ``missing``.
        """
        question = group_question(tuple(parts))
        if (failure := self._counters.learn(question)) is not None:
            now_s = self.clock.now_s()
            return GroupAnswer({}, dict.fromkeys(question.parts, failure), now_s, now_s)
        try:
            sent_s = self.port.send(question.packet, question.reply_bytes)
            statuses, wrong = self._replies(question, sent_s)
        except LineLost as error:
            raise self.placed(error, list(question.parts), "group read") from error
        received_s = self.clock.now_s()
        missing = {}
        if len(statuses) < len(question.parts):
            for servo_id, part in question.parts.items():
                if servo_id not in statuses:
                    addresses = f"addresses {part.address} to {part.address + part.length - 1}"
                    silence = wrong.get(servo_id) or self.silence(servo_id, "group read", addresses)
                    missing[servo_id] = silence
        return GroupAnswer(statuses, missing, sent_s, received_s)

    def _replies(
        self, question: GroupQuestion, sent_s: float
    ) -> tuple[dict[int, StatusPacket], dict[int, DriverError]]:
        """The replies to a group read until all have come or the deadline passes.

        They come in the order of the list; where they do not, or a servo says two things, none is certain.
        """
        parts = question.parts
        waited = list(parts)
        taken: dict[int, StatusPacket] = {}
        wrong: dict[int, DriverError] = {}
        while waited and (status := self.port.receive()) is not None:
            servo_id = status.servo_id
            if servo_id not in parts or len(status.data) != (0 if status.refused else parts[servo_id].length):
                self.note_unexpected(status)
            elif status.refused:
                wrong[servo_id] = self.refusal(status, "group read", "")
                waited = _behind(waited, servo_id)
            elif (mismatch := self._counters.mismatch(question, status, sent_s)) is not None:
                wrong[servo_id] = mismatch
            elif servo_id in waited:
                taken[servo_id] = status
                waited = _behind(waited, servo_id)
            else:
                self.note_unexpected(status)
                if status != taken.get(servo_id):
                    return {}, wrong
        return taken, wrong


def _pinged(status: StatusPacket) -> Pinged:
    """What the data of a ping's reply say."""
    model = int.from_bytes(status.data[:2], "little")
    return Pinged(status.servo_id, model, status.data[2], status.alert)


def _same(one: bytes | Refused, other: bytes | Refused) -> bool:
    """Whether two outcomes of one question are the same."""
    if isinstance(one, Refused) or isinstance(other, Refused):
        return type(one) is type(other) and str(one) == str(other)
    return one == other


def _behind(waited: list[int], servo_id: int) -> list[int]:
    """The servos whose replies are still to come after one has spoken: those behind it in the list."""
    return waited[waited.index(servo_id) + 1 :] if servo_id in waited else waited
