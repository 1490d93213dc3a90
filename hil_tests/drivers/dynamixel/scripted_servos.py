"""Servos for tests that answer exactly what a test wants, on a line in memory or a pseudo terminal.

Bytes of the answers are made by the simulator's own packet code, which the driver does not share.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager

from drivers.clock import Clock, SystemClock
from drivers.dynamixel.link import Link
from drivers.serial_line import OpenLine, SerialLine
from drivers.servo_bus.exchange import REPLY_TIMEOUT_S
from drivers.sim.wire.carrier import Reply
from drivers.sim.wire.dynamixel_bus import Instruction, InstructionParser, status_packet
from drivers.sim.wire.line import MemoryLine, PtyLine
from drivers.simulation_clock import SimulationClock
from hil_tests.drivers.turned import START_S, Turned

BAUD_RATE = 1_000_000

Answer = Callable[[Instruction, int], Sequence[Reply]]
"""What is answered to an instruction; the number counts instructions from 0."""


class ScriptedServos:
    """A line's far end (`drivers.sim.wire.carrier.WireDevice`) that hands each instruction to a function."""

    baud = BAUD_RATE

    def __init__(self, answer: Answer) -> None:
        self.heard: list[Instruction] = []
        self.bytes_heard = b""
        self._answer = answer
        self._parser = InstructionParser()

    def receive(self, data: bytes, time_s: float) -> Sequence[Reply]:
        self.bytes_heard += data
        replies: list[Reply] = []
        for instruction in self._parser.feed(data):
            self.heard.append(instruction)
            replies += self._answer(instruction, len(self.heard) - 1)
        return replies

    def poll(self, time_s: float) -> Sequence[Reply]:
        return ()


class Line(Turned):
    """A line with scripted servos behind it, and how a driver gets to them."""

    def __init__(self, servos: ScriptedServos, clock: Clock, line: MemoryLine | PtyLine) -> None:
        self.servos = servos
        self.clock = clock
        self.line = line
        self.path = line.path
        self.open_line: OpenLine = line.open if isinstance(line, MemoryLine) else SerialLine

    def link(self, reply_timeout_s: float = REPLY_TIMEOUT_S, baud: int = BAUD_RATE) -> Link:
        return Link(self.path, baud, reply_timeout_s, clock=self.clock, open_line=self.open_line)


@contextmanager
def scripted(answer: Answer, *, real: bool = False) -> Iterator[tuple[Line, ScriptedServos]]:
    """Scripted servos on a turned clock; ``real`` ones behind a pseudo terminal, on the machine's."""
    servos = ScriptedServos(answer)
    clock = SystemClock() if real else SimulationClock(start_s=START_S)
    make = PtyLine if real else MemoryLine
    with clock.at_work(), make(servos, clock, wire_time=False) as line:
        yield Line(servos, clock, line), servos


def says(servo_id: int, data: bytes = b"", error: int = 0, delay_s: float = 0.0) -> Reply:
    """One answer."""
    return Reply(status_packet(servo_id, error, data), delay_s, servo_id)


def number(value: int, size: int = 4) -> bytes:
    """A register's bytes."""
    return (value & (256**size - 1)).to_bytes(size, "little")
