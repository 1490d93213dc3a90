"""One axis of a simulated pan/tilt unit: positions in steps, limits, speeds, step modes, resets."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Literal

from drivers.sim.wire.axis import WireAxis
from drivers.sim.wire.ptu_models import STEPS, PtuModel

ARCSEC_RAD = math.radians(1 / 3600)

SWITCH_STEPS = 20
"""How far beyond the factory limits the limit switches are, half steps (assumed)."""


@dataclass(frozen=True)
class AxisDefaults:
    """What DS keeps and DR brings back, in positions."""

    speed: int
    acceleration: int
    base_speed: int
    fastest: int
    slowest: int
    reset_speed: int
    hold: str = "R"
    move: str = "R"
    step_mode: str = "H"


class PtuAxis:
    """Pan or tilt.

    Parameters
    ----------
    name
        ``Pan`` or ``Tilt``.
    model
        The unit's.
    axis
        What it turns.
    sign
        1 or -1: whether positions grow with the axis angle.
    step_mode
        A key of ``STEPS``.
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
        self.factory = AxisDefaults(
            speed=round(model.speed * scale),
            acceleration=round(model.acceleration * scale),
            base_speed=round(model.base_speed * scale),
            fastest=round(model.fastest * scale),
            slowest=model.slowest,
            reset_speed=round(model.speed * scale),
            step_mode=step_mode,
        )
        self.now = self.factory
        self.user_low, self.user_high = self.limits()
        self.target = 0
        self.slaved: int | None = None
        self.told_limit = True  # whether the limit where it stands has been told by !P or !T
        self._sweep: list[int] = []

    @property
    def step_rad(self) -> float:
        """One position as it is, radians."""
        return self._model.half_step_arcsec * STEPS[self.mode] * ARCSEC_RAD

    @property
    def told_arcsec(self) -> float:
        """One position as PR and TR tell it, arc seconds."""
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

    def told_position(self, time_s: float) -> int | str:
        """Return the position as the unit tells it."""
        return "nan" if self.axis.no_number(time_s) else self.position(time_s)

    def speed(self, time_s: float) -> int:
        """Return how fast it goes, positions a second (signed)."""
        return round(self._sign * self.axis.velocity_rad_per_s(time_s) / self.step_rad)

    def resting(self, time_s: float) -> bool:
        """Return whether it stands, and no part of a reset is left."""
        return not self._sweep and not self.axis.under_way(time_s)

    def go(self, time_s: float, position: int, speed: int | None = None) -> None:
        """Start towards a position; the limit switches stop it."""
        self.target = position
        low, high = self.switches()
        stop = max(low, min(high, position))
        self.told_limit = low <= position <= high
        self._drive(time_s, stop, self.now.speed if speed is None else speed)

    def turn(self, time_s: float, speed: int, low: int, high: int) -> None:
        """Turn at a signed speed until one of two positions."""
        if speed == 0:
            self.halt(time_s)
            return
        stop = high if speed > 0 else low
        if self.position(time_s) != stop:
            self.told_limit = False
        self.target = stop
        self._drive(time_s, stop, abs(speed))

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
        self.told_limit = True
        self.axis.halt(time_s, self.now.acceleration * self.step_rad)
        self.target = round(self._sign * self.axis.rest_rad() / self.step_rad)

    def reset(self, time_s: float) -> None:
        """Find both limits again, then go to zero; a new step mode comes into force."""
        if self.now.step_mode != self.mode:
            self._change_mode()
        low, high = self.limits()
        self._sweep = [low, high, 0]
        self.slaved = None
        self.told_limit = True
        self._drive(time_s, low, self.now.reset_speed)

    def follow_reset(self, time_s: float, hit: Callable[[], None]) -> None:
        """Go on with a reset when a limit is reached; ``hit`` is told of each."""
        if not self._sweep or self.axis.under_way(time_s) or self.axis.blocked(time_s):
            return
        reached = self._sweep.pop(0)
        if self._sweep:
            hit()
            self._drive(time_s, self._sweep[0], self.now.reset_speed)
        else:
            self.known = True
            self.target = reached
            self.user_low, self.user_high = self.limits()

    def at_limit(self, time_s: float) -> bool:
        """Return once that the axis has come to rest at a limit that it was not meant to stop at."""
        if self.told_limit or self._sweep or self.axis.under_way(time_s) or self.axis.blocked(time_s):
            return False
        self.told_limit = True
        return True

    def _drive(self, time_s: float, position: int, speed: int) -> None:
        step = self.step_rad
        self.axis.goal(time_s, self.angle_rad(position), max(1, speed) * step, self.now.acceleration * step)

    def _change_mode(self) -> None:
        """Speeds keep their meaning in the new steps."""
        ratio = STEPS[self.mode] / STEPS[self.now.step_mode]
        self.mode = self.now.step_mode
        now = self.now
        self.now = replace(
            now,
            speed=round(now.speed * ratio),
            acceleration=round(now.acceleration * ratio),
            base_speed=round(now.base_speed * ratio),
            fastest=round(now.fastest * ratio),
            reset_speed=round(now.reset_speed * ratio),
        )
