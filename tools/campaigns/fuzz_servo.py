"""Feed broken bytes to the drivers' and the simulators' parsers.

    .venv/bin/python -m tools.campaigns.fuzz_servo --cases 1000000

A case is a stream of noise, broken packets and good ones, in chunks of any size, with a good one at the end.
A parser passes if it lets no exception out, takes nothing for a packet that is none, and takes the good one
at the end. What is a packet is decided here by the SDK's checksum and a plain search, not by our code. Broken
bytes whose 16-bit checksum fits by chance are packets to everybody; they are counted as ``coincidence``. The
PTU's lines have no checksum: a digit that the noise itself changed is counted as ``changed digit``, and a
limit hit that runs into an echo (``!PPP *``) may be refused. Anything else is printed with the bytes that
caused it, and the exit code is 1.
"""

from __future__ import annotations

import math
import random
import re
import time
from collections import Counter
from collections.abc import Callable, Iterator

from dynamixel_sdk import PacketHandler

from drivers.dynamixel.packets import take_status
from drivers.flir_ptu import protocol
from drivers.flir_ptu.protocol import LineSplitter, answer_of, number_of
from drivers.sim.axis import AxisSettings
from drivers.sim.wire.axis import WireAxis
from drivers.sim.wire.dynamixel_bus import DynamixelBus
from drivers.sim.wire.dynamixel_packets import InstructionParser
from drivers.sim.wire.dynamixel_servo import SimulatedServo
from drivers.sim.wire.ptu import SimulatedPtu
from tools.command import end, options

SDK = PacketHandler(2.0)
MARK = b"\xff\xff\xfd"
AWKWARD = bytes((0xFF, 0xFF, 0xFF, 0xFD, 0xFD, 0x00, 0x00, 0x01, 0x04, 0x07, 0x55, 0xFE))
LONGEST = 1024


class ParserFailed(Exception):
    """A parser did what it must not."""


# Packets, by the SDK


def crc(data: bytes) -> int:
    return int(SDK.updateCRC(0, data, len(data)))


def packet(packet_id: int, body: bytes, *, stuff: bool = True) -> bytes:
    """A packet around instruction and parameters."""
    raw = [*MARK, 0, packet_id, (len(body) + 2) & 255, (len(body) + 2) >> 8, *body, 0, 0]
    whole = bytes(SDK.addStuffing(raw) if stuff else raw)[:-2]
    return whole + crc(whole).to_bytes(2, "little")


def packets_in(stream: bytes) -> Iterator[tuple[int, int, int, bytes]]:
    """Start, end, id and stuffed body of everything in a stream that is a packet, overlapping ones too."""
    at = stream.find(MARK + b"\x00")
    while at >= 0:
        end = at + 7 + int.from_bytes(stream[at + 5 : at + 7], "little")
        if at + 10 <= end <= min(len(stream), at + LONGEST):
            whole = stream[at:end]
            if crc(whole[:-2]) == int.from_bytes(whole[-2:], "little"):
                yield at, end, whole[4], whole[7:-2]
        at = stream.find(MARK + b"\x00", at + 1)


def plain(body: bytes) -> bytes:
    """A body without its stuffing, byte by byte."""
    out, at = bytearray(), 0
    while at < len(body):
        out.append(body[at])
        stuffed = body[at - 2 : at + 2] == MARK + b"\xfd" and at >= 2
        at += 2 if stuffed else 1
    return bytes(out)


# Streams


def some_bytes(rng: random.Random, longest: int) -> bytes:
    size = rng.randrange(longest + 1)
    if rng.random() < 0.5:
        return rng.randbytes(size)
    return bytes(rng.choices(AWKWARD, k=size))


def broken(rng: random.Random, data: bytes) -> bytes:
    """Bytes with some of them flipped, changed, lost, doubled, or put in between."""
    out = bytearray(data)
    for _ in range(rng.choice((1, 1, 2, 4))):
        if not out:
            break
        at, kind = rng.randrange(len(out)), rng.randrange(6)
        if kind == 0:
            out[at] ^= 1 << rng.randrange(8)
        elif kind == 1:
            out[at] = rng.choice(AWKWARD)
        elif kind == 2:
            del out[at : at + rng.choice((1, 1, 3))]
        elif kind == 3:
            out[at:at] = some_bytes(rng, 4)
        elif kind == 4:
            out[at:at] = out[at : at + 6]
        else:
            del out[at:]
    return bytes(out)


