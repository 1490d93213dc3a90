"""The options of driver ``pelco`` as a configuration gives them, checked strictly."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any

from drivers.options import OptionReader
from drivers.pelco.protocol import TURN, place_questions
from drivers.ptz.inquiry import Dialect
from drivers.ptz.options import AxisOptions, PtzOptions, shared_axis, shared_options

DEVICE = "pelco"
BAUDS = (2400, 4800, 9600, 19200, 38400, 115200)
PORTS = "a serial device such as /dev/ttyUSB0, socket://HOST:PORT or rfc2217://HOST:PORT"
SCHEMES = ("socket://", "rfc2217://")
UNIT_RAD = math.radians(0.01)
HIGHEST_ADDRESS = 254
DIALECTS = tuple(
    Dialect(
        DEVICE, f"Pelco-{protocol}", partial(place_questions, protocol), (2400, 4800, 9600), (1, 2),
        BAUDS, HIGHEST_ADDRESS, SCHEMES, {"protocol": protocol},
    )
    for protocol in ("D", "P")
)  # fmt: skip
"""A Pelco-P head that takes its address as it is sent answers at one more."""


@dataclass(frozen=True)
class PelcoAxisOptions(AxisOptions):
    """One axis, whose positions are hundredths of a degree, 0 to 35999.

    Attributes
    ----------
    fastest_rad_per_s
        Its own speed on the way to a position, which no command sets: not below the true one.
    resolution_rad
        Its real steps, where they are coarser than 0.01 degree; they are reported as its count.
    sign
        1 if the head counts up where the axis turns positive, else -1; -1 is usual for tilt.
    """

    resolution_rad: float = UNIT_RAD

    @property
    def slack(self) -> int:
        """How many units it may stand from a goal because of its steps."""
        return max(1, math.ceil(0.5 * self.resolution_rad / UNIT_RAD - 1e-9))

    def unwrapped(self, place: int) -> int:
        """Return the position of a value 0 to 35999 that is nearest to the middle of the limits."""
        middle = self.counts(sum(self.limits_rad) / 2)
        return place + TURN * round((middle - place) / TURN)


@dataclass(frozen=True)
class PelcoOptions(PtzOptions):
    """A head.

    Attributes
    ----------
    protocol
        Which of the two it speaks.
    step_rad
        The longest step. No axis goes further than this when its host falls silent.
    """

    pan: PelcoAxisOptions
    tilt: PelcoAxisOptions
    protocol: str = "D"
    step_rad: float = 0.05


def options_from(values: Mapping[str, Any]) -> PelcoOptions:
    """Return the options that a configuration holds.

    Raises
    ------
    BadOptions
        For an unknown or missing key or a value that cannot be: which, what it is, what would be right.
    """
    read = OptionReader(values, PelcoOptions.__dataclass_fields__, ("port", "pan", "tilt"))
    shared = shared_options(read, SCHEMES, PORTS, BAUDS, HIGHEST_ADDRESS)
    return PelcoOptions(
        **shared,
        pan=_axis(read, "pan"),
        tilt=_axis(read, "tilt"),
        protocol=read.one_of("protocol", "D", ("D", "P")),
        step_rad=read.number("step_rad", 0.05, 0.002, 0.5),
    )


def _axis(options: OptionReader, name: str) -> PelcoAxisOptions:
    known = [key for key in PelcoAxisOptions.__dataclass_fields__ if key != "count_rad"]
    read = options.section(name, "a mapping with limits_rad ...", known, ("limits_rad", "fastest_rad_per_s"))
    axis = PelcoAxisOptions(
        **shared_axis(read),
        count_rad=UNIT_RAD,
        resolution_rad=max(UNIT_RAD, read.number("resolution_rad", None, 0.0001, 0.02) or 0.0),
    )
    low, high = axis.limits_rad
    if high - low > math.tau - math.radians(1.0):
        raise read.refused(
            "limits_rad", " reach over more than 359 degrees, and positions repeat after a turn"
        )
    return axis
