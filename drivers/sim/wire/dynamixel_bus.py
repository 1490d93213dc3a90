"""A simulated Dynamixel bus: bytes of the host in, answers of the servos out, in their order.

Protocol 2.0 as a servo sees it. A packet is ``FF FF FD 00 id length instruction parameters crc``; length
counts from the instruction on, both words little end first. Where the body holds ``FF FF FD`` a sender adds
another ``FD``, so ``FF FF FD`` with anything else behind it is always the start of a packet, even inside what
looked like one. That is how the parser gets back into step. Source: ROBOTIS e-Manual, "DYNAMIXEL Protocol
2.0".
"""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass

from drivers.sim.wire.carrier import Reply
from drivers.sim.wire.dynamixel_models import (
    CRC_ERROR,
    DATA_LENGTH,
    INSTRUCTION_ERROR,
    InstructionRefused,
)
from drivers.sim.wire.dynamixel_servo import SimulatedServo

HEADER = b"\xff\xff\xfd\x00"
BROADCAST = 0xFE
MAX_ID = 0xFC
STATUS = 0x55

MAX_PACKET = 1024
"""Longest packet that a servo takes, bytes; a length field beyond it is noise. (The SDK's own bound.)"""

PING, READ, WRITE, REBOOT = 1, 2, 3, 8
SYNC_READ, SYNC_WRITE, BULK_READ, BULK_WRITE = 0x82, 0x83, 0x92, 0x93

_MARK = HEADER[:3]
_FRONT = 7  # bytes up to the instruction


def _crc_table() -> tuple[int, ...]:
    table = []
    for byte in range(256):
        crc = byte << 8
        for _ in range(8):
            crc = (crc << 1) ^ 0x8005 if crc & 0x8000 else crc << 1
        table.append(crc & 0xFFFF)
    return tuple(table)


_CRC_TABLE = _crc_table()


def crc16(data: bytes | bytearray, crc: int = 0) -> int:
    """Return the CRC of the bytes (polynomial 0x8005, nothing reflected, from ``crc`` on)."""
    for byte in data:
        crc = (crc << 8 & 0xFFFF) ^ _CRC_TABLE[crc >> 8 ^ byte]
    return crc


def stuffed(body: bytes) -> bytes:
    """Return the body with a further FD after every FF FF FD."""
    return body.replace(_MARK, _MARK + b"\xfd")


def unstuffed(body: bytes) -> bytes:
    """Return the body as it was before `stuffed`."""
    return body.replace(_MARK + b"\xfd", _MARK)


def packet(packet_id: int, body: bytes) -> bytes:
    """Return a whole packet around a body (instruction and parameters, not yet stuffed)."""
    body = stuffed(body)
    front = HEADER + bytes((packet_id,)) + (len(body) + 2).to_bytes(2, "little")
    return front + body + crc16(front + body).to_bytes(2, "little")


def status_packet(servo_id: int, error: int, parameters: bytes = b"") -> bytes:
    """Return the answer of one servo."""
    return packet(servo_id, bytes((STATUS, error)) + parameters)


def renamed(data: bytes, servo_id: int) -> bytes:
    """Return a whole packet as another servo would send it; bytes that are none as they are."""
    if not data.startswith(HEADER) or len(data) < _FRONT + 4:
        return data
    front = HEADER + bytes((servo_id,)) + data[5:-2]
    return front + crc16(front).to_bytes(2, "little")


@dataclass(frozen=True)
class Instruction:
    """One packet from the host; ``intact`` is False when its CRC does not match."""

    packet_id: int
    code: int
    parameters: bytes
    intact: bool = True


class InstructionParser:
    """Finds packets in any bytes, in any chunks; never raises, holds at most one packet's bytes."""

    def __init__(self) -> None:
        self._buffer = bytearray()

    def feed(self, data: bytes) -> list[Instruction]:
        """Take bytes of the line, return the packets that they complete."""
        self._buffer += data
        found: list[Instruction] = []
        while True:
            step, instruction = self._look()
            if instruction is not None:
                found.append(instruction)
            if step == 0:
                return found
            del self._buffer[:step]

    def _look(self) -> tuple[int, Instruction | None]:
        """How many bytes at the front are done with (0: wait for more), and the packet in them."""
        buffer = self._buffer
        start = buffer.find(_MARK)
        if start < 0:
            # The beginning of a mark may stand at the end.
            keep = 2 if buffer.endswith(b"\xff\xff") else 1 if buffer.endswith(b"\xff") else 0
            return len(buffer) - keep, None
        if start > 0:
            return start, None
        if len(buffer) < _FRONT:
            # Decide as early as possible, so that a header that cannot be one never hides the next.
            known = buffer[3:5]
            bad = (len(known) > 0 and known[0] != 0) or (len(known) > 1 and not _is_id(known[1]))
            return (1, None) if bad else (0, None)
        length = buffer[5] | buffer[6] << 8
        if buffer[3] != 0 or not _is_id(buffer[4]) or not 3 <= length <= MAX_PACKET - _FRONT:
            return 1, None
        end = _FRONT + length
        body = buffer[_FRONT : min(end - 2, len(buffer))]
        inside = _mark_inside(body, whole=len(buffer) >= end - 2)
        if inside is not None:
            return _FRONT + inside, None
        if len(buffer) < end:
            return 0, None
        if crc16(buffer[: end - 2]) != buffer[end - 2] | buffer[end - 1] << 8:
            return 1, Instruction(buffer[4], body[0], b"", intact=False)
        plain = unstuffed(bytes(body))
        return end, Instruction(buffer[4], plain[0], plain[1:])


