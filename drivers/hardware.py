"""The devices of a configuration: how they are named there, and what they are together once they are open."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from types import MappingProxyType, TracebackType
from typing import TYPE_CHECKING, Any, Literal

from drivers.absent_camera import AbsentCamera
from drivers.faults import PAN_TILT
from drivers.interfaces import Camera, PanTilt

if TYPE_CHECKING:
    from drivers.sim.rover import SimulatedRover

log = logging.getLogger(__name__)

HardwareKind = Literal["real", "simulated", "replayed", "mixed"]

CLOSING_PATIENCE_S = 0.5
"""After that the next device is closed beside one that is not closed yet."""

CLOSING_S = 10.0
"""Devices that are not closed by then are left behind, so that a driver that hangs holds no command's end."""


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
        """What the devices are, together."""
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
