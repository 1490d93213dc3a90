"""The options of driver ``flir_ptu`` as a configuration gives them, checked strictly."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from drivers.approach import APPROACHES, ApproachedAxis
from drivers.options import OptionReader

DEVICE = "flir_ptu"
# The manuals name 9600 (default) and 38,400 (4.7.1); that a unit takes the others was seen in no source.
BAUDS = (600, 1200, 2400, 4800, 9600, 19200, 38400, 57600, 115200)
PORTS = "a serial device such as /dev/ttyUSB0, socket://HOST:4000 or rfc2217://HOST:PORT"


@dataclass(frozen=True, kw_only=True)
class AxisOptions(ApproachedAxis):
    """One axis, as of `ApproachedAxis`; its limits are also the unit's user limits, if it has any.

    Attributes
    ----------
    zero_rad
        The axis's angle where the unit stands at position 0.
    resolution_arcsec
        The size of a position, seconds of arc; None takes the unit's own. An E46 needs it, since it reports a
        wrong one before its first reset.
    """

    zero_rad: float = 0.0
    resolution_arcsec: float | None = None


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
    """

    port: str
    pan: AxisOptions
    tilt: AxisOptions
    baud: int = 9600
    speed_rad_per_s: float | None = None
    acceleration_rad_per_s2: float | None = None
    settle_s: float = 0.1


def options_from(values: Mapping[str, Any]) -> Options:
    """Return the options that a configuration holds.

    Raises BadOptions for an unknown or missing key or a value that cannot be: which, what it is, what would
    be right.
    """
    read = OptionReader(values, Options.__dataclass_fields__, ("port", "pan", "tilt"))
    port = read.text("port", PORTS)
    if "://" in port and not port.startswith(("socket://", "rfc2217://")):
        raise read.bad("port", PORTS)
    return Options(
        port=port,
        pan=_axis(read, "pan"),
        tilt=_axis(read, "tilt"),
        baud=read.one_of("baud", 9600, BAUDS, ", "),
        speed_rad_per_s=read.number("speed_rad_per_s", None, 1e-4, 20.0),
        acceleration_rad_per_s2=read.number("acceleration_rad_per_s2", None, 1e-4, 100.0),
        settle_s=read.number("settle_s", 0.1, 0.0, 10.0),
    )


def _axis(options: OptionReader, name: str) -> AxisOptions:
    """Read one axis."""
    known = AxisOptions.__dataclass_fields__
    read = options.section(name, "a mapping with limits_rad", known, ("limits_rad",))
    low, high = read.pair("limits_rad", "[low, high] in radians")
    if not -math.tau <= low < high <= math.tau:
        raise read.bad("limits_rad", "[low, high] with low below high, at most a full turn either way")
    axis = AxisOptions(
        limits_rad=(low, high),
        sign=read.one_of("sign", 1, (1, -1), ", "),
        zero_rad=read.number("zero_rad", 0.0, -math.tau, math.tau),
        approach=read.one_of("approach", "none", APPROACHES, ", "),
        approach_rad=read.number("approach_rad", 0.0, 0.0, 0.5),
        gravity_turnover_rad=read.number("gravity_turnover_rad", math.pi / 2, -math.pi, math.pi),
        resolution_arcsec=read.number("resolution_arcsec", None, 0.1, 3600.0),
    )
    if (axis.approach == "none") != (axis.approach_rad == 0.0):
        raise read.bad("approach_rad", f"a stretch above zero beside a side, none beside {axis.approach!r}")
    return axis
