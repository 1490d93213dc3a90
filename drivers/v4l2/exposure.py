"""Automatic exposure of our own: between measurements it brings a percentile of the grey levels to a target.

The camera's own automatic is off, because it would change pictures in the middle of a measurement and the two
cameras of a pair apart from each other. One `ExposureControl` serves all cameras of a group, which so always
have the same exposure; it looks at the brightest of them.
"""

from __future__ import annotations

import threading
from dataclasses import dataclass
from typing import Annotated

import numpy as np
from pydantic import Field

from calib.files.records import Text
from drivers.errors import BadOptions
from drivers.interfaces import Image
from drivers.options import DriverOptions

PERCENTILE, TARGET, TOLERANCE = 95.0, 180.0, 25.0
"""The percentile of the grey levels is brought to the target, and left alone within the tolerance of it (the
hysteresis: without it, noise alone would change the exposure again and again)."""
SATURATED = 250
PATIENCE = 6  # so many looks of one camera without one of the others: that one gives no pictures now
MOST_STEP = 4.0  # no change by more than this factor at once: levels far from the target tell little


Seconds = Annotated[float, Field(ge=1e-5, le=10.0)]


class AutoExposureSettings(DriverOptions):
    """What the automatic exposure aims at."""

    group: Text = ""
    """Cameras of one name share their exposure."""
    shortest_s: Seconds = 1e-4
    """Shortest exposure."""
    longest_s: Seconds = 0.03
    """Longest exposure; a frame at most."""


def level(image: Image, percentile: float) -> float:
    """Return a percentile of a (h, w) picture's grey levels, from every fourth pixel of every fourth row."""
    return float(np.percentile(image[::4, ::4], percentile))


class ExposureControl:
    """Finds the exposure time for a group of cameras; safe from any thread."""

    def __init__(self, settings: AutoExposureSettings, exposure_s: float) -> None:
        self._settings = settings
        self._exposure_s = exposure_s
        self._members: set[str] = set()
        self._levels: dict[str, float] = {}
        self._looks: dict[str, int] = {}
        self._holds = 0
        self._lock = threading.Lock()

    @property
    def exposure_s(self) -> float:
        """The exposure time that all cameras of the group are to have, seconds."""
        with self._lock:
            return self._exposure_s

    @property
    def is_fixed(self) -> bool:
        """Whether a measurement is under way, during which nothing changes."""
        with self._lock:
            return self._holds > 0

    def hold(self) -> None:
        """Keep the exposure as it is until `release`; calls nest."""
        with self._lock:
            self._holds += 1

    def release(self) -> None:
        """End one `hold`."""
        with self._lock:
            self._holds = max(0, self._holds - 1)
            self._begin_again()

    def join(self, camera: str) -> None:
        """Count a camera in: its pictures are waited for before anything changes."""
        with self._lock:
            self._members.add(camera)

    def leave(self, camera: str) -> None:
        """Count a camera out."""
        with self._lock:
            self._members.discard(camera)
            self._begin_again()

    def see(self, camera: str, image: Image, exposure_s: float) -> float:
        """Take in a grey picture that was taken with ``exposure_s`` and return the exposure time to have now.

        Pictures taken with another exposure than the present one are not judged.
        """
        s = self._settings
        seen = level(image, PERCENTILE)
        with self._lock:
            if self._holds or abs(exposure_s - self._exposure_s) > 1e-9:
                return self._exposure_s
            self._levels[camera] = seen
            self._looks[camera] = self._looks.get(camera, 0) + 1
            if self._members - set(self._levels) and self._looks[camera] < PATIENCE:
                return self._exposure_s
            brightest = max(self._levels.values())
            if abs(brightest - TARGET) <= TOLERANCE:
                return self._exposure_s
            factor = 1 / MOST_STEP if brightest >= SATURATED else TARGET / max(brightest, 1.0)
            factor = min(max(factor, 1 / MOST_STEP), MOST_STEP)
            wanted_s = min(max(self._exposure_s * factor, s.shortest_s), s.longest_s)
            if wanted_s != self._exposure_s:
                self._exposure_s = wanted_s
                self._begin_again()
            return self._exposure_s

    def _begin_again(self) -> None:
        """Forget what was seen: it was taken with another exposure, or of another time."""
        self._levels.clear()
        self._looks.clear()


@dataclass
class _Group:
    """The control that cameras share, and what it was made with by the first of them."""

    control: ExposureControl
    settings: AutoExposureSettings
    exposure_s: float
    maker: str
    users: int = 0


class _Groups:
    """The exposure controls that cameras share, by group name, as long as a camera uses them."""

    def __init__(self) -> None:
        self._known: dict[str, _Group] = {}
        self._lock = threading.Lock()

    def join(self, camera: str, settings: AutoExposureSettings, exposure_s: float) -> ExposureControl:
        """Return the control of a group, made by its first camera; a camera without group has its own.

        Raises BadOptions if the camera has other settings, or begins with another exposure time, than the
        group's first: cameras of one group have one exposure.
        """
        if not settings.group:
            return ExposureControl(settings, exposure_s)
        with self._lock:
            group = self._known.get(settings.group)
            if group is None:
                group = _Group(ExposureControl(settings, exposure_s), settings, exposure_s, camera)
            _check_same(camera, group, settings, exposure_s)
            self._known[settings.group] = group
            group.users += 1
            group.control.join(camera)
            return group.control

    def leave(self, camera: str, settings: AutoExposureSettings) -> None:
        """Let go of a group; the last one out forgets it."""
        with self._lock:
            if (group := self._known.get(settings.group)) is not None:
                group.control.leave(camera)
                group.users -= 1
                if not group.users:
                    del self._known[settings.group]


def _check_same(camera: str, group: _Group, settings: AutoExposureSettings, exposure_s: float) -> None:
    """Refuse settings that differ from a group's. Raises BadOptions."""
    options = [(f"auto_exposure.{name}", name) for name in ("shortest_s", "longest_s")]
    here = {option: getattr(settings, name) for option, name in options} | {"exposure_s": exposure_s}
    there = {option: getattr(group.settings, name) for option, name in options}
    for option, value in (there | {"exposure_s": group.exposure_s}).items():
        if here[option] != value:
            raise BadOptions(
                f"{option!r} is {here[option]:g}, but {value:g} for {group.maker} of the same group "
                f"{settings.group!r}; cameras of a group share one exposure, so the same is expected",
                device=camera,
            )


GROUPS = _Groups()
