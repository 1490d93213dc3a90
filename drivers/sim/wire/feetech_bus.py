"""A simulated bus of Feetech servos: bytes of the host in, answers of the servos out, in their order.

Packets are from the maker's protocol manual; the driver's are its own: ``FF FF ID LENGTH CODE PARAMETERS
SUM``. The length counts what follows it, the sum is the low byte of all behind the header, inverted. A reply
has the servo's status where an instruction has its code.
"""

from __future__ import annotations

import threading
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from drivers.sim.wire.carrier import Reply
from drivers.sim.wire.feetech_servo import SimulatedFeetechServo

BROADCAST = 0xFE
HEADER = b"\xff\xff"
PING, READ, WRITE, SYNC_READ, SYNC_WRITE = 1, 2, 3, 0x82, 0x83
_LONGEST = 250


def packet(servo_id: int, code: int, body: bytes = b"") -> bytes:
    """Return the bytes of an instruction or, with the status as its code, of a reply."""
    inside = bytes((servo_id, len(body) + 2, code)) + body
    return HEADER + inside + bytes((~sum(inside) & 0xFF,))


def renamed(data: bytes, servo_id: int) -> bytes:
    """Return a reply as if another servo had sent it, with a sum that fits."""
    return packet(servo_id & 0xFF, data[4], data[5:-1]) if len(data) > 5 else data


@dataclass(frozen=True)
class FeetechInstruction:
    """One packet from the host whose sum fits."""

    servo_id: int
    code: int
    parameters: bytes


class FeetechInstructionParser:
    """Finds packets in any bytes, in any chunks; never raises, holds at most one packet's bytes."""

    def __init__(self) -> None:
        self._buffer = bytearray()

    def feed(self, data: bytes) -> list[FeetechInstruction]:
        """Take bytes of the line, return the packets that they complete."""
        self._buffer += data
        found: list[FeetechInstruction] = []
        while True:
            start = self._buffer.find(HEADER)
            if start < 0:
                del self._buffer[: len(self._buffer) - self._buffer.endswith(b"\xff")]
                return found
            del self._buffer[:start]
            if len(self._buffer) < 4:
                return found
            end = 4 + self._buffer[3]
            if self._buffer[2] == 0xFF or not 6 <= end <= _LONGEST:
                del self._buffer[:1]
                continue
            if len(self._buffer) < end:
                return found
            whole = bytes(self._buffer[:end])
            if whole[-1] == ~sum(whole[2:-1]) & 0xFF:
                found.append(FeetechInstruction(whole[2], whole[4], whole[5:-1]))
                del self._buffer[:end]
            else:
                del self._buffer[:1]


class FeetechBus:
    """Servos on one line, a ``WireDevice``; safe from any thread.

    ``echoes``: whether the adapter is a half-duplex one that gives the host its own bytes back.
    ``host_baud``: of the host, set by the line; a servo with another rate hears nothing.
    """

    renamed = staticmethod(renamed)

    def __init__(self, servos: Iterable[SimulatedFeetechServo], *, echoes: bool = False) -> None:
        self.servos = list(servos)
        self.echoes = echoes
        self.host_baud: int | None = None
        self._parser = FeetechInstructionParser()
        self._lock = threading.RLock()

    @property
    def baud(self) -> int:
        """Bits a second that the line is listened to at."""
        return self.host_baud or (self.servos[0].baud if self.servos else 1_000_000)

    def receive(self, data: bytes, time_s: float) -> Sequence[Reply]:
        """Take bytes of the host, return what the adapter and the servos give back."""
        with self._lock:
            replies = [Reply(data, sender=-1)] if self.echoes else []
            for instruction in self._parser.feed(data):
                replies += self._answer(instruction, time_s)
            return replies

    def poll(self, time_s: float) -> Sequence[Reply]:
        """Let happen what happens without a packet; servos never speak unasked."""
        with self._lock:
            for servo in self.servos:
                servo.update(time_s)
            return ()

    def _answer(self, instruction: FeetechInstruction, time_s: float) -> list[Reply]:
        here = [s for s in self.servos if s.hears(time_s) and s.baud == self.baud]
        for servo in here:
            servo.update(time_s)
        code, parameters = instruction.code, instruction.parameters
        if code == SYNC_WRITE and instruction.servo_id == BROADCAST and len(parameters) > 1:
            self._sync_write(parameters, here, time_s)
            return []
        if code == SYNC_READ and instruction.servo_id == BROADCAST and len(parameters) > 1:
            return self._sync_read(parameters, here, time_s)
        replies: list[Reply] = []
        for servo in here:
            if instruction.servo_id in (servo.servo_id, BROADCAST):
                servo_id, delay_s, level = servo.servo_id, servo.return_delay_s, servo.answers_writes
                data = _done(servo, code, parameters, time_s)
                own = instruction.servo_id != BROADCAST or code == PING
                if data is not None and own and (level or code in (PING, READ)):
                    answer = packet(servo_id, servo.status(time_s), data)
                    replies.append(Reply(answer, delay_s, servo_id))
        return replies

    def _sync_read(self, parameters: bytes, here: list[SimulatedFeetechServo], time_s: float) -> list[Reply]:
        """Answer in the order of the list; a servo that is not there silences those behind it (assumed)."""
        address, length = parameters[:2]
        replies = []
        for servo_id in parameters[2:]:
            servo = next((s for s in here if s.servo_id == servo_id), None)
            if servo is None:
                break
            data = servo.read(address, length, time_s)
            answer = packet(servo_id, servo.status(time_s), data)
            replies.append(Reply(answer, servo.return_delay_s, servo_id))
        return replies

    @staticmethod
    def _sync_write(parameters: bytes, here: list[SimulatedFeetechServo], time_s: float) -> None:
        """Write the same cells of several servos; none answers."""
        address, length = parameters[:2]
        for at in range(2, len(parameters) - length, length + 1):
            for servo in here:
                if servo.servo_id == parameters[at]:
                    servo.write(address, parameters[at + 1 : at + 1 + length], time_s)


def _done(servo: SimulatedFeetechServo, code: int, parameters: bytes, time_s: float) -> bytes | None:
    """Carry out one instruction; returns the data of its answer, None for one that is not answered."""
    if code == PING:
        return b""
    if code == READ and len(parameters) == 2:
        return servo.read(parameters[0], parameters[1], time_s)
    if code == WRITE and len(parameters) > 1:
        servo.write(parameters[0], parameters[1:], time_s)
        return b""
    return None
