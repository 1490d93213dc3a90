"""Reading and writing several servos by one packet: what is asked, and the common reply. No I/O."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from drivers.dynamixel.models import TICK_ADDRESSES
from drivers.dynamixel.packets import (
    BROADCAST_ID,
    BULK_READ,
    BULK_WRITE,
    FAST_BULK_READ,
    FAST_SYNC_READ,
    HEADER,
    STATUS,
    SYNC_READ,
    SYNC_WRITE,
    Status,
    crc16,
    instruction_packet,
)
from drivers.errors import DriverError


@dataclass(frozen=True)
class Part:
    """What is read of, or written to, one servo in a group: the address, and length or data."""

    servo_id: int
    address: int
    length: int
    data: bytes = b""

    @property
    def place(self) -> bytes:
        """Address and length as packets hold them."""
        return self.address.to_bytes(2, "little") + self.length.to_bytes(2, "little")


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
class GroupQuestion:
    """A group read as it is sent and what it is to be answered; kept, since most are asked again and again.

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


def group_question(fast: bool, parts: Sequence[Part]) -> GroupQuestion:
    """Return a group read: Sync Read where all blocks are alike, else Bulk Read."""
    ids = {part.servo_id: bytes((part.servo_id,)) for part in parts}
    if _alike(parts):
        instruction = FAST_SYNC_READ if fast else SYNC_READ
        body = parts[0].place + b"".join(ids.values())
    else:
        instruction = FAST_BULK_READ if fast else BULK_READ
        body = b"".join(ids[part.servo_id] + part.place for part in parts)
    places = {part.servo_id: tick_at(part.address, part.length) for part in parts}
    return GroupQuestion(
        instruction_packet(BROADCAST_ID, instruction, body),
        sum(11 + part.length for part in parts),
        {part.servo_id: part for part in parts},
        {servo_id: at for servo_id, at in places.items() if at is not None},
    )


def group_write_packet(parts: Sequence[Part]) -> bytes:
    """Return a write to several servos: Sync Write where all blocks are alike, else Bulk Write."""
    if _alike(parts):
        body = parts[0].place + b"".join(bytes((part.servo_id,)) + part.data for part in parts)
        return instruction_packet(BROADCAST_ID, SYNC_WRITE, body)
    body = b"".join(bytes((part.servo_id,)) + part.place + part.data for part in parts)
    return instruction_packet(BROADCAST_ID, BULK_WRITE, body)


def fast_blocks(status: Status, parts: Sequence[Part]) -> list[Status] | None:
    """Return the replies in the common reply to a fast group read, those before the first broken block.

    Blocks are error, id, data and the checksum of all bytes so far; the last checksum is the packet's, which
    holds. None if the reply is not as long as it has to be: it is to another question.
    """
    body = bytes((status.error,)) + status.data
    if len(body) != sum(4 + part.length for part in parts) - 2:  # without the last checksum
        return None
    total = len(body) + 3  # and the instruction and the checksum of the packet
    crc = crc16(HEADER + bytes((status.servo_id,)) + total.to_bytes(2, "little") + bytes((STATUS,)))
    blocks = []
    for part in parts:
        block, body = body[: 2 + part.length], body[2 + part.length :]
        stated, body = body[:2], body[2:]
        crc = crc16(block, crc)
        if block[1] != part.servo_id or (stated and stated != crc.to_bytes(2, "little")):
            break
        crc = crc16(stated, crc)
        blocks.append(Status(part.servo_id, block[0], block[2:]))
    return blocks


def _alike(parts: Sequence[Part]) -> bool:
    """Whether all blocks have one address and length."""
    return len({(part.address, part.length) for part in parts}) == 1
