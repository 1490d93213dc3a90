"""The options of a camera, and its settings: exposure and gain, at the opening and at run time.

Both have several names in GenICam, all of which Aravis knows.
"""

from __future__ import annotations

import ctypes
import ipaddress
import math
import time
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, ConfigDict, Field, WithJsonSchema, model_validator

from calib.files.records import Text, problem
from drivers.aravis.library import GenicamError, Library
from drivers.errors import DriverError, StreamFailed
from drivers.interfaces import CameraSetting
from drivers.options import DriverOptions, check_in_frame, named_values, one_of, read_options, wholes
from drivers.pixels import GENICAM
from drivers.values_set import SAME, ValuesSet, change_each

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


OFF = "Off"
NEAREST = ": the camera's nearest"


@dataclass(frozen=True)
class Feature:
    """Which features a setting is: ``feature`` (also as chunk data) and ``automatic`` by GenICam's names.

    ``called`` is its name in Aravis's functions, ``unit`` that of the camera's own number in that of
    `SETTINGS`.
    """

    name: str
    word: str
    feature: str
    automatic: str
    called: str
    unit: float = 1.0


# Names: GenICam's Standard Features Naming Convention (SFNC).
EXPOSURE = Feature("exposure_s", "exposure time", "ExposureTime", "ExposureAuto", "exposure_time", 1e-6)
GAIN = Feature("gain", "gain", "Gain", "GainAuto", "gain")
MEANINGS = (EXPOSURE, GAIN)


class Control:
    """One setting of one opened camera. Its methods raise GenicamError."""

    def __init__(self, arv: Library, camera: int, meaning: Feature) -> None:
        self._arv, self._camera, self.meaning = arv, camera, meaning
        self.exists = bool(arv(f"camera_is_{meaning.called}_available", camera))

    @property
    def automatic(self) -> bool:
        """Whether the camera itself sets it now."""
        name = self.meaning.automatic
        if not self._arv("camera_is_feature_available", self._camera, name):
            return False
        return str(self._arv("camera_get_string", self._camera, name)) != OFF

    def value(self) -> float | None:
        """Return what is set now; None if the camera sets it itself."""
        if self.automatic:
            return None
        one = self.meaning
        return one.unit * float(self._arv(f"camera_get_{one.called}", self._camera))

    def bounds(self) -> tuple[float, float]:
        """Return the least and the highest that may be set."""
        one = self.meaning
        low, high = ctypes.c_double(), ctypes.c_double()
        name = f"camera_get_{one.called}_bounds"
        self._arv(name, self._camera, ctypes.byref(low), ctypes.byref(high))
        return one.unit * low.value, one.unit * high.value

    def set(self, value: float) -> None:
        """Turn its automatic off, and set it; a value that is refused leaves the automatic as it was."""
        name = self.meaning.automatic
        was = str(self._arv("camera_get_string", self._camera, name)) if self.automatic else OFF
        if was != OFF:
            self._arv("camera_set_string", self._camera, name, OFF)
        try:
            self._arv(f"camera_set_{self.meaning.called}", self._camera, value / self.meaning.unit)
        except GenicamError as error:
            if was != OFF:
                try:
                    self._arv("camera_set_string", self._camera, name, was)
                except GenicamError as other:
                    raise GenicamError(f"{error}; {name} stays {OFF}: {other}") from None
            raise


def set_up(
    arv: Library, camera: int, wanted: Mapping[str, float]
) -> tuple[dict[str, float | None], list[str]]:
    """Set what is wanted, by name, of a camera that is being opened.

    Returns the value of each setting that it has (None: its automatic sets it), and a sentence for each that
    it lacks or that became another. Raises GenicamError if it refuses one.
    """
    values: dict[str, float | None] = {}
    problems: list[str] = []
    for one in MEANINGS:
        control = Control(arv, camera, one)
        if not control.exists:
            if one.name in wanted:
                problems.append(f"the camera has no control for {one.word}; it stays as it is")
            continue
        if one.name in wanted:
            control.set(wanted[one.name])
        value = values[one.name] = control.value()
        if one.name in wanted:
            problems += _other(one, value, wanted[one.name])
    return values, problems


def _other(one: Feature, value: float | None, wanted: float) -> list[str]:
    """A sentence for a value that became another than wanted; none if it did not."""
    if value is None:
        return [f"{one.name} stays with the camera's automatic where {wanted:.6g} was requested"]
    if math.isclose(value, wanted, rel_tol=SAME, abs_tol=1e-12):
        return []
    return [f"{one.name} is {value:.6g} where {wanted:.6g} was requested{NEAREST}"]


def settings_of(arv: Library, camera: int, period_s: float | None) -> list[CameraSetting]:
    """Return what of a camera may be changed, as it is now.

    ``period_s`` is from frame to frame and bounds an exposure; None if the camera is triggered or does not
    say. Raises GenicamError if the camera does not answer.
    """
    found = []
    for one in MEANINGS:
        control = Control(arv, camera, one)
        if not control.exists:
            continue
        low, high = control.bounds()
        if one is EXPOSURE and period_s is not None:
            high = max(low, min(high, period_s))
        found.append(CameraSetting(one.name, control.value(), low, high, automatic=control.automatic))
    return found


def change(
    arv: Library, camera: int, wanted: Mapping[str, float], in_force: Mapping[str, ValuesSet], device: str
) -> tuple[dict[str, float], list[str], DriverError | None]:
    """Change settings one after the other, as `change_each`."""
    meanings = {one.name: one for one in MEANINGS}

    def set_one(name: str, value: float) -> tuple[float | None, str, str]:
        reason = ""
        try:
            control = Control(arv, camera, meanings[name])
            try:
                control.set(value)
            except GenicamError as error:
                reason = str(error)
            return control.value(), reason, NEAREST
        except GenicamError as error:
            message = f"it is not known whether {name} was changed: {reason or error}"
            raise StreamFailed(message, device=device) from None

    ordered = [(one.name, wanted[one.name]) for one in MEANINGS if one.name in wanted]
    return change_each(ordered, in_force, set_one, time.monotonic, device)
