"""The options of driver ``flir_ptu`` as a configuration gives them, checked strictly."""

from __future__ import annotations

import math
from functools import partial
from typing import Annotated

from pydantic import AfterValidator, Field, WithJsonSchema

from calib.files.records import Text, problem
from drivers.approach import ApproachedAxis
from drivers.options import Ascending, DriverOptions, one_of, read_options

DEVICE = "flir_ptu"
# The manuals name 9600 (default) and 38,400 (4.7.1); that a unit takes the others was seen in no source.
BAUDS = (600, 1200, 2400, 4800, 9600, 19200, 38400, 57600, 115200)


def _port(port: str) -> str:
    if "://" in port and not port.startswith(("socket://", "rfc2217://")):
        ports = "a serial device such as /dev/ttyUSB0, socket://HOST:4000 or rfc2217://HOST:PORT"
        raise problem("", f"{port!r} where {ports} is expected")
    return port


class AxisOptions(ApproachedAxis):
    """One axis; its limits are also the unit's user limits, if it has any."""

    limits_rad: Annotated[tuple[float, float], Ascending(-math.tau, math.tau)]
    """What may be commanded; set in the unit too, if it can be."""
    zero_rad: Annotated[float, Field(ge=-math.tau, le=math.tau)] = 0.0
    """The axis's angle where the unit is at position 0."""
    resolution_arcsec: Annotated[float, Field(ge=0.1, le=3600.0)] | None = None
    """The size of a position, seconds of arc; left out: the unit's own. An E46 needs it, since it reports a
    wrong one before its first reset."""


class Options(DriverOptions):
    """A unit."""

    port: Annotated[Text, AfterValidator(_port)]
    """The line: a serial device, socket://HOST:4000 or rfc2217://HOST:PORT."""
    pan: AxisOptions
    """The pan axis."""
    tilt: AxisOptions
    """The tilt axis."""
    baud: Annotated[int, one_of(BAUDS), WithJsonSchema({"enum": [*BAUDS]})] = 9600
    """The line's bits per second; ``socket://`` has none."""
    speed_rad_per_s: Annotated[float, Field(ge=1e-4, le=20.0)] | None = None
    """Of moves that name no speed; left out: as the unit has it."""
    acceleration_rad_per_s2: Annotated[float, Field(ge=1e-4, le=100.0)] | None = None
    """Of all moves; left out: as the unit has it."""
    settle_s: Annotated[float, Field(ge=0.0, le=10.0)] = 0.1
    """How long both axes must be at rest at their targets to count as settled."""


options_from = partial(read_options, Options)
"""Return the options that a configuration holds. Raises BadOptions."""