def _is_id(value: int) -> bool:
    return value <= MAX_ID or value == BROADCAST


def _mark_inside(body: bytearray, whole: bool) -> int | None:
    """Where in a body a mark stands that is not stuffed: there another packet may start."""
    at = body.find(_MARK)
    while at >= 0:
        if at + 3 >= len(body):
            return at if whole else None  # else what follows is not here yet
        if body[at + 3] != 0xFD:
            return at
        at = body.find(_MARK, at + 4)
    return None


class DynamixelBus:
    """Servos on one line, a ``WireDevice``; safe from any thread.

    Parameters
    ----------
    servos
        Those on the line. Two may have the same id: then their answers collide. Of a model of two axes each
        two that follow one another are in one case.
    waits_for_predecessor
        In a sync or bulk read a servo answers after the one before it in the list; when that one is not
        there, it and all behind it stay silent. False: the list is answered without the missing one.

    Attributes
    ----------
    host_baud
        Bits a second of the host, set by the line; a servo with another rate hears nothing. None: the
        rate of the first servo.
    """

    renamed = staticmethod(renamed)

    def __init__(self, servos: Iterable[SimulatedServo], *, waits_for_predecessor: bool = True) -> None:
        self.servos = list(servos)
        twins = [servo for servo in self.servos if servo.model.axes == 2]
        for one, other in zip(twins[::2], twins[1::2], strict=False):
            one.mate, other.mate = other, one
        self.waits_for_predecessor = waits_for_predecessor
        self.host_baud: int | None = None
        self._parser = InstructionParser()
        self._lock = threading.RLock()

    @property
    def baud(self) -> int:
        """Bits a second that the line is listened to at."""
        return self.host_baud or (self.servos[0].baud if self.servos else 57600)

    def receive(self, data: bytes, time_s: float) -> Sequence[Reply]:
        """Take bytes of the host, return what the servos answer to the packets that they complete."""
        with self._lock:
            replies: list[Reply] = []
            for instruction in self._parser.feed(data):
                replies += self._answer(instruction, time_s)
            return replies

    def poll(self, time_s: float) -> Sequence[Reply]:
        """Let happen what happens without a packet (watchdog, protection); servos never speak unasked."""
        with self._lock:
            for servo in self.servos:
                servo.update(time_s)
            return ()

    @contextlib.contextmanager
    def held(self) -> Iterator[None]:
        """Keep the line from the servos meanwhile, so that another thread may do something to them."""
        with self._lock:
            yield

    def _answer(self, instruction: Instruction, time_s: float) -> list[Reply]:
        here: list[SimulatedServo] = []
        for servo in self.servos:
            servo.update(time_s)
            if servo.hears(time_s) and servo.baud == self.baud:
                here.append(servo)
        code, parameters = instruction.code, instruction.parameters
        if not instruction.intact:
            return self._damaged(instruction, here)
        if code == STATUS:
            return []  # an answer that came back to the servos
        for servo in here:
            servo.feed(time_s)
        if code in (SYNC_READ, BULK_READ):
            wanted = _wanted(code, parameters) if instruction.packet_id == BROADCAST else []
            return self._group_read(wanted, here, time_s)
        if code in (SYNC_WRITE, BULK_WRITE):
            if instruction.packet_id == BROADCAST:
                _group_write(code, parameters, here, time_s)
            return []
        return self._single(instruction, here, time_s)

    def _damaged(self, instruction: Instruction, here: list[SimulatedServo]) -> list[Reply]:
        """A CRC that does not match: the servo that seems to be meant says so."""
        return _collided(
            Reply(
                status_packet(servo.servo_id, CRC_ERROR | servo.alert()),
                servo.return_delay_s,
                servo.servo_id,
            )
            for servo in here
            if servo.servo_id == instruction.packet_id and servo.answers("write")
        )

    def _single(self, instruction: Instruction, here: list[SimulatedServo], time_s: float) -> list[Reply]:
        """An instruction to one servo, to a group by its secondary id, or to all."""
        code, broadcast = instruction.code, instruction.packet_id == BROADCAST
        replies: list[Reply] = []
        for servo in sorted(here, key=lambda s: s.servo_id):
            servo_id = servo.servo_id
            own = servo_id == instruction.packet_id
            group = servo.table["secondary_id"] == instruction.packet_id <= MAX_ID and not own
            if not (own or group or broadcast):
                continue
            error, data, alert = 0, b"", servo.alert()  # a reboot forgets the error
            level = servo.answers("ping" if code == PING else "read" if code == READ else "write")
            try:
                data = _do(servo, instruction, time_s, broadcast=broadcast, group=group)
            except InstructionRefused as refused:
                error = refused.error
            if level and (own or (broadcast and code == PING)):
                # In a broadcast ping each waits for the one with the next lower id.
                answer = status_packet(servo_id, error | alert, data)
                replies.append(Reply(answer, servo.return_delay_s, servo_id))
        return _collided(replies)

    def _group_read(
        self, wanted: list[tuple[int, int, int]], here: list[SimulatedServo], time_s: float
    ) -> list[Reply]:
        """Sync and bulk reads, answered in the order of the list."""
        replies: list[Reply] = []
        for servo_id, address, length in wanted:
            found = [s for s in here if s.servo_id == servo_id and s.answers("read")]
            if not found and self.waits_for_predecessor:
                break
            answers = []
            for servo in found:
                error, data = 0, b""
                try:
                    data = servo.read(address, length, time_s)
                except InstructionRefused as refused:
                    error = refused.error
                answer = status_packet(servo_id, error | servo.alert(), data)
                answers.append(Reply(answer, found[0].return_delay_s, servo_id))
            replies += _collided(answers)
        return replies


