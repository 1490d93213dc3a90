"""The options of driver ``flir_ptu`` as a configuration gives them, checked strictly."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal

from drivers.errors import BadOptions
from drivers.faults import nearest

DEVICE = "flir_ptu"
BAUDS = (600, 1200, 2400, 4800, 9600, 19200, 38400, 57600, 115200)
PORTS = "a serial device such as /dev/ttyUSB0, socket://HOST:4000 or rfc2217://HOST:PORT"

Approach = Literal["none", "positive", "negative", "gravity"]


@dataclass(frozen=True)
class AxisOptions:
    """One axis. Angles are the mast's: pan positive to the right, tilt positive up.

    Attributes
    ----------
    limits_rad
        What may be commanded; also given to the unit, if it has user limits.
    sign
        -1 where the unit counts up while the axis turns negative.
    zero_rad
        The axis's angle where the unit stands at position 0.
    approach
        From which side a goal is approached, to take the backlash up: ``none``, ``positive`` (the last
        stretch turns positive), ``negative``, or ``gravity``: against the weight.
    approach_rad
        How long the last stretch is; more than the backlash.
    resolution_arcsec
        What a position has to be, seconds of arc; None takes what the unit says. An E46 needs it, since it
        says something wrong before its first reset.
    gravity_turnover_rad
        The angle at which the weight changes sides, for ``gravity``: below it the last stretch turns
        positive, above it negative.
    """

    limits_rad: tuple[float, float]
    sign: int = 1
    zero_rad: float = 0.0
    approach: Approach = "none"
    approach_rad: float = 0.0
    gravity_turnover_rad: float = math.pi / 2
    resolution_arcsec: float | None = None

    def approach_sign(self, goal_rad: float) -> int:
        """Return the direction of the last stretch in positions: 1, -1, or 0 for none."""
        if self.approach == "gravity":
            return self.sign if goal_rad < self.gravity_turnover_rad else -self.sign
        return {"none": 0, "positive": self.sign, "negative": -self.sign}[self.approach]


@dataclass(frozen=True)
class Options:
    """A unit.

    Attributes
    ----------
    port, baud
        The line; ``socket://`` has no baud rate.
    speed_rad_per_s, acceleration_rad_per_s2
        Of moves that name no speed, and of all; None leaves them as the unit has them.
    settle_s
        How long both axes must stand at their targets to count as settled.
    supply_V
        Lowest and highest supply; None: not below 0.8 of what it was when the unit was opened.
    hottest_C
        Above this temperature of the unit, °C, there is a fault.
    """

    port: str
    pan: AxisOptions
    tilt: AxisOptions
    baud: int = 9600
    speed_rad_per_s: float | None = None
    acceleration_rad_per_s2: float | None = None
    settle_s: float = 0.1
    supply_V: tuple[float, float] | None = None
    hottest_C: float = 60.0


def options_from(values: Mapping[str, Any]) -> Options:
    """Return the options that a configuration holds.

    Raises
    ------
    BadOptions
        For an unknown or missing key or a value that cannot be: which, what it is, what would be right.
    """
    known = tuple(Options.__dataclass_fields__)
    read = _Reader("", values, known, ("port", "pan", "tilt"))
    port = values["port"]
    foreign = isinstance(port, str) and "://" in port and not port.startswith(("socket://", "rfc2217://"))
    if not isinstance(port, str) or not port.strip() or foreign:
        raise read.bad("port", PORTS)
    return Options(
        port=port,
        pan=_axis("pan", values["pan"]),
        tilt=_axis("tilt", values["tilt"]),
        baud=read.one_of("baud", 9600, BAUDS),
        speed_rad_per_s=read.number("speed_rad_per_s", None, 1e-4, 20.0),
        acceleration_rad_per_s2=read.number("acceleration_rad_per_s2", None, 1e-4, 100.0),
        settle_s=read.number("settle_s", 0.1, 0.0, 10.0),
        supply_V=read.pair("supply_V", "[low, high] in volts, low below high"),
        hottest_C=read.number("hottest_C", 60.0, 0.0, 150.0),
    )


def _axis(name: str, values: Any) -> AxisOptions:
    """Read one axis."""
    if not isinstance(values, Mapping):
        raise BadOptions(f"options.{name} is {values!r}, expected a mapping with limits_rad")
    read = _Reader(f"{name}.", values, tuple(AxisOptions.__dataclass_fields__), ("limits_rad",))
    ends = values["limits_rad"]
    if not isinstance(ends, list | tuple) or len(ends) != 2 or not all(_is_number(end) for end in ends):
        raise read.bad("limits_rad", "[low, high] in radians")
    low, high = (float(end) for end in ends)
    if not -math.tau <= low < high <= math.tau:
        raise read.bad("limits_rad", "[low, high] with low below high, at most a full turn either way")
    axis = AxisOptions(
        limits_rad=(low, high),
        sign=read.one_of("sign", 1, (1, -1)),
        zero_rad=read.number("zero_rad", 0.0, -math.tau, math.tau),
        approach=read.one_of("approach", "none", ("none", "positive", "negative", "gravity")),
        approach_rad=read.number("approach_rad", 0.0, 0.0, 0.5),
        gravity_turnover_rad=read.number("gravity_turnover_rad", math.pi / 2, -math.pi, math.pi),
        resolution_arcsec=read.number("resolution_arcsec", None, 0.1, 3600.0),
    )
    if (axis.approach == "none") != (axis.approach_rad == 0.0):
        raise read.bad("approach_rad", f"a stretch above zero beside a side, none beside {axis.approach!r}")
    return axis


class _Reader:
    """One mapping of options, read key by key."""

    def __init__(
        self, place: str, values: Mapping[str, Any], known: tuple[str, ...], needed: tuple[str, ...]
    ) -> None:
        self._place, self._values = place, values
        for key in values:
            if key not in known:
                words = f"options.{place}{key}: there is no such option{nearest(str(key), known)}"
                raise BadOptions(words)
        for key in needed:
            if key not in values:
                raise BadOptions(f"options.{place}{key} is missing")

    def bad(self, key: str, expected: str) -> BadOptions:
        """The refusal of a key's value."""
        words = f"options.{self._place}{key} is {self._values.get(key)!r}, expected {expected}"
        return BadOptions(words)

    def number(self, key: str, default: Any, low: float, high: float) -> Any:
        """A number within bounds."""
        if key not in self._values:
            return default
        value = self._values[key]
        if not _is_number(value) or not low <= value <= high:
            raise self.bad(key, f"a number from {low:g} to {high:g}")
        return float(value)

    def pair(self, key: str, expected: str) -> tuple[float, float] | None:
        """Two rising numbers, or None where there are none."""
        value = self._values.get(key)
        if value is None:
            return None
        good = isinstance(value, list | tuple) and len(value) == 2 and all(_is_number(one) for one in value)
        if not good or not value[0] < value[1]:
            raise self.bad(key, expected)
        return float(value[0]), float(value[1])

    def one_of(self, key: str, default: Any, allowed: tuple[Any, ...]) -> Any:
        """One of a few values."""
        value = self._values.get(key, default)
        if isinstance(value, bool) or not isinstance(value, str | int) or value not in allowed:
            raise self.bad(key, ", ".join(str(one) for one in allowed))
        return value


def _is_number(value: Any) -> bool:
    """Whether a value is a finite number and not a truth value."""
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)
