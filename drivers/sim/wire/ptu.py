"""A simulated FLIR / Directed Perception pan/tilt unit on a line: its ASCII protocol, byte by byte.

Pan grows to the left and tilt upwards, as the manuals have it. Wording follows the manuals and what drivers
of real units parse; where no source gives any (user limits, step modes) it is like its neighbours'. Only the
commands that drivers need are known; others are refused as illegal.
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
from drivers.sim.wire.ptu_axis import MODELS, STEPS, PtuAxis

BAUD_RATES = (600, 1200, 2400, 4800, 9600, 19200, 38400, 57600, 115200)
_COMMAND = re.compile(r"([A-Z]+)([+-]?\d+)?")
_STEP_NAMES = {"F": "FULL", "H": "HALF", "Q": "QUARTER", "E": "EIGHTH", "A": "AUTO"}

ANSWER_S = 0.001
"""From the end of a command to its answer (assumed)."""

RECOMPUTE_S = 1.5
"""How long a change of acceleration takes: "several seconds" (assumed)."""

NOMINAL_V = 24.0

BANNER = b"\r\n### FLIR Motion Control Systems pan-tilt unit\r\n"
"""What an E series unit says to a host that connects by TCP (the wording differs with the firmware)."""

_LONGEST = 100  # bytes of one command; the controller's buffer (D46 manual 7.3.2)
_ILLEGAL = "Illegal Command Entered"


class CommandRefused(Exception):
    """What the unit does not do, with the text that it answers behind the ``!``."""


class SimulatedPtu:
    """A unit on a line (``drivers.sim.wire.carrier.WireDevice``).

    Raises BadOptions for a model, step mode or baud rate that does not exist.
    """

    def __init__(
        self, model: str, pan: WireAxis, tilt: WireAxis, *, step_mode: str | None = None, baud: int = 9600
    ) -> None:
        if model not in MODELS:
            raise BadOptions(f"there is no pan/tilt unit {model!r}{nearest(model, MODELS)}")
        self.model = MODELS[model]
        mode = self.model.step_mode if step_mode is None else step_mode
        if mode not in STEPS:
            raise BadOptions(f"step mode {mode!r} where one of {', '.join(STEPS)} is expected")
        if baud not in BAUD_RATES:
            rates = ", ".join(str(rate) for rate in BAUD_RATES)
            raise BadOptions(f"a pan/tilt unit has no baud rate {baud}; there is {rates}")
        self.baud = baud
        self.pan = PtuAxis("Pan", self.model, pan, -1, mode)  # the unit counts to the left
        self.tilt = PtuAxis("Tilt", self.model, tilt, 1, mode)
        self.axes: Mapping[str, PtuAxis] = {"P": self.pan, "T": self.tilt}
        self.banner = BANNER if self.model.e_series else b""
        self.echo = not self.model.e_series
        self.limit_mode = "E"  # the factory's limits; U: the user's
        self.slaved = False
        self.eeprom_writes = 0
        # whether the last command is not through yet, by the time; meanwhile nothing is answered
        self._busy: Callable[[float], bool] | None = None
        self._sweeping: list[PtuAxis] = []
        self._received = bytearray()

    # Bytes

    def receive(self, data: bytes, time_s: float) -> Sequence[Reply]:
        """Take bytes and answer the commands that are complete; later ones wait for one that takes long."""
        self._received += data
        return self.poll(time_s)

    def poll(self, time_s: float) -> Sequence[Reply]:
        """Return the answers that have become due, and !P and !T of an axis that has hit a limit."""
        sent = [Reply(f"!{letter}".encode()) for letter in self._follow(time_s)]
        while self._busy is None or not self._busy(time_s):
            if self._busy is not None:
                sent.append(Reply(self._framed("*"), ANSWER_S))
                self._busy = None
                continue
            end = next((i for i, byte in enumerate(self._received) if byte in b" \r\n"), None)
            if end is None:
                del self._received[_LONGEST:]
                break
            command, delimiter = bytes(self._received[:end]), bytes(self._received[end : end + 1])
            del self._received[: end + 1]
            echo = command + delimiter if self.echo else b""
            framed = self._framed(self._answer(command, time_s)) if command else b""
            if self._busy is not None:
                framed = b""  # later
            if echo + framed:
                sent.append(Reply(echo + framed, ANSWER_S))
        return sent

    def _framed(self, text: str) -> bytes:
        lead = b"\n" if self.model.e_series else b""
        return lead + text.encode("ascii", "replace") + b"\r\n"

    def _answer(self, command: bytes, time_s: float) -> str:
        """Carry out one command and return its answer, ``*`` or ``!`` and text."""
        try:
            text = self._carry_out(command.decode("ascii", "replace").upper(), time_s)
        except CommandRefused as refusal:
            return f"! {refusal}"
        return "*" if text is None else f"* {text}"

    def _carry_out(self, command: str, time_s: float) -> str | None:
        """One command's text behind the ``*``, if it has any. Raises CommandRefused."""
        found = _COMMAND.fullmatch(command)
        if found is None:
            raise CommandRefused(_ILLEGAL)
        name, number = found[1], None if found[2] is None else int(found[2])
        if name in _PLAIN and number is None:
            return _PLAIN[name](self, time_s)
        if name[0] in self.axes and name[1:] in _QUANTITIES:
            axis, quantity = self.axes[name[0]], _QUANTITIES[name[1:]]
            if number is None:
                return quantity.sentence.format(axis=axis.name, value=quantity.value(axis, time_s))
            if quantity.put is not None:
                quantity.put(self, axis, number, time_s)
                return None
        elif name in ("PR", "TR") and number is None:
            axis = self.axes[name[0]]
            if self.model.e_series:
                return f"{axis.reported_arcsec:.6f} seconds arc per position"
            arcsec = math.floor(axis.reported_arcsec * 1e4) / 1e4  # 185.142857 is reported as 185.1428
            return f"{arcsec:.4f} seconds arc per {axis.name} position"
        elif name in ("WP", "WT") and number is None:
            axis = self.axes[name[1]]
            return f"{axis.name} in {_STEP_NAMES[axis.mode]} step mode"
        raise CommandRefused(_ILLEGAL)

    # What the commands do

    def _follow(self, time_s: float) -> list[str]:
        """Go on until a moment; return the letters of the axes that have hit a limit, in order."""
        for axis in self.axes.values():
            axis.axis.follow(time_s)
        hits: list[str] = []
        for letter, axis in (("T", self.tilt), ("P", self.pan)):
            if self._sweeping and self._sweeping[0] is axis:
                if axis.follow_reset(time_s):
                    hits.append(letter)
                if axis.resting(time_s):
                    self._sweeping.pop(0)
                    if self._sweeping:
                        self._sweeping[0].reset(time_s)
            if axis.at_limit(time_s):
                hits.append(letter)
        return hits

    def go(self, axis: PtuAxis, position: int, time_s: float) -> None:
        """Start towards a position, or keep it until slaved mode ends."""
        _check_position(
            axis, position, axis.limits() if self.limit_mode == "E" else (axis.user_low, axis.user_high)
        )
        if self.slaved:
            axis.slaved = position
        else:
            axis.go(time_s, position)

    def set_user_limit(self, axis: PtuAxis, end: int, position: int) -> None:
        """Set the lower (``end`` 0) or upper (1) user limit."""
        _check_position(axis, position, axis.limits())
        low, high = (position, axis.user_high) if end == 0 else (axis.user_low, position)
        if low > high:
            which = ("Minimum", "Maximum")[end]
            raise CommandRefused(f"{which} user {axis.name} position is beyond the other one")
        axis.user_low, axis.user_high = low, high

    def set_speed(self, axis: PtuAxis, speed: int, time_s: float) -> None:
        """Set the desired speed, positions a second."""
        if speed > axis.fastest:
            raise CommandRefused(f"{axis.name} speed cannot exceed {axis.fastest} positions/sec")
        if speed < axis.slowest:
            raise CommandRefused(f"{axis.name} speed cannot be less than {axis.slowest} positions/sec")
        axis.change_speed(time_s, speed)

    def set_acceleration(self, axis: PtuAxis, acceleration: int, time_s: float) -> None:
        """Set the acceleration, positions/s²; busy until the axis stands and the ramp is computed anew."""
        if acceleration < 1:
            raise CommandRefused(_ILLEGAL)
        axis.acceleration = acceleration
        end_s = max(time_s, axis.axis.end_s()) + RECOMPUTE_S
        self._busy = lambda now_s: now_s < end_s

    def reset(self, time_s: float) -> None:
        """R: find the limits again, tilt first; busy until it is done."""
        self.halt(time_s)
        self._sweeping = [self.tilt, self.pan]
        self.tilt.reset(time_s)
        self._busy = lambda now_s: bool(self._sweeping)

    def immediate(self, time_s: float) -> None:
        """I: slaved mode is over, and what was slaved starts (D46 manual, slaved execution mode)."""
        self.slaved = False
        for axis in self.axes.values():
            if axis.slaved is not None:
                axis.go(time_s, axis.slaved)
                axis.slaved = None

    def halt(self, time_s: float) -> None:
        """H: brake and stay."""
        for axis in self.axes.values():
            axis.halt(time_s)

    def supply(self, time_s: float) -> str:
        """O: the supply, and the temperature of the hotter axis."""
        volts = NOMINAL_V * min(axis.axis.supply(time_s) for axis in self.axes.values())
        hottest_c = max(axis.axis.temperature_c(time_s) for axis in self.axes.values())
        return f"Input {volts:.0f} VDC @ {hottest_c * 1.8 + 32:.0f} degF"


