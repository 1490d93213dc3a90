"""The simulator's packets against the maker's printed examples and the SDK's own functions."""

from __future__ import annotations

import pytest
from dynamixel_sdk import PacketHandler
from hypothesis import given, settings
from hypothesis import strategies as st

from drivers.sim.wire.dynamixel_bus import (
    Instruction,
    InstructionParser,
    crc16,
    packet,
    status_packet,
    stuffed,
    unstuffed,
)

SDK = PacketHandler(2.0)

# Instruction and status packets as the manual prints them (e-Manual, Protocol 2.0, chapters of each).
INSTRUCTIONS = {
    "FFFFFD000103000119 4E": Instruction(1, 0x01, b""),
    "FFFFFD00FE03000131 42": Instruction(0xFE, 0x01, b""),
    "FFFFFD000107000284000400 1D15": Instruction(1, 0x02, bytes.fromhex("84000400")),
    "FFFFFD000109000374000002 0000 CA89": Instruction(1, 0x03, bytes.fromhex("740000020000")),
    "FFFFFD00010900046800C80000 00AE8E": Instruction(1, 0x04, bytes.fromhex("6800C8000000")),
    "FFFFFD000103000502CE": Instruction(1, 0x05, b""),
    "FFFFFD00010400060 1A1E6": Instruction(1, 0x06, b"\x01"),
    "FFFFFD00010300082F4E": Instruction(1, 0x08, b""),
    "FFFFFD000108001001 44584C22 B1DC": Instruction(1, 0x10, bytes.fromhex("0144584C22")),
    "FFFFFD000108002001 4354524C 16F5": Instruction(1, 0x20, bytes.fromhex("014354524C")),
    "FFFFFD00FE09008284000400 0102CEFA": Instruction(0xFE, 0x82, bytes.fromhex("840004000102")),
    "FFFFFD00FE0A008A84000400 03070420F2": Instruction(0xFE, 0x8A, bytes.fromhex("84000400030704")),
}
STATUS = {
    "FFFFFD00010700550006042665 5D": (1, 0, "060426"),
    "FFFFFD000207005500060426 6F6D": (2, 0, "060426"),
    "FFFFFD00010800550 0A60000008CC0": (1, 0, "A6000000"),
    "FFFFFD0002080055001F080000BABE": (2, 0, "1F080000"),
    "FFFFFD000104005500A10C": (1, 0, ""),
    "FFFFFD00020500550024 8BA9": (2, 0, "24"),
}


def clean(text: str) -> bytes:
    return bytes.fromhex(text.replace(" ", ""))


def sdk_packet(packet_id: int, body: bytes) -> bytes:
    """A packet by the SDK: its stuffing (whose result its own transmitter drops) and its CRC."""
    length = len(body) + 2
    raw = [0xFF, 0xFF, 0xFD, 0, packet_id, length & 255, length >> 8, *body, 0, 0]
    whole = SDK.addStuffing(raw)
    crc = SDK.updateCRC(0, whole, len(whole) - 2)
    return bytes(whole[:-2]) + bytes((crc & 255, crc >> 8))


@pytest.mark.parametrize("text", INSTRUCTIONS)
def test_instructions_of_the_manual(text: str) -> None:
    assert InstructionParser().feed(clean(text)) == [INSTRUCTIONS[text]]


@pytest.mark.parametrize("text", STATUS)
def test_answers_of_the_manual(text: str) -> None:
    servo_id, error, data = STATUS[text]
    assert status_packet(servo_id, error, bytes.fromhex(data)) == clean(text)


bodies = st.lists(st.sampled_from([0xFF, 0xFD, 0xFE, 0x00, 0x01]), min_size=1, max_size=24).map(bytes)


@settings(max_examples=300)
@given(body=st.one_of(bodies, st.binary(min_size=1, max_size=200)), servo_id=st.integers(0, 252))
def test_stuffing_and_crc_are_the_sdks(body: bytes, servo_id: int) -> None:
    assert packet(servo_id, body) == sdk_packet(servo_id, body)
    assert unstuffed(stuffed(body)) == body
    assert crc16(body) == SDK.updateCRC(0, body, len(body))


@settings(max_examples=300)
@given(data=st.data(), noise=st.binary(max_size=60))
def test_any_chunks_give_the_same_packets(data: st.DataObject, noise: bytes) -> None:
    sent = [(data.draw(st.integers(0, 252)), data.draw(bodies)) for _ in range(3)]
    stream = noise.join(sdk_packet(*one) for one in sent)
    at_once = InstructionParser().feed(stream)
    cuts = sorted(data.draw(st.lists(st.integers(0, len(stream)), max_size=8)))
    parser, pieces = InstructionParser(), []
    for start, end in zip([0, *cuts], [*cuts, len(stream)], strict=True):
        pieces += parser.feed(stream[start:end])
    assert pieces == at_once
