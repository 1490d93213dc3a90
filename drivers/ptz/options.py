"""The options that such heads share, as a configuration gives them, checked strictly."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

from drivers.options import OptionReader


@dataclass(frozen=True)
class AxisOptions:
    """One axis. Its counts and speed are those of the head's data sheet; the protocols have neither.

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
class PtzOptions:
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


def shared_options(
    read: OptionReader, schemes: tuple[str, ...], ports: str, bauds: tuple[int, ...], addresses: int
) -> dict[str, Any]:
    """Return the options of a head without its axes: its line may have these schemes and rates.

    ``addresses`` is the highest address. Raises BadOptions for a value that cannot be.
    """
    port = read.text("port", ports)
    if "://" in port and not port.startswith(schemes):
        raise read.bad("port", ports)
    return {
        "port": port,
        "baud": read.one_of("baud", 9600, bauds, ", "),
        "address": read.whole("address", 1, 1, addresses),
        "speed_rad_per_s": read.number("speed_rad_per_s", 0.5, 0.001, 20.0),
        "acceleration_rad_per_s2": read.number("acceleration_rad_per_s2", 0.4, 0.01, 100.0),
        "settle_s": read.number("settle_s", 0.2, 0.0, 5.0),
        "reply_timeout_s": read.number("reply_timeout_s", 0.1, 0.01, 0.2),
    }


def shared_axis(read: OptionReader) -> dict[str, Any]:
    """Return the options of an axis without its count. Raises BadOptions for a value that cannot be."""
    low, high = read.pair("limits_rad", "[low, high] in radians")
    if not -math.tau <= low < high <= math.tau:
        raise read.bad("limits_rad", "[low, high] with low below high, at most a full turn either way")
    return {
        "limits_rad": (low, high),
        "fastest_rad_per_s": read.number("fastest_rad_per_s", None, 0.01, 20.0),
        "sign": read.one_of("sign", 1, (1, -1), ", "),
        "zero_rad": read.number("zero_rad", 0.0, -math.tau, math.tau),
    }
