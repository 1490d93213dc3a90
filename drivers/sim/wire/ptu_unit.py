"""What a simulated pan/tilt unit is and does: models, two axes, modes, limits and memory. No bytes.

Positions are steps, so the unit's angles are as fine as its step. Pan grows to the left and tilt upwards, as
the manuals have it. A unit without encoders counts its steps and does not notice that an axis is seized; here
the count always is where the motor is, so that every fault of an axis can be seen in it.

The table of models is in half steps, the manuals' own unit. Sources: PTU-D46 User's Manual 2.14.0 (D46-17:
resolution, limits, speed bounds, defaults), PTU-D300 User's Manual 2.18.0, E Series Command Reference 4.00;
D46-70 from its quarter of the D46-17's step (the marketed 0.003° is its eighth step); D48E from its eighth
step of 23.142857", of which 27067 make 174°. Where a manual gives no figure for a model, the D46-17's is
scaled by the step, and the tilt range of the -70 units and of the E46 is -80° to +31°.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import Literal

from drivers.sim.axis import WireAxis

STEPS = MappingProxyType({"F": 2.0, "H": 1.0, "Q": 0.5, "E": 0.25, "A": 0.25})
"""Step modes and their step in half steps: full, half, quarter, eighth, auto (counted in eighths)."""

_D46 = "Pan-Tilt Controller v2.12.1d1(C14/E), (C)2003 Directed Perception, Inc., All Rights Reserved"
_D47 = "Pan-Tilt Controller v2.14.0(D47-C14/E), (C)2006 Directed Perception, Inc., All Rights Reserved"
_D48 = "Pan-Tilt Controller v3.2.2(D48-C14/E), (C)2010 FLIR Commercial Systems, Inc., All Rights Reserved"
_E46 = "Pan-Tilt Controller v3.2.2(E46-C14/E), (C)2011 FLIR Commercial Systems, Inc., All Rights Reserved"

# 185.142857" is 1296/7": 2000 half steps to 102.857°.
_STEP_17, _STEP_70, _STEP_48 = 1296 / 7, 324 / 7, 648 / 7
_17 = {"half_step_arcsec": _STEP_17, "pan": (-3090, 3090), "tilt": (-907, 604), "fastest": 2902}
_70 = {
    "half_step_arcsec": _STEP_70,
    "pan": (-12366, 12366),
    "tilt": (-6222, 2411),
    "fastest": 5600,
    "speed": 4000,
    "acceleration": 8000,
}

ARCSEC_RAD = math.radians(1 / 3600)

RECOMPUTE_S = 1.5
"""How long a change of acceleration, base speed or upper speed takes: "several seconds" (assumed)."""

NOMINAL_V = 24.0

SWITCH_STEPS = 20
"""How far beyond the factory limits the limit switches are, half steps (assumed)."""


@dataclass(frozen=True)
class PtuModel:
    """One kind of unit; positions and speeds in half steps.

    Attributes
    ----------
    half_step_arcsec
        One half step of either axis, arc seconds.
    e_series
        Answers as an E series unit: a line feed in front of every answer, no echo at power-up, six decimals,
        and the banner over TCP.
    unsure_arcsec
        What it takes for its half step before its first reset; None when it knows.
    """

    version: str
    half_step_arcsec: float
    pan: tuple[int, int]
    tilt: tuple[int, int]
    fastest: int
    slowest: int = 31
    speed: int = 1000
    acceleration: int = 2000
    step_mode: str = "H"
    e_series: bool = False
    unsure_arcsec: float | None = None


MODELS: Mapping[str, PtuModel] = MappingProxyType(
    {
        "d46_17": PtuModel(_D46, **_17),  # type: ignore[arg-type]
        "d46_70": PtuModel(_D46, **_70),  # type: ignore[arg-type]
        "d47": PtuModel(_D47, **_17),  # type: ignore[arg-type]
        "d48e": PtuModel(
            _D48,
            _STEP_48,
            pan=(-6767, 6767),
            tilt=(-3500, 1166),
            fastest=3800,
            speed=2000,
            acceleration=4000,
            step_mode="E",
            e_series=True,
        ),
        "e46_17": PtuModel(_E46, **_17, e_series=True, unsure_arcsec=_STEP_17),  # type: ignore[arg-type]
        "e46_70": PtuModel(_E46, **_70, e_series=True, unsure_arcsec=_STEP_17),  # type: ignore[arg-type]
    }
)
"""Units by name."""


@dataclass(frozen=True)
class AxisPace:
    """Speeds of an axis, positions a second, and its acceleration, positions a second squared."""

    speed: int
    acceleration: int
    fastest: int
    slowest: int


class PtuAxis:
    """Pan or tilt.

    Parameters
    ----------
    sign
        1 or -1: whether positions grow with the axis angle.
    known
        Whether the unit knows its own gear ratio without a reset.
    """

    def __init__(
        self,
        name: Literal["Pan", "Tilt"],
        model: PtuModel,
        axis: WireAxis,
        sign: int,
        step_mode: str,
        known: bool,
    ) -> None:
        self.name = name
        self.axis = axis
        self._model = model
        self._sign = sign
        self._range = model.pan if name == "Pan" else model.tilt
        self.known = known
        self.mode = step_mode
        scale = 1 / STEPS[step_mode]
        self._reset_speed = round(model.speed * scale)
        self.now = AxisPace(
            speed=self._reset_speed,
            acceleration=round(model.acceleration * scale),
            fastest=round(model.fastest * scale),
            slowest=model.slowest,
        )
        self.user_low, self.user_high = self.limits()
        self.target = 0
        self.slaved: int | None = None
        self.limit_reported = True  # whether the limit where it stands has been reported by !P or !T
        self._sweep: list[int] = []

    @property
    def step_rad(self) -> float:
        """One position as it is, radians."""
        return self._model.half_step_arcsec * STEPS[self.mode] * ARCSEC_RAD

    @property
    def reported_arcsec(self) -> float:
        """One position as PR and TR report it, arc seconds."""
        half = self._model.half_step_arcsec
        if not self.known and self._model.unsure_arcsec is not None:
            half = self._model.unsure_arcsec
        return half * STEPS[self.mode]

    def limits(self) -> tuple[int, int]:
        """Return the factory limits, positions."""
        scale = 1 / STEPS[self.mode]
        low, high = self._range
        return math.ceil(low * scale), math.floor(high * scale)

    def switches(self) -> tuple[int, int]:
        """Return where the limit switches stop the axis, positions."""
        low, high = self.limits()
        margin = round(SWITCH_STEPS / STEPS[self.mode])
        return low - margin, high + margin

    def angle_rad(self, position: float) -> float:
        """Return the angle of the axis at a position."""
        return self._sign * position * self.step_rad

    def position(self, time_s: float) -> int:
        """Return where the unit believes the axis to be."""
        return round(self._sign * self.axis.angle_rad(time_s) / self.step_rad)

    def reported_position(self, time_s: float) -> int | str:
        """Return the position as the unit reports it."""
        return "nan" if self.axis.no_number(time_s) else self.position(time_s)

    def resting(self, time_s: float) -> bool:
        """Return whether it stands, and no part of a reset is left."""
        return not self._sweep and not self.axis.under_way(time_s)

    def go(self, time_s: float, position: int, speed: int | None = None) -> None:
        """Start towards a position; the limit switches stop it."""
        self.target = position
        low, high = self.switches()
        stop = max(low, min(high, position))
        self.limit_reported = low <= position <= high
        self._drive(time_s, stop, self.now.speed if speed is None else speed)

    def change_speed(self, time_s: float, speed: int) -> None:
        """Take another speed, also under way."""
        self.now = replace(self.now, speed=speed)
        if self.axis.under_way(time_s) and not self._sweep:
            low, high = self.switches()
            self._drive(time_s, max(low, min(high, self.target)), speed)

    def halt(self, time_s: float) -> None:
        """Brake and hold."""
        self._sweep = []
        self.slaved = None
        self.limit_reported = True
        self.axis.halt(time_s, self.now.acceleration * self.step_rad)
        self.target = round(self._sign * self.axis.rest_rad() / self.step_rad)

    def reset(self, time_s: float) -> None:
        """Find both limits again, then go to zero."""
        low, high = self.limits()
        self._sweep = [low, high, 0]
        self.slaved = None
        self.limit_reported = True
        self._drive(time_s, low, self._reset_speed)

    def follow_reset(self, time_s: float, hit: Callable[[], None]) -> None:
        """Go on with a reset when a limit is reached; ``hit`` is called for each."""
        if not self._sweep or self.axis.under_way(time_s) or self.axis.blocked(time_s):
            return
        reached = self._sweep.pop(0)
        if self._sweep:
            hit()
            self._drive(time_s, self._sweep[0], self._reset_speed)
        else:
            self.known = True
            self.target = reached
            self.user_low, self.user_high = self.limits()

    def at_limit(self, time_s: float) -> bool:
        """Return once that the axis has come to rest at a limit that it was not meant to stop at."""
        if self.limit_reported or self._sweep or self.axis.under_way(time_s) or self.axis.blocked(time_s):
            return False
        self.limit_reported = True
        return True

    def _drive(self, time_s: float, position: int, speed: int) -> None:
        step = self.step_rad
        self.axis.goal(time_s, self.angle_rad(position), max(1, speed) * step, self.now.acceleration * step)


class CommandRefused(Exception):
    """What the unit does not do, with the text that it answers behind the ``!``."""


class PtuUnit:
    """A unit.

    Attributes
    ----------
    limit_mode
        E or U: the factory's limits, the user's.
    busy
        Whether the last command is not through yet, as a function of the time that tells when it is; None if
        nothing is under way. Meanwhile the unit answers nothing.
    """

    def __init__(
        self,
        model: PtuModel,
        pan: WireAxis,
        tilt: WireAxis,
        step_mode: str,
        baud: int,
    ) -> None:
        self.model = model
        known = model.unsure_arcsec is None
        self.pan = PtuAxis("Pan", model, pan, -1, step_mode, known)  # the unit counts to the left
        self.tilt = PtuAxis("Tilt", model, tilt, 1, step_mode, known)
        self.axes: Mapping[str, PtuAxis] = {"P": self.pan, "T": self.tilt}
        self.echo = not model.e_series
        self.limit_mode = "E"
        self.slaved = False
        self.busy: Callable[[float], bool] | None = None
        self.eeprom_writes = 0
        self.baud = baud
        self._sweeping: list[PtuAxis] = []

    def follow(self, time_s: float) -> list[str]:
        """Go on until a moment; return the letters of the axes that have hit a limit, in order."""
        for axis in self.axes.values():
            axis.axis.follow(time_s)
        hits: list[str] = []
        for letter, axis in (("T", self.tilt), ("P", self.pan)):
            if self._sweeping and self._sweeping[0] is axis:
                axis.follow_reset(time_s, lambda letter=letter: hits.append(letter))  # type: ignore[misc]
                if axis.resting(time_s):
                    self._sweeping.pop(0)
                    if self._sweeping:
                        self._sweeping[0].reset(time_s)
            if axis.at_limit(time_s):
                hits.append(letter)
        return hits

    # Positions

    def allowed(self, axis: PtuAxis) -> tuple[float, float]:
        """Return the positions that may be commanded."""
        return axis.limits() if self.limit_mode == "E" else (axis.user_low, axis.user_high)

    def go(self, axis: PtuAxis, position: int, time_s: float) -> None:
        """Start towards a position, or keep it until slaved mode ends. Raises Refused."""
        _check_position(axis, position, self.allowed(axis))
        if self.slaved:
            axis.slaved = position
        else:
            axis.go(time_s, position)

    def go_by(self, axis: PtuAxis, offset: int, time_s: float) -> None:
        """Start towards a position so far from here. Raises Refused."""
        self.go(axis, axis.position(time_s) + offset, time_s)

    def set_user_limit(self, axis: PtuAxis, end: int, position: int) -> None:
        """Set the lower (``end`` 0) or upper (1) user limit. Raises Refused."""
        _check_position(axis, position, axis.limits())
        user = (position, axis.user_high) if end == 0 else (axis.user_low, position)
        if user[0] > user[1]:
            word = ("Minimum", "Maximum")[end]
            raise CommandRefused(f"{word} user {axis.name} position is beyond the other one")
        axis.user_low, axis.user_high = user

    # Speeds

    def set_speed(self, axis: PtuAxis, speed: int, time_s: float) -> None:
        """Set the desired speed. Raises Refused."""
        if speed > axis.now.fastest:
            raise _too_fast(axis)
        if speed < axis.now.slowest:
            raise CommandRefused(f"{axis.name} speed cannot be less than {axis.now.slowest} positions/sec")
        axis.change_speed(time_s, speed)

    def set_acceleration(self, axis: PtuAxis, acceleration: int, time_s: float) -> None:
        """Set the acceleration. Raises Refused."""
        if acceleration < 1:
            raise CommandRefused("Illegal Command Entered")
        axis.now = replace(axis.now, acceleration=acceleration)
        self._recompute(axis, time_s)

    def _recompute(self, axis: PtuAxis, time_s: float) -> None:
        """Be busy until the axis stands and the ramp is computed anew."""
        end_s = max(time_s, axis.axis.end_s()) + RECOMPUTE_S
        self.busy = lambda now_s: now_s < end_s

    # Execution

    def reset(self, time_s: float) -> None:
        """R: find the limits again, tilt first; busy until it is done."""
        self.halt(time_s)
        self._sweeping = [self.tilt, self.pan]
        self.tilt.reset(time_s)
        self.busy = lambda now_s: bool(self._sweeping)

    def immediate(self, time_s: float) -> None:
        """I: slaved mode is over, and what was slaved starts (D46 manual, slaved execution mode)."""
        self.slaved = False
        for axis in self.axes.values():
            if axis.slaved is not None:
                axis.go(time_s, axis.slaved)
                axis.slaved = None

    def halt(self, time_s: float) -> None:
        """H: brake and hold."""
        for axis in self.axes.values():
            axis.halt(time_s)

    def save(self) -> None:
        """DS: wear the EEPROM."""
        self.eeprom_writes += 1

    def supply_v(self, time_s: float) -> float:
        """Return the supply, volts."""
        return NOMINAL_V * min(axis.axis.supply(time_s) for axis in self.axes.values())

    def temperature_c(self, time_s: float) -> float:
        """Return the temperature of the hotter axis, °C."""
        return max(axis.axis.temperature_c(time_s) for axis in self.axes.values())


def _check_position(axis: PtuAxis, position: int, limits: tuple[float, float]) -> None:
    low, high = limits
    if position > high:
        raise CommandRefused(f"Maximum allowable {axis.name} position is {high}")
    if position < low:
        raise CommandRefused(f"Minimum allowable {axis.name} position is {low}")


def _too_fast(axis: PtuAxis) -> CommandRefused:
    return CommandRefused(f"{axis.name} speed cannot exceed {axis.now.fastest} positions/sec")