def rubbish(rng: random.Random, good: Callable[[], bytes]) -> bytes:
    """What may come before a good packet."""
    parts = []
    for _ in range(rng.randrange(4)):
        kind = rng.randrange(5)
        if kind == 0:
            parts.append(some_bytes(rng, 30))
        elif kind == 1:
            parts.append(good())
        elif kind == 2:
            parts.append(MARK + b"\x00" + some_bytes(rng, 6))  # a header that promises much
        else:
            parts.append(broken(rng, good()))
    return b"".join(parts)


def chunks(rng: random.Random, stream: bytes) -> Iterator[bytes]:
    if rng.random() < 0.3:
        yield stream
        return
    at = 0
    while at < len(stream):
        size = rng.choice((1, 1, 2, 7, 40))
        yield stream[at : at + size]
        at += size


def seen(stream: bytes, taken: list[tuple[int, bytes]], sent: tuple[int, bytes], where: str) -> str:
    """Judge what a parser took from a stream that ends with a good packet: ids and bodies, unstuffed."""
    real = list(packets_in(stream))
    allowed = {(packet_id, plain(body)) for _, _, packet_id, body in real}
    for one in taken:
        if one not in allowed:
            raise ParserFailed(f"{where} took {one} out of {stream.hex()}")
    if taken[-1:] != [sent]:
        begin = len(stream) - len(packet(*sent))
        if any(start < begin < end for start, end, _, _ in real):
            return "coincidence"
        raise ParserFailed(f"{where} did not take the last packet of {stream.hex()}, but {taken}")
    return "right"


# The parsers


def instruction(rng: random.Random) -> tuple[int, bytes]:
    """Id and body of an instruction, mostly one that exists."""
    packet_id = rng.choice((1, 2, 3, 0xFE, rng.randrange(253)))
    code = rng.choice((1, 2, 3, 3, 3, 4, 5, 6, 8, 0x10, 0x20, 0x55, 0x82, 0x83, 0x8A, 0x92, 0x93, 0x9A))
    address = rng.choice(
        (rng.randrange(700), rng.choice((7, 8, 11, 20, 64, 98, 116, 132, 168, 224, 512, 564)))
    )
    if code in (0x92, 0x93, 0x9A):
        body = bytes((rng.choice((1, 2, 3)),)) + address.to_bytes(2, "little") + bytes((rng.randrange(9), 0))
    elif code in (0x82, 0x83, 0x8A):
        body = address.to_bytes(2, "little") + bytes((rng.randrange(9), 0, 1, 2, 3)[: rng.randrange(8)])
    else:
        body = address.to_bytes(2, "little") + some_bytes(rng, 8)
    if rng.random() < 0.1:
        body += some_bytes(rng, 400)
    return packet_id, bytes((code,)) + (b"" if rng.random() < 0.1 else body)


def simulator_parser(rng: random.Random) -> str:
    """The simulated servos' parser."""
    parser, last = InstructionParser(), instruction(rng)
    stream = rubbish(rng, lambda: packet(*instruction(rng))) + packet(*last)
    taken = []
    for chunk in chunks(rng, stream):
        taken += [(i.packet_id, bytes((i.code,)) + i.parameters) for i in parser.feed(chunk) if i.intact]
    return seen(stream, taken, last, "the simulator's parser")


AXIS = AxisSettings(math.tau / 4096, 0.0, -3.0, 3.0, 6.0, 60.0)


