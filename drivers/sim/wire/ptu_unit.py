"""What a simulated pan/tilt unit is and does: two axes, its modes, limits and memory. No bytes, few words.

Positions are steps, so the unit's angles are as fine as its step. Pan grows to the left and tilt upwards, as
the manuals have it. A unit without encoders counts its steps and does not notice that an axis is held; here
the count always is where the motor is, so that every fault of an axis can be seen in it. Base speed is kept
and told but moves start from rest.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

from drivers.sim.wire.axis import WireAxis
from drivers.sim.wire.ptu_axis import STEPS, AxisDefaults, PtuAxis, PtuModel

RECOMPUTE_S = 1.5
"""How long a change of acceleration, base speed or upper speed takes: "several seconds" (assumed)."""

NOMINAL_V = 24.0
_BAUD_S = 0.02  # a new baud rate comes into force when the answer is through


class CommandRefused(Exception):
    """What the unit does not do, in the words that it answers behind the ``!``."""


class PtuUnit:
    """A unit.

    Parameters
    ----------
    model, pan, tilt, step_mode, signs, baud
        As ``drivers.sim.wire.ptu.SimulatedPtu``.

    Attributes
    ----------
    axes
        ``P`` and ``T``.
    echo, verbose
        How it answers.
    limit_mode
        E, D or U: the factory's limits, none, the user's.
    slaved, velocity, encoder, continuous
        Modes that commands switch: S, CV, CEC, PCE.
    at_power_up
        E or D: kept, since the unit never loses power here.
    busy
        Whether the last command is not through yet, as a function of the time that tells when it is; None if
        nothing is under way. Meanwhile the unit answers nothing.
    eeprom_writes
        How often it was told to save.
    baud
        Of its serial line, now.
    """

    def __init__(
        self,
        model: PtuModel,
        pan: WireAxis,
        tilt: WireAxis,
        step_mode: str,
        signs: tuple[int, int],
        baud: int,
    ) -> None:
        self.model = model
        known = model.unsure_arcsec is None
        self.pan = PtuAxis("Pan", model, pan, signs[0], step_mode, known)
        self.tilt = PtuAxis("Tilt", model, tilt, signs[1], step_mode, known)
        self.axes: Mapping[str, PtuAxis] = {"P": self.pan, "T": self.tilt}
        self.echo = not model.e_series
        self.verbose = True
        self.limit_mode = "E"
        self.slaved = False
        self.velocity = False
        self.encoder = False
        self.continuous = False
        self.at_power_up = "E"
        self.busy: Callable[[float], bool] | None = None
        self.eeprom_writes = 0
        self.baud, self._next_baud = baud, (math.inf, baud)
        self._saved: tuple[AxisDefaults, AxisDefaults] = (self.pan.now, self.tilt.now)
        self._speeds: dict[str, int] = {}  # desired speeds from before pure velocity
        self._sweeping: list[PtuAxis] = []

    def follow(self, time_s: float) -> list[str]:
        """Go on until a moment; return the letters of the axes that have hit a limit, in order."""
        if time_s >= self._next_baud[0]:
            self.baud, self._next_baud = self._next_baud[1], (math.inf, 0)
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
        if self.limit_mode == "D" or (self.continuous and axis is self.pan):
            return -math.inf, math.inf
        return axis.limits() if self.limit_mode == "E" else (axis.user_low, axis.user_high)

    def go(self, axis: PtuAxis, position: int, time_s: float) -> None:
        """Start towards a position, or keep it until slaved mode ends. Raises Refused."""
        if self.velocity:
            raise CommandRefused("Illegal Command in pure velocity mode")
        _check_position(axis, position, self.allowed(axis))
        if self.slaved:
            axis.slaved = position
        else:
            axis.go(time_s, position)

    def go_by(self, axis: PtuAxis, offset: int, time_s: float) -> None:
        """Start towards a position so far from here. Raises Refused."""
        self.go(axis, axis.position(time_s) + offset, time_s)

    def go_both(self, positions: Sequence[int], speeds: Sequence[int], time_s: float) -> None:
        """Start both axes towards positions at speeds, or neither. Raises Refused."""
        axes = (self.pan, self.tilt)
        for axis, speed in zip(axes, speeds, strict=True):
            self.check_speed(axis, speed)
        for axis, position in zip(axes, positions, strict=True):
            low, high = self.allowed(axis)
            if not low <= position <= high:
                self.go(axis, position, time_s)  # which refuses
        for axis, position, speed in zip(axes, positions, speeds, strict=True):
            axis.now = replace(axis.now, speed=speed)
            self.go(axis, position, time_s)

    def set_user_limit(self, axis: PtuAxis, end: int, position: int) -> None:
        """Set the lower (``end`` 0) or upper (1) user limit. Raises Refused."""
        _check_position(axis, position, axis.limits())
        user = (position, axis.user_high) if end == 0 else (axis.user_low, position)
        if user[0] > user[1]:
            word = ("Minimum", "Maximum")[end]
            raise CommandRefused(f"{word} user {axis.name} position is beyond the other one")
        axis.user_low, axis.user_high = user

    # Speeds

    def check_speed(self, axis: PtuAxis, speed: int) -> None:
        """Pass a speed within the axis' bounds. Raises Refused."""
        size = abs(speed) if self.velocity else speed
        if self.velocity and size == 0:
            return
        if size > axis.now.fastest:
            raise _too_fast(axis)
        if size < axis.now.slowest:
            raise _too_slow(axis)

    def set_speed(self, axis: PtuAxis, speed: int, time_s: float) -> None:
        """Set the desired speed; in pure velocity mode the axis turns until its limit. Raises Refused."""
        self.check_speed(axis, speed)
        if not self.velocity:
            axis.change_speed(time_s, speed)
            return
        axis.now = replace(axis.now, speed=speed)
        low, high = self.allowed(axis)
        switches = axis.switches()
        axis.turn(time_s, speed, round(max(low, switches[0])), round(min(high, switches[1])))

    def change_speed(self, axis: PtuAxis, change: int, time_s: float) -> None:
        """Set the desired speed to so much more than it goes now. Raises Refused."""
        self.set_speed(axis, axis.speed(time_s) + change, time_s)

    def set_fastest(self, axis: PtuAxis, speed: int, time_s: float) -> None:
        """Set the upper bound of speeds. Raises Refused."""
        if speed > axis.factory.fastest / STEPS[axis.mode] * STEPS[axis.factory.step_mode]:
            raise _too_fast(axis)
        if speed < axis.now.slowest:
            raise _too_slow(axis)
        axis.now = replace(axis.now, fastest=speed, speed=min(axis.now.speed, speed))
        self._recompute(axis, time_s)

    def set_slowest(self, axis: PtuAxis, speed: int, time_s: float) -> None:
        """Set the lower bound of speeds. Raises Refused."""
        if speed < self.model.slowest:
            raise CommandRefused(f"Motor speed cannot be less than {self.model.slowest} pos/sec")
        if speed > axis.now.fastest:
            raise _too_fast(axis)
        axis.now = replace(axis.now, slowest=speed)

    def set_base_speed(self, axis: PtuAxis, speed: int, time_s: float) -> None:
        """Set the speed from which a real motor would start. Raises Refused."""
        if not self.model.slowest <= speed <= axis.now.fastest:
            raise _too_fast(axis)
        axis.now = replace(axis.now, base_speed=speed)
        self._recompute(axis, time_s)

    def set_acceleration(self, axis: PtuAxis, acceleration: int, time_s: float) -> None:
        """Set the acceleration. Raises Refused."""
        if acceleration < 1:
            raise CommandRefused("Illegal Command Entered")
        axis.now = replace(axis.now, acceleration=acceleration)
        self._recompute(axis, time_s)

    def set_reset_speed(self, axis: PtuAxis, speed: int, time_s: float) -> None:
        """Set the speed of a reset. Raises Refused."""
        self.check_speed(axis, speed)
        axis.now = replace(axis.now, reset_speed=speed)

    def _recompute(self, axis: PtuAxis, time_s: float) -> None:
        """Be busy until the axis stands and the ramp is computed anew."""
        end_s = max(time_s, axis.axis.end_s()) + RECOMPUTE_S
        self.busy = lambda now_s: now_s < end_s

    # Execution

    def reset(self, axes: Sequence[PtuAxis], time_s: float) -> None:
        """R: find the limits of some axes again, one after the other; busy until it is done."""
        self.control(False, time_s)
        for axis in axes:
            axis.halt(time_s)
        self._sweeping = list(axes)
        axes[0].reset(time_s)
        self.busy = lambda now_s: bool(self._sweeping)

    def immediate(self, time_s: float) -> None:
        """I: slaved mode is over, and what was slaved starts (D46 manual, slaved execution mode)."""
        self.slaved = False
        self._start_slaved(time_s)

    def wait(self, time_s: float) -> None:
        """A: start what is slaved; busy until both axes stand."""
        self._start_slaved(time_s)
        self.busy = lambda now_s: not (self.pan.resting(now_s) and self.tilt.resting(now_s))

    def _start_slaved(self, time_s: float) -> None:
        for axis in self.axes.values():
            if axis.slaved is not None:
                axis.go(time_s, axis.slaved)
                axis.slaved = None

    def halt(self, axes: Sequence[PtuAxis], time_s: float) -> None:
        """H: brake and hold."""
        for axis in axes:
            axis.halt(time_s)
            if self.velocity:
                axis.now = replace(axis.now, speed=0)

    def control(self, velocity: bool, time_s: float) -> None:
        """CV, CI: either way the axes stop; pure velocity begins with none."""
        if velocity == self.velocity:
            return
        self.velocity = velocity
        for axis in self.axes.values():
            axis.halt(time_s)
            if velocity:
                self._speeds[axis.name] = axis.now.speed
            axis.now = replace(axis.now, speed=0 if velocity else self._speeds[axis.name])

    # The host

    def keep(self, what: str) -> None:
        """DS saves, DR restores, DF brings back the factory's."""
        pan, tilt = self.pan, self.tilt
        if what == "S":
            self._saved = (pan.now, tilt.now)
            self.eeprom_writes += 1
        else:
            pan.now, tilt.now = self._saved if what == "R" else (pan.factory, tilt.factory)

    def set_baud(self, baud: int, time_s: float) -> None:
        """Change the serial line's rate, once the answer is through."""
        self._next_baud = (time_s + _BAUD_S, baud)

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


def _too_slow(axis: PtuAxis) -> CommandRefused:
    return CommandRefused(f"{axis.name} speed cannot be less than {axis.now.slowest} positions/sec")
