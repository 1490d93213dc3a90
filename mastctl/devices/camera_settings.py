"""The cameras' settings: changed between operations, and kept while one compares its images."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager, suppress
from dataclasses import dataclass
from numbers import Real
from typing import Any

from drivers.clock import Clock
from drivers.errors import BadReply, BadSetting, DriverError
from drivers.interfaces import SETTINGS, Camera, CameraSetting
from mastctl.control.machine import StandingFault
from mastctl.devices.frames import check_known
from mastctl.devices.thread import DeviceThread
from mastctl.errors import NotNow

HOLD_TIMEOUT_S = 3.0  # a driver waits up to 2 s for changes under way to show
SET_TIMEOUT_S = 2.0


class CameraControls:
    """The settings of all cameras; safe from any thread.

    ``cameras`` and ``threads`` may get other entries later. ``clock`` stamps the faults.
    """

    def __init__(
        self, cameras: Mapping[str, Camera], threads: Mapping[str, DeviceThread], clock: Clock
    ) -> None:
        self._cameras = cameras
        self._threads = threads
        self._clock = clock
        self._holds = Counter[str]()  # of each camera, counted in its own thread
        self._refocused: Mapping[str, _Refocused] = {}  # replaced, never edited

    def of(self, name: str) -> tuple[list[CameraSetting], bool]:
        """Return what a camera is set to, and whether an operation keeps it; empty if nothing can change.

        Raises NotKnown; NoReply, BadReply, DriverError if the camera does not answer within 2 s.
        """
        check_known(name, self._cameras)
        return self._threads[name].call("settings", lambda: self._read(name), SET_TIMEOUT_S, noted=False)

    def change(self, name: str, wanted: Mapping[str, float]) -> list[str]:
        """Change some of a camera's settings; return a sentence for each that became another than wanted.

        Raises BadSetting: for one that it lacks, cannot change, or that is out of its bounds; nothing has
        changed then, but what the sentence names; NotNow ``busy`` if an operation keeps them; NotKnown,
        NoReply, BadReply, DriverError: as `of`.
        """
        check_known(name, self._cameras)

        def change() -> list[str]:
            if self._holds[name]:
                why = "an operation compares its pictures and holds its settings; wait for it or stop it"
                raise NotNow("busy", f"{name}: {why}")
            before, _ = self._read(name)
            changes = check_wanted(before, wanted, name)
            try:
                notes = [str(note) for note in self._cameras[name].adjust(changes)]
            except BaseException:
                with suppress(Exception):  # the first error counts
                    self._note_focus(name, wanted, before)
                raise
            self._note_focus(name, wanted, before)
            return notes

        return self._threads[name].call("adjust", change, SET_TIMEOUT_S, noted=False)

    def hold(self, name: str) -> Callable[[], None]:
        """Keep a camera's exposure and settings as they are; return what ends that.

        Both ends are queued in the camera's own thread, and no caller waits for them. The beginning comes
        before every image that is taken after it, the end after the beginning, however late that is. So a
        camera that hangs or refuses keeps no operation waiting; its fault says so.
        """
        context: list[AbstractContextManager[None]] = []
        begun: list[bool] = []

        def enter() -> None:
            begun.append(True)
            self._holds[name] += 1
            one = self._cameras[name].exposure_held()
            one.__enter__()
            context.append(one)

        def leave() -> None:
            self._holds[name] -= len(begun)
            if context:
                context.pop().__exit__(None, None, None)

        def release() -> None:
            with suppress(DriverError):  # closed, and with it the camera
                self._threads[name].submit("release_exposure", leave, HOLD_TIMEOUT_S, anyway=True)

        try:
            self._threads[name].submit("hold_exposure", enter, HOLD_TIMEOUT_S)
        except DriverError:  # overdue or closed: its fault says so already, and it takes no images
            return lambda: None
        return release

    def calibrated(self) -> None:
        """Treat the focus that each camera has now as that of the mast file, which came into use."""
        self._refocused = {}

    def faults(self) -> list[StandingFault]:
        """Return a fault for each camera that has another focus than it was calibrated with."""
        return [
            StandingFault(
                name,
                "refocused",
                f"{name}: its focus is {one.now:g} and was {one.calibrated:g} when the mast file came into "
                "use; the calibration is not of this focus",
                one.since_s,
                f"its focus is {one.calibrated:g} again, or another mast file is in use",
            )
            for name, one in self._refocused.items()
        ]

    def _read(self, name: str) -> tuple[list[CameraSetting], bool]:
        """In the camera's thread: what it states, if that can be."""
        return [_checked(one, name) for one in self._cameras[name].settings()], self._holds[name] > 0

    def _note_focus(self, name: str, wanted: Mapping[str, float], before: Sequence[CameraSetting]) -> None:
        """Compare a focus that was to be changed with that of before its first change."""
        if "focus" not in wanted:
            return
        had = next((one.value for one in before if one.name == "focus"), None)
        now = next((one.value for one in self._read(name)[0] if one.name == "focus"), None)
        former = self._refocused.get(name)
        calibrated = former.calibrated if former is not None else had
        others = {key: one for key, one in self._refocused.items() if key != name}
        if calibrated is None or now is None or now == calibrated:
            self._refocused = others
        else:
            since_s = self._clock.now_s() if former is None else former.since_s
            self._refocused = {**others, name: _Refocused(calibrated, now, since_s)}


