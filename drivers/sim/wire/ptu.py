"""A simulated FLIR / Directed Perception pan/tilt unit: the ASCII protocol over its two axes.

Positions are steps, so the unit's angles are as fine as its step. Pan grows to the left and tilt upwards, as
the manuals have it. A unit without encoders counts its steps and does not notice that an axis is held; here
the count always is where the motor is, so that every fault of an axis can be seen in it. Wording follows the
manuals and what drivers of real units parse; where no source gives any (C, user limits, step modes) it is
like its neighbours'. Base speed is kept and told but moves start from rest.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

from drivers.errors import BadOptions
from drivers.faults import nearest
from drivers.sim.wire.axis import WireAxis
from drivers.sim.wire.line import Reply
from drivers.sim.wire.ptu_axis import AxisDefaults, PtuAxis
from drivers.sim.wire.ptu_models import MODELS, STEPS

ANSWER_S = 0.001
"""From the end of a command to its answer (assumed)."""

RECOMPUTE_S = 1.5
"""How long a change of acceleration, base speed or upper speed takes: "several seconds" (assumed)."""

NOMINAL_V = 24.0

BANNER = b"\r\n### FLIR Motion Control Systems pan-tilt unit\r\n"
"""What an E series unit says to whoever connects by TCP (the wording differs with the firmware)."""

_LONGEST = 100  # bytes of one command; the controller's buffer (D46 manual 7.3.2)
BAUD_RATES = (600, 1200, 2400, 4800, 9600, 19200, 38400, 57600, 115200)
_BAUD_S = 0.02  # a new baud rate comes into force when the answer is through
_WORDS = re.compile(r"([A-Z]+)([+-]?\d+)?")
_STEP_NAMES = {"F": "FULL", "H": "HALF", "Q": "QUARTER", "E": "EIGHTH", "A": "AUTO"}
_POWER_NAMES = {"R": "REGULAR", "L": "LOW", "H": "HIGH", "O": "OFF"}


def _listed(values: Sequence[object]) -> str:
    return ", ".join(str(value) for value in values)


class _Refused(Exception):
    """A command that is answered by ``!`` and these words."""


class SimulatedPtu:
    """A unit on a line (``drivers.sim.wire.line.WireDevice``).

    Parameters
    ----------
    model
        A name of ``drivers.sim.wire.ptu_models.MODELS``.
    pan, tilt
        What it turns.
    step_mode
        F, H, Q, E or A; as delivered when left out.
    signs
        Whether positions of pan and tilt grow (1) or fall (-1) with the axis angle. By default pan falls:
        the unit counts to the left, the mast to the right.
    baud
        Of its serial line at first.

    Raises
    ------
    BadOptions
        For a model, step mode or baud rate that does not exist.
    """

    def __init__(
        self,
        model: str,
        pan: WireAxis,
        tilt: WireAxis,
        *,
        step_mode: str | None = None,
        signs: tuple[int, int] = (-1, 1),
        baud: int = 9600,
    ) -> None:
        if model not in MODELS:
            raise BadOptions(f"there is no pan/tilt unit {model!r}{nearest(model, MODELS)}")
        self.model = MODELS[model]
        mode = self.model.step_mode if step_mode is None else step_mode
        if mode not in STEPS:
            raise BadOptions(f"step mode {mode!r} where one of {', '.join(STEPS)} is expected")
        if baud not in BAUD_RATES:
            raise BadOptions(f"a pan/tilt unit has no baud rate {baud}; there is {_listed(BAUD_RATES)}")
        known = self.model.unsure_arcsec is None
        self.pan = PtuAxis("Pan", self.model, pan, signs[0], mode, known)
        self.tilt = PtuAxis("Tilt", self.model, tilt, signs[1], mode, known)
        self._axes: Mapping[str, PtuAxis] = {"P": self.pan, "T": self.tilt}
        self.eeprom_writes = 0
        self._saved: tuple[AxisDefaults, AxisDefaults] = (self.pan.now, self.tilt.now)
        self._baud, self._next_baud = baud, (math.inf, baud)
        self._echo = not self.model.e_series
        self._verbose = True
        self._limits = "E"
        self._slaved = False
        self._velocity = False
        self._speeds: dict[str, int] = {}  # desired speeds from before pure velocity
        self._encoder = False
        self._continuous = False
        self._at_power_up = "E"
        self._received = bytearray()
        self._waiting: tuple[Callable[[float], bool], str] | None = None  # until when, then this answer
        self._sweeping: list[PtuAxis] = []

    @property
    def baud(self) -> int:
        """Bits a second of its serial line, now."""
        return self._baud

    @property
    def banner(self) -> bytes:
        """What it says to whoever connects by TCP."""
        return BANNER if self.model.e_series else b""

    def receive(self, data: bytes, time_s: float) -> Sequence[Reply]:
        """Take bytes and answer the commands that are complete; later ones wait for one that takes long."""
        self._received += data
        return self._work(time_s)

    def poll(self, time_s: float) -> Sequence[Reply]:
        """Return the answers that have become due, and !P and !T."""
        return self._work(time_s)

    def _work(self, time_s: float) -> list[Reply]:
        if time_s >= self._next_baud[0]:
            self._baud, self._next_baud = self._next_baud[1], (math.inf, 0)
        for axis in self._axes.values():
            axis.axis.follow(time_s)
        sent = self._happened(time_s)
        while self._waiting is None or self._waiting[0](time_s):
            if self._waiting is not None:
                sent.append(self._framed(self._waiting[1]))
                self._waiting = None
                continue
            end = next((i for i, byte in enumerate(self._received) if byte in b" \r\n"), None)
            if end is None:
                del self._received[_LONGEST:]
                break
            words, delimiter = bytes(self._received[:end]), bytes(self._received[end : end + 1])
            del self._received[: end + 1]
            echo = words + delimiter if self._echo else b""
            framed = self._framed(self._answer(words, time_s)).data if words else b""
            if self._waiting is not None:
                framed = b""  # later
            if echo + framed:
                sent.append(Reply(echo + framed, ANSWER_S))
        return sent

    def _framed(self, answer: str) -> Reply:
        lead = b"\n" if self.model.e_series else b""
        return Reply(lead + answer.encode("ascii", "replace") + b"\r\n", ANSWER_S)

    def _happened(self, time_s: float) -> list[Reply]:
        """Go on with a reset, and tell limits that were hit."""
        sent: list[Reply] = []
        for letter, axis in (("T", self.tilt), ("P", self.pan)):
            note = Reply(f"!{letter}".encode())
            if self._sweeping and self._sweeping[0] is axis:
                axis.follow_reset(time_s, lambda note=note: sent.append(note))  # type: ignore[misc]
                if axis.resting(time_s):
                    self._sweeping.pop(0)
                    if self._sweeping:
                        self._sweeping[0].reset(time_s)
            if axis.at_limit(time_s):
                sent.append(note)
        return sent

    # Commands

    def _answer(self, words: bytes, time_s: float) -> str:
        """Carry out one command and return its answer, ``*`` or ``!`` and text."""
        text = words.decode("ascii", "replace").upper()
        try:
            told = self._command(text, time_s)
        except _Refused as refusal:
            return f"! {refusal}"
        return "*" if told is None else f"* {told}"

    def _command(self, text: str, time_s: float) -> str | None:
        if text.startswith("@"):
            self._set_host(text, time_s)
            return None
        if self.model.e_series and re.fullmatch(r"B[+-]?\d+(,[+-]?\d+){3}", text):
            self._position_and_speed([int(word) for word in text[1:].split(",")], time_s)
            return None
        found = _WORDS.fullmatch(text)
        if found is None:
            raise _Refused("Illegal Command Entered")
        name, number = found[1], None if found[2] is None else int(found[2])
        plain = _PLAIN.get(name)
        if plain is not None and number is None:
            return plain(self, time_s)
        axis = self._axes.get(name[0])
        numeric = _NUMERIC.get(name[1:]) if axis is not None else None
        if axis is not None and numeric is not None:
            return numeric(self, axis, number, time_s)
        if axis is not None and name[1:2] in ("H", "M") and number is None:
            return self._power(axis, name[1], name[2:])
        if name[0] == "W" and name[1:2] in self._axes and number is None:
            return self._step(self._axes[name[1]], name[2:])
        if name in ("RPS", "RTS"):
            return self._reset_speed(self._axes[name[1]], number)
        raise _Refused("Illegal Command Entered")

    def _told(self, verbose: str, value: object) -> str:
        """A query's answer: words with the value in them, or the value alone."""
        return verbose.format(value) if self._verbose else str(value)

    def _allowed(self, axis: PtuAxis) -> tuple[float, float]:
        """The positions that may be commanded."""
        if self._limits == "D" or (self._continuous and axis is self.pan):
            return -math.inf, math.inf
        return axis.limits() if self._limits == "E" else (axis.user_low, axis.user_high)

    def _goal(self, axis: PtuAxis, position: int, time_s: float) -> None:
        if self._velocity:
            raise _Refused("Illegal Command in pure velocity mode")
        low, high = self._allowed(axis)
        if position > high:
            raise _Refused(f"Maximum allowable {axis.name} position is {high}")
        if position < low:
            raise _Refused(f"Minimum allowable {axis.name} position is {low}")
        if self._slaved:
            axis.slaved = position
        else:
            axis.go(time_s, position)

    def _position(self, axis: PtuAxis, number: int | None, time_s: float) -> str | None:
        if number is None:
            return self._told(f"Current {axis.name} position is {{}}", axis.position(time_s))
        self._goal(axis, number, time_s)
        return None

    def _offset(self, axis: PtuAxis, number: int | None, time_s: float) -> str | None:
        if number is None:
            return self._told(f"Target {axis.name} position is {{}}", axis.target)
        self._goal(axis, axis.position(time_s) + number, time_s)
        return None

    def _position_and_speed(self, values: Sequence[int], time_s: float) -> None:
        axes = (self.pan, self.tilt)
        for axis, speed in zip(axes, values[2:], strict=True):
            self._check_speed(axis, speed)
        for axis, position in zip(axes, values[:2], strict=True):
            low, high = self._allowed(axis)
            if not low <= position <= high:
                self._goal(axis, position, time_s)  # which refuses
        for axis, position, speed in zip(axes, values[:2], values[2:], strict=True):
            axis.now = replace(axis.now, speed=speed)
            self._goal(axis, position, time_s)

    def _check_speed(self, axis: PtuAxis, speed: int) -> None:
        size = abs(speed) if self._velocity else speed
        if self._velocity and size == 0:
            return
        if size > axis.now.fastest:
            raise _Refused(f"{axis.name} speed cannot exceed {axis.now.fastest} positions/sec")
        if size < axis.now.slowest:
            raise _Refused(f"{axis.name} speed cannot be less than {axis.now.slowest} positions/sec")

    def _speed(self, axis: PtuAxis, number: int | None, time_s: float) -> str | None:
        if number is None:
            return self._told(f"Target {axis.name} speed is {{}} positions/sec", axis.now.speed)
        self._check_speed(axis, number)
        if self._velocity:
            axis.now = replace(axis.now, speed=number)
            self._turn(axis, time_s)
        else:
            axis.change_speed(time_s, number)
        return None

    def _speed_offset(self, axis: PtuAxis, number: int | None, time_s: float) -> str | None:
        if number is None:
            return self._told(f"Current {axis.name} speed is {{}} positions/sec", axis.speed(time_s))
        return self._speed(axis, axis.speed(time_s) + number, time_s)

    def _turn(self, axis: PtuAxis, time_s: float) -> None:
        """Pure velocity: turn until the limit."""
        low, high = self._allowed(axis)
        switches = axis.switches()
        axis.turn(time_s, axis.now.speed, round(max(low, switches[0])), round(min(high, switches[1])))

    def _upper(self, axis: PtuAxis, number: int | None, time_s: float) -> str | None:
        if number is None:
            return self._told(f"Maximum {axis.name} speed is {{}} positions/sec", axis.now.fastest)
        if number > axis.factory.fastest / STEPS[axis.mode] * STEPS[axis.factory.step_mode]:
            raise _Refused(f"{axis.name} speed cannot exceed {axis.now.fastest} positions/sec")
        if number < axis.now.slowest:
            raise _Refused(f"{axis.name} speed cannot be less than {axis.now.slowest} positions/sec")
        axis.now = replace(axis.now, fastest=number, speed=min(axis.now.speed, number))
        self._recompute(axis, time_s)
        return None

    def _lower(self, axis: PtuAxis, number: int | None, time_s: float) -> str | None:
        if number is None:
            return self._told(f"Minimum {axis.name} speed is {{}} positions/sec", axis.now.slowest)
        if number < self.model.slowest:
            raise _Refused(f"Motor speed cannot be less than {self.model.slowest} pos/sec")
        if number > axis.now.fastest:
            raise _Refused(f"{axis.name} speed cannot exceed {axis.now.fastest} positions/sec")
        axis.now = replace(axis.now, slowest=number)
        return None

    def _base(self, axis: PtuAxis, number: int | None, time_s: float) -> str | None:
        if number is None:
            return self._told(f"Current {axis.name} base speed is {{}} positions/sec", axis.now.base_speed)
        if not self.model.slowest <= number <= axis.now.fastest:
            raise _Refused(f"{axis.name} speed cannot exceed {axis.now.fastest} positions/sec")
        axis.now = replace(axis.now, base_speed=number)
        self._recompute(axis, time_s)
        return None

    def _acceleration(self, axis: PtuAxis, number: int | None, time_s: float) -> str | None:
        if number is None:
            return self._told(f"{axis.name} acceleration is {{}} positions/sec^2", axis.now.acceleration)
        if number < 1:
            raise _Refused("Illegal Command Entered")
        axis.now = replace(axis.now, acceleration=number)
        self._recompute(axis, time_s)
        return None

    def _recompute(self, axis: PtuAxis, time_s: float) -> None:
        """Hold the answer until the axis stands and the ramp is computed anew."""
        end_s = max(time_s, axis.axis.end_s()) + RECOMPUTE_S
        self._waiting = (lambda now_s: now_s >= end_s, "*")

    def _resolution(self, axis: PtuAxis, number: int | None, time_s: float) -> str | None:
        if number is not None:
            raise _Refused("Illegal Command Entered")
        if self.model.e_series:
            return self._told("{} seconds arc per position", f"{axis.told_arcsec:.6f}")
        cut = math.floor(axis.told_arcsec * 1e4) / 1e4  # 185.142857 is told as 185.1428
        return self._told(f"{{}} seconds arc per {axis.name} position", f"{cut:.4f}")

    def _limit(self, axis: PtuAxis, number: int | None, end: int) -> str:
        if number is not None:
            raise _Refused("Illegal Command Entered")
        word = ("Minimum", "Maximum")[end]
        return self._told(f"{word} {axis.name} position is {{}}", axis.limits()[end])

    def _user_limit(self, axis: PtuAxis, number: int | None, end: int) -> str | None:
        word = ("Minimum", "Maximum")[end]
        if number is None:
            value = (axis.user_low, axis.user_high)[end]
            return self._told(f"{word} user {axis.name} position is {{}}", value)
        low, high = axis.limits()
        if number > high:
            raise _Refused(f"Maximum allowable {axis.name} position is {high}")
        if number < low:
            raise _Refused(f"Minimum allowable {axis.name} position is {low}")
        user = (number, axis.user_high) if end == 0 else (axis.user_low, number)
        if user[0] > user[1]:
            raise _Refused(f"{word} user {axis.name} position is beyond the other one")
        axis.user_low, axis.user_high = user
        return None

    def _power(self, axis: PtuAxis, kind: str, level: str) -> str | None:
        held = kind == "H"
        if level == "":
            name = _POWER_NAMES[axis.now.hold if held else axis.now.move]
            words = f"{axis.name} in {{}} {'hold' if held else 'move'} power mode"
            return self._told(words, name)
        if level not in (("R", "L", "O") if held else ("R", "L", "H", "O")):
            raise _Refused("Illegal Command Entered")
        axis.now = replace(axis.now, hold=level) if held else replace(axis.now, move=level)
        return None

    def _step(self, axis: PtuAxis, mode: str) -> str | None:
        if mode == "":
            return self._told(f"{axis.name} in {{}} step mode", _STEP_NAMES[axis.now.step_mode])
        if mode not in STEPS:
            raise _Refused("Illegal Command Entered")
        axis.now = replace(axis.now, step_mode=mode)  # in force after the axis has been reset
        return None

    def _reset_speed(self, axis: PtuAxis, number: int | None) -> str | None:
        if number is None:
            return self._told(f"{axis.name} reset speed is {{}} positions/sec", axis.now.reset_speed)
        self._check_speed(axis, number)
        axis.now = replace(axis.now, reset_speed=number)
        return None

    def _reset(self, axes: Sequence[PtuAxis], time_s: float) -> None:
        self._control(False, time_s)
        for axis in axes:
            axis.halt(time_s)
        self._sweeping = list(axes)
        axes[0].reset(time_s)
        self._waiting = (lambda now_s: not self._sweeping, "*")

    def _immediate(self, time_s: float) -> None:
        """I: slaved mode is over, and what was slaved starts (D46 manual, slaved execution mode)."""
        self._slaved = False
        self._start_slaved(time_s)

    def _start_slaved(self, time_s: float) -> None:
        for axis in self._axes.values():
            if axis.slaved is not None:
                axis.go(time_s, axis.slaved)
                axis.slaved = None

    def _await(self, time_s: float) -> None:
        """A: start what is slaved, and answer when both axes stand."""
        self._start_slaved(time_s)
        self._waiting = (lambda now_s: self.pan.resting(now_s) and self.tilt.resting(now_s), "*")

    def _halt(self, axes: Sequence[PtuAxis], time_s: float) -> None:
        for axis in axes:
            axis.halt(time_s)
            if self._velocity:
                axis.now = replace(axis.now, speed=0)

    def _control(self, velocity: bool, time_s: float) -> None:
        """CV, CI: either way the axes stop; pure velocity begins with none."""
        if velocity == self._velocity:
            return
        self._velocity = velocity
        for axis in self._axes.values():
            axis.halt(time_s)
            if velocity:
                self._speeds[axis.name] = axis.now.speed
            axis.now = replace(axis.now, speed=0 if velocity else self._speeds[axis.name])

    def _keep(self, what: str) -> None:
        """DS saves, DR restores, DF brings back the factory's."""
        pan, tilt = self.pan, self.tilt
        if what == "S":
            self._saved = (pan.now, tilt.now)
            self.eeprom_writes += 1
        else:
            kept = self._saved if what == "R" else (pan.factory, tilt.factory)
            pan.now, tilt.now = kept

    def _set_host(self, text: str, time_s: float) -> None:
        found = re.fullmatch(r"@\((\d+),(\d+),([TF])\)", text)
        if found is None or int(found[1]) not in BAUD_RATES:
            raise _Refused("Illegal Command Entered")
        self._next_baud = (time_s + _BAUD_S, int(found[1]))

    def _supply(self, time_s: float) -> str:
        """O: volts, and the temperature of the hotter axis."""
        volts = NOMINAL_V * min(axis.axis.supply(time_s) for axis in self._axes.values())
        hot_c = max(axis.axis.temperature_c(time_s) for axis in self._axes.values())
        return f"Input {volts:.0f} VDC @ {hot_c * 1.8 + 32:.0f} degF"

    def _set(self, attribute: str, value: object) -> None:
        """Switch a mode."""
        setattr(self, attribute, value)

    def _limit_mode(self) -> str:
        words = {
            "E": "Limit bounds are ENABLED (soft limits enabled)",
            "D": "Limit bounds are DISABLED (hard limits only: use care)",
            "U": "Limit bounds are USER DEFINED (user limits enabled)",
        }
        return words[self._limits]

    def _e_series(self, attribute: str, value: object) -> None:
        """Switch a mode that only E series units have."""
        if not self.model.e_series:
            raise _Refused("Illegal Command Entered")
        setattr(self, attribute, value)