class FuzzedBus:
    """Simulated servos that live through many streams, as they are left by each."""

    def __init__(self) -> None:
        self.now_s = 0.0
        self.renew()

    def renew(self) -> None:
        models = ("xl330_m288", "ph42_020_s300", "mx_28")
        self.servos = [
            SimulatedServo(m, i + 1, WireAxis(AXIS, time_s=self.now_s), time_s=self.now_s)
            for i, m in enumerate(models)
        ]
        self.bus = DynamixelBus(self.servos)
        self.left = 200

    def __call__(self, rng: random.Random) -> str:
        """The simulated servos themselves: answers are packets, and a ping is answered in the end."""
        self.left -= 1
        if self.left < 0:
            self.renew()
        stream = rubbish(rng, lambda: packet(*instruction(rng))) + packet(*instruction(rng))
        for chunk in chunks(rng, stream):
            self.now_s += 0.01
            said = b"".join(reply.data for reply in self.bus.receive(chunk, self.now_s))
            self.bus.poll(self.now_s)
            self.check(said, stream)
        for _ in range(2):  # a servo that was told to may be starting, or change its baud rate
            self.now_s += 1.0
            self.bus.poll(self.now_s)
        ids = [servo.servo_id for servo in self.servos]
        for servo in self.servos:
            if ids.count(servo.servo_id) > 1:
                self.renew()
                return "one id twice"
            self.bus.host_baud = servo.baud
            asked = packet(servo.servo_id, b"\x01")
            wanted = bytes((0x55,)), servo.model.number.to_bytes(2, "little")
            replies = self.bus.receive(asked, self.now_s)
            found = [p for reply in replies for p in packets_in(reply.data)]
            bodies = [body for _, _, packet_id, body in found if packet_id == servo.servo_id]
            if len(bodies) != 1 or (bodies[0][:1], bodies[0][2:4]) != wanted:
                raise ParserFailed(f"no answer to a ping of {servo.servo_id} after {stream.hex()}")
        self.bus.host_baud = None
        return "right"

    def check(self, said: bytes, stream: bytes) -> None:
        """Whatever servos say is whole packets, but for pieces of a fast answer that was cut off."""
        at = 0
        while at < len(said):
            end = next((e for s, e, _, _ in packets_in(said) if s == at), None)
            if end is None:
                if said[at : at + 5] == MARK + b"\x00\xfe":
                    return  # a servo of a fast read is missing, its piece and those behind it too
                if len({servo.servo_id for servo in self.servos}) < len(self.servos):
                    return  # two that share an id talk at once
                raise ParserFailed(f"the bus said {said.hex()} to {stream.hex()}")
            at = end


def status(rng: random.Random) -> tuple[int, bytes]:
    """Id and body of an answer."""
    return rng.randrange(253), b"\x55" + bytes((rng.choice((0, 0x80, 4)),)) + some_bytes(rng, 20)


def driver_parser(rng: random.Random) -> str:
    """The driver's parser of status packets."""
    buffer, last = bytearray(), status(rng)
    stream = rubbish(
        rng, lambda: packet(*(status(rng) if rng.random() < 0.7 else instruction(rng)))
    ) + packet(*last)
    taken = []

    def take(at_end: bool) -> None:
        while (one := take_status(buffer, at_end=at_end)) is not None:
            taken.append((one.servo_id, bytes((0x55, one.error)) + one.data))

    for chunk in chunks(rng, stream):
        buffer += chunk
        take(at_end=False)
    take(at_end=True)
    return seen(stream, taken, last, "the driver's parser")


def driver_fast_parser(rng: random.Random) -> str:
    """The driver's parser of answers to fast reads, which are not stuffed."""
    buffer, body = bytearray(), b"\x55" + some_bytes(rng, 40).ljust(8, b"\xff")
    last = packet(0xFE, body, stuff=False)
    stream = rubbish(rng, lambda: packet(*status(rng))) + last
    taken = []
    for chunk in chunks(rng, stream):
        buffer += chunk
        while (one := take_status(buffer, fast=True)) is not None:
            taken.append((one.servo_id, bytes((0x55, one.error)) + one.data))
    while (one := take_status(buffer, at_end=True, fast=True)) is not None:
        taken.append((one.servo_id, bytes((0x55, one.error)) + one.data))
    real = list(packets_in(stream))
    allowed = {(packet_id, found) for _, _, packet_id, found in real}
    for one_taken in taken:
        if one_taken not in allowed:
            raise ParserFailed(f"the driver took {one_taken} out of {stream.hex()}")
    if taken[-1:] != [(0xFE, body)]:
        begin = len(stream) - len(last)
        if any(s < begin < e or begin < s for s, e, _, _ in real):
            return "coincidence"
        raise ParserFailed(f"the driver did not take the last packet of {stream.hex()}, but {taken}")
    return "right"


