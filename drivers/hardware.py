"""The devices of a configuration: which drivers there are, how devices are named, what they are when open."""

from __future__ import annotations

import importlib
import json
import logging
import sys
import threading
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from types import MappingProxyType, TracebackType
from typing import TYPE_CHECKING, Any, Literal

from drivers.absent import AbsentCamera
from drivers.clock import Clock, SystemClock
from drivers.errors import BadOptions
from drivers.faults import PAN_TILT, nearest
from drivers.interfaces import Camera, PanTilt
from drivers.serial_line import stable_name
from drivers.simulation_clock import SimulationClock, simulation_speed

if TYPE_CHECKING:
    from drivers.sim.rover import SimulatedRover


log = logging.getLogger(__name__)

HEADS = {
    "dynamixel": "drivers.dynamixel.head",
    "feetech": "drivers.feetech.head",
    "flir_ptu": "drivers.flir_ptu.head",
    "pelco": "drivers.pelco.head",
    "visca": "drivers.visca.head",
}
"""Pan/tilt drivers of this repository: the module whose ``open_head(options, clock)`` opens them, and whose
``halt(options)`` stops a head that no daemon drives any more."""

HEAD_OPTIONS = {
    "dynamixel": "drivers.dynamixel.settings:dynamixel_settings",
    "feetech": "drivers.feetech.settings:feetech_settings",
    "flir_ptu": "drivers.flir_ptu.options:options_from",
    "pelco": "drivers.pelco.options:options_from",
    "visca": "drivers.visca.options:options_from",
}
"""The reader of the options of each."""

CAMERAS = {"aravis": "drivers.aravis.camera", "v4l2": "drivers.v4l2.camera"}
"""Camera drivers of this repository: the module whose ``open_camera(options, clock, name)`` opens one."""

OURS = ("sim", "replay")
"""No device behind them: they neither fail for a moment nor block, and live on any clock."""

BUILT_IN = (*HEADS, *CAMERAS, *OURS)

Kind = Literal["head", "camera"]
GROUPS: Mapping[Kind, str] = {"head": "mastctl.heads", "camera": "mastctl.cameras"}
"""The groups of entry points by which an installed package names its factories."""

HardwareKind = Literal["real", "simulated", "replayed", "mixed"]

CLOSING_PATIENCE_S = 0.5
"""After that the next device is closed beside one that is not closed yet."""

CLOSING_S = 10.0
"""Devices that are not closed by then are left behind, so that a driver that hangs holds no command's end."""


def clock_for(settings: HardwareSettings) -> Clock:
    """Return the clock that these devices live on: the simulation's, if it is not to go as life does.

    Raises
    ------
    BadOptions
        If a speed is asked for that is none, or that a device cannot follow: real ones and those from outside
        live in real time.
    """
    speed = simulation_speed(settings.simulation.get("speed", 1.0))
    if speed == 1.0:
        return SystemClock()
    told = f"simulation.speed is {settings.simulation['speed']}, expected 1:"
    for name, device in {PAN_TILT: settings.pan_tilt, **settings.cameras}.items():
        if device.driver not in OURS:
            raise BadOptions(f"{told} driver {device.driver!r} lives in real time", device=name)
    return SimulationClock(speed)


@dataclass(frozen=True)
class InstalledDriver:
    """A driver that an installed package offers.

    Attributes
    ----------
    kind, name
        The device that it drives, and its name in a configuration.
    factory
        ``package.module:factory``.
    package
        The distribution's name and version.
    """

    kind: Kind
    name: str
    factory: str
    package: str


def installed_drivers() -> Sequence[InstalledDriver]:
    """Return the drivers that installed packages offer, heads first, by name; imports none of them."""
    return _installed(tuple((folder, _changed_ns(folder)) for folder in sys.path))


def _changed_ns(folder: str) -> int:
    """When something was put into a folder or taken out of it last; 0 for none."""
    try:
        return Path(folder).stat().st_mtime_ns
    except OSError:
        return 0


@lru_cache(maxsize=1)
def _installed(folders: tuple[tuple[str, int], ...]) -> Sequence[InstalledDriver]:
    """What these folders offer: all their packages are read for it, 12 ms of processor time."""
    from importlib.metadata import entry_points  # loads 50 modules, and most rigs have no such driver

    every, found = entry_points(), []
    for kind, group in GROUPS.items():
        for entry in sorted(every.select(group=group), key=lambda entry: (entry.name, entry.value)):
            package = "" if entry.dist is None else f"{entry.dist.name} {entry.dist.version}"
            found.append(InstalledDriver(kind, entry.name, entry.value, package))
    return tuple(found)