@dataclass(frozen=True)
class _Refocused:
    """The focus that a camera was calibrated with, the one that it has, and since when it is not that."""

    calibrated: float
    now: float
    since_s: float


def _checked(one: object, camera: str) -> CameraSetting:
    """What a driver states of a setting, its numbers as Python's own. Raises BadReply for what cannot be."""
    if not isinstance(one, CameraSetting) or one.name not in SETTINGS:
        name = getattr(one, "name", type(one).__name__)
        expected = f"where one of {', '.join(SETTINGS)} is expected"
        raise BadReply(f"settings returned {name!r} {expected}", device=camera)
    found: dict[str, Any] = {}
    for key, is_right, expected in _RIGHT:
        found[key] = value = getattr(one, key)
        if not is_right(value):
            message = f"settings returned {one.name} with {key} {value!r} where {expected} is expected"
            raise BadReply(message, device=camera)
        if _is_number(value):
            found[key] = float(value)
    if found["minimum"] > found["maximum"]:
        bounds = f"minimum {one.minimum:g} above maximum {one.maximum:g}"
        raise BadReply(f"settings returned {one.name} with {bounds}", device=camera)
    return CameraSetting(one.name, **found)


def _is_number(value: object) -> bool:
    if not isinstance(value, Real) or isinstance(value, bool):
        return False
    try:
        return math.isfinite(value)
    except OverflowError:  # an integer
        return False


_RIGHT: tuple[tuple[str, Callable[[Any], bool], str], ...] = (
    ("value", lambda value: value is None or _is_number(value), "a finite number or None"),
    ("minimum", _is_number, "a finite number"),
    ("maximum", _is_number, "a finite number"),
    ("step", lambda value: _is_number(value) and value >= 0, "a finite number of 0 or more"),
    ("automatic", lambda value: isinstance(value, bool), "True or False"),
    ("refusal", lambda value: isinstance(value, str), "a text"),
)


def check_wanted(
    known: Sequence[CameraSetting], wanted: Mapping[str, float], camera: str
) -> dict[str, float]:
    """Return settings that a camera has, can change, and that are within its bounds. Raises BadSetting.

    Bounds are shown with six digits, and one that comes back so is the bound.
    """
    has = {one.name: one for one in known}
    found: dict[str, float] = {}
    for name, value in wanted.items():
        if name not in has:
            known_ones = f"it has {', '.join(has)}" if has else "nothing of it can be changed while it runs"
            raise BadSetting(f"it has no {name}; {known_ones}", device=camera)
        one, unit = has[name], SETTINGS[name] and f" {SETTINGS[name]}"
        if one.refusal:
            raise BadSetting(f"{name} {one.refusal}", device=camera)
        low, high = f"{one.minimum:g}", f"{one.maximum:g}"
        if not min(float(low), one.minimum) <= value <= max(float(high), one.maximum):
            message = f"{name} is to be {value:g}{unit}, {low} to {high}{unit} is expected"
            raise BadSetting(message, device=camera)
        found[name] = min(max(value, one.minimum), one.maximum)
    return found
