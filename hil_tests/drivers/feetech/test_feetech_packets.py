"""Feetech's packets: the driver's and the simulator's against frames that the maker's own SDK has sent.

The frames are those of feetech-servo-sdk 1.0.0 (``scservo_sdk``), written down byte by byte.
"""

from __future__ import annotations

import pytest

from drivers.feetech import servos as packets
from drivers.servo_bus.port import Part, StatusPacket
from drivers.sim.wire.feetech_bus import FeetechInstruction, FeetechInstructionParser, packet, renamed

OF_THE_SDK = {
    "ping": "ff ff 01 02 01 fb",
    "read 56, 8 bytes": "ff ff 01 04 02 38 08 b8",
    "write 2048 to 42": "ff ff 01 05 03 2a 00 08 c4",
    "sync write": "ff ff fe 14 83 29 07 01 32 00 08 00 00 60 09 02 32 0a 08 00 00 60 09 e7",
    "sync read": "ff ff fe 06 82 38 08 01 02 36",
}


def ours() -> dict[str, bytes]:
    """The same by the driver."""
    goal = packets.REGISTERS["goal_position"]
    told = [goal.encode(count) + bytes((0, 0, 0x60, 9)) for count in (2048, 2058)]
    write, read = packets.WRITE, bytes((56, 8))
    return {
        "ping": packets.instruction_packet(1, packets.PING),
        "read 56, 8 bytes": packets.instruction_packet(1, packets.READ, read),
        "write 2048 to 42": packets.instruction_packet(1, write, b"\x2a" + goal.encode(2048)),
        "sync write": packets.group_write_packet([Part(n, 41, 7, b"\x32" + told[n - 1]) for n in (1, 2)]),
        "sync read": packets.sync_read_packet(56, 8, (1, 2)),
    }


@pytest.mark.parametrize("what", OF_THE_SDK)
def test_driver_and_simulator_have_the_packets_of_the_makers_sdk(what: str) -> None:
    frame = bytes.fromhex(OF_THE_SDK[what])
    assert ours()[what] == frame
    parser = FeetechInstructionParser()
    found = [one for byte in b"\xff\x01" + frame for one in parser.feed(bytes((byte,)))]
    assert found == [FeetechInstruction(frame[2], frame[4], frame[5:-1])]


NOISES = [b"", b"\xff", b"\xff\xff", b"\xff\xff\x01", b"\x00\xff\xff\xfe\xfa", b"\xff" * 9]


@pytest.mark.parametrize("noise", NOISES)
def test_a_reply_is_found_behind_noise_and_a_wrong_byte_is_seen(noise: bytes) -> None:
    reply = packet(2, 0x20, bytes(range(9)))
    buffer = bytearray(noise + reply)
    status = packets.take_status(buffer, at_end=True)
    assert status is not None and (status.servo_id, status.error, status.data) == (2, 0x20, bytes(range(9)))
    for at in range(len(reply)):
        for change in (1, 0x80, 0xFF):
            broken = bytearray(noise + reply)
            broken[len(noise) + at] ^= change
            told = packets.take_status(broken, at_end=True)
            assert told is None or len(told.data) != 9, (at, change)


def test_a_reply_in_pieces_is_awaited_and_a_broken_one_dropped() -> None:
    reply = packet(1, 0, b"abc")
    buffer = bytearray()
    for byte in reply[:-1]:
        buffer.append(byte)
        assert packets.take_status(buffer) is None
    assert packets.take_status(bytearray(reply)) == StatusPacket(1, 0, b"abc", 0, False)
    half = bytearray(reply[:6] + packet(2, 0, b"d"))
    assert packets.take_status(half, at_end=True) == StatusPacket(2, 0, b"d", 0, False)
    assert renamed(reply, 2) == packet(2, 0, b"abc")


def test_minus_is_a_bit() -> None:
    registers = packets.REGISTERS
    offset, position = registers["offset"], registers["present_position"]
    assert offset.encode(-100) == (0x800 | 100).to_bytes(2, "little")
    assert offset.decode(offset.encode(-100)) == -100
    assert position.decode(bytes((0x05, 0x80))) == -5
