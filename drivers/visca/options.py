"""The options of driver ``visca`` as a configuration gives them, checked strictly."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from drivers.options import OptionReader

DEVICE = "visca"
BAUDS = (9600, 19200, 38400, 115200)
PORTS = "a serial device such as /dev/ttyUSB0, udp://HOST, socket://HOST:PORT or rfc2217://HOST:PORT"
SCHEMES = ("udp://", "socket://", "rfc2217://")


@dataclass(frozen=True)
class AxisOptions:
    """One axis. Its counts and speed are those of the head's data sheet; the protocol has neither.

    Attributes
    ----------
    limits_rad
        What may be commanded.
    count_rad
        One count of its position.
    fastest_rad_per_s
        Of its highest speed code; slower codes are taken as shares of it.
    sign
        1 if the head counts up where the axis turns positive, else -1.
    zero_rad
        The axis's angle where the head is at position 0.
    """

    limits_rad: tuple[float, float]
    count_rad: float
    fastest_rad_per_s: float
    sign: int = 1
    zero_rad: float = 0.0

    def counts(self, angle_rad: float) -> int:
        """Return the nearest position to an angle."""
        return round(self.sign * (angle_rad - self.zero_rad) / self.count_rad)

    def angle_rad(self, counts: float) -> float:
        """Return the angle of a position."""
        return self.zero_rad + self.sign * counts * self.count_rad


@dataclass(frozen=True)
class ViscaOptions:
    """A head.

    Attributes
    ----------
    port, baud, address
        The line, and which head on it.
    speed_rad_per_s
        Of moves that name no speed.
    acceleration_rad_per_s2
        Assumed of its axes, for keep-outs.
    settle_s
        How long both axes must stand in position to count as settled.
    reply_timeout_s
        The patience with a reply, beyond its time on the wire.
    """

    port: str
    pan: AxisOptions
    tilt: AxisOptions
    baud: int = 9600
    address: int = 1
    speed_rad_per_s: float = 0.5
    acceleration_rad_per_s2: float = 0.4
    settle_s: float = 0.2
    reply_timeout_s: float = 0.1


def options_from(values: Mapping[str, Any]) -> ViscaOptions:
    """Return the options that a configuration holds.

    Raises
    ------
    BadOptions
        For an unknown or missing key or a value that cannot be: which, what it is, what would be right.
    """
    read = OptionReader(values, ViscaOptions.__dataclass_fields__, ("port", "pan", "tilt"))
    port = read.text("port", PORTS)
    if "://" in port and not port.startswith(SCHEMES):
        raise read.bad("port", PORTS)
    return ViscaOptions(
        port=port,
        pan=_axis(read, "pan"),
        tilt=_axis(read, "tilt"),
        baud=read.one_of("baud", 9600, BAUDS, ", "),
        address=read.whole("address", 1, 1, 7),
        speed_rad_per_s=read.number("speed_rad_per_s", 0.5, 0.001, 20.0),
        acceleration_rad_per_s2=read.number("acceleration_rad_per_s2", 0.4, 0.01, 100.0),
        settle_s=read.number("settle_s", 0.2, 0.0, 5.0),
        reply_timeout_s=read.number("reply_timeout_s", 0.1, 0.01, 0.2),
    )


def _axis(options: OptionReader, name: str) -> AxisOptions:
    needed = ("limits_rad", "count_rad", "fastest_rad_per_s")
    read = options.section(name, "a mapping with limits_rad ...", AxisOptions.__dataclass_fields__, needed)
    low, high = read.pair("limits_rad", "[low, high] in radians")
    if not -math.tau <= low < high <= math.tau:
        raise read.bad("limits_rad", "[low, high] with low below high, at most a full turn either way")
    axis = AxisOptions(
        limits_rad=(low, high),
        count_rad=read.number("count_rad", None, 1e-5, 0.02),
        fastest_rad_per_s=read.number("fastest_rad_per_s", None, 0.01, 20.0),
        sign=read.one_of("sign", 1, (1, -1), ", "),
        zero_rad=read.number("zero_rad", 0.0, -math.tau, math.tau),
    )
    if max(abs(axis.counts(low)), abs(axis.counts(high))) > 0x7FFF:
        raise read.refused(
            "limits_rad", f" are beyond the 32767 counts of {axis.count_rad:g} rad that VISCA has"
        )
    return axis
