"""Transactions with servos on one line: an instruction, its replies, and typed errors that say where.

A `Link` belongs to one thread at a time. Every failure names port, servo id, register and instruction, in
its sentence and in ``detail``. No value is ever made up: what a servo did not say is an error.

A reply says who speaks, and not what was asked. What proves that it is of its question:

- Where it holds the servo's millisecond counter, that shows the moment of the question (`counter`).
- Where it does not, `Link.proven` asks twice around a silence and wants one answer; what is read for one
  register differs in length from what is read for another (`models.Register.window`).
- Of a group read the replies come in the order asked, one of each servo, or none counts.
- A reply without data (to a write, a restart) proves nothing: who must be certain reads afterwards.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass

from dynamixel_sdk import (
    BROADCAST_ID,
    INST_BULK_READ,
    INST_BULK_WRITE,
    INST_FAST_BULK_READ,
    INST_FAST_SYNC_READ,
    INST_PING,
    INST_READ,
    INST_REBOOT,
    INST_SYNC_READ,
    INST_SYNC_WRITE,
    INST_WRITE,
)

from drivers.dynamixel.counter import Counter
from drivers.dynamixel.models import REGISTERS, Register
from drivers.dynamixel.packets import ERROR_WORDS, PacketHandler, Status, crc16, instruction_packet
from drivers.dynamixel.port import QUIET_S, Port
from drivers.errors import BadReply, DriverError, LineLost, NoReply, Refused

log = logging.getLogger(__name__)

REPLY_TIMEOUT_S = 0.05  # USB adapters hold bytes back for up to 16 ms, the servo for up to 0.5 ms

PING_REPLY_BYTES = 14
AGREEING_TRIES = 5  # of two answers in a row that are to be the same

TICKS = tuple(REGISTERS[key]["realtime_tick"].address for key in ("X", "P"))
MEETING_SHAPES = ((12, 0), (8, 2), (4, 4), (0, 2), (8, 4), (4, 2), (12, 2), (0, 4))
"""Bytes read before and after the counter to get to know it; no two of the same length in all."""


@dataclass(frozen=True)
class Pinged:
    """What a servo says to a ping."""

    servo_id: int
    model_number: int
    firmware: int
    alert: bool


@dataclass(frozen=True)
class Part:
    """What is read of, or written to, one servo in a group: the address, and length or data."""

    servo_id: int
    address: int
    length: int
    data: bytes = b""


@dataclass(frozen=True)
class GroupAnswer:
    """The replies to a group read: by id what came, and why the rest did not.

    The servos measured after ``sent_s`` and before ``received_s``, seconds of CLOCK_MONOTONIC.
    """

    statuses: Mapping[int, Status]
    missing: Mapping[int, DriverError]
    sent_s: float
    received_s: float


@dataclass(frozen=True)
class _GroupQuestion:
    """A group read as it is sent and what it is to be answered; kept, since most are asked again and again.

    ``ticks`` are the places of the servos' counters in the blocks of those that have them there, by id.
    """

    packet: bytes
    reply_bytes: int
    parts: Mapping[int, Part]
    ticks: Mapping[int, int]


@dataclass
class LineCounts:
    """How the line has been since it was opened."""

    transactions: int = 0
    timeouts: int = 0
    strays: int = 0
    refusals: int = 0


class Link:
    """One open line and its transactions.

    Parameters
    ----------
    port
        A serial device or a URL that pyserial understands.
    baud
        Bits per second.
    reply_timeout_s
        How long a reply may take beyond its time on the wire.
    urgent
        As of `Port`, whose ``Overtaken`` every method may raise but `shout`.

    Raises
    ------
    LineLost, BadOptions
        As `Port`.
    """

    def __init__(
        self,
        port: str,
        baud: int,
        reply_timeout_s: float = REPLY_TIMEOUT_S,
        urgent: Callable[[], bool] = lambda: False,
    ) -> None:
        self.name = port
        self.counts = LineCounts()
        self._port = Port(port, baud, reply_timeout_s, urgent)
        self._packets = PacketHandler()
        self._group_questions: dict[tuple[bool, tuple[Part, ...]], _GroupQuestion] = {}
        self._counters: dict[int, Counter] = {}

    @property
    def baud(self) -> int:
        """Bits per second."""
        return int(self._port.baudrate)

    def set_baud(self, baud: int) -> None:
        """Open the line anew at another speed. Raises LineLost, BadOptions."""
        self._port.setBaudRate(baud)

    def close(self) -> None:
        """Let go of the line; never raises."""
        self._port.closePort()

    def undisturbed(self) -> AbstractContextManager[None]:
        """Within it nothing urgent breaks off what is said; for what must not be left half done."""
        return self._port.undisturbed()

    def ping(self, servo_id: int) -> Pinged:
        """Ask one servo who it is. Raises NoReply, BadReply, LineLost."""
        status = self._ask(servo_id, INST_PING, b"", 3, "ping", "")
        model = int.from_bytes(status.data[:2], "little")
        return Pinged(servo_id, model, status.data[2], status.alert)

    def ping_all(self) -> tuple[list[Pinged], int]:
        """Ask who is on the line; takes its whole window of about a second.

        Returns
        -------
        list of Pinged, int
            Who answered, by id; and how many bytes came that were no reply (two servos of one id?).

        Raises
        ------
        LineLost
            If the line is gone.
        """
        self._packets.send(self._port, BROADCAST_ID, INST_PING)
        slots_s = 253 * (0.003 + 14 * self._port.byte_s)
        self._port.setPacketTimeoutMillis(1000 * (slots_s + self._port.reply_timeout_s))
        found: dict[int, Pinged] = {}
        before, understood = self._port.received_bytes, 0
        while (status := self._packets.receive(self._port)) is not None:
            understood += PING_REPLY_BYTES
            if len(status.data) == 3:
                model = int.from_bytes(status.data[:2], "little")
                found[status.servo_id] = Pinged(status.servo_id, model, status.data[2], status.alert)
        self._port.suspect = False
        noise = max(0, self._port.received_bytes - before - understood)
        return [found[servo_id] for servo_id in sorted(found)], noise

    def proven(self, servo_id: int, *registers: Register) -> list[int]:
        """Return registers' values, each of an answer that is certainly of its question.

        Takes a silence of some 20 ms if any of the registers is not read with the servo's counter.

        Raises
        ------
        BadReply
            If answers contradict one another again and again, or are of another moment.
        NoReply, Refused, LineLost
            With port, id, register and instruction.
        """
        found: dict[tuple[int, int], bytes] = {}
        asked = {register.window: register for register in registers if _tick_at(*register.window) is None}
        before = {window: self._outcome(servo_id, register) for window, register in asked.items()}
        tries_left = AGREEING_TRIES
        while asked:
            if not tries_left:
                names = " and ".join(register.name for register in asked.values())
                raise BadReply(
                    f"servo {servo_id} on {self.name} contradicts itself about {names}",
                    detail=self._where(servo_id, "read", names),
                )
            tries_left -= 1
            self.quiet(QUIET_S)
            for window, register in tuple(asked.items()):
                now = self._outcome(servo_id, register)
                if _same(now, before[window]):
                    del asked[window]
                    if isinstance(now, Refused):
                        raise now
                    found[window] = now
                before[window] = now
        for register in registers:
            if register.window not in found:
                answer = self.group_read([Part(servo_id, *register.window)])
                if answer.missing:
                    raise answer.missing[servo_id]
                found[register.window] = answer.statuses[servo_id].data
        return [register.decode_window(found[register.window]) for register in registers]

    def _outcome(self, servo_id: int, register: Register) -> bytes | Refused:
        """One answer to a question for a register's window, or its refusal; raises NoReply, LineLost."""
        address, length = register.window
        asked = address.to_bytes(2, "little") + length.to_bytes(2, "little")
        try:
            return self._ask(servo_id, INST_READ, asked, length, "read", register.name).data
        except Refused as refused:
            return refused

    def read(self, servo_id: int, register: Register) -> int:
        """Return what seems to be a register's value, signed where it is: see `proven`.

        Raises
        ------
        NoReply, BadReply, Refused, LineLost
            With port, id, register and instruction.
        """
        asked = register.address.to_bytes(2, "little") + register.size.to_bytes(2, "little")
        status = self._ask(servo_id, INST_READ, asked, register.size, "read", register.name)
        return register.decode(status.data)

    def write(self, servo_id: int, register: Register, value: int) -> None:
        """Set a register and wait for the servo's word that it did. Raises as `read`."""
        data = register.address.to_bytes(2, "little") + register.encode(value)
        self._ask(servo_id, INST_WRITE, data, 0, "write", register.name)

    def write_unanswered(self, servo_id: int, register: Register, value: int) -> None:
        """Set a register of a servo that is set to keep silent; an answer is dropped. Raises LineLost."""
        data = register.address.to_bytes(2, "little") + register.encode(value)
        self._packets.send(self._port, servo_id, INST_WRITE, data)
        self._port.drain()

    def quiet(self, quiet_s: float) -> None:
        """Drop what comes until nothing has come for ``quiet_s``: late replies. Raises LineLost, BadReply."""
        self._port.drain(quiet_s, 1.0)

    def reboot(self, servo_id: int) -> None:
        """Restart a servo: torque drops. Raises NoReply, BadReply, Refused, LineLost."""
        self._counters.pop(servo_id, None)  # it begins anew
        self._ask(servo_id, INST_REBOOT, b"", 0, "reboot", "")

    def group_read(self, parts: Sequence[Part], *, fast: bool = False) -> GroupAnswer:
        """Read one block of each of several servos in one transaction.

        Servos whose blocks have one address and length are asked by Sync Read, others by Bulk Read. Each
        servo waits for the one before it, so one that is missing may silence those behind it. Blocks that
        hold the servo's counter are taken only if it shows this moment; a servo whose counter is not known
        yet is asked for it first.

        Parameters
        ----------
        parts
            One per servo.
        fast
            Ask for one common reply (Fast Sync or Bulk Read); newer firmware only.

        Raises
        ------
        LineLost, BadReply
            If the line is gone or never quiet; everything else stands in the answer's ``missing``.
        """
        key = (fast, tuple(parts))
        question = self._group_questions.get(key)
        if question is None:
            question = self._group_questions[key] = _group_question(fast, parts)
        for servo_id in question.ticks:
            if servo_id not in self._counters and (error := self._unmet(question, servo_id)) is not None:
                now_s = time.monotonic()
                return GroupAnswer({}, dict.fromkeys(question.parts, error), now_s, now_s)
        self.counts.transactions += 1
        try:
            self._port.clearPort()
            sent_s = time.monotonic()
            self._port.writePort(question.packet)
            self._port.setPacketTimeout(len(question.packet) + question.reply_bytes)
            statuses, wrong = (self._fast_replies if fast else self._replies)(question, sent_s)
        except LineLost as error:
            raise self._placed(error, list(question.parts), "group read", "") from error
        received_s = time.monotonic()
        missing = {}
        if len(statuses) < len(question.parts):
            for servo_id, part in question.parts.items():
                if servo_id not in statuses:
                    addresses = f"addresses {part.address} to {part.address + part.length - 1}"
                    missing[servo_id] = wrong.get(servo_id) or self._none(servo_id, "group read", addresses)
        return GroupAnswer(statuses, missing, sent_s, received_s)

    def group_write(self, parts: Sequence[Part]) -> None:
        """Write to several servos with one packet; nobody answers, so read back what must be certain.

        Raises
        ------
        LineLost, BadReply
            If the line is gone or never quiet.
        """
        if len({(part.address, part.length) for part in parts}) == 1:
            first = parts[0]
            body = first.address.to_bytes(2, "little") + first.length.to_bytes(2, "little")
            body += b"".join(bytes((part.servo_id,)) + part.data for part in parts)
            instruction = INST_SYNC_WRITE
        else:
            body = b"".join(
                bytes((part.servo_id,))
                + part.address.to_bytes(2, "little")
                + part.length.to_bytes(2, "little")
                + part.data
                for part in parts
            )
            instruction = INST_BULK_WRITE
        self.counts.transactions += 1
        try:
            self._packets.send(self._port, BROADCAST_ID, instruction, body)
        except LineLost as error:
            raise self._placed(error, [part.servo_id for part in parts], "group write", "") from error

    def shout(self, parts: Sequence[Part], copies: int = 1) -> None:
        """Write to each of several servos by a packet of its own, at once and whatever is under way.

        Nobody answers, nothing is listened to before, and one servo's packet does not hang on another's:
        what is sent may collide with a reply, so send more than one copy where it matters.

        Raises
        ------
        LineLost
            If the line is gone.
        """
        packets = b"".join(
            instruction_packet(
                BROADCAST_ID,
                INST_SYNC_WRITE,
                part.address.to_bytes(2, "little")
                + part.length.to_bytes(2, "little")
                + bytes((part.servo_id,))
                + part.data,
            )
            for part in parts
        )
        self.counts.transactions += copies * len(parts)
        try:
            self._port.write_now(copies * packets)
        except LineLost as error:
            raise self._placed(error, [part.servo_id for part in parts], "group write", "") from error

    def _ask(
        self, servo_id: int, instruction: int, parameters: bytes, length: int, word: str, register: str
    ) -> Status:
        """One instruction to one servo and its reply of ``length`` bytes."""
        self.counts.transactions += 1
        port = self._port
        try:
            self._packets.send(port, servo_id, instruction, parameters)
            port.setPacketTimeout(12 + len(parameters) + 11 + length)
            while (status := self._packets.receive(port)) is not None:
                if status.servo_id != servo_id:
                    self._stray(status)
                elif status.refused:
                    raise self._refusal(status, word, register)
                elif len(status.data) == length:
                    return status
                else:
                    self._stray(status)
        except LineLost as error:
            raise self._placed(error, [servo_id], word, register) from error
        raise self._none(servo_id, word, register)

    def _replies(
        self, question: _GroupQuestion, sent_s: float
    ) -> tuple[dict[int, Status], dict[int, DriverError]]:
        """The replies to a group read until all have come or the deadline passes.

        They come in the order of the list; where they do not, or a servo says two things, none is certain.
        """
        parts = question.parts
        waited = list(parts)
        taken: dict[int, Status] = {}
        wrong: dict[int, DriverError] = {}
        while waited:
            status = self._packets.receive(self._port)
            if status is None:
                break
            servo_id = status.servo_id
            if servo_id not in parts or len(status.data) != (0 if status.refused else parts[servo_id].length):
                self._stray(status)
            elif status.refused:
                wrong[servo_id] = self._refusal(status, "group read", "")
                waited = _behind(waited, servo_id)
            elif servo_id in question.ticks and (doubts := self._doubts(question, status, sent_s)):
                wrong[servo_id] = doubts
            elif servo_id in waited:
                taken[servo_id] = status
                waited = _behind(waited, servo_id)
            else:
                self._stray(status)
                if status != taken.get(servo_id):
                    return {}, wrong
        return taken, wrong

    def _unmet(self, question: _GroupQuestion, servo_id: int) -> DriverError | None:
        """Get to know the counter of a servo of a group; returns why that failed. Raises LineLost."""
        try:
            self._meet(servo_id, question.parts[servo_id].address + question.ticks[servo_id])
        except LineLost:
            raise
        except DriverError as error:
            return error
        return None

    def _meet(self, servo_id: int, tick_address: int) -> None:
        """Get to know a servo's counter: by two answers, each after a silence, that agree about it.

        No question is asked twice, so that no reply that is some questions late can be taken for another.
        """
        shapes = iter(MEETING_SHAPES)
        for shape in shapes:
            counter = Counter(*self._tick(servo_id, tick_address, shape))
            doubts = counter.doubts(*self._tick(servo_id, tick_address, next(shapes)))
            if not doubts:
                self._counters[servo_id] = counter
                return
        raise BadReply(
            f"servo {servo_id} on {self.name}: no two replies are of the moments that they were asked for: "
            f"{doubts}",
            detail=self._where(servo_id, "read", "realtime_tick"),
        )

    def _tick(self, servo_id: int, address: int, shape: tuple[int, int]) -> tuple[int, float, float]:
        """The counter in a reply of so many bytes around it, and when that was asked and came."""
        before, after = shape
        self.quiet(QUIET_S)
        sent_s = time.monotonic()
        length = before + 2 + after
        asked = (address - before).to_bytes(2, "little") + length.to_bytes(2, "little")
        status = self._ask(servo_id, INST_READ, asked, length, "read", "realtime_tick")
        tick = int.from_bytes(status.data[before : before + 2], "little")
        return tick, sent_s, time.monotonic()

    def _doubts(self, question: _GroupQuestion, status: Status, sent_s: float) -> BadReply | None:
        """Why a reply that just came and holds its servo's counter is not to this question; None if it is."""
        servo_id = status.servo_id
        at = question.ticks[servo_id]
        tick = int.from_bytes(status.data[at : at + 2], "little")
        doubts = self._counters[servo_id].doubts(tick, sent_s, time.monotonic())
        if not doubts:
            return None
        self._stray(status)
        return BadReply(
            f"servo {servo_id} on {self.name}: {doubts}",
            detail=self._where(servo_id, "group read", "realtime_tick"),
        )

    def _fast_replies(
        self, question: _GroupQuestion, sent_s: float
    ) -> tuple[dict[int, Status], dict[int, DriverError]]:
        """The blocks of the common reply to a fast group read; every block has a checksum of its own.

        Blocks are error, id, data and the checksum of all bytes so far; the last checksum is the packet's.
        """
        parts = list(question.parts.values())
        length = sum(4 + part.length for part in parts) - 2  # without the last checksum
        while (status := self._packets.receive(self._port, fast=True)) is not None:
            body = bytes((status.error,)) + status.data
            if len(body) == length:
                break
            self._stray(status)
        else:
            return {}, {}
        total = len(body) + 10 - 7
        header = b"\xff\xff\xfd\x00" + bytes((status.servo_id,)) + total.to_bytes(2, "little") + b"\x55"
        crc, at = crc16(header), 0
        statuses: dict[int, Status] = {}
        wrong: dict[int, DriverError] = {}
        for number, part in enumerate(parts):
            end = at + 2 + part.length
            block = body[at:end]
            last = number == len(parts) - 1
            crc = crc16(block, crc)
            stated = body[end : end + 2]
            good = len(block) == 2 + part.length and block[1] == part.servo_id
            if not good or not (last or stated == crc.to_bytes(2, "little")) or (last and end != len(body)):
                self._port.suspect = True
                break
            crc = crc16(stated, crc)
            at = end + 2
            answer = Status(part.servo_id, block[0], block[2:])
            if answer.refused:
                wrong[part.servo_id] = self._refusal(answer, "fast group read", "")
            elif part.servo_id in question.ticks and (doubts := self._doubts(question, answer, sent_s)):
                wrong[part.servo_id] = doubts
            else:
                statuses[part.servo_id] = answer
        return statuses, wrong

    def _stray(self, status: Status) -> None:
        """Note a reply to another question; the line is listened to until quiet before the next one."""
        self.counts.strays += 1
        self._port.suspect = True
        log.debug("%s: dropped a reply of id %d that nobody waits for", self.name, status.servo_id)

    def _none(self, servo_id: int, word: str, register: str) -> NoReply:
        self.counts.timeouts += 1
        self._port.suspect = True
        what = f"{word} of {register}" if register else word
        return NoReply(
            f"servo {servo_id} on {self.name} at {self.baud} baud gave no usable answer to {what} within "
            f"{1000 * self._port.reply_timeout_s:g} ms",
            detail=self._where(servo_id, word, register),
        )

    def _refusal(self, status: Status, word: str, register: str) -> Refused:
        self.counts.refusals += 1
        what = f"{word} of {register}" if register else word
        reason = ERROR_WORDS.get(status.refused, f"unknown error {status.refused}")
        alert = ", and it reports a hardware error" if status.alert else ""
        return Refused(
            f"servo {status.servo_id} on {self.name} refused the {what}: {reason}{alert}",
            detail={**self._where(status.servo_id, word, register), "error": status.error},
        )

    def _placed(self, error: LineLost, servo_ids: Sequence[int], word: str, register: str) -> LineLost:
        """The same loss, saying what was being asked."""
        servos = " and ".join(str(servo_id) for servo_id in servo_ids)
        what = f"{word} of {register}" if register else word
        where = self._where(servo_ids[0], word, register)
        return LineLost(f"{error} during {what} of servo {servos}", detail={**where, **error.detail})

    def _where(self, servo_id: int, word: str, register: str) -> dict[str, object]:
        return {
            "port": self.name,
            "baud": self.baud,
            "servo_id": servo_id,
            "register": register,
            "instruction": word,
        }


