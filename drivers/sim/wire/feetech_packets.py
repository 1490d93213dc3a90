"""Packets of simulated Feetech servos, from the maker's protocol manual; the driver's are its own.

``FF FF ID LENGTH CODE PARAMETERS SUM``: the length counts what follows it, the sum is the low byte of all
behind the header, inverted. A reply has the servo's status where an instruction has its code.
"""

from __future__ import annotations

from dataclasses import dataclass

BROADCAST = 0xFE
HEADER = b"\xff\xff"
PING, READ, WRITE, REG_WRITE, ACTION, RESET, SYNC_READ, SYNC_WRITE = 1, 2, 3, 4, 5, 10, 0x82, 0x83
_LONGEST = 250


def packet(servo_id: int, code: int, body: bytes = b"") -> bytes:
    """Return the bytes of an instruction or, with the status as its code, of a reply."""
    inside = bytes((servo_id, len(body) + 2, code)) + body
    return HEADER + inside + bytes((~sum(inside) & 0xFF,))


def renamed(data: bytes, servo_id: int) -> bytes:
    """Return a reply as if another servo had sent it, with a sum that fits."""
    return packet(servo_id & 0xFF, data[4], data[5:-1]) if len(data) > 5 else data


@dataclass(frozen=True)
class Instruction:
    """One packet from the host whose sum fits."""

    servo_id: int
    code: int
    parameters: bytes


class InstructionParser:
    """Finds packets in any bytes, in any chunks; never raises, holds at most one packet's bytes."""

    def __init__(self) -> None:
        self._buffer = bytearray()

    def feed(self, data: bytes) -> list[Instruction]:
        """Take bytes of the line, return the packets that they complete."""
        self._buffer += data
        found: list[Instruction] = []
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
                found.append(Instruction(whole[2], whole[4], whole[5:-1]))
                del self._buffer[:end]
            else:
                del self._buffer[:1]
