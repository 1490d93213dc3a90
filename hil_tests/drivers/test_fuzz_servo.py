"""The drivers' parsers on broken bytes take only what was really sent, and always the good answer at the end.

What is a packet is decided by the SDK's checksum and a plain search, not by our code.
"""

from __future__ import annotations

import re
from collections.abc import Iterator

from dynamixel_sdk import PacketHandler
from hypothesis import given, settings
from hypothesis import strategies as st

from drivers.dynamixel.packets import take_status
from drivers.flir_ptu import protocol
from drivers.flir_ptu.protocol import LineSplitter, answer_of, number_of

SDK = PacketHandler(2.0)
MARK = b"\xff\xff\xfd"
AWKWARD = b"\xff\xff\xfd\xfd\x00\x00\x01\x04\x07\x55\xfe"
SAID = {
    "POSITION": "Current {} position is {}",
    "RESOLUTION": "{1} seconds arc per {0} position",
    "LOWEST": "Minimum {} position is {}",
    "SPEED": "Target {} speed is {} positions/sec",
    "ACCELERATION": "{} acceleration is {} positions/sec^2",
}
"""What the units say, from the manuals."""

many = settings(max_examples=200, deadline=None)
noise = st.lists(st.sampled_from(AWKWARD) | st.integers(0, 255), max_size=30).map(bytes)
sizes = st.sampled_from((1, 2, 7, 40, 10_000))


@st.composite
def broken(draw: st.DrawFn, good: st.SearchStrategy[bytes]) -> bytes:
    """Bytes of which some are lost or changed, or that have others between them."""
    data = bytearray(draw(good))
    at = draw(st.integers(0, len(data)))
    data[at : at + draw(st.integers(0, 3))] = draw(noise)
    return bytes(data)


def crc(data: bytes) -> int:
    return int(SDK.updateCRC(0, data, len(data)))


def packet(said: tuple[int, bytes]) -> bytes:
    """The bytes of a packet with an id and a body."""
    servo_id, body = said
    raw = [*MARK, 0, servo_id, (len(body) + 2) & 255, (len(body) + 2) >> 8, *body, 0, 0]
    whole = bytes(SDK.addStuffing(raw))[:-2]
    return whole + crc(whole).to_bytes(2, "little")


def packets_in(stream: bytes) -> Iterator[tuple[int, int, int, bytes]]:
    """Start, end, id and stuffed body of everything in a stream that is a packet, overlapping ones too."""
    for found in re.finditer(b"(?=%s\x00)" % MARK, stream):
        at = found.start()
        end = at + 7 + int.from_bytes(stream[at + 5 : at + 7], "little")
        if at + 10 <= end <= len(stream):
            whole = stream[at:end]
            if crc(whole[:-2]) == int.from_bytes(whole[-2:], "little"):
                yield at, end, whole[4], whole[7:-2]


def plain(body: bytes) -> bytes:
    """A body without its stuffing."""
    return body.replace(MARK + b"\xfd", MARK)


def bodies(kinds: bytes) -> st.SearchStrategy[tuple[int, bytes]]:
    """Ids with bodies that begin with one of some instructions."""
    body = st.tuples(st.sampled_from(kinds), st.sampled_from((0, 4, 0x80)), noise)
    return st.tuples(st.integers(0, 252), body.map(lambda it: bytes(it[:2]) + it[2]))


packets = bodies(b"\x55\x55\x02\x03\x82").map(packet)
promising = noise.map(lambda rest: MARK + b"\x00" + rest)


@many
@given(st.lists(noise | packets | broken(packets) | promising, max_size=4), bodies(b"\x55"), sizes)
def test_a_servos_answer_after_broken_bytes_is_taken_and_nothing_that_is_no_packet(
    before: list[bytes], last: tuple[int, bytes], size: int
) -> None:
    stream = b"".join(before) + packet(last)
    buffer, taken = bytearray(), []
    for at in range(0, len(stream), size):
        buffer += stream[at : at + size]
        while (one := take_status(buffer, at_end=at + size >= len(stream))) is not None:
            taken.append((one.servo_id, bytes((0x55, one.error)) + one.data))
    real = list(packets_in(stream))
    assert set(taken) <= {(servo_id, plain(body)) for _, _, servo_id, body in real}
    begin = len(stream) - len(packet(last))
    by_chance = any(start < begin < end for start, end, _, _ in real)  # a packet of noise over its beginning
    assert taken[-1:] == [last] or by_chance


asked = st.tuples(st.sampled_from(sorted(SAID)), st.sampled_from(("pan", "tilt")))
put_between = st.tuples(st.integers(0, 40), noise)


@many
@given(
    asked=asked,
    number=st.integers(-9999, 9999),
    before=st.lists(st.none() | noise | put_between, max_size=4),
    other=asked,
    hit=st.sampled_from((b"", b"!P", b"!T!P")),
    echo=st.booleans(),
    size=sizes,
)
def test_a_units_answer_after_broken_lines_is_read_and_no_other_value(
    asked: tuple[str, str],
    number: int,
    before: list[bytes | tuple[int, bytes] | None],
    other: tuple[str, str],
    hit: bytes,
    echo: bool,
    size: int,
) -> None:
    query = getattr(protocol, asked[0])[asked[1]]

    def line(kind: str, axis: str, value: int) -> bytes:
        sent = query.letters.encode() + b" " if echo and not hit else b""  # a hit hides the echo behind it
        return hit + sent + b"* " + SAID[kind].format(axis.capitalize(), value).encode() + b"\r\n"

    good, stream = line(*asked, number), b""
    for one in before:
        if one is None:
            stream += line(*other, 10_000 + number)
        elif isinstance(one, bytes):
            stream += one
        else:
            stream += good[: one[0]] + one[1] + good[one[0] :]
    splitter, taken = LineSplitter(), []
    stream += b"\r\n" + good
    for at in range(0, len(stream), size):
        for got in splitter.feed(stream[at : at + size]):
            found = answer_of(got, query.letters)
            value = number_of(found.text, query.terms, True) if found is not None and found.good else None
            taken.append((got.decode("latin-1").lower(), value))
    assert taken[-1][1] == number
    for text, value in taken:
        if value is not None:  # whatever digits the noise has changed
            assert all(word in text for word in query.terms) and f"{value:g}".lstrip("-")[:1] in text, text