def _check_position(axis: PtuAxis, position: int, limits: tuple[float, float]) -> None:
    low, high = limits
    if position > high:
        raise CommandRefused(f"Maximum allowable {axis.name} position is {high}")
    if position < low:
        raise CommandRefused(f"Minimum allowable {axis.name} position is {low}")


@dataclass(frozen=True)
class _Quantity:
    """A quantity of an axis: reported without a number, set with one, unless it can only be read."""

    sentence: str
    value: Callable[[PtuAxis, float], object]
    put: Callable[[SimulatedPtu, PtuAxis, int, float], None] | None = None


# What follows P or T.
_QUANTITIES: Mapping[str, _Quantity] = {
    "P": _Quantity("Current {axis} position is {value}", PtuAxis.reported_position, SimulatedPtu.go),
    "O": _Quantity(
        "Target {axis} position is {value}",
        lambda a, t: a.target,
        lambda u, a, n, t: u.go(a, a.position(t) + n, t),
    ),
    "S": _Quantity(
        "Target {axis} speed is {value} positions/sec", lambda a, t: a.speed, SimulatedPtu.set_speed
    ),
    "U": _Quantity("Maximum {axis} speed is {value} positions/sec", lambda a, t: a.fastest),
    "L": _Quantity("Minimum {axis} speed is {value} positions/sec", lambda a, t: a.slowest),
    "A": _Quantity(
        "{axis} acceleration is {value} positions/sec^2",
        lambda a, t: a.acceleration,
        SimulatedPtu.set_acceleration,
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


def _switch(attribute: str, value: object) -> Callable[[SimulatedPtu, float], str | None]:
    """The command that switches a mode."""
    return lambda unit, time_s: setattr(unit, attribute, value)


def _save(unit: SimulatedPtu, time_s: float) -> None:
    """Wear the EEPROM."""
    unit.eeprom_writes += 1


# Commands without a number.
_PLAIN: Mapping[str, Callable[[SimulatedPtu, float], str | None]] = {
    "S": _switch("slaved", True),
    "I": SimulatedPtu.immediate,
    "H": SimulatedPtu.halt,
    "R": SimulatedPtu.reset,
    "CI": lambda u, t: None,
    "LE": _switch("limit_mode", "E"),
    "LU": _switch("limit_mode", "U"),
    "V": lambda u, t: u.model.version,
    "O": SimulatedPtu.supply,
    "EE": _switch("echo", True),
    "FV": lambda u, t: None,  # it always answers in sentences
    "DS": _save,
}
