"""A simulated FLIR / Directed Perception pan/tilt unit on a line: its ASCII protocol, byte by byte.

What the unit does is known in `drivers.sim.wire.ptu_unit`. Wording follows the manuals and what drivers of
real units parse; where no source gives any (user limits, step modes) it is like its neighbours'.
Only the commands that drivers need are known; others are refused as illegal.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

from drivers.errors import BadOptions
from drivers.faults import nearest
from drivers.sim.axis import WireAxis
from drivers.sim.wire.carrier import Reply
from drivers.sim.wire.ptu_unit import MODELS, STEPS, CommandRefused, PtuAxis, PtuUnit

BAUD_RATES = (600, 1200, 2400, 4800, 9600, 19200, 38400, 57600, 115200)
_WORDS = re.compile(r"([A-Z]+)([+-]?\d+)?")
_STEP_NAMES = {"F": "FULL", "H": "HALF", "Q": "QUARTER", "E": "EIGHTH", "A": "AUTO"}

_Plain = Callable[[PtuUnit, float], str | None]

ANSWER_S = 0.001
"""From the end of a command to its answer (assumed)."""

BANNER = b"\r\n### FLIR Motion Control Systems pan-tilt unit\r\n"
"""What an E series unit says to a host that connects by TCP (the wording differs with the firmware)."""

_LONGEST = 100  # bytes of one command; the controller's buffer (D46 manual 7.3.2)


def answer(unit: PtuUnit, command: bytes, time_s: float) -> str:
    """Carry out one command and return its answer, ``*`` or ``!`` and text."""
    text = command.decode("ascii", "replace").upper()
    try:
        text_back = _carry_out(unit, text, time_s)
    except CommandRefused as refusal:
        return f"! {refusal}"
    return "*" if text_back is None else f"* {text_back}"


def _carry_out(unit: PtuUnit, text: str, time_s: float) -> str | None:
    """One command's text behind the ``*``, if it has any. Raises Refused."""
    found = _WORDS.fullmatch(text)
    if found is None:
        raise _illegal()
    name, number = found[1], None if found[2] is None else int(found[2])
    if name in _PLAIN and number is None:
        return _PLAIN[name](unit, time_s)
    if name[0] in unit.axes and name[1:] in _QUANTITIES:
        return _QUANTITIES[name[1:]].carry_out(unit, unit.axes[name[0]], number, time_s)
    if name[0] in unit.axes and name[1:] == "R":
        resolution = _E_SERIES_RESOLUTION if unit.model.e_series else _RESOLUTION
        return resolution.carry_out(unit, unit.axes[name[0]], number, time_s)
    if name[0] == "W" and name[1:] in unit.axes and number is None:
        axis = unit.axes[name[1]]
        return f"{axis.name} in {_STEP_NAMES[axis.mode]} step mode"
    raise _illegal()


def _illegal() -> CommandRefused:
    return CommandRefused("Illegal Command Entered")


@dataclass(frozen=True)
class _Quantity:
    """A quantity of an axis: reported without a number, set with one, unless it can only be read."""

    sentence: str
    value: Callable[[PtuAxis, float], object]
    put: Callable[[PtuUnit, PtuAxis, int, float], None] | None = None

    def carry_out(self, unit: PtuUnit, axis: PtuAxis, number: int | None, time_s: float) -> str | None:
        """Report or set it."""
        if number is None:
            return self.sentence.format(axis=axis.name, value=self.value(axis, time_s))
        if self.put is None:
            raise _illegal()
        self.put(unit, axis, number, time_s)
        return None


_E_SERIES_RESOLUTION = _Quantity("{value} seconds arc per position", lambda a, t: f"{a.reported_arcsec:.6f}")

_RESOLUTION = _Quantity(  # 185.142857 is reported as 185.1428
    "{value} seconds arc per {axis} position", lambda a, t: f"{math.floor(a.reported_arcsec * 1e4) / 1e4:.4f}"
)


# What follows P or T.
_QUANTITIES: Mapping[str, _Quantity] = {
    "P": _Quantity("Current {axis} position is {value}", lambda a, t: a.reported_position(t), PtuUnit.go),
    "O": _Quantity("Target {axis} position is {value}", lambda a, t: a.target, PtuUnit.go_by),
    "S": _Quantity(
        "Target {axis} speed is {value} positions/sec", lambda a, t: a.now.speed, PtuUnit.set_speed
    ),
    "U": _Quantity("Maximum {axis} speed is {value} positions/sec", lambda a, t: a.now.fastest),
    "L": _Quantity("Minimum {axis} speed is {value} positions/sec", lambda a, t: a.now.slowest),
    "A": _Quantity(
        "{axis} acceleration is {value} positions/sec^2",
        lambda a, t: a.now.acceleration,
        PtuUnit.set_acceleration,
    ),
    "N": _Quantity("Minimum {axis} position is {value}", lambda a, t: a.limits()[0]),
    "X": _Quantity("Maximum {axis} position is {value}", lambda a, t: a.limits()[1]),
    "NU": _Quantity(
        "Minimum user {axis} position is {value}",
        lambda a, t: a.user_low,
        lambda u, a, n, t: u.set_user_limit(a, 0, n),
    ),
    "XU": _Quantity(
        "Maximum user {axis} position is {value}",
        lambda a, t: a.user_high,
        lambda u, a, n, t: u.set_user_limit(a, 1, n),
    ),
}


