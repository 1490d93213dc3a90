"""What the simulated pan/tilt units are made of, and one axis of one: its positions, limits and speeds.

Positions are steps, so the unit's angles are as fine as its step. A unit without encoders counts its steps
and does not notice that an axis is seized; here the count always is where the motor is, so that every fault
of an axis can be seen in it.

The table of models is in half steps, the manuals' own unit. Sources: PTU-D46 User's Manual 2.14.0 (D46-17:
resolution, limits, speed bounds, defaults), PTU-D300 User's Manual 2.18.0, E Series Command Reference 4.00;
D46-70 from its quarter of the D46-17's step (the marketed 0.003° is its eighth step); D48E from its eighth
step of 23.142857", of which 27067 make 174°. Where a manual gives no figure for a model, the D46-17's is
scaled by the step, and the tilt range of the -70 units and of the E46 is -80° to +31°.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
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

SWITCH_STEPS = 20
"""How far beyond the factory limits the limit switches are, half steps (assumed)."""


@dataclass(frozen=True)
class PtuModel:
    """One kind of unit; positions, speeds (a second) and accelerations in half steps.

    An ``e_series`` unit has a line feed in front of every answer, no echo at power-up, six decimals, and the
    banner over TCP. ``unsure_arcsec`` is the half step that it assumes before its first reset; None when it
    knows.
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


class PtuAxis:
    """Pan or tilt; ``sign`` is 1 or -1: whether positions grow with the axis angle."""

    def __init__(
        self,
        name: Literal["Pan", "Tilt"],
        model: PtuModel,
        axis: WireAxis,
        sign: int,
        step_mode: str,
    ) -> None:
        self.name = name
        self.axis = axis
        self._model = model
        self._sign = sign
        self._range = model.pan if name == "Pan" else model.tilt
        self._knows_step = model.unsure_arcsec is None  # without a reset
        self.mode = step_mode
        scale = 1 / STEPS[step_mode]
        self.speed = self._reset_speed = round(model.speed * scale)
        self.acceleration = round(model.acceleration * scale)
        self.fastest, self.slowest = round(model.fastest * scale), model.slowest
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
        if not self._knows_step:
            half = self._model.unsure_arcsec or half
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
        self._drive(time_s, stop, self.speed if speed is None else speed)

    def change_speed(self, time_s: float, speed: int) -> None:
        """Take another speed, also under way."""
        self.speed = speed
        if self.axis.under_way(time_s) and not self._sweep:
            low, high = self.switches()
            self._drive(time_s, max(low, min(high, self.target)), speed)

    def halt(self, time_s: float) -> None:
        """Brake and hold."""
        self._sweep = []
        self.slaved = None
        self.limit_reported = True
        self.axis.halt(time_s, self.acceleration * self.step_rad)
        self.target = round(self._sign * self.axis.rest_rad() / self.step_rad)

    def reset(self, time_s: float) -> None:
        """Find both limits again, then go to zero."""
        low, high = self.limits()
        self._sweep = [low, high, 0]
        self.slaved = None
        self.limit_reported = True
        self._drive(time_s, low, self._reset_speed)

    def follow_reset(self, time_s: float) -> bool:
        """Go on with a reset where a limit or zero is reached; return whether it is a limit."""
        if not self._sweep or self.axis.under_way(time_s) or self.axis.blocked(time_s):
            return False
        reached = self._sweep.pop(0)
        if self._sweep:
            self._drive(time_s, self._sweep[0], self._reset_speed)
            return True
        self._knows_step = True
        self.target = reached
        self.user_low, self.user_high = self.limits()
        return False

    def at_limit(self, time_s: float) -> bool:
        """Return once that the axis has come to rest at a limit that it was not meant to stop at."""
        if self.limit_reported or self._sweep or self.axis.under_way(time_s) or self.axis.blocked(time_s):
            return False
        self.limit_reported = True
        return True

    def _drive(self, time_s: float, position: int, speed: int) -> None:
        step = self.step_rad
        self.axis.goal(time_s, self.angle_rad(position), max(1, speed) * step, self.acceleration * step)
