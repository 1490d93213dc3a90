"""Limits of the joints and of their speed, and the sun that head cameras must not look into."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal

import numpy as np

from calib.geometry.rig import Rig
from calib.geometry.rigid import FloatArray, rot_x, rot_y
from mastctl.devices.keep_out import Box, Pair
from mastctl.errors import BadRequest


class OutsideLimits(BadRequest):
    """A joint angle or speed that must not be commanded.

    ``what``: ``pan``, ``tilt`` or ``speed``; ``value``, ``bound``: the requested value and the limit it
    breaks, in ``unit``; NaN for a value that is no number.
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
        Around every keep-out: no goal lies in it, and no move but that of a head which is in it already.
        The ranges above are those inside it.
    acceleration_rad_per_s2
        The head's axes speed up and brake with no more; None: whatever they do.
    keep_out
        Where the head must not be (`mastctl.devices.keep_out`).

    Raises ValueError if a bound is not finite, a range is empty, or speed or acceleration is not positive.
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
        """Pass joint angles that may be commanded. Raises OutsideLimits."""
        for axis, value, bounds in (("pan", pan_rad, self.pan_rad), ("tilt", tilt_rad, self.tilt_rad)):
            if not math.isfinite(value):
                raise OutsideLimits(axis, value, math.nan, "rad", f"{axis} {value} rad is not a finite angle")
            low, high = bounds
            if value < low or value > high:
                bound = low if value < low else high
                shown_value, shown_bound = _apart(value, bound)
                unwound = value - math.copysign(math.tau, value)
                hint = f"; {unwound:.6g} rad points the same way" if low <= unwound <= high else ""
                raise OutsideLimits(
                    axis, value, bound, "rad",
                    f"{axis} {shown_value} rad is beyond the soft limit {shown_bound} rad{hint}",
                )  # fmt: skip

    def speed(self, requested_rad_per_s: float | None) -> float:
        """Return the speed to command: the requested one up to the cap, the cap by default.

        Raises OutsideLimits if it is not a finite number above 0: some servos treat 0 as "as fast as
        possible".
        """
        if requested_rad_per_s is None:
            return self.speed_rad_per_s
        if not (math.isfinite(requested_rad_per_s) and requested_rad_per_s > 0.0):
            raise OutsideLimits(
                "speed", requested_rad_per_s, 0.0, "rad/s",
                f"speed {requested_rad_per_s} rad/s is not a finite number above 0 rad/s",
            )  # fmt: skip
        return min(requested_rad_per_s, self.speed_rad_per_s)


def _apart(value: float, bound: float) -> tuple[str, str]:
    """Write two different numbers briefly, but so that they differ."""
    brief = f"{value:.6g}", f"{bound:.6g}"
    return brief if brief[0] != brief[1] else (repr(value), repr(bound))


SUN = "sun"
ROWS = 16  # over a cone's height: a row is an eighth of the half angle high
LEAST_ROW_RAD = 0.004
OVERLAP_RAD = 1e-6  # of rows: boxes are open, and two that only touch would leave a crack between them
LEAST_CONE_RAD, WIDEST_CONE_RAD = 0.001, 1.5

Frame = Literal["rover", "site"]


@dataclass(frozen=True)
class SunDirection:
    """Where the sun is and how near to it a camera may look.

    Attributes
    ----------
    direction
        Unit vector towards it in ``frame``: x forward (north), y right (east), z down.
    frame
        ``rover``, or ``site``: then it turns with the rover's pose.
    half_angle_rad
        Of the cone around it.
    until_s
        When it holds no longer, seconds of CLOCK_MONOTONIC; None: until another is stated.
    """

    direction: tuple[float, float, float]
    frame: Frame
    half_angle_rad: float
    until_s: float | None = None

    def holds(self, now_s: float) -> bool:
        """Return whether it is still true at a moment."""
        return self.until_s is None or now_s <= self.until_s


def direction_of(azimuth_rad: float, elevation_rad: float) -> tuple[float, float, float]:
    """Return a unit vector: azimuth from x over y, elevation above the xy plane, z down."""
    level = math.cos(elevation_rad)
    return level * math.cos(azimuth_rad), level * math.sin(azimuth_rad), -math.sin(elevation_rad)


def sun_boxes(rig: Rig, in_rover: FloatArray, half_angle_rad: float, tilt_rad: Pair) -> tuple[Box, ...]:
    """Return boxes of true angles that together hold every pose in which a head camera looks into the cone.

    ``in_rover`` is (3,), the unit vector towards the sun in the rover frame; ``tilt_rad`` the range of true
    tilt that is wanted. Body cameras do not turn and are left aside.
    """
    sun = rig.mast.rover_from_mast.rotation.T @ in_rover
    axes = {tuple(camera.model.A.tolist()) for camera in rig.cameras.values() if camera.on == "head"}
    step = max(2.0 * half_angle_rad / ROWS, LEAST_ROW_RAD)
    rows = max(1, math.ceil((tilt_rad[1] - tilt_rad[0]) / step))
    step = (tilt_rad[1] - tilt_rad[0]) / rows
    found = []
    for number in range(rows):
        middle = tilt_rad[0] + (number + 0.5) * step
        turned = rot_x(rig.mast.axis_twist_rad) @ rot_y(middle)
        pans = [
            pan
            for axis in axes
            for pan in _pans(turned @ np.array(axis), sun, half_angle_rad + 0.5 * step + OVERLAP_RAD)
        ]
        row = middle - 0.5 * step - OVERLAP_RAD, middle + 0.5 * step + OVERLAP_RAD
        found += [Box(SUN, pan, row) for pan in _joined(pans)]
    return tuple(found)


def _pans(axis: FloatArray, sun: FloatArray, angle_rad: float) -> Iterator[Pair]:
    """The interval of pan at which an axis is within an angle of the sun, both in the mast frame."""
    level = math.hypot(axis[0], axis[1]) * math.hypot(sun[0], sun[1])
    wanted = math.cos(min(angle_rad, math.pi)) - float(axis[2] * sun[2])
    if wanted > level:
        return
    middle = math.atan2(sun[1], sun[0]) - math.atan2(axis[1], axis[0])
    half = math.pi + OVERLAP_RAD if wanted <= -level else math.acos(wanted / level)
    middle = math.remainder(middle, math.tau)
    yield middle - half, middle + half


def _joined(pans: list[Pair]) -> list[Pair]:
    """Overlapping intervals as one, those that touch round the circle too."""
    joined: list[Pair] = []
    for low, high in sorted(pans):
        if joined and low <= joined[-1][1]:
            joined[-1] = joined[-1][0], max(joined[-1][1], high)
        else:
            joined.append((low, high))
    return joined