def _do(
    servo: SimulatedServo, instruction: Instruction, time_s: float, *, broadcast: bool, group: bool
) -> bytes:
    """Carry out one instruction on one servo and return the parameters of its answer."""
    code, parameters = instruction.code, instruction.parameters
    if code == PING:
        return servo.ping()
    if code == READ:
        if len(parameters) != 4:
            raise InstructionRefused(DATA_LENGTH)
        address, length = _word(parameters, 0), _word(parameters, 2)
        return b"" if broadcast else servo.read(address, length, time_s)
    if code == WRITE:
        if len(parameters) < 3:
            raise InstructionRefused(DATA_LENGTH)
        servo.write(_word(parameters, 0), parameters[2:], time_s, by_group=group)
    elif code == REBOOT:
        servo.reboot(time_s)
    else:
        raise InstructionRefused(INSTRUCTION_ERROR)
    return b""


def _word(data: bytes, at: int) -> int:
    return int.from_bytes(data[at : at + 2], "little")


def _wanted(code: int, parameters: bytes) -> list[tuple[int, int, int]]:
    """Id, address and length for each servo of a sync or bulk read; what is left over is ignored."""
    if code == SYNC_READ:
        address, length = _word(parameters, 0), _word(parameters, 2)
        return [(servo_id, address, length) for servo_id in dict.fromkeys(parameters[4:])]
    whole = len(parameters) // 5 * 5
    found: dict[int, tuple[int, int, int]] = {}
    for at in range(0, whole, 5):
        found.setdefault(
            parameters[at], (parameters[at], _word(parameters, at + 1), _word(parameters, at + 3))
        )
    return list(found.values())


def _group_write(code: int, parameters: bytes, here: list[SimulatedServo], time_s: float) -> None:
    """Write to each servo of a sync or bulk write; none answers, refused values are dropped."""
    at = 4 if code == SYNC_WRITE else 0
    address, length = _word(parameters, 0), _word(parameters, 2)
    while at < len(parameters):
        servo_id = parameters[at]
        at += 1
        if code == BULK_WRITE:
            address, length = _word(parameters, at), _word(parameters, at + 2)
            at += 4
        data = parameters[at : at + length]
        at += length
        if len(data) < length:
            return
        for servo in here:
            if servo.servo_id == servo_id:
                try:
                    servo.write(address, data, time_s)
                except InstructionRefused:
                    continue


def _collided(replies: Iterable[Reply]) -> list[Reply]:
    """Answers of servos with the same id lie on one another: a line is low when one pulls it low."""
    merged: dict[int, Reply] = {}
    for reply in replies:
        other = merged.get(reply.sender)
        if other is None:
            merged[reply.sender] = reply
            continue
        size = max(len(reply.data), len(other.data))
        one, two = reply.data.ljust(size, b"\xff"), other.data.ljust(size, b"\xff")
        both = bytes(a & b for a, b in zip(one, two, strict=True))
        merged[reply.sender] = Reply(both, min(reply.delay_s, other.delay_s), reply.sender)
    return list(merged.values())