COMMANDS = (
    *(f"{axis}{letter}" for axis in "PT" for letter in "PORSDULBANX"),
    *("PP500", "TP-200", "PO10", "PS900", "TS100", "PA2000", "PU1500", "PL100", "PB80"),
    *("I", "S", "A", "H", "HP", "HT", "CI", "CV", "PCE", "PCD", "LE", "LD", "LU", "L", "PNU-100", "PXU100"),
    *("R", "RP", "RT", "RE", "RD", "RPS500", "WP", "WPF", "WTE", "WPA", "EE", "ED", "FT", "FV", "DS", "DR"),
    *("DF", "V", "O", "C", "PHL", "PMR", "THR", "TMO", "B0,0,500,500", "CEC", "@(9600,0,F)"),
)


def ptu_simulator(rng: random.Random) -> str:
    """The simulated pan/tilt unit."""
    model = rng.choice(("d46_17", "d48e"))
    unit = SimulatedPtu(model, WireAxis(AXIS), WireAxis(AXIS, number=1))
    now_s = 0.0

    def say(data: bytes) -> bytes:
        nonlocal now_s
        said = b""
        for chunk in chunks(rng, data):
            now_s += 0.02
            said += b"".join(reply.data for reply in unit.receive(chunk, now_s))
        for pause_s in (0.1, 1.0, 30.0, 1e3, 1e5, 1e6):
            now_s += pause_s
            said += b"".join(reply.data for reply in unit.poll(now_s))
        return said

    def resolution() -> float | None:
        found = re.search(rb"\*[^\d!*]*(\d+\.\d+)", say(b"PR ").split(b"PR")[-1])
        return None if found is None else float(found[1])

    say(b"")
    first = resolution()
    parts = []
    for _ in range(rng.randrange(1, 7)):
        command = rng.choice(COMMANDS).encode() + rng.choice((b" ", b"\r", b"\n"))
        kind = rng.random()
        parts.append(command if kind < 0.4 else broken(rng, command) if kind < 0.8 else some_bytes(rng, 30))
    stream = b"".join(parts)
    say(stream)
    for _ in range(10):  # commands that take long follow one another
        say(b" ")
    last = resolution()
    if first is None or last is None:
        raise ParserFailed(f"{model} did not tell its resolution ({first}, {last}) after {stream!r}")
    steps = math.log2(last / first)
    if abs(steps - round(steps)) > 1e-3 or abs(steps) > 3.01:
        raise ParserFailed(f"{model} told {last} instead of {first} after {stream!r}")
    return "right"


SAID = {
    "POSITION": "Current {} position is {}",
    "RESOLUTION": "{1} seconds arc per {0} position",
    "LOWEST": "Minimum {} position is {}",
    "HIGHEST": "Maximum {} position is {}",
    "SPEED": "Target {} speed is {} positions/sec",
    "FASTEST": "Maximum {} speed is {} positions/sec",
    "SLOWEST": "Minimum {} speed is {} positions/sec",
    "ACCELERATION": "{} acceleration is {} positions/sec^2",
}
"""What the units say, from the manuals."""


