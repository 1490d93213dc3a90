"""The options of the driver ``v4l2`` in a configuration, read strictly."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any

from pydantic import BeforeValidator, ConfigDict, Field, WithJsonSchema, model_validator

from calib.files.records import Text, problem
from drivers.options import DriverOptions, check_in_frame, named_values, one_of, read_options, wholes
from drivers.pixels import FORMATS
from drivers.v4l2.exposure import AutoExposureSettings
from drivers.v4l2.find import Address, check_address

Format = Annotated[Text, one_of(FORMATS), WithJsonSchema({"enum": sorted(FORMATS)})]
CONTROLS = named_values(bool, (int, str), "a whole number, true, false or a menu's entry")
Counts = Annotated[int, Field(ge=-(2**31), le=2**31 - 1)]


def _automatic(value: Any) -> Any:
    """The section ``auto_exposure``: true, false, or its settings."""
    return {} if value is True else None if value is False else value


class CameraOptions(DriverOptions):
    """How one camera is to be opened."""

    model_config = ConfigDict(
        json_schema_extra={
            "oneOf": [{"required": ["device"]}, {"anyOf": [{"required": ["card"]}, {"required": ["bus"]}]}]
        }
    )

    device: Text = ""
    """A stable link that udev keeps."""
    card: Text = ""
    """Or its card name, its bus, or both, as mastctl camera list shows them."""
    bus: Text = ""
    """Or its card name, its bus, or both, as mastctl camera list shows them."""
    format: Format = "YUYV"
    """Requested of the camera; its answer is checked."""
    size_px: Annotated[tuple[int, int], wholes(2, 1, 16384)] = (640, 480)
    """As in the mast file."""
    rate_hz: Annotated[float, Field(ge=0.1, le=1000.0)] | None = 30.0
    """Frames per second; null leaves the camera's."""
    colour: bool = False
    """Frames in color; without it they are grey, as measurement needs them."""
    controls: Annotated[dict[str, Any], CONTROLS] = {}  # noqa: RUF012  frozen
    """Any other control by name, in the device's own units, set in this order before the ones below."""
    exposure_s: Annotated[float, Field(ge=1e-5, le=10.0)] | None = None
    """Fixed exposure time, the camera's automatic off."""
    gain: Counts | None = None
    """Fixed, its automatic off; device units."""
    white_balance_k: Annotated[int, Field(ge=1000, le=20000)] | None = None
    """Fixed, its automatic off."""
    focus: Counts | None = None
    """Fixed, its automatic off; device units."""
    auto_exposure: Annotated[
        AutoExposureSettings | None,
        BeforeValidator(_automatic),
        Field(json_schema_extra=lambda schema: schema["anyOf"].append({"type": "boolean"})),
    ] = None
    """Our own between measurements; needs exposure_s, the time to begin with."""
    margin_s: Annotated[float, Field(ge=0.0, le=1.0)] = 0.002
    """How much earlier than its stamp an exposure may have begun."""
    trigger: Text = ""
    """A name, the same for all cameras that one hardware trigger exposes: they are paired by count."""
    buffers: Annotated[int, Field(ge=3, le=32)] = 16
    """Frames that the kernel holds while this process is delayed."""

    @property
    def address(self) -> Address:
        """Which camera it is."""
        return Address(self.device, self.card, self.bus)

    @model_validator(mode="after")
    def _check(self) -> CameraOptions:
        if self.device and (self.card or self.bus):
            raise problem("device", "stands beside card or bus; one or the other is expected")
        check_in_frame("exposure_s", self.exposure_s, self.rate_hz)
        auto = self.auto_exposure
        if auto is None:
            return self
        if self.exposure_s is None:
            raise problem("auto_exposure", "needs exposure_s: the exposure time to begin with")
        if self.rate_hz is not None and "longest_s" not in auto.model_fields_set:
            auto = auto.model_copy(update={"longest_s": min(auto.longest_s, 1 / self.rate_hz)})
            object.__setattr__(self, "auto_exposure", auto)
        check_in_frame("auto_exposure.longest_s", auto.longest_s, self.rate_hz)
        if auto.shortest_s >= auto.longest_s:
            message = f"{auto.shortest_s:g} s, expected less than longest_s ({auto.longest_s:g} s)"
            raise problem("auto_exposure.shortest_s", message)
        return self


def parse_options(options: Mapping[str, Any], name: str) -> CameraOptions:
    """Read a camera's options.

    Raises BadOptions naming the camera, the option, its value and what is expected.
    """
    read = read_options(CameraOptions, options, name)
    check_address(read.address, name)
    return read
