"""The options of the driver ``aravis`` in a configuration, read strictly."""

from __future__ import annotations

import ipaddress
from collections.abc import Mapping
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, ConfigDict, Field, WithJsonSchema, model_validator

from calib.files.records import Text, problem
from drivers.options import DriverOptions, check_in_frame, named_values, one_of, read_options, wholes
from drivers.pixels import GENICAM

Stamped = Literal["start", "end", "either"]
FEATURES = named_values(
    str.isidentifier, (int, float, str), "the GenICam name of a feature with a number, text, true or false"
)


def _address(text: str) -> str:
    try:
        return str(ipaddress.IPv4Address(text))
    except ValueError:
        raise problem("", f"{text!r}, expected an IPv4 address, such as 192.168.0.20") from None


def _input(text: str) -> str:
    if text == "Software":
        raise problem("", f"{text!r}, expected an input line, such as Line1: a request exposes no frame")
    return text


class AravisOptions(DriverOptions):
    """How one camera is to be opened."""

    model_config = ConfigDict(
        json_schema_extra={
            "if": {"not": {"anyOf": [{"required": [key]} for key in ("serial", "address", "id")]}},
            "then": False,
        }
    )

    serial: Text = ""
    """The camera's serial number, as mastctl camera list shows it."""
    address: Annotated[Text, AfterValidator(_address)] = ""
    """Of a GigE Vision camera: opened without a search."""
    id: Text = ""
    """The name that Aravis lists: maker, model, serial number."""
    format: Annotated[Text, one_of(GENICAM), WithJsonSchema({"enum": sorted(GENICAM)})] = "Mono8"
    """By GenICam's name; requested of the camera, whose answer is checked."""
    size_px: Annotated[tuple[int, int], wholes(2, 1, 32768)] = (640, 480)
    """As in the mast file."""
    offset_px: Annotated[tuple[int, int], wholes(2, 0, 32768)] = (0, 0)
    """Where the picture begins on the sensor."""
    rate_hz: Annotated[float, Field(ge=0.1, le=1000.0)] | None = 30.0
    """Frames per second; null leaves the camera's; not beside trigger_source."""
    colour: bool = False
    """Frames in color; without it they are grey."""
    features: Annotated[dict[str, Any], FEATURES] = {}  # noqa: RUF012  frozen
    """The camera's own features by their GenICam names, set in this order before all else."""
    exposure_s: Annotated[float, Field(ge=1e-6, le=10.0)] | None = None
    """Fixed exposure time, the camera's automatic off."""
    gain: Annotated[float, Field(ge=-1000.0, le=1e6)] | None = None
    """Fixed, its automatic off; dB in most cameras."""
    trigger_source: Annotated[Text, AfterValidator(_input)] = ""
    """The input line whose rising edge exposes a frame, by its GenICam name; left out: free-running."""
    trigger: Text = ""
    """A name, the same for all cameras that one hardware trigger exposes: they are paired by count."""
    stamp: Stamped = "either"
    """The moment of an exposure that the camera stamps; either: it is not known."""
    margin_s: Annotated[float, Field(ge=0.0, le=1.0)] = 0.01
    """How late after the exposure's end the first packet comes at best; for a clock that cannot be read."""
    buffers: Annotated[int, Field(ge=3, le=64)] = 8
    """Frames that Aravis holds while this process is delayed."""

    @property
    def free_running(self) -> bool:
        """Whether the camera exposes frames by itself."""
        return not self.trigger_source

    @property
    def camera(self) -> str:
        """Which camera, for people."""
        named = (("serial number", self.serial), ("address", self.address), ("id", self.id))
        return " and ".join(f"{what} {value}" for what, value in named if value)

    @model_validator(mode="after")
    def _check(self) -> AravisOptions:
        if not (self.serial or self.address or self.id):
            raise problem("", "serial, address or id is expected: which camera it is")
        if self.trigger_source and "rate_hz" in self.model_fields_set and self.rate_hz is not None:
            raise problem("rate_hz", "stands beside trigger_source; a triggered camera has no rate")
        if self.trigger_source:
            object.__setattr__(self, "rate_hz", None)
        check_in_frame("exposure_s", self.exposure_s, self.rate_hz)
        return self


def parse_options(options: Mapping[str, Any], name: str) -> AravisOptions:
    """Read a camera's options.

    Raises BadOptions naming the camera, the option, its value and what is expected.
    """
    return read_options(AravisOptions, options, name)
