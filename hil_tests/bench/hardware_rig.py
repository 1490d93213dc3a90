"""A real head made to look like the rigs of the contract suite.

The suite moves its heads within LIMITS_RAD; a real head, of this repository's drivers or of one from
outside (``package.module:factory``), moves within the limits of its configuration.
`Scaled` stands between: it maps the one range onto the other, axis by axis, so that the same tests run
unchanged and a head with narrow limits makes small moves.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from drivers.faults import FaultPanel
from drivers.hardware import DeviceSettings, HardwareSettings
from drivers.interfaces import PanTilt, Reading
from drivers.open_hardware import open_hardware
from mastctl.config import Config, load_config
from mastctl.pointing.settings import PointingSettings
from tools.campaigns.servo_rigs import LIMITS_RAD, Rig

CHOSEN: str | None = None
"""The configuration that --hardware names."""

COUNTS = {"dynamixel": 3, "flir_ptu": 1}
"""How many counts from its goal a head of a driver may stand when it calls itself settled."""

OUTSIDE_COUNT_RAD = 1e-3
"""Taken for the count of a head from outside, which nobody here knows; a 12-bit servo has 1.5e-3."""


class Scaled:
    """A head whose limits look like LIMITS_RAD, and which remembers what it measured."""

    def __init__(self, head: PanTilt, config: Config) -> None:
        self._head = head
        self._ends = (config.limits.pan_rad, config.limits.tilt_rad)
        self._cap = config.limits.speed_rad_per_s
        self.scales = [
            (high - low) / (far - near)
            for (low, high), (near, far) in zip(self._ends, LIMITS_RAD, strict=True)
        ]
        self._seen: list[tuple[float, float, float]] = []

    def read(self) -> Reading:
        """Read, in the suite's angles."""
        found = self._head.read()
        pan, tilt = (self._to_suite(axis, a) for axis, a in enumerate((found.pan_rad, found.tilt_rad)))
        self._seen.append((found.time_s, pan, tilt))
        return Reading(pan, tilt, found.moving, found.time_s, found.faults)

    def move(self, pan_rad: float, tilt_rad: float, speed_rad_per_s: float | None = None) -> None:
        """Move, from the suite's angles, never faster than the configuration's cap."""
        speed = self._cap if speed_rad_per_s is None else speed_rad_per_s * min(self.scales)
        if speed > self._cap:
            speed = self._cap
        self._head.move(self._to_head(0, pan_rad), self._to_head(1, tilt_rad), speed)

    def stop(self) -> None:
        """Stop."""
        self._head.stop()

    def close(self) -> None:
        """Close."""
        self._head.close()

    def seen_rad(self, time_s: float) -> tuple[float, float]:
        """The measured angles of a moment; a real head's true ones nobody knows."""
        if not self._seen:
            self.read()
        times_s, pans, tilts = zip(*self._seen, strict=True)
        return float(np.interp(time_s, times_s, pans)), float(np.interp(time_s, times_s, tilts))

    def _to_suite(self, axis: int, angle_rad: float) -> float:
        return LIMITS_RAD[axis][0] + (angle_rad - self._ends[axis][0]) / self.scales[axis]

    def _to_head(self, axis: int, angle_rad: float) -> float:
        (low, high), (near, far) = self._ends[axis], LIMITS_RAD[axis]
        if angle_rad in (near, far):
            return low if angle_rad == near else high
        if angle_rad < near or angle_rad > far:
            return math.nextafter(low, -math.inf) if angle_rad < near else math.nextafter(high, math.inf)
        return low + (angle_rad - near) * self.scales[axis]


@contextmanager
def hardware_rig(file: Path) -> Iterator[Rig]:
    """The head of a configuration, standing in the middle of its limits."""
    config = load_config(file)
    settings = config.hardware.pan_tilt
    outside = ":" in settings.driver
    own_count_rad = OUTSIDE_COUNT_RAD if outside else _count_rad(settings)
    with open_hardware(HardwareSettings(settings, {})) as hardware:
        head = Scaled(hardware.pan_tilt, config)
        count_rad = own_count_rad / min(head.scales)
        settle_rad = (
            PointingSettings().arrival_tolerance_rad / min(head.scales)  # what the service takes
            if outside
            else COUNTS[settings.driver] * count_rad
        )
        yield Rig(
            name=f"{settings.driver}, real",
            head=head,
            panel=FaultPanel(lambda: 0.0, ()),
            true_rad=head.seen_rad,
            count_rad=count_rad,
            settle_rad=settle_rad,
            fastest_rad_per_s=None,
        )


def error_registers(settings: DeviceSettings) -> dict[str, Any]:
    """What the device itself has noted as wrong, by name; the head has to be closed."""
    options = settings.options
    if settings.driver == "dynamixel":
        from drivers.dynamixel.link import Link
        from drivers.dynamixel.workshop import facts

        link = Link(options["port"], options.get("baud", 1_000_000))
        try:
            found = {name: facts(link, options[name]["id"]).values for name in ("pan", "tilt")}
        finally:
            link.close()
        return {name: values["hardware_error"] for name, values in found.items() if values["hardware_error"]}
    return {}  # a PTU has none: what it says by itself (!P, !T) is in the last reading's faults


def _count_rad(settings: DeviceSettings) -> float:
    """One count of a head, radians; the coarser axis."""
    if settings.driver == "dynamixel":
        from drivers.dynamixel.models import model_named

        return float(max(model_named(settings.options[n]["model"]).count_rad for n in ("pan", "tilt")))
    if settings.driver == "flir_ptu":
        from drivers.flir_ptu.workshop import facts

        found = facts(settings.options["port"], settings.options.get("baud", 9600))
        arcsec = max(found.pan.resolution_arcsec, found.tilt.resolution_arcsec)
        return math.radians(arcsec / 3600)
    raise ValueError(f"the count of driver {settings.driver!r} is not known here")
