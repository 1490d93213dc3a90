"""Packets of the Dynamixel driver against the maker's printed examples, the SDK's checksum, and any bytes."""

from __future__ import annotations

import itertools

import dynamixel_sdk as sdk
import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.dynamixel import packets
from drivers.dynamixel.packets import crc16, instruction_packet, take_status
from drivers.sim.wire import dynamixel_bus as wire

PING, READ, WRITE, SYNC_READ = 1, 2, 3, 0x82

# ROBOTIS e-manual, "DYNAMIXEL Protocol 2.0", the examples of each instruction.
INSTRUCTIONS = {
    "ping 1": (1, PING, "", "FF FF FD 00 01 03 00 01 19 4E"),
    "read 1": (1, READ, "84 00 04 00", "FF FF FD 00 01 07 00 02 84 00 04 00 1D 15"),
    "write 1": (1, WRITE, "74 00 00 02 00 00", "FF FF FD 00 01 09 00 03 74 00 00 02 00 00 CA 89"),
    "sync read": (0xFE, SYNC_READ, "84 00 04 00 01 02", "FF FF FD 00 FE 09 00 82 84 00 04 00 01 02 CE FA"),
}
REPLIES = {
    "ping 1": ("FF FF FD 00 01 07 00 55 00 06 04 26 65 5D", 1, 0, "06 04 26"),
    "read 1": ("FF FF FD 00 01 08 00 55 00 A6 00 00 00 8C C0", 1, 0, "A6 00 00 00"),
    "read 2": ("FF FF FD 00 02 08 00 55 00 1F 08 00 00 BA BE", 2, 0, "1F 08 00 00"),
}


@pytest.mark.parametrize("name", INSTRUCTIONS)
def test_instructions_as_the_manual_prints_them(name: str) -> None:
    servo_id, instruction, parameters, printed = INSTRUCTIONS[name]
    sent = instruction_packet(servo_id, instruction, bytes.fromhex(parameters))
    assert sent == bytes.fromhex(printed)


@pytest.mark.parametrize("name", REPLIES)
def test_replies_as_the_manual_prints_them(name: str) -> None:
    printed, servo_id, error, data = REPLIES[name]
    buffer = bytearray.fromhex(printed)
    status = take_status(buffer)
    assert status is not None
    assert (status.servo_id, status.error, status.data) == (servo_id, error, bytes.fromhex(data))
    assert not buffer


@given(st.binary(max_size=60))
def test_checksum_is_the_sdks(data: bytes) -> None:
    assert crc16(data) == sdk.PacketHandler(2.0).updateCRC(0, list(data), len(data))


def test_instructions_have_the_sdks_numbers() -> None:
    assert packets.BROADCAST_ID == sdk.BROADCAST_ID
    for name in (
        "PING", "READ", "WRITE", "REBOOT", "STATUS", "SYNC_READ", "SYNC_WRITE", "BULK_READ", "BULK_WRITE",
    ):  # fmt: skip
        assert getattr(packets, name) == getattr(sdk, f"INST_{name}"), name


def test_what_is_stuffed_and_unstuffed_is_what_it_was() -> None:
    # Every body of up to seven bytes of those that make a header: the SDK fails on some of these.
    for size in range(8):
        for tail in itertools.product((0xFF, 0xFD, 0x00), repeat=size):
            sent = instruction_packet(1, packets.STATUS, bytes((0, *tail)))
            assert sent[4:].find(b"\xff\xff\xfd\x00") < 0
            status = take_status(bytearray(sent))
            assert status is not None
            assert status.data == bytes(tail)


@given(st.binary(max_size=40), st.binary(max_size=30), st.integers(0, 252), st.integers(0, 255), st.data())
def test_a_reply_is_found_behind_noise_in_pieces_of_any_size(
    noise: bytes, data: bytes, servo_id: int, error: int, draw: st.DataObject
) -> None:
    sent = noise + wire.status_packet(servo_id, error, data)
    buffer, found, at = bytearray(), None, 0
    while at < len(sent) and found is None:
        step = draw.draw(st.integers(1, len(sent) - at))
        buffer += sent[at : at + step]
        at += step
        found = take_status(buffer)
    if found is None:  # the noise ends in what looks like a longer packet's head
        found = take_status(buffer, at_end=True)
    assert found is not None
    assert (found.servo_id, found.error, found.data) == (servo_id, error, data)


def test_one_wrong_bit_anywhere_is_no_reply() -> None:
    good = wire.status_packet(1, 0, (2048).to_bytes(4, "little"))
    for bit in range(8 * len(good)):
        bad = bytearray(good)
        bad[bit // 8] ^= 1 << bit % 8
        assert take_status(bad, at_end=True) is None, bit


def test_an_echo_of_the_instruction_is_stepped_over() -> None:
    reply = wire.status_packet(1, 0x80, b"\x01")
    buffer = bytearray(instruction_packet(1, READ, b"\x84\x00\x01\x00") + reply)
    status = take_status(buffer)
    assert status is not None
    assert status.alert
    assert status.data == b"\x01"
