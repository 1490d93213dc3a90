"""A pan/tilt unit for tests that says exactly what a test wants: the manual's examples, odd firmwares, lies.

It knows nothing of motors: an axis is where it was sent, at once, unless ``positions`` is set by the test.
The words are those printed in the manuals (PTU-D46 v2.14, E series v6.00).
"""

from __future__ import annotations

import re
import threading
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from typing import Any

from drivers.flir_ptu.head import FlirPtu, open_head
from drivers.sim.wire.carrier import Reply
from drivers.sim.wire.line import MemoryLine
from drivers.simulation_clock import SimulationClock
from hil_tests.waiting import until

OPTIONS: dict[str, Any] = {
    "pan": {"limits_rad": [-2.5, 2.5]}, "tilt": {"limits_rad": [-0.7, 0.5]}, "settle_s": 0.0,
}  # fmt: skip


class ScriptedPtu:
    """A unit on a simulated line (`drivers.sim.wire.carrier.WireDevice`).

    Attributes
    ----------
    answers
        Answers by command, in place of the usual ones: bytes without line end, or a function of the command.
    heard
        Every command, in order.
    """

    baud = 9600

    def __init__(
        self,
        *,
        verbose: bool = True,
        echo: bool = True,
        obeys: bool = True,
        start: bytes = b"",
        end: bytes = b"\r",
        e_series: bool = False,
        capitals: bool = False,
    ) -> None:
        self.verbose, self.echo = verbose, echo
        self.obeys = obeys  # FV, FT, EE, ED
        self.start, self.end = start, end
        self.capitals = capitals  # whatever was written, the echo is
        self.e_series = e_series  # the echo on a line of its own, resolutions without the axis's name
        self.positions = {"P": 0, "T": 0}
        self.slaved: dict[str, int] | None = None
        self.resolutions = {"P": "185.142857", "T": "46.285714"}
        self.limits = {"P": (-3090, 3090), "T": (-3628, 2416)}
        self.speeds = {"P": 1000, "T": 1000}
        self.user_limits = True
        self.answers: dict[str, bytes | Callable[[str], bytes | None]] = {}
        self.unasked = b""
        self.heard: list[str] = []
        self._rest = b""

    def receive(self, data: bytes, time_s: float) -> Sequence[Reply]:
        *commands, self._rest = re.split(rb"[ \r\n]", self._rest + data)
        replies = [self.reply(command.decode()) for command in commands if command]
        return [Reply(reply) for reply in replies if reply is not None]

    def poll(self, time_s: float) -> Sequence[Reply]:
        unasked, self.unasked = self.unasked, b""
        return [Reply(unasked)] if unasked else []

    def reply(self, written: str) -> bytes | None:
        command = written.upper()
        self.heard.append(command)
        echo = self.echo
        answer = self.answers.get(command, self.usual)
        text = answer(command) if callable(answer) else answer
        if text is None:
            return None
        echoed = f"{command if self.capitals else written} ".encode() if echo else b""
        return (echoed + self.start if self.e_series else self.start + echoed) + text + self.end

    def usual(self, command: str) -> bytes | None:
        letters, argument = re.fullmatch(r"([A-Z]*)(-?\d*)", command).groups()  # type: ignore[union-attr]
        axis, rest = letters[:1], letters[1:]
        name = {"P": "Pan", "T": "Tilt"}.get(axis, "")
        if letters in ("FV", "FT", "EE", "ED"):
            if self.obeys:
                self.verbose = {"FV": True, "FT": False}.get(letters, self.verbose)
                self.echo = {"EE": True, "ED": False}.get(letters, self.echo)
            return b"*"
        if letters == "V":
            return b"* Pan-Tilt Controller v2.13.0(D46/E), (C)2004-2006 Directed Perception, Inc."
        if letters in ("H", "CI", "LE", "LU", "R"):
            return b"*" if letters != "LU" or self.user_limits else b"! Illegal Command Entered"
        if letters == "S":
            self.slaved = self.slaved or {}
            return b"*"
        if letters == "I":
            self.positions |= self.slaved or {}
            self.slaved = None
            return b"*"
        if rest == "P" and argument:
            low, high = self.limits[axis]
            if not low <= int(argument) <= high:
                end = ("Minimum", low) if int(argument) < low else ("Maximum", high)
                return f"! {end[0]} allowable {name} position is {end[1]}".encode()
            if self.slaved is None:
                self.positions[axis] = int(argument)
            else:
                self.slaved[axis] = int(argument)
            return b"*"
        if rest == "O" and argument == "0":
            if self.slaved is not None:
                self.slaved[axis] = self.positions[axis]
            return b"*"
        if rest in ("NU", "XU"):
            return b"*" if self.user_limits else b"! Illegal Command Entered"
        if rest == "S" and argument:
            self.speeds[axis] = int(argument)
            return b"*"
        if rest == "A" and argument:
            return b"*"
        said = {
            "P": f"Current {name} position is {self.positions.get(axis)}",
            "R": f"{self.resolutions.get(axis)} seconds arc per {name} position",
            "N": f"Minimum {name} position is {self.limits.get(axis, (0, 0))[0]}",
            "X": f"Maximum {name} position is {self.limits.get(axis, (0, 0))[1]}",
            "S": f"Target {name} speed is {self.speeds.get(axis)} positions/sec",
            "U": f"Maximum {name} speed is 2902 positions/sec",
            "L": f"Minimum {name} speed is 31 positions/sec",
            "A": f"{name} acceleration is 2000 positions/sec^2",
        }.get(rest)
        if rest == "R" and self.e_series:
            said = f"{self.resolutions.get(axis)} seconds arc per position"
        if not name or said is None:
            return b"! Illegal Command Entered"
        if not self.verbose:
            said = re.search(r"-?\d+(\.\d+)?", said)[0]  # type: ignore[index]
        return f"* {said}".encode()


