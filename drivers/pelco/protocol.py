"""Frames of Pelco-D and Pelco-P: what is said to a head, and the two answers that it gives. No I/O.

Sources: the command lists in manuals of Telycam, Avonic, AVer and DVDO, which agree. A reply bears the
address and a checksum, and no number.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial, reduce
from operator import xor

STOP = 0x00
SET = (0x4B, 0x4D)  # pan, tilt; hundredths of a degree
ASK = (0x51, 0x53)
TOLD = (0x59, 0x5B)
START, LENGTH = {"D": 0xFF, "P": 0xA0}, {"D": 7, "P": 8}
END_P = 0xAF
TURN = 36000  # hundredths of a degree


def frame(protocol: str, address: int, command: int, value: int = 0) -> bytes:
    """Return a frame of a command with 16 bits of data; in Pelco-P the first head has the number 0."""
    body = bytes((address - (protocol == "P"), 0, command, value >> 8, value & 0xFF))
    if protocol == "D":
        return bytes((START["D"],)) + body + bytes((sum(body) & 0xFF,))
    whole = bytes((START["P"],)) + body + bytes((END_P,))
    return whole + bytes((reduce(xor, whole),))


def place_questions(
    protocol: str, address: int
) -> list[tuple[bytes, Callable[[bytearray], tuple[int, ...] | None]]]:
    """Return the questions where pan and tilt are, and what takes each answer out of a buffer."""

    def take(told: int, buffer: bytearray) -> tuple[int, ...] | None:
        while (found := take_answer(protocol, address, buffer)) is not None:
            if found[0] == told and found[1] < TURN:
                return found[1:]
        return None

    return [(frame(protocol, address, ask), partial(take, told)) for ask, told in zip(ASK, TOLD, strict=True)]


def take_answer(protocol: str, address: int, buffer: bytearray) -> tuple[int, int] | None:
    """Take the first whole answer of a head out of a buffer, and what stands before it.

    Returns its command and its value; None when there is none yet. An adapter's echo of a question, and the
    general response (four bytes), are none.
    """
    length = LENGTH[protocol]
    while len(buffer) >= length:
        whole = bytes(buffer[:length])
        if whole[3] in TOLD:
            value = whole[4] << 8 | whole[5]
            if whole == frame(protocol, address, whole[3], value):
                del buffer[:length]
                return whole[3], value
        del buffer[0]
    return None