_Plain = Callable[[SimulatedPtu, float], str | None]
_Numeric = Callable[[SimulatedPtu, PtuAxis, int | None, float], str | None]

# Commands that are whole words.
_PLAIN: Mapping[str, _Plain] = {
    "A": lambda u, t: u._await(t),
    "S": lambda u, t: u._set("_slaved", True),
    "I": lambda u, t: u._immediate(t),
    "H": lambda u, t: u._halt((u.pan, u.tilt), t),
    "HP": lambda u, t: u._halt((u.pan,), t),
    "HT": lambda u, t: u._halt((u.tilt,), t),
    "R": lambda u, t: u._reset((u.tilt, u.pan), t),
    "RP": lambda u, t: u._reset((u.pan,), t),
    "RT": lambda u, t: u._reset((u.tilt,), t),
    "RE": lambda u, t: u._set("_at_power_up", "E"),
    "RD": lambda u, t: u._set("_at_power_up", "D"),
    "C": lambda u, t: f"PTU is in {'pure velocity' if u._velocity else 'independent'} control mode",
    "CI": lambda u, t: u._control(False, t),
    "CV": lambda u, t: u._control(True, t),
    "CEC": lambda u, t: u._e_series("_encoder", True),
    "CED": lambda u, t: u._e_series("_encoder", False),
    "PCE": lambda u, t: u._e_series("_continuous", True),
    "PCD": lambda u, t: u._e_series("_continuous", False),
    "L": lambda u, t: u._limit_mode(),
    "LE": lambda u, t: u._set("_limits", "E"),
    "LD": lambda u, t: u._set("_limits", "D"),
    "LU": lambda u, t: u._set("_limits", "U"),
    "V": lambda u, t: u.model.version,
    "O": lambda u, t: u._supply(t),
    "E": lambda u, t: f"Echoing {'ON' if u._echo else 'OFF'}",
    "EE": lambda u, t: u._set("_echo", True),
    "ED": lambda u, t: u._set("_echo", False),
    "F": lambda u, t: f"ASCII {'verbose' if u._verbose else 'terse'} mode",
    "FV": lambda u, t: u._set("_verbose", True),
    "FT": lambda u, t: u._set("_verbose", False),
    "DS": lambda u, t: u._keep("S"),
    "DR": lambda u, t: u._keep("R"),
    "DF": lambda u, t: u._keep("F"),
    "U": lambda u, t: u._told("Unit ID is {}", 0),
}

# What follows P or T; without a number a query.
_NUMERIC: Mapping[str, _Numeric] = {
    "P": SimulatedPtu._position,
    "O": SimulatedPtu._offset,
    "S": SimulatedPtu._speed,
    "D": SimulatedPtu._speed_offset,
    "U": SimulatedPtu._upper,
    "L": SimulatedPtu._lower,
    "B": SimulatedPtu._base,
    "A": SimulatedPtu._acceleration,
    "R": SimulatedPtu._resolution,
    "N": lambda u, a, n, t: u._limit(a, n, 0),
    "X": lambda u, a, n, t: u._limit(a, n, 1),
    "NU": lambda u, a, n, t: u._user_limit(a, n, 0),
    "XU": lambda u, a, n, t: u._user_limit(a, n, 1),
}
