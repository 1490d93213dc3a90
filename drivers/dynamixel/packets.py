"""Packets of protocol 2.0: instructions to bytes, bytes to status packets, several servos in one. No I/O.

Our own codec, with ROBOTIS's SDK as the oracle of its tests: the SDK sends packets unstuffed, ends a wait at
the first noise or broken packet, reads an error reply's checksum as data, and spins while it waits.
The source of the format: ROBOTIS e-manual, "DYNAMIXEL Protocol 2.0".
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache

from drivers.dynamixel.models import TICK_ADDRESSES
from drivers.errors import DriverError
from drivers.servo_bus.port import Part, StatusPacket, at_header

HEADER = b"\xff\xff\xfd\x00"
START = b"\xff\xff\xfd"
STUFFED = b"\xff\xff\xfd\xfd"
BROADCAST_ID = 0xFE
LONGEST_PACKET = 1024
SHORTEST_STATUS = 11  # header 4, id, length 2, instruction, error, CRC 2
ALERT = 0x80

PING, READ, WRITE, REBOOT, STATUS = 0x01, 0x02, 0x03, 0x08, 0x55
SYNC_READ, SYNC_WRITE, BULK_READ, BULK_WRITE = 0x82, 0x83, 0x92, 0x93

# E-manual, protocol 2.0, the error field of a status packet.
REFUSALS = {
    1: "it could not process the instruction",
    2: "it does not know the instruction",
    3: "the instruction's checksum did not fit",
    4: "the value is out of range, or its bus watchdog has tripped",
    5: "the data has the wrong length",
    6: "the value is beyond one of its limits",
    7: "the register cannot be read or written now (torque on locks permanent registers)",
}


def _crc_table() -> tuple[int, ...]:
    """CRC-16 with the polynomial 0x8005, high bit first."""
    table = []
    for byte in range(256):
        crc = byte << 8
        for _ in range(8):
            crc = (crc << 1) ^ 0x8005 if crc & 0x8000 else crc << 1
        table.append(crc & 0xFFFF)
    return tuple(table)


_CRC = _crc_table()


def crc16(data: bytes | bytearray, crc: int = 0) -> int:
    """Return the packet checksum of some bytes, going on from an earlier one."""
    table = _CRC
    for byte in data:
        crc = ((crc & 0xFF) << 8) ^ table[(crc >> 8) ^ byte]
    return crc


def instruction_packet(servo_id: int, instruction: int, parameters: bytes = b"") -> bytes:
    """Return the bytes of an instruction, stuffed and with its checksum."""
    body = (bytes((instruction,)) + parameters).replace(START, STUFFED)
    packet = HEADER + bytes((servo_id,)) + (len(body) + 2).to_bytes(2, "little") + body
    return packet + crc16(packet).to_bytes(2, "little")


def take_status(buffer: bytearray, *, at_end: bool = False) -> StatusPacket | None:
    """Take the first whole status packet out of a buffer; None when there is none yet.

    What comes before it (noise, echoes of instructions, packets whose checksum does not fit) is dropped.

    With ``at_end`` no more bytes will come: a header whose packet is not whole was noise.
    """
    while True:
        if not at_header(buffer, HEADER):
            return None
        if len(buffer) < 7:
            if not at_end:
                return None
            length = 0
        else:
            length = 7 + (buffer[5] | buffer[6] << 8)
        if 7 + 3 <= length <= LONGEST_PACKET and buffer[4] <= BROADCAST_ID:
            if len(buffer) >= length:
                crc = buffer[length - 2] | buffer[length - 1] << 8
                if crc16(buffer[: length - 2]) == crc:
                    packet = bytes(buffer[:length])
                    del buffer[:length]
                    if packet[7] == STATUS and length >= SHORTEST_STATUS:
                        body = packet[8 : length - 2].replace(STUFFED, START)
                        error = body[0]
                        return StatusPacket(packet[4], error, body[1:], error & ~ALERT, bool(error & ALERT))
                    continue  # an instruction: the adapter's echo
            elif not at_end and buffer.find(HEADER, 1) < 0:
                return None  # a second header inside means that this one is noise
        del buffer[:1]


@dataclass(frozen=True)
class GroupAnswer:
    """The replies to a group read: by id what came, and why the rest did not.

    The servos measured after ``sent_s`` and before ``received_s``, seconds of CLOCK_MONOTONIC.
    """

    statuses: Mapping[int, StatusPacket]
    missing: Mapping[int, DriverError]
    sent_s: float
    received_s: float


@dataclass(frozen=True)
class GroupQuestion:
    """A group read as it is sent, and what its answer is to be.

    ``ticks`` are the places of the servos' counters in the blocks of those that have them there, by id.
    """

    packet: bytes
    reply_bytes: int
    parts: Mapping[int, Part]
    ticks: Mapping[int, int]


def tick_at(address: int, length: int) -> int | None:
    """Return where in a block the servo's counter stands, None if it is not in it."""
    ticks = (tick - address for tick in TICK_ADDRESSES if address <= tick and tick + 2 <= address + length)
    return next(ticks, None)


@lru_cache(maxsize=64)  # most are made again and again
def group_question(parts: Sequence[Part]) -> GroupQuestion:
    """Return a group read: Sync Read where all blocks are alike, else Bulk Read."""
    if _alike(parts):
        instruction = SYNC_READ
        body = _place(parts[0]) + bytes(part.servo_id for part in parts)
    else:
        instruction = BULK_READ
        body = b"".join(bytes((part.servo_id,)) + _place(part) for part in parts)
    ticks = {part.servo_id: tick_at(part.address, part.length) for part in parts}
    return GroupQuestion(
        instruction_packet(BROADCAST_ID, instruction, body),
        sum(11 + part.length for part in parts),
        {part.servo_id: part for part in parts},
        {servo_id: at for servo_id, at in ticks.items() if at is not None},
    )


def group_write_packet(parts: Sequence[Part]) -> bytes:
    """Return a write to several servos: Sync Write where all blocks are alike, else Bulk Write."""
    if _alike(parts):
        body = _place(parts[0]) + b"".join(bytes((part.servo_id,)) + part.data for part in parts)
        return instruction_packet(BROADCAST_ID, SYNC_WRITE, body)
    body = b"".join(bytes((part.servo_id,)) + _place(part) + part.data for part in parts)
    return instruction_packet(BROADCAST_ID, BULK_WRITE, body)


def _place(part: Part) -> bytes:
    """Address and length as packets hold them."""
    return part.address.to_bytes(2, "little") + part.length.to_bytes(2, "little")


def _alike(parts: Sequence[Part]) -> bool:
    """Whether all blocks have one address and length."""
    return len({(part.address, part.length) for part in parts}) == 1