class Bench:
    """Lines with scripted units, and heads on them; bytes take no time on the wire."""

    def __init__(self, stack: ExitStack) -> None:
        self._stack = stack
        self.clock = SimulationClock(start_s=10.0)
        stack.enter_context(self.clock.at_work())

    def __call__(self, unit: ScriptedPtu | None = None, **options: Any) -> tuple[FlirPtu, ScriptedPtu]:
        """Open a head on a unit; both are closed at the end."""
        unit = unit or ScriptedPtu()
        return self.head(self.line(unit), **options), unit

    def line(self, unit: ScriptedPtu) -> MemoryLine:
        return self._stack.enter_context(MemoryLine(unit, self.clock, wire_time=False))

    def head(self, line: MemoryLine, **options: Any) -> FlirPtu:
        head = open_head({**OPTIONS, "port": line.path, **options}, self.clock, line.open)
        self._stack.callback(head.close)
        return head

    def settled(self, head: FlirPtu) -> tuple[float, float]:
        """Read until the head has settled; return its angles."""
        reading = head.read()
        while reading.moving:
            self.clock.sleep(0.002)
            reading = head.read()
        return reading.pan_rad, reading.tilt_rad

    def rested(self, head: FlirPtu) -> None:
        """Read until the head has stood for so long that it cannot be anywhere else."""
        for _ in range(5):
            head.read()
            self.clock.sleep(0.5)

    def until(self, holds: Callable[[], Any], what: str) -> Any:
        return until(holds, what, clock=self.clock)

    def begun(self, *targets: Callable[[], Any]) -> list[threading.Thread]:
        """Start threads."""
        threads = [self.clock.thread(target, "test") for target in targets]
        for thread in threads:
            thread.start()
        return threads

    def ended(self, *threads: threading.Thread) -> None:
        """Wait for their end."""
        self.until(lambda: not any(thread.is_alive() for thread in threads), "the threads' end")