def factory_of(kind: Kind, driver: str, device: str) -> str:
    """Return the factory, ``package.module:factory``, of a driver that is not in this repository.

    Parameters
    ----------
    kind
        The device that it is to drive.
    driver
        The factory itself, or the name by which an installed package offers one.
    device
        Put before a message.

    Raises
    ------
    BadOptions
        If no package offers it for this kind, or several do.
    """
    if ":" in driver:
        return driver
    installed = installed_drivers()
    named = [one for one in installed if one.name == driver]
    factories = {one.factory: one.package for one in named if one.kind == kind}
    if len(factories) == 1:
        return next(iter(factories))
    if factories:
        packages = " and ".join(factories.values())
        raise BadOptions(f"{packages} both offer a driver {driver!r}; uninstall one of them", device=device)
    if named:
        words = f"driver {driver!r} of {named[0].package} is for a {named[0].kind}, not for a {kind}"
        raise BadOptions(words, device=device)
    known = (*BUILT_IN, *(one.name for one in installed if one.kind == kind))
    raise BadOptions(
        f"there is no driver {driver!r}{nearest(driver, known)}; a driver from outside is named "
        f"package.module:factory, or as its package names it in the group {GROUPS[kind]}",
        device=device,
    )


def head_name(settings: HardwareSettings) -> str | None:
    """Return which head any settings drive: None for one in this program's memory.

    A head is its line (`drivers.serial_line.stable_name` of the option ``port``); one from outside without
    such an option is its factory with all options.
    """
    device = settings.pan_tilt
    outside = ":" in device.driver
    if not outside and device.driver not in BUILT_IN:
        outside = any(one.name == device.driver for one in installed_drivers())
    if device.driver not in HEADS and not outside:
        return None
    port = device.options.get("port")
    if isinstance(port, str) and port:
        return stable_name(port)
    if outside:
        return f"{device.driver} {json.dumps(dict(device.options), sort_keys=True, default=str)}"
    return None


@dataclass(frozen=True)
class DeviceSettings:
    """A device as a configuration names it: the driver, and its options.

    ``offset_s`` is for cameras: how much later than its stamps say mid-exposure is, as it was measured.
    """

    driver: str
    options: Mapping[str, Any] = field(default_factory=dict)
    offset_s: float = 0.0


def head_options(device: DeviceSettings) -> Any:
    """Return the options of a head of this repository as its driver reads them. Raises BadOptions."""
    module, _, reader = HEAD_OPTIONS[device.driver].partition(":")
    return getattr(importlib.import_module(module), reader)(device.options)


@dataclass(frozen=True)
class HardwareSettings:
    """All devices of a configuration.

    Attributes
    ----------
    pan_tilt
        The head.
    cameras
        Cameras by name, as in the mast file.
    simulation
        The ``simulation`` section, which makes the one rover that all ``sim`` devices share.
    folder
        Where relative paths in options start: the configuration's folder.
    """

    pan_tilt: DeviceSettings
    cameras: Mapping[str, DeviceSettings]
    simulation: Mapping[str, Any] = field(default_factory=dict)
    folder: Path = Path()


class Hardware:
    """Open devices. A context manager: leaving it closes them, the head first.

    Attributes
    ----------
    pan_tilt, cameras
        The devices.
    kind
        ``real``, ``simulated``, ``replayed``, or ``mixed``. Drivers from outside count as real, if they do
        not say otherwise (`drivers.interfaces.SaysSimulated`).
    simulation
        The simulated rover behind ``sim`` devices, or None; only for experiments, tests and faults.
    """

    def __init__(
        self,
        pan_tilt: PanTilt,
        cameras: Mapping[str, Camera],
        kinds: Mapping[str, HardwareKind | None],
        simulation: SimulatedRover | None = None,
    ) -> None:
        self.pan_tilt = pan_tilt
        self.cameras = MappingProxyType(dict(cameras))
        self._kinds = dict(kinds)
        self.simulation = simulation

    @property
    def kind(self) -> HardwareKind:
        """The kind of the devices, together."""
        devices = {PAN_TILT: self.pan_tilt, **self.cameras}
        found = {self._kinds.get(name) or _own_word(device) for name, device in devices.items()}
        return found.pop() if len(found) == 1 else "mixed"

    def close(self) -> None:
        """Close every device; one that fails to is logged and does not keep the others open."""
        devices = {PAN_TILT: self.pan_tilt, **self.cameras}
        close_devices(devices if self.simulation is None else {**devices, "simulated rover": self.simulation})

    def __enter__(self) -> Hardware:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self.close()


def says_simulated(device: object) -> bool:
    """Return whether a device says that nothing of it is real (`drivers.interfaces.SaysSimulated`)."""
    try:
        return getattr(device, "simulated", False) is True
    except Exception:  # a property of somebody else's: what cannot be told is taken as real
        return False


def _own_word(device: object) -> HardwareKind:
    """What a device from outside says that it is."""
    if isinstance(device, AbsentCamera):
        device = device.camera
    return "simulated" if says_simulated(device) else "real"


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
