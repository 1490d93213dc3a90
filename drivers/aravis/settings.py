"""The settings that go by meaning: exposure, gain, white balance and focus, at the opening and at run time.

Exposure and gain have several names in GenICam, all of which Aravis knows. For a white balance in kelvin and
a focus there is no standard name; those here are The Imaging Source's.
"""

from __future__ import annotations

import ctypes
import math
import time
from collections.abc import Mapping
from dataclasses import dataclass

from drivers.aravis.library import GenicamError, Library
from drivers.aravis.options import AravisOptions
from drivers.errors import DriverError, StreamFailed
from drivers.interfaces import CameraSetting
from drivers.values_set import SAME, ValuesSet, change_each

OFF = "Off"
NEAREST = ": the camera's nearest"


@dataclass(frozen=True)
class Feature:
    """Which features a setting is.

    Attributes
    ----------
    feature, automatic
        The GenICam names of its value, also as chunk data, and of its automatic.
    called
        How Aravis calls it in its functions; empty: it has none for it.
    unit
        Of the camera's own number, in that of `SETTINGS`.
    """

    name: str
    word: str
    feature: str
    automatic: str
    called: str = ""
    unit: float = 1.0


# Names: GenICam's Standard Features Naming Convention (SFNC); white balance and focus as The Imaging Source's
# cameras have them (tiscamera), which the SFNC does not name.
EXPOSURE = Feature("exposure_s", "exposure time", "ExposureTime", "ExposureAuto", "exposure_time", 1e-6)
GAIN = Feature("gain", "gain", "Gain", "GainAuto", "gain")
MEANINGS = (
    EXPOSURE,
    GAIN,
    Feature("white_balance_k", "white balance", "BalanceWhiteTemperature", "BalanceWhiteAuto"),
    Feature("focus", "focus", "Focus", "FocusAuto"),
)
CHUNKS = (EXPOSURE, GAIN)
"""Those that GenICam has as chunk data."""


class Control:
    """One setting of one opened camera. Its methods raise GenicamError."""

    def __init__(self, arv: Library, camera: int, meaning: Feature) -> None:
        self._arv, self._camera, self.meaning = arv, camera, meaning
        arguments = (meaning.feature,) * (not meaning.called)
        name = f"is_{meaning.called or 'feature'}_available"
        self.exists = bool(arv(f"camera_{name}", camera, *arguments))

    def _kind(self) -> str:
        """How GenICam keeps the feature."""
        try:
            self._arv("camera_get_float", self._camera, self.meaning.feature)
        except GenicamError:
            return "integer"
        return "float"

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
        if one.called:
            return one.unit * float(self._arv(f"camera_get_{one.called}", self._camera))
        return one.unit * float(self._arv(f"camera_get_{self._kind()}", self._camera, one.feature))

    def bounds(self) -> tuple[float, float]:
        """Return the least and the highest that may be set."""
        one = self.meaning
        kind = "" if one.called else self._kind()
        number = ctypes.c_int64 if kind == "integer" else ctypes.c_double
        low, high = number(), number()
        arguments = (one.feature,) if kind else ()
        name = f"camera_get_{kind or one.called}_bounds"
        self._arv(name, self._camera, *arguments, ctypes.byref(low), ctypes.byref(high))
        return one.unit * low.value, one.unit * high.value

    def set(self, value: float) -> None:
        """Turn its automatic off, and set it; a value that is refused leaves the automatic as it was."""
        name = self.meaning.automatic
        was = str(self._arv("camera_get_string", self._camera, name)) if self.automatic else OFF
        if was != OFF:
            self._arv("camera_set_string", self._camera, name, OFF)
        try:
            self._set(value)
        except GenicamError as error:
            if was != OFF:
                try:
                    self._arv("camera_set_string", self._camera, name, was)
                except GenicamError as other:
                    raise GenicamError(f"{error}; {name} stays {OFF}: {other}") from None
            raise

    def _set(self, value: float) -> None:
        one, counts = self.meaning, value / self.meaning.unit
        if one.called:
            self._arv(f"camera_set_{one.called}", self._camera, counts)
        elif self._kind() == "float":
            self._arv("camera_set_float", self._camera, one.feature, counts)
        else:
            self._arv("camera_set_integer", self._camera, one.feature, round(counts))


def set_up(
    arv: Library, camera: int, wanted: Mapping[str, float]
) -> tuple[dict[str, float | None], list[str]]:
    """Set what is wanted, by name, of a camera that is being opened.

    Raises GenicamError if it refuses one.

    Returns
    -------
    values
        Of each setting that it has, None for one that its automatic sets.
    problems
        A sentence for each that it lacks, or that became another.
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


def settings_of(
    arv: Library, camera: int, options: AravisOptions, period_s: float | None
) -> list[CameraSetting]:
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
        refusal = ""
        if one.name == "focus" and one.feature not in options.features:
            refusal = (
                f"is not in the camera's options (features: {one.feature}), "
                "so no restart could come back to the calibrated one"
            )
        found.append(
            CameraSetting(one.name, control.value(), low, high, automatic=control.automatic, refusal=refusal)
        )
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
