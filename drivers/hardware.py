"""The devices of a configuration: how they are named, which clock they run on, what they are when open."""

from __future__ import annotations

import json
import logging
import threading
import time
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

from drivers.clock import Clock, SystemClock
from drivers.errors import BadOptions
from drivers.faults import PAN_TILT
from drivers.interfaces import Camera, PanTilt
from drivers.registry import HardwareKind, Kind, driver_of, whole
from drivers.serial_line import stable_name
from drivers.sim import ROVER
from drivers.simulation_clock import SimulationClock, simulation_speed

if TYPE_CHECKING:
    from drivers.sim.rover import RoverModel


log = logging.getLogger(__name__)

CLOSING_PATIENCE_S = 0.5
"""After that the next device is closed beside one that is not closed yet."""

CLOSING_S = 10.0
"""Devices that are not closed by then are left behind, so that a driver that hangs holds no command's end."""


def clock_for(settings: HardwareSettings) -> Clock:
    """Return the clock that these devices live on: the simulation's, if it is not to go as life does.

    Raises BadOptions if the speed is none, or a device cannot follow it, since its driver runs in real time.
    """
    speed = simulation_speed(settings.simulation.get("speed", 1.0))
    if speed == 1.0:
        return SystemClock()
    message = f"simulation.speed is {settings.simulation['speed']}, expected 1:"
    devices: dict[Kind, Mapping[str, DeviceSettings]]
    devices = {"head": {PAN_TILT: settings.pan_tilt}, "camera": settings.cameras}
    for kind, named in devices.items():
        for name, device in named.items():
            if not driver_of(kind, device.driver, name).any_clock:
                raise BadOptions(f"{message} driver {device.driver!r} runs in real time", device=name)
    return SimulationClock(speed)


def is_hardware(hardware: HardwareKind, kind: Kind, driver: str) -> bool:
    """Return whether the devices of a driver are ``real``, ``simulated`` or ``replayed``."""
    with suppress(BadOptions):  # there is none of this name: the same sentence comes when it is opened
        return driver_of(kind, driver, driver).hardware == hardware
    return False


def head_name(settings: HardwareSettings) -> str | None:
    """Return which head any settings drive: None for one in this program's memory.

    A head is its line (`drivers.serial_line.stable_name` of the option ``port``); one from outside without
    such an option is its factory with all options.
    """
    device = settings.pan_tilt
    try:
        driver = driver_of("head", device.driver, PAN_TILT)
    except BadOptions:  # the same sentence comes when it is opened
        return None
    if driver.hardware != "real":
        return None
    port = device.options.get("port")
    if isinstance(port, str) and port:
        return stable_name(port)
    return f"{device.driver} {json.dumps(dict(device.options), sort_keys=True, default=str)}"


@dataclass(frozen=True)
class DeviceSettings:
    """A device as a configuration names it: the driver, and its options.

    ``offset_s`` is for cameras: how much later than its stamps say mid-exposure is, as it was measured.
    """

    driver: str
    options: Mapping[str, Any] = field(default_factory=dict)
    offset_s: float = 0.0


@dataclass(frozen=True)
class HardwareSettings:
    """All devices of a configuration, and its folder, where relative paths in options start.

    ``simulation`` is the section that makes the one rover that all ``sim`` devices share.
    """

    pan_tilt: DeviceSettings
    cameras: Mapping[str, DeviceSettings]
    simulation: Mapping[str, Any] = field(default_factory=dict)
    folder: Path = Path()


class Hardware:
    """Open devices. A context manager: leaving it closes them, the head first.

    ``simulation`` is the simulated rover behind ``sim`` devices, or None; only for experiments, tests and
    faults.
    """

    def __init__(
        self,
        pan_tilt: PanTilt,
        cameras: Mapping[str, Camera],
        kinds: Mapping[str, HardwareKind],
        shared: Mapping[str, Any] = MappingProxyType({}),
    ) -> None:
        self.pan_tilt = whole(pan_tilt, PanTilt)
        self.cameras = MappingProxyType({name: whole(camera, Camera) for name, camera in cameras.items()})
        self._kinds = dict(kinds)
        self._shared = shared
        self.simulation: RoverModel | None = shared.get(ROVER)

    @property
    def kind(self) -> HardwareKind:
        """The kind of the devices, together."""
        devices: dict[str, PanTilt | Camera] = {PAN_TILT: self.pan_tilt, **self.cameras}
        found = {self._kind(name, device) for name, device in devices.items()}
        return found.pop() if len(found) == 1 else "mixed"

    def _kind(self, name: str, device: PanTilt | Camera) -> HardwareKind:
        kind = self._kinds.get(name, "real")
        return "simulated" if kind == "real" and says_simulated(device) else kind

    def close(self) -> None:
        """Close every device; one that fails to is logged and does not keep the others open."""
        close_devices({PAN_TILT: self.pan_tilt, **self.cameras, **closable(self._shared)})

    def __enter__(self) -> Hardware:
        return self

    def __exit__(self, *raised: object) -> None:
        self.close()


def says_simulated(device: PanTilt | Camera) -> bool:
    """Return whether a device says that nothing of it is real."""
    try:
        return device.info.simulated is True
    except Exception:  # of a driver from outside: what cannot be known is taken as real
        return False


def closable(shared: Mapping[str, Any]) -> dict[str, Any]:
    """Return what devices shared and is to be closed after them."""
    return {name: one for name, one in shared.items() if hasattr(one, "close")}


def close_devices(devices: Mapping[str, Any]) -> None:
    """Close devices in this order, whatever some of them do; one that takes long keeps no other open."""

    def close(name: str, device: Any) -> None:
        try:
            device.close()
        except BaseException:  # whatever a foreign driver raises, SystemExit too: there is only the log
            log.exception("%s did not close", name)

    until_s = time.monotonic() + CLOSING_S
    closing = {}
    for name, device in devices.items():
        thread = threading.Thread(target=close, args=(name, device), name=f"closing {name}", daemon=True)
        closing[name] = thread
        thread.start()
        thread.join(CLOSING_PATIENCE_S)
    for name, thread in closing.items():
        thread.join(max(0.0, until_s - time.monotonic()))
        if thread.is_alive():
            log.error("%s is not closed yet and is left behind", name)
