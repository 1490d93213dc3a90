"""The simulated pan/tilt unit against the manuals' own examples, byte by byte, on a clock turned by hand."""

from __future__ import annotations

import math

import pytest

from drivers.clock import ManualClock
from drivers.faults import FaultPanel
from drivers.sim.axis import AxisSettings, WireAxis
from drivers.sim.wire.ptu import SimulatedPtu

AXIS = AxisSettings(
    count_rad=1e-5,
    backlash_rad=0.0,
    low_rad=-3.0,
    high_rad=3.0,
    speed_rad_per_s=1.0,
    acceleration_rad_per_s2=1.0,
)
POLL_S = 0.005


class Unit:
    """A unit that is asked without a line."""

    def __init__(self, model: str = "d46_17", **options: object) -> None:
        self.clock = ManualClock()
        self.panel = FaultPanel(self.clock.now_s, ())
        self.pan = WireAxis(AXIS, self.panel, number=0)
        self.tilt = WireAxis(AXIS, self.panel, number=1)
        self.device = SimulatedPtu(model, self.pan, self.tilt, **options)  # type: ignore[arg-type]

    def raw(self, data: bytes, wait_s: float = 0.0) -> bytes:
        """What is sent for bytes, at once and within a time."""
        sent = [reply.data for reply in self.device.receive(data, self.clock.now_s())]
        step_s = max(POLL_S, wait_s / 1000)
        for _ in range(round(wait_s / step_s)):
            self.clock.advance(step_s)
            sent += [reply.data for reply in self.device.poll(self.clock.now_s())]
        return b"".join(sent)

    def ask(self, command: str, wait_s: float = 0.0) -> str:
        """The answer without echo and framing."""
        sent = self.raw(command.encode() + b" ", wait_s).decode()
        return sent.removeprefix(command + " ").strip()

    def pass_s(self, duration_s: float) -> str:
        """What it sends meanwhile by itself."""
        return self.raw(b"", duration_s).decode()


@pytest.fixture
def unit() -> Unit:
    return Unit()


@pytest.mark.parametrize(
    ("command", "answer"),
    [  # the manuals' examples (D46 2.14.0, D300 2.18.0) and what drivers of real units look for
        ("PR", "* 185.1428 seconds arc per Pan position"),
        ("TR", "* 185.1428 seconds arc per Tilt position"),
        ("PP", "* Current Pan position is 0"),
        ("PN", "* Minimum Pan position is -3090"),
        ("PX", "* Maximum Pan position is 3090"),
        ("TN", "* Minimum Tilt position is -907"),
        ("TX", "* Maximum Tilt position is 604"),
        ("PP3200", "! Maximum allowable Pan position is 3090"),
        ("tp-1900", "! Minimum allowable Tilt position is -907"),
        ("PS", "* Target Pan speed is 1000 positions/sec"),
        ("PS3300", "! Pan speed cannot exceed 2902 positions/sec"),
        ("PU", "* Maximum Pan speed is 2902 positions/sec"),
        ("PL", "* Minimum Pan speed is 31 positions/sec"),
        ("PA", "* Pan acceleration is 2000 positions/sec^2"),
        ("O", "* Input 24 VDC @ 95 degF"),
        (
            "V",
            "* Pan-Tilt Controller v2.12.1d1(C14/E), (C)2003 Directed Perception, Inc., All Rights Reserved",
        ),
        ("XYZ", "! Illegal Command Entered"),
    ],
)
def test_answers_are_those_of_the_manuals(unit: Unit, command: str, answer: str) -> None:
    assert unit.ask(command) == answer


def test_echo_framing_and_delimiters(unit: Unit) -> None:
    assert unit.raw(b"PP ") == b"PP * Current Pan position is 0\r\n"
    assert unit.raw(b"pp\r") == b"pp\r* Current Pan position is 0\r\n"
    assert unit.raw(b"F") + unit.raw(b"V") + unit.raw(b" ") == b"FV *\r\n", "in pieces"
    position = b"* Current %b position is 0\r\n"
    assert unit.raw(b"PP TP ") == b"PP " + position % b"Pan" + b"TP " + position % b"Tilt"


def test_a_reset_sweeps_the_range_and_tells_each_limit_before_its_answer(unit: Unit) -> None:
    seen: list[float] = []
    assert unit.raw(b"R ") == b"R "
    sent = ""
    for _ in range(300):
        sent += unit.pass_s(0.1)
        seen.append(unit.pan.angle_rad(unit.clock.now_s()))
    assert sent == "!T!T!P!P*\r\n"
    limit_rad = 3090 * math.radians(1296 / 7 / 3600)
    assert min(seen) < -0.95 * limit_rad and max(seen) > 0.95 * limit_rad
    assert unit.ask("PP") == "* Current Pan position is 0"
