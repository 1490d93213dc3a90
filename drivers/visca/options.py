"""The options of driver ``visca`` as a configuration gives them, checked strictly."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from drivers.options import OptionReader
from drivers.ptz.inquiry import Dialect
from drivers.ptz.options import AxisOptions, PtzOptions, shared_axis, shared_options
from drivers.visca.protocol import place_questions
from drivers.visca.udp import UdpLine

DEVICE = "visca"
BAUDS = (9600, 19200, 38400, 115200)
PORTS = "a serial device such as /dev/ttyUSB0, udp://HOST, socket://HOST:PORT or rfc2217://HOST:PORT"
SCHEMES = ("udp://", "socket://", "rfc2217://")
HIGHEST_ADDRESS = 7
DIALECTS = (
    Dialect(
        DEVICE, "VISCA", place_questions, (9600, 38400), tuple(range(1, HIGHEST_ADDRESS + 1)),
        BAUDS, HIGHEST_ADDRESS, SCHEMES, udp=UdpLine,
    ),
)  # fmt: skip


def options_from(values: Mapping[str, Any]) -> PtzOptions:
    """Return the options that a configuration holds.

    Raises
    ------
    BadOptions
        For an unknown or missing key or a value that cannot be: which, what it is, what would be right.
    """
    read = OptionReader(values, PtzOptions.__dataclass_fields__, ("port", "pan", "tilt"))
    shared = shared_options(read, SCHEMES, PORTS, BAUDS, HIGHEST_ADDRESS)
    return PtzOptions(**shared, pan=_axis(read, "pan"), tilt=_axis(read, "tilt"))


def _axis(options: OptionReader, name: str) -> AxisOptions:
    needed = ("limits_rad", "count_rad", "fastest_rad_per_s")
    read = options.section(name, "a mapping with limits_rad ...", AxisOptions.__dataclass_fields__, needed)
    axis = AxisOptions(**shared_axis(read), count_rad=read.number("count_rad", None, 1e-5, 0.02))
    low, high = axis.limits_rad
    if max(abs(axis.counts(low)), abs(axis.counts(high))) > 0x7FFF:
        raise read.refused(
            "limits_rad", f" are beyond the 32767 counts of {axis.count_rad:g} rad that VISCA has"
        )
    return axis
