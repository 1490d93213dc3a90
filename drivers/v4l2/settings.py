"""The settings that go by meaning: exposure, gain, white balance and focus, at the opening and at run time.

Each is a control in the device's own units with an automatic beside it that has to be off. At run time they
are changed through a second opening of the node, so the thread that takes the frames is not in the way.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, Any

from pydantic import BeforeValidator, ConfigDict, Field, WithJsonSchema, model_validator

from calib.files.records import Text, problem
from drivers.clock import Clock
from drivers.errors import DriverError
from drivers.interfaces import CameraSetting
from drivers.options import DriverOptions, check_in_frame, named_values, one_of, read_options, wholes
from drivers.pixels import FORMATS
from drivers.v4l2 import abi
from drivers.v4l2.controls import CameraControl, first_of, get_value, list_controls, set_value
from drivers.v4l2.exposure import AutoExposureSettings
from drivers.v4l2.find import Address, check_address
from drivers.v4l2.node import Node
from drivers.values_set import ValuesSet, change_each

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


EXPOSURE_UNIT_S = 1e-4  # of V4L2_CID_EXPOSURE_ABSOLUTE


@dataclass(frozen=True)
class ControlMeaning:
    """Which controls a setting is.

    ``automatic`` is the control of its automatic, ``off`` that control's value for off.
    """

    name: str
    word: str
    automatic: int
    off: int
    control: int
    unit: float = 1.0

    def counts(self, value: float) -> int:
        """Return a value in the device's own counts."""
        return round(value / self.unit)


EXPOSURE = ControlMeaning(
    "exposure_s",
    "exposure",
    abi.CID_EXPOSURE_AUTO,
    abi.EXPOSURE_MANUAL,
    abi.CID_EXPOSURE_ABSOLUTE,
    EXPOSURE_UNIT_S,
)
MEANINGS = (
    EXPOSURE,
    ControlMeaning("gain", "gain", abi.CID_AUTOGAIN, 0, abi.CID_GAIN),
    ControlMeaning(
        "white_balance_k", "white balance", abi.CID_AUTO_WHITE_BALANCE, 0, abi.CID_WHITE_BALANCE_TEMPERATURE
    ),
    ControlMeaning("focus", "focus", abi.CID_FOCUS_AUTO, 0, abi.CID_FOCUS_ABSOLUTE),
)


def is_automatic(node: Node, controls: Sequence[CameraControl], one: ControlMeaning) -> bool:
    """Return whether the camera itself sets it now."""
    automatic = first_of(controls, (one.automatic,))
    return automatic is not None and get_value(node, automatic) not in (one.off, None)


def value_of(node: Node, controls: Sequence[CameraControl], one: ControlMeaning) -> float | None:
    """Return what is set now; None if the camera has no such control, or sets it itself."""
    control = first_of(controls, (one.control,))
    if control is None or is_automatic(node, controls, one):
        return None
    counts = get_value(node, control)
    return None if counts is None else counts * one.unit


def settings_of(node: Node, options: CameraOptions, period_s: float | None) -> list[CameraSetting]:
    """Return what of a camera may be changed, as it is now.

    ``period_s`` is from frame to frame and bounds an exposure; None if the camera does not say.
    """
    controls, found = list_controls(node), []
    for one in MEANINGS:
        if (control := first_of(controls, (one.control,))) is None:
            continue
        lowest, highest = control.minimum * one.unit, control.maximum * one.unit
        if one is EXPOSURE and period_s is not None:  # in whole steps, or rounding would exceed it
            whole_s = math.floor(period_s / one.unit + 1e-6) * one.unit
            highest = max(lowest, min(highest, whole_s))
        found.append(
            CameraSetting(
                one.name,
                value_of(node, controls, one),
                lowest,
                highest,
                control.step * one.unit,
                is_automatic(node, controls, one),
                _refusal(one, options),
            )
        )
    return found


def _refusal(one: ControlMeaning, options: CameraOptions) -> str:
    """Why a setting is not to be changed at run time."""
    if one is EXPOSURE and options.auto_exposure is not None:
        return "is set by 'auto_exposure' of the camera's options"
    if one.name == "focus" and options.focus is None:
        return "is not in the camera's options, so no restart could come back to the calibrated one"
    return ""


def change(
    node: Node,
    wanted: Mapping[str, float],
    in_force: Mapping[str, ValuesSet],
    clock: Clock,
    device: str,
) -> tuple[dict[str, float], list[str], DriverError | None]:
    """Change settings one after the other, as `change_each`."""
    controls = list_controls(node)
    meanings = {one.name: one for one in MEANINGS if first_of(controls, (one.control,)) is not None}
    known = {name: values for name, values in in_force.items() if name in meanings}

    def set_one(name: str, value: float) -> tuple[float | None, str, str]:
        one = meanings[name]
        control, automatic = (first_of(controls, (number,)) for number in (one.control, one.automatic))
        assert control is not None
        problem, was, left = None, None, ""
        if automatic is not None:
            was = get_value(node, automatic)
            problem = set_value(node, automatic, one.off)
        counts = min(max(one.counts(value), control.minimum), control.maximum)
        problem = problem or set_value(node, control, counts)
        refused = problem is not None and problem.became is None
        # A refused value leaves the automatic as it was.
        if refused and automatic and was is not None and set_value(node, automatic, was) is not None:
            left = f"; {automatic.name} stays {one.off}"
        reason = f"{problem.message}{left}" if refused and problem is not None else ""
        return value_of(node, controls, one), reason, f"; the camera has steps of {control.step * one.unit:g}"

    ordered = [(one.name, wanted[one.name]) for one in MEANINGS if one.name in wanted]
    return change_each(ordered, known, set_one, clock.now_s, device)


def with_settings(options: CameraOptions, became: Mapping[str, float]) -> CameraOptions:
    """Return the options that open the camera as it is now."""
    whole = {name: round(value) for name, value in became.items() if name != EXPOSURE.name}
    exposure_s = became.get(EXPOSURE.name, options.exposure_s)
    return options.model_copy(update={**whole, EXPOSURE.name: exposure_s})
