"""Soft limits of the head: the last check before a move leaves for the hardware.

The same code serves the web interface, the command line and plug-ins, because it is called in one place:
`mastctl.devices.devices.Devices.move`. Whoever wants to know earlier (the choice among solutions, a request's
check) may ask here too.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from mastctl.devices.keep_out import Box
from mastctl.errors import BadRequest


class OutsideLimits(BadRequest):
    """A joint angle or speed that must not be commanded.

    Attributes
    ----------
    what
        ``pan``, ``tilt`` or ``speed``.
    value, bound
        The asked value and the limit it breaks, in ``unit``; the bound is NaN for a value that is no number.
    """

    def __init__(self, what: str, value: float, bound: float, unit: str, message: str) -> None:
        self.what = what
        self.value = value
        self.bound = bound
        self.unit = unit
        super().__init__("outside_limits", message)

    @property
    def detail(self) -> dict[str, float | str]:
        """The same for programs."""
        return {"what": self.what, "value": self.value, "bound": self.bound, "unit": self.unit}


@dataclass(frozen=True)
class Limits:
    """Soft limits, radians and radians per second; the bounds themselves are allowed.

    Attributes
    ----------
    pan_rad, tilt_rad
        (lowest, highest) joint angle that may be commanded. A pan that turns more than a turn has its cable's
        winding bounded by them: angles whole turns apart are different ones.
    speed_rad_per_s
        Fastest joint speed.
    margin_rad
        Around every keep-out: no goal lies in it, and no way but that of a head which stands in it already.
        The ranges above are those inside it.
    acceleration_rad_per_s2
        The head's axes speed up and brake with no more; None: whatever they do.
    keep_out
        Where the head must not be (`mastctl.devices.keep_out`).

    Raises
    ------
    ValueError
        If a bound is not finite, a range is empty, or speed or acceleration is not positive.
    """

    pan_rad: tuple[float, float]
    tilt_rad: tuple[float, float]
    speed_rad_per_s: float
    margin_rad: float = 0.0
    acceleration_rad_per_s2: float | None = None
    keep_out: tuple[Box, ...] = ()

    def __post_init__(self) -> None:
        for axis, (low, high) in (("pan_rad", self.pan_rad), ("tilt_rad", self.tilt_rad)):
            if not (math.isfinite(low) and math.isfinite(high) and low < high):
                raise ValueError(
                    f"{axis} is [{low}, {high}] where [lowest, highest] with lowest < highest is expected"
                )
        if not (math.isfinite(self.speed_rad_per_s) and self.speed_rad_per_s > 0.0):
            raise ValueError(f"speed_rad_per_s is {self.speed_rad_per_s} where a number above 0 is expected")
        acceleration = self.acceleration_rad_per_s2
        if acceleration is not None and not (math.isfinite(acceleration) and acceleration > 0.0):
            raise ValueError(f"acceleration_rad_per_s2 is {acceleration} where a number above 0 is expected")
        if not (math.isfinite(self.margin_rad) and self.margin_rad >= 0.0):
            raise ValueError(f"margin_rad is {self.margin_rad} where 0 or more is expected")

    def check(self, pan_rad: float, tilt_rad: float) -> None:
        """Pass joint angles that may be commanded.

        Raises
        ------
        OutsideLimits
            If an angle is not a finite number or lies beyond its limit; says value, bound and unit.
        """
        for axis, value, bounds in (("pan", pan_rad, self.pan_rad), ("tilt", tilt_rad, self.tilt_rad)):
            if not math.isfinite(value):
                raise OutsideLimits(axis, value, math.nan, "rad", f"{axis} {value} rad is not a finite angle")
            low, high = bounds
            if value < low or value > high:
                bound = low if value < low else high
                told_value, told_bound = _told_apart(value, bound)
                unwound = value - math.copysign(math.tau, value)
                hint = f"; {unwound:.6g} rad points the same way" if low <= unwound <= high else ""
                raise OutsideLimits(
                    axis, value, bound, "rad",
                    f"{axis} {told_value} rad is beyond the soft limit {told_bound} rad{hint}",
                )  # fmt: skip

    def speed(self, asked_rad_per_s: float | None) -> float:
        """Return the speed to command: the asked one up to the cap, the cap when none was asked.

        Raises
        ------
        OutsideLimits
            If the asked speed is not a finite number above 0: some servos take 0 for "as fast as possible".
        """
        if asked_rad_per_s is None:
            return self.speed_rad_per_s
        if not (math.isfinite(asked_rad_per_s) and asked_rad_per_s > 0.0):
            raise OutsideLimits(
                "speed", asked_rad_per_s, 0.0, "rad/s",
                f"speed {asked_rad_per_s} rad/s is not a finite number above 0 rad/s",
            )  # fmt: skip
        return min(asked_rad_per_s, self.speed_rad_per_s)


def _told_apart(value: float, bound: float) -> tuple[str, str]:
    """Write two different numbers briefly, but so that they differ."""
    brief = f"{value:.6g}", f"{bound:.6g}"
    return brief if brief[0] != brief[1] else (repr(value), repr(bound))