def _switch(attribute: str, value: object) -> _Plain:
    """The command that switches a mode."""
    return lambda unit, time_s: setattr(unit, attribute, value)


# Commands that are whole words.
_PLAIN: Mapping[str, _Plain] = {
    "S": _switch("slaved", True),
    "I": lambda u, t: u.immediate(t),
    "H": lambda u, t: u.halt(t),
    "R": lambda u, t: u.reset(t),
    "CI": lambda u, t: None,
    "LE": _switch("limit_mode", "E"),
    "LU": _switch("limit_mode", "U"),
    "V": lambda u, t: u.model.version,
    "O": lambda u, t: f"Input {u.supply_v(t):.0f} VDC @ {u.temperature_c(t) * 1.8 + 32:.0f} degF",
    "EE": _switch("echo", True),
    "FV": lambda u, t: None,  # it always answers in sentences
    "DS": lambda u, t: u.save(),
}


class SimulatedPtu:
    """A unit on a line (``drivers.sim.wire.carrier.WireDevice``).

    Raises BadOptions for a model, step mode or baud rate that does not exist.
    """

    def __init__(
        self,
        model: str,
        pan: WireAxis,
        tilt: WireAxis,
        *,
        step_mode: str | None = None,
        baud: int = 9600,
    ) -> None:
        if model not in MODELS:
            raise BadOptions(f"there is no pan/tilt unit {model!r}{nearest(model, MODELS)}")
        mode = MODELS[model].step_mode if step_mode is None else step_mode
        if mode not in STEPS:
            raise BadOptions(f"step mode {mode!r} where one of {', '.join(STEPS)} is expected")
        if baud not in BAUD_RATES:
            rates = ", ".join(str(rate) for rate in BAUD_RATES)
            raise BadOptions(f"a pan/tilt unit has no baud rate {baud}; there is {rates}")
        self._unit = PtuUnit(MODELS[model], pan, tilt, mode, baud)
        self._received = bytearray()

    @property
    def pan(self) -> PtuAxis:
        """The axis P."""
        return self._unit.pan

    @property
    def tilt(self) -> PtuAxis:
        """The axis T."""
        return self._unit.tilt

    @property
    def eeprom_writes(self) -> int:
        """How often it has saved."""
        return self._unit.eeprom_writes

    @property
    def baud(self) -> int:
        """Bits a second of its serial line, now."""
        return self._unit.baud

    @property
    def banner(self) -> bytes:
        """What it says to a host that connects by TCP."""
        return BANNER if self._unit.model.e_series else b""

    def receive(self, data: bytes, time_s: float) -> Sequence[Reply]:
        """Take bytes and answer the commands that are complete; later ones wait for one that takes long."""
        self._received += data
        return self._work(time_s)

    def poll(self, time_s: float) -> Sequence[Reply]:
        """Return the answers that have become due, and !P and !T."""
        return self._work(time_s)

    def _work(self, time_s: float) -> list[Reply]:
        unit = self._unit
        sent = [Reply(f"!{letter}".encode()) for letter in unit.follow(time_s)]
        while unit.busy is None or not unit.busy(time_s):
            if unit.busy is not None:
                sent.append(self._framed("*"))
                unit.busy = None
                continue
            end = next((i for i, byte in enumerate(self._received) if byte in b" \r\n"), None)
            if end is None:
                del self._received[_LONGEST:]
                break
            command, delimiter = bytes(self._received[:end]), bytes(self._received[end : end + 1])
            del self._received[: end + 1]
            echo = command + delimiter if unit.echo else b""
            framed = self._framed(answer(unit, command, time_s)).data if command else b""
            if unit.busy is not None:
                framed = b""  # later
            if echo + framed:
                sent.append(Reply(echo + framed, ANSWER_S))
        return sent

    def _framed(self, text: str) -> Reply:
        lead = b"\n" if self._unit.model.e_series else b""
        return Reply(lead + text.encode("ascii", "replace") + b"\r\n", ANSWER_S)