def _tick_at(address: int, length: int) -> int | None:
    """Where in a block the servo's counter stands, None if it is not in it."""
    return next((tick - address for tick in TICKS if address <= tick and tick + 2 <= address + length), None)


def _same(one: bytes | Refused, other: bytes | Refused) -> bool:
    """Whether two outcomes of one question are the same."""
    if isinstance(one, Refused) or isinstance(other, Refused):
        return type(one) is type(other) and str(one) == str(other)
    return one == other


def _behind(waited: list[int], servo_id: int) -> list[int]:
    """Who is still waited for after a servo has spoken: those behind it in the list."""
    return waited[waited.index(servo_id) + 1 :] if servo_id in waited else waited


def _group_question(fast: bool, parts: Sequence[Part]) -> _GroupQuestion:
    """A group read: Sync Read where all blocks are alike, else Bulk Read."""
    if len({(part.address, part.length) for part in parts}) == 1:
        instruction = INST_FAST_SYNC_READ if fast else INST_SYNC_READ
        body = parts[0].address.to_bytes(2, "little") + parts[0].length.to_bytes(2, "little")
        body += bytes(part.servo_id for part in parts)
    else:
        instruction = INST_FAST_BULK_READ if fast else INST_BULK_READ
        body = b"".join(
            bytes((part.servo_id,)) + part.address.to_bytes(2, "little") + part.length.to_bytes(2, "little")
            for part in parts
        )
    places = {part.servo_id: _tick_at(part.address, part.length) for part in parts}
    return _GroupQuestion(
        instruction_packet(BROADCAST_ID, instruction, body),
        sum(11 + part.length for part in parts),
        {part.servo_id: part for part in parts},
        {servo_id: at for servo_id, at in places.items() if at is not None},
    )
