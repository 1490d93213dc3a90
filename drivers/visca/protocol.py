"""Frames of VISCA: what is said to a head, and what it says back. No I/O.

A frame ends with FF and has neither a checksum nor a number. Source: Sony's command lists of the EVI series,
whose positions have four digits.
"""

from __future__ import annotations

from collections.abc import Callable
from enum import Enum

END = 0xFF
LONGEST_FRAME = 16
FASTEST_CODES = {"pan": 0x18, "tilt": 0x14}

ERROR_WORDS = {
    0x01: "message too long",
    0x02: "syntax error",
    0x03: "command buffer full",
    0x04: "command canceled",
    0x05: "no socket",
    0x41: "not executable now",
}


class Kind(Enum):
    """The kind of a frame of a head."""

    ACK = "acknowledgement"
    DONE = "completion"
    PLACE = "position"
    ERROR = "error"
    OTHER = "other"


def place_inquiry(address: int) -> bytes:
    """Return the question where both axes are."""
    return bytes((0x80 | address, 0x09, 0x06, 0x12, END))


def stop_command(address: int) -> bytes:
    """Return the command that stops both axes."""
    return bytes((0x80 | address, 0x01, 0x06, 0x01, 0x01, 0x01, 0x03, 0x03, END))


def go_command(address: int, speeds: tuple[int, int], places: tuple[int, int]) -> bytes:
    """Return the command that sends both axes to positions, counts, at speeds by their codes."""
    digits = b"".join(bytes((place & 0xFFFF) >> shift & 0xF for shift in (12, 8, 4, 0)) for place in places)
    return bytes((0x80 | address, 0x01, 0x06, 0x02, *speeds)) + digits + bytes((END,))


def place_questions(address: int) -> list[tuple[bytes, Callable[[bytearray], tuple[int, ...] | None]]]:
    """Return the question of `place_inquiry`, and what takes its answer out of a buffer."""

    def take(buffer: bytearray) -> tuple[int, ...] | None:
        while (found := take_frame(buffer)) is not None:
            if kind_of(found, address) is Kind.PLACE:
                return places_of(found)
        return None

    return [(place_inquiry(address), take)]


def take_frame(buffer: bytearray) -> bytes | None:
    """Take the first whole frame out of a buffer; None when there is none yet."""
    end = buffer.find(END)
    if end < 0:
        del buffer[: max(0, len(buffer) - LONGEST_FRAME)]
        return None
    frame = bytes(buffer[: end + 1])
    del buffer[: end + 1]
    return frame


def kind_of(frame: bytes, address: int) -> Kind:
    """Return what a frame of this head is; one that is not of its form is ``OTHER``."""
    if len(frame) < 3 or frame[0] != 0x80 | (address + 8) << 4 & 0xF0:
        return Kind.OTHER
    first, rest = frame[1] & 0xF0, frame[2:-1]
    if len(frame) == 3 and first in (0x40, 0x50):
        return Kind.ACK if first == 0x40 else Kind.DONE
    if len(frame) == 11 and frame[1] == 0x50 and all(digit < 16 for digit in rest):
        return Kind.PLACE
    return Kind.ERROR if len(frame) == 4 and first == 0x60 else Kind.OTHER


def places_of(frame: bytes) -> tuple[int, int]:
    """Return pan and tilt of an answer, counts."""
    words = [sum(digit << 4 * (3 - i) for i, digit in enumerate(frame[at : at + 4])) for at in (2, 6)]
    pan, tilt = (word - 0x10000 if word & 0x8000 else word for word in words)
    return pan, tilt