def ptu_driver(rng: random.Random) -> str:
    """The driver's reading of a unit's answers, in words."""

    def answer() -> tuple[str, str, str, str]:
        kind, axis = rng.choice(list(SAID)), rng.choice(("pan", "tilt"))
        number = f"{rng.uniform(2, 200):.4f}" if kind == "RESOLUTION" else str(rng.randrange(-9999, 9999))
        return kind, axis, number, SAID[kind].format(axis.capitalize(), number)

    def line(words: str, command: str) -> bytes:
        hits = rng.choice(("", "", "", "!P", "!T!P"))
        echo = rng.choice(("", f"{command} "))
        return (hits + echo + "* " + words).encode() + rng.choice((b"\r\n", b"\n\r\n"))

    kind, axis, number, words = answer()
    query = getattr(protocol, kind)[axis]
    stream, others = b"", []
    for _ in range(rng.randrange(4)):
        what = rng.random()
        if what < 0.3:
            other = answer()
            others.append(other)
            stream += line(other[3], query.letters)
        elif what < 0.8:
            stream += broken(rng, line(words, query.letters))
        else:
            stream += some_bytes(rng, 40)
    stream += b"\r\n" + line(words, query.letters)
    splitter, taken = LineSplitter(), []
    for chunk in chunks(rng, stream):
        for got in splitter.feed(chunk):
            found = answer_of(got, query.letters)
            value = number_of(found.text, query.words, True) if found is not None and found.good else None
            taken.append((got, value))
    if taken[-1][1] is None and re.match(rb"(!T)?!P[PT]", taken[-1][0]):
        return "refused: hit right before echo"
    if taken[-1][1] != float(number):
        raise ParserFailed(f"the answer {words!r} was read as {taken[-1]} at the end of {stream!r}")
    outcome = "right"
    same = {float(o[2]) for o in others if o[:2] == (kind, axis)} | {float(number)}
    for got, value in taken:
        if value is None or value in same:
            continue
        text = got.decode("latin-1").lower()
        if not all(word in text for word in query.words) or f"{value:g}".lstrip("-")[:1] not in text:
            raise ParserFailed(f"{got!r} was read as {value} in answer to {query.letters}")
        outcome = "changed digit"
    return outcome


def targets() -> dict[str, Callable[[random.Random], str]]:
    """What is fuzzed, by name."""
    return {
        "simulated servos: parser": simulator_parser,
        "simulated servos: bus": FuzzedBus(),
        "servo driver: parser": driver_parser,
        "servo driver: fast reads": driver_fast_parser,
        "simulated PTU": ptu_simulator,
        "PTU driver: answers": ptu_driver,
    }


def campaign(cases: int, seed: int) -> tuple[dict[str, Counter[str]], dict[str, float], list[str]]:
    """Run the cases, an equal share for each target; return outcomes, seconds, and what failed."""
    counts: dict[str, Counter[str]] = {}
    spent_s: dict[str, float] = {}
    failures: list[str] = []
    for name, target in targets().items():
        counts[name] = Counter()
        begun = time.perf_counter()
        for case in range(math.ceil(cases / len(targets()))):
            rng = random.Random(f"{seed}/{name}/{case}")
            try:
                counts[name][target(rng)] += 1
            except Exception as error:
                counts[name]["FAILED"] += 1
                failures.append(f"seed {seed}, {name}, case {case}: {type(error).__name__}: {error}")
                if isinstance(target, FuzzedBus):
                    target.renew()
        spent_s[name] = time.perf_counter() - begun
    return counts, spent_s, failures


def main() -> int:
    """Run the campaign, print the table, and return 1 if anything failed."""
    args = options(__doc__, 60_000, tasks=False).parse_args()
    counts, spent_s, failures = campaign(args.cases, args.seed)
    for failure in failures[:20]:
        print(failure)
    total = sum(sum(counter.values()) for counter in counts.values())
    print(f"{total} cases, seed {args.seed}, {sum(spent_s.values()):.0f} s, {len(failures)} failed")
    print(f"{'':26s}{'cases':>9s}{'right':>9s}{'us/case':>9s}  other")
    for name, counter in counts.items():
        cases = sum(counter.values())
        other = ", ".join(f"{word} {n}" for word, n in sorted(counter.items()) if word != "right")
        print(f"{name:26s}{cases:9d}{counter['right']:9d}{1e6 * spent_s[name] / cases:9.0f}  {other or '-'}")
    return 1 if failures else 0


if __name__ == "__main__":
    end(main)
