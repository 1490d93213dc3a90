"""Packets of Feetech's servos: ``FF FF``, id, length, instruction or status, data, and an inverted sum.

A reply says who speaks and how it is, neither what was asked nor when (`drivers.feetech.link`). Its sum has
eight bits: one wrong byte is always seen, several pass once in 256. Nothing is stuffed. Source: the maker's
protocol manual and SDK.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from drivers.servo_bus.port import PacketFormat

HEADER = b"\xff\xff"
BROADCAST_ID, HIGHEST_ID = 254, 252
PING, READ, WRITE, SYNC_READ, SYNC_WRITE = 1, 2, 3, 0x82, 0x83
STATUS_BYTES = 6  # of a reply without data
LONGEST_PACKET = 250


@dataclass(frozen=True)
class FeetechStatus:
    """A servo's reply; its error byte says how the servo is, and refuses nothing."""

    servo_id: int
    error: int
    data: bytes
    refused: int = 0

    @property
    def alert(self) -> bool:
        """Whether the servo reports a fault of its own."""
        return self.error != 0


def instruction_packet(servo_id: int, instruction: int, parameters: bytes = b"") -> bytes:
    """Return the bytes of an instruction."""
    body = bytes((servo_id, len(parameters) + 2, instruction)) + parameters
    return HEADER + body + bytes((~sum(body) & 0xFF,))


def sync_read_packet(address: int, length: int, servo_ids: tuple[int, ...]) -> bytes:
    """Return a read of the same bytes of several servos, which answer in this order."""
    return instruction_packet(BROADCAST_ID, SYNC_READ, bytes((address, length, *servo_ids)))


def sync_write_packet(address: int, data: Mapping[int, bytes]) -> bytes:
    """Return a write of equally many bytes to each of several servos, by id; nobody answers it."""
    length = max(map(len, data.values()), default=0)
    body = b"".join(bytes((servo_id,)) + one for servo_id, one in data.items())
    return instruction_packet(BROADCAST_ID, SYNC_WRITE, bytes((address, length)) + body)


def take_status(buffer: bytearray, *, at_end: bool = False) -> FeetechStatus | None:
    """Take the first whole packet whose sum fits out of a buffer; None when there is none yet.

    Parameters
    ----------
    buffer
        Bytes as they came in; what was used or dropped is removed.
    at_end
        No more bytes will come: a header whose packet is not whole was noise, look behind it.
    """
    while True:
        start = buffer.find(HEADER)
        if start < 0:
            del buffer[: len(buffer) - buffer.endswith(b"\xff")]
            return None
        del buffer[:start]
        if len(buffer) >= STATUS_BYTES or (len(buffer) >= 3 and buffer[2] > HIGHEST_ID + 1):
            end = 4 + buffer[3]
            if buffer[2] <= HIGHEST_ID + 1 and STATUS_BYTES <= end <= LONGEST_PACKET:
                if len(buffer) < end and not at_end:
                    return None
                whole = bytes(buffer[:end])
                if len(whole) == end and whole[-1] == ~sum(whole[2:-1]) & 0xFF:
                    del buffer[:end]
                    return FeetechStatus(whole[2], whole[4], whole[5:-1])
        elif not at_end:
            return None
        del buffer[:1]


FORMAT = PacketFormat(
    take_status,
    instruction_packet,
    lambda address, length: bytes((address, length)),
    STATUS_BYTES,
    {PING: "ping", READ: "read", WRITE: "write"},
    {},
)
