"""Dynamixel protocol 2.0 as a servo sees it: instruction packets in, status packets out.

A packet is ``FF FF FD 00 id length instruction parameters crc``; length counts from the instruction on, both
words little end first. Where the body holds ``FF FF FD`` a sender adds another ``FD``, so ``FF FF FD`` with
anything else behind it is always the start of a packet, even inside what looked like one. That is how the
parser gets back into step. Source: ROBOTIS e-Manual, "DYNAMIXEL Protocol 2.0".
"""

from __future__ import annotations

from dataclasses import dataclass

HEADER = b"\xff\xff\xfd\x00"
BROADCAST = 0xFE
MAX_ID = 0xFC
STATUS = 0x55

MAX_PACKET = 1024
"""Longest packet that a servo takes, bytes; a length field beyond it is noise. (The SDK's own bound.)"""

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
