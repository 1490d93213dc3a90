"""What a simulated pan/tilt unit is and does: two axes, its modes, limits and memory. No bytes.

Positions are steps, so the unit's angles are as fine as its step. Pan grows to the left and tilt upwards, as
the manuals have it. A unit without encoders counts its steps and does not notice that an axis is held; here
the count always is where the motor is, so that every fault of an axis can be seen in it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace

from drivers.sim.wire.axis import WireAxis
from drivers.sim.wire.ptu_axis import PtuAxis, PtuModel

RECOMPUTE_S = 1.5
"""How long a change of acceleration, base speed or upper speed takes: "several seconds" (assumed)."""

NOMINAL_V = 24.0


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
