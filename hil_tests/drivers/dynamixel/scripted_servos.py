"""Servos for tests that answer exactly what a test wants, on a pseudo terminal.

Bytes of the answers are made by the simulator's own packet code, which the driver does not share.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager

from drivers.clock import SystemClock
from drivers.sim.wire.dynamixel_packets import Instruction, InstructionParser, status_packet
from drivers.sim.wire.line import PtyLine, Reply

Answer = Callable[[Instruction, int], Sequence[Reply]]
"""What is answered to an instruction; the number counts instructions from 0."""


class ScriptedServos:
    """A line's far end (`drivers.sim.wire.line.WireDevice`) that hands each instruction to a function."""

    baud = 1_000_000

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


@contextmanager
def scripted(answer: Answer) -> Iterator[tuple[PtyLine, ScriptedServos]]:
    """A pseudo terminal with scripted servos behind it."""
    servos = ScriptedServos(answer)
    with PtyLine(servos, SystemClock(), wire_time=False) as line:
        yield line, servos


def says(servo_id: int, data: bytes = b"", error: int = 0, delay_s: float = 0.0) -> Reply:
    """One answer."""
    return Reply(status_packet(servo_id, error, data), delay_s, servo_id)


def number(value: int, size: int = 4) -> bytes:
    """A register's bytes."""
    return (value & (256**size - 1)).to_bytes(size, "little")
