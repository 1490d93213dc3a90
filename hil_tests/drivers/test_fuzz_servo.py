"""A short share of tools/campaigns/fuzz_servo.py: the parsers of drivers and simulators on broken bytes."""

from __future__ import annotations

from hypothesis import given, settings
from hypothesis import strategies as st

from drivers.dynamixel.packets import take_status
from drivers.flir_ptu.protocol import LineSplitter, answer_of
from drivers.sim.wire.axis import WireAxis
from drivers.sim.wire.dynamixel_bus import DynamixelBus
from drivers.sim.wire.ptu import SimulatedPtu
from hil_tests.drivers.sim.wire.dynamixel_host import SETTINGS, servo
from tools.campaigns import fuzz_servo

AWKWARD = st.lists(st.sampled_from([0xFF, 0xFD, 0x00, 0x01, 0x03, 0x55, 0xFE]), max_size=80).map(bytes)
CHUNKS = st.lists(st.one_of(st.binary(max_size=60), AWKWARD), max_size=6)
LETTERS = st.lists(st.text("PTORSUL WFHQEACIBD@!*-+0123456789,.\r\n", max_size=20), max_size=6)


def test_no_parser_fails() -> None:
    counts, _, failures = fuzz_servo.campaign(3000, seed=11)
    assert failures == []
    for name, counter in counts.items():
        assert counter["right"] > 0.7 * 500, name


@settings(max_examples=200, deadline=None)
@given(chunks=CHUNKS)
def test_any_bytes_to_the_servos_and_to_their_driver(chunks: list[bytes]) -> None:
    bus, buffer = DynamixelBus([servo("xm430_w350", 1), servo("ph42_020_s300", 2)]), bytearray()
    for number, chunk in enumerate(chunks):
        bus.receive(chunk, 0.01 * number)
        buffer += chunk
        while take_status(buffer) is not None:
            pass
    while take_status(buffer, at_end=True) is not None:
        pass
    assert len(buffer) < 4


@settings(max_examples=200, deadline=None)
@given(chunks=st.one_of(CHUNKS, LETTERS.map(lambda parts: [part.encode() for part in parts])))
def test_any_bytes_to_the_unit_and_to_its_driver(chunks: list[bytes]) -> None:
    unit = SimulatedPtu("d48e", WireAxis(SETTINGS), WireAxis(SETTINGS, number=1))
    splitter = LineSplitter()
    for number, chunk in enumerate(chunks):
        unit.receive(chunk, 0.01 * number)
        for line in splitter.feed(chunk):
            answer_of(line, "PP")
