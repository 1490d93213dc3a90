"""Transactions with Feetech servos on one line, each answer proven to be of its question.

The protocol has no sequence number, and a reply does not say what was asked. What proves a sample is:

- **Length.** Each question asks for another number of bytes, `STARTS` of them in turn; another length is no
  answer.
- **Token** (STS, SMS). Just before it, each question writes a number into the torque limit of both servos, up
  to `TOKENS` steps of 0.1 % below what is configured, and reads it back within the answer. Together that is
  the number of a question out of `STARTS * TOKENS`: a reply is told from any up to 271 questions late.
- **Agreement** (SCS, which has no such register). For `LATE_S` after a reply that was lost, wrong or one too
  many, each question is asked twice, by two lengths, and the answers have to fit. This proves less:
  a reply that is later than that, or two that are late alike, are taken.

What is read for one register is asked twice around a silence, by two lengths, and has to agree.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

from drivers.clock import Clock
from drivers.errors import BadReply, DriverError, LineLost
from drivers.feetech.models import FeetechModel, Register
from drivers.feetech.packets import (
    BROADCAST_ID,
    FORMAT,
    PING,
    READ,
    STATUS_BYTES,
    WRITE,
    instruction_packet,
    sync_read_packet,
    sync_write_packet,
)
from drivers.serial_line import OpenLine, SerialLine
from drivers.servo_bus.course import ServoSample
from drivers.servo_bus.link import REPLY_TIMEOUT_S, BusLink
from drivers.servo_bus.port import QUIET_S, Status

STARTS, TOKENS = 17, 16
FIRST_START = 24  # of what is read, up to torque_enable
LATE_S = 1.0
SAME_COUNTS = 2  # apart at most, of two answers of an axis that stands
AGREEING_TRIES = 5
NOBODY = sync_write_packet(40, {})
"""A write to no servo: an adapter that gives it back echoes."""


@dataclass
class Questions:
    """Which question comes next, and until when late replies may come; outlasts a line of the head."""

    numbers: itertools.count[int] = field(default_factory=itertools.count)
    doubted_until_s: float = -math.inf


class FeetechLink(BusLink):
    """One open line and its transactions, as of `BusLink`.

    Parameters
    ----------
    port, baud, reply_timeout_s, urgent, clock, open_line
        As of `BusLink`.
    questions
        Of the head, over all its lines.
    """

    def __init__(
        self,
        port: str,
        baud: int,
        reply_timeout_s: float = REPLY_TIMEOUT_S,
        urgent: Callable[[], bool] = lambda: False,
        *,
        questions: Questions | None = None,
        clock: Clock | None = None,
        open_line: OpenLine = SerialLine,
    ) -> None:
        super().__init__(port, baud, reply_timeout_s, FORMAT, urgent, clock, open_line)
        self._questions = questions or Questions()

    def find_echo(self) -> bool:
        """Find out whether the adapter gives back what is sent, and drop that from now on.

        Raises
        ------
        LineLost, BadReply
            If the line is gone, or never quiet.
        """
        self._port.echoes = self._port.comes_back(NOBODY)
        return self._port.echoes

    def ping(self, servo_id: int) -> int:
        """Return the status of a servo that is there. Raises NoReply, BadReply, LineLost."""
        return self.exchange.ask(servo_id, PING, b"", 0).error

    def ping_all(self) -> tuple[list[int], int]:
        """Ask who is on the line.

        Returns
        -------
        list of int, int
            The ids that answered; and how many bytes came that were no reply: two servos spoke at once.

        Raises
        ------
        LineLost, BadReply
            If the line is gone or never quiet.
        """
        port = self._port
        port.send(instruction_packet(BROADCAST_ID, PING), 0)
        port.deadline_s = self.clock.now_s() + port.reply_timeout_s + 253 * (0.0005 + 6 * port.byte_s)
        found, before = [], port.received_bytes
        while (status := port.receive()) is not None:
            found.append(status.servo_id)
        port.suspect = False
        noise = port.received_bytes - before - 6 * (len(found) + port.echoes)
        return sorted(set(found)), max(0, noise)

    def look(self, servo_id: int, model: FeetechModel) -> ServoSample:
        """Return one servo's motion, asked one time after a silence. Raises as `proven`."""
        sent_s = self.clock.now_s()
        values = _values(model, 40, self.block(servo_id, 40, 31))
        return ServoSample(values, values["status"] != 0, sent_s, self.clock.now_s())

    def proven(self, servo_id: int, register: Register, model: FeetechModel) -> int:
        """Return a register's value, said twice around a silence by replies of two lengths.

        Raises
        ------
        BadReply
            If the answers contradict one another again and again.
        NoReply, LineLost
            With port, id, register and instruction.
        """
        size, before = register.size, None
        for more in range(AGREEING_TRIES):
            data = self.exchange.read(servo_id, register.address, size + more % 2, register.name)[:size]
            if data == before:
                return register.decode(data, model.order)
            before = data
            self.quiet(QUIET_S)
        raise BadReply(
            f"servo {servo_id} on {self.name} contradicts itself about {register.name}",
            detail=self.exchange.where(servo_id, "read", register.name),
        )

    def block(self, servo_id: int, address: int, length: int) -> bytes:
        """Return bytes of one servo's memory, asked one time after a silence. Raises as `proven`."""
        self.quiet(QUIET_S)
        return self.exchange.read(servo_id, address, length, "memory")

    def write(self, servo_id: int, register: Register, value: int, model: FeetechModel) -> None:
        """Set a register and wait for the servo's word. Raises NoReply, BadReply, LineLost."""
        data = bytes((register.address,)) + register.encode(value, model.order)
        self.exchange.ask(servo_id, WRITE, data, 0, register.name)

    def write_unanswered(self, servo_id: int, register: Register, value: int, model: FeetechModel) -> None:
        """Set a register of a servo that may keep silent about it; an answer is dropped. Raises LineLost."""
        data = bytes((register.address,)) + register.encode(value, model.order)
        self._port.send(instruction_packet(servo_id, WRITE, data), 0)
        self._port.drain()

    def group_write(self, address: int, data: Mapping[int, bytes]) -> None:
        """Write equally many bytes to each servo with one packet, unanswered. Raises LineLost, BadReply."""
        self._port.send(sync_write_packet(address, data), 0)

    def shout(self, address: int, data: Mapping[int, bytes], copies: int) -> None:
        """Write to each servo by a packet of its own, at once and whatever is under way. Raises LineLost."""
        packets = b"".join(sync_write_packet(address, {one: data[one]}) for one in data)
        self._port.suspect = True
        self._port.send_now(copies * packets)

    def samples(self, servos: Mapping[int, tuple[FeetechModel, int]]) -> dict[int, ServoSample]:
        """Return what servos say about their motion now, by id.

        Parameters
        ----------
        servos
            Of each id its model, all of one series, and its full torque limit, 0.1 %.

        Raises
        ------
        NoReply, BadReply, LineLost
            If one is silent, or an answer is not of this question.
        """
        number = next(self._questions.numbers)
        start, token = FIRST_START + number % STARTS, number % TOKENS
        if any(model.is_scs for model, _ in servos.values()):
            return self._asked_singly(servos, start)
        end = 71
        limits = {one: limit - token for one, (_, limit) in servos.items()}
        told = {one: limit.to_bytes(2, "little") for one, limit in limits.items()}
        length, ids = end - start, tuple(servos)
        question = sync_write_packet(48, told) + sync_read_packet(start, length, ids)
        try:
            sent_s = self._port.send(question, len(ids) * (STATUS_BYTES + length))
            taken = self._replies(ids, length)
        except LineLost as error:
            raise self.exchange.placed(error, ids, "sync read") from error
        received_s = self.clock.now_s()
        found = {}
        for one, status in taken.items():
            values = _values(servos[one][0], start, status.data)
            if values["torque_limit"] != limits[one]:
                self.exchange.stray(status)
                raise BadReply(
                    f"servo {one} on {self.name}: a reply to another question (late, or repeated): it holds "
                    f"the torque limit {values['torque_limit']} where {limits[one]} was written with the "
                    "question",
                    detail=self.exchange.where(one, "sync read", "torque_limit"),
                )
            values["torque_limit"] = servos[one][1]
            found[one] = ServoSample(values, status.alert, sent_s, received_s)
        return found

    def _replies(self, ids: Sequence[int], length: int) -> dict[int, Status]:
        """The replies to a sync read, in the order asked, one of each servo. Raises NoReply, LineLost."""
        taken: dict[int, Status] = {}
        for one in ids:
            while True:
                status = self._port.receive()
                if status is None:
                    raise self.exchange.silence(one, "sync read", f"{length} bytes")
                if status.servo_id == one and len(status.data) == length:
                    taken[one] = status
                    break
                self.exchange.stray(status)
                if (
                    status.servo_id in ids
                    and len(status.data) == length
                    and status != taken.get(status.servo_id)
                ):
                    raise BadReply(
                        f"servo {status.servo_id} on {self.name} answers out of turn",
                        detail=self.exchange.where(status.servo_id, "sync read", ""),
                    )
        return taken

    def _asked_singly(
        self, servos: Mapping[int, tuple[FeetechModel, int]], start: int
    ) -> dict[int, ServoSample]:
        """The same of servos that answer one at a time: said twice where a late reply may be under way."""
        try:
            found = self._round(servos, start)
            if self.clock.now_s() < self._questions.doubted_until_s:
                before, next_start = found, FIRST_START + next(self._questions.numbers) % STARTS
                found = self._round(servos, next_start)
                for one, sample in found.items():
                    self._see_same(one, servos[one][0].speed_unit_counts, before[one], sample)
        except LineLost:
            raise
        except DriverError:
            self._questions.doubted_until_s = self.clock.now_s() + LATE_S
            raise
        return found

    def _round(self, servos: Mapping[int, tuple[FeetechModel, int]], start: int) -> dict[int, ServoSample]:
        """One answer of each servo. Raises NoReply, BadReply, LineLost."""
        found = {}
        for one, (model, _) in servos.items():
            sent_s = self.clock.now_s()
            status = self.exchange.ask(one, READ, bytes((start, 67 - start)), 67 - start, "motion")
            values = _values(model, start, status.data)
            found[one] = ServoSample(values, status.alert, sent_s, self.clock.now_s())
            if self._port.suspect:
                raise BadReply(f"{self.name}: more came than was asked for")
        return found

    def _see_same(self, one: int, unit: int, before: ServoSample, after: ServoSample) -> None:
        """See that two samples can follow one another. Raises BadReply."""
        told = max(abs(sample.values["present_velocity"]) for sample in (before, after))
        speed = unit * (told + (unit > 1))  # less than one unit more is not told
        most = SAME_COUNTS + speed * (after.received_s - before.sent_s)
        if abs(after.counts - before.counts) > most:
            raise BadReply(
                f"servo {one} on {self.name} says {before.counts} and then {after.counts} counts, where a "
                "reply was lost before: one of them is late",
                detail=self.exchange.where(one, "read", "present_position"),
            )


def open_link(
    port: str,
    baud: int,
    reply_timeout_s: float = REPLY_TIMEOUT_S,
    urgent: Callable[[], bool] = lambda: False,
    *,
    questions: Questions | None = None,
    clock: Clock | None = None,
    open_line: OpenLine = SerialLine,
) -> FeetechLink:
    """Open a line and find out whether its adapter echoes; parameters and errors as of `FeetechLink`."""
    link = FeetechLink(
        port, baud, reply_timeout_s, urgent, questions=questions, clock=clock, open_line=open_line
    )
    try:
        link.find_echo()
    except BaseException:
        link.close()
        raise
    return link


def _values(model: FeetechModel, start: int, data: bytes) -> dict[str, int]:
    """The registers in a block by name, and what a course asks for beside them."""
    values = {}
    for register in model.registers.values():
        at = register.address - start
        if register.address >= 40 and at + register.size <= len(data):
            values[register.name] = register.decode(data[at : at + register.size], model.order)
    values["moving_status"] = 2 * values["moving"]  # a profile is under way
    values["profile_acceleration"] = values.get("acceleration", 1)
    values["profile_velocity"] = values["goal_speed"]
    values.setdefault("present_current", 0)
    return values
