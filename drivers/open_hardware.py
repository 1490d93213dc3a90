"""The one entry point to hardware: from a configuration's driver names to open devices.

Nothing else knows real and simulated drivers both. A name is ``dynamixel``, ``flir_ptu``, ``v4l2``, ``sim``,
``replay``, or for a driver from outside this repository ``package.module:factory`` or the name that an
installed package gives it (`drivers.hardware.factory_of`).
"""

from __future__ import annotations

import importlib
import logging
from collections.abc import Iterator
from concurrent.futures import wait
from contextlib import contextmanager
from functools import partial
from typing import TYPE_CHECKING, Any

from drivers.absent import AbsentCamera, Opening, begin_opening, let_go
from drivers.clock import Clock, SystemClock
from drivers.errors import BadOptions, DriverError, NoReply
from drivers.faults import PAN_TILT, nearest
from drivers.frame_times import corrected
from drivers.hardware import (
    CAMERAS,
    HEADS,
    OURS,
    DeviceSettings,
    Hardware,
    HardwareKind,
    HardwareSettings,
    close_devices,
    factory_of,
)
from drivers.interfaces import Camera, PanTilt
from drivers.outside import device_from_outside

if TYPE_CHECKING:
    from drivers.sim.rover import SimulatedRover

log = logging.getLogger(__name__)

OPENING_PATIENCE_S = 5.0
"""A device that takes longer to open is named; if it is a camera, the others go on without it."""

HEAD_OPENING_S = 60.0
"""A head that takes longer to open is refused: without its readings nothing can be done."""


def open_hardware(settings: HardwareSettings, clock: Clock | None = None) -> Hardware:
    """Open the head and every camera that the settings name, one after the other.

    A camera that cannot be reached is absent (`AbsentCamera`), as is one whose opening takes longer than
    `OPENING_PATIENCE_S`; it joins when it can be opened. A head is waited for `HEAD_OPENING_S`.

    Parameters
    ----------
    settings
        Drivers and their options.
    clock
        Time for simulated and replayed devices, as a rule that of `drivers.hardware.clock_for`; the machine's
        monotonic clock when left out.

    Raises
    ------
    BadOptions
        For a driver that does not exist or cannot be loaded, and options that it refuses.
    DriverError
        From a driver that cannot reach its head; NoReply if it does not return in time. Devices opened
        before are closed again, and those that come later too.
    """
    opener = _Opener(settings, clock or SystemClock())
    devices: dict[str, Any] = {}
    try:
        devices[PAN_TILT] = opener.head(settings.pan_tilt)
        for name, device in settings.cameras.items():
            devices[name] = opener.camera(name, device)
    except BaseException:
        close_devices(devices if opener.rover is None else {**devices, "simulated rover": opener.rover})
        raise
    pan_tilt = devices.pop(PAN_TILT)
    return Hardware(pan_tilt, devices, opener.kinds, opener.rover)


def halt_head(settings: HardwareSettings) -> list[str]:
    """Stop a head of which no daemon lives: open its line, say stop, and leave it holding.

    Nothing is set up, no other device is opened. A head from outside is opened, stopped and closed.

    Returns
    -------
    list of str
        The actions on each axis, in plain words.

    Raises
    ------
    BadOptions
        If the settings say too little.
    DriverError
        If the head did not confirm; it may still move.
    """
    device = settings.pan_tilt
    if device.driver in HEADS:
        return list(importlib.import_module(HEADS[device.driver]).halt(device.options))
    if device.driver in OURS:
        return [f"driver {device.driver!r} has no head that moves without its daemon; nothing to halt"]
    head = _Opener(settings, SystemClock()).head(device)
    try:
        head.stop()
    finally:
        head.close()
    return [f"driver {device.driver!r}: stopped and closed"]


@contextmanager
def open_one_camera(settings: HardwareSettings, name: str, clock: Clock | None = None) -> Iterator[Camera]:
    """Open one camera of the settings by itself, without the head, and close it at the end.

    Raises
    ------
    BadOptions, DriverError
        As `open_hardware`; but a camera that cannot be reached is an error here.
    """
    opener = _Opener(settings, clock or SystemClock())
    try:
        camera: Camera = opener.one(name, settings.cameras[name])
        try:
            yield camera
        finally:
            close_devices({name: camera})
    finally:
        if opener.rover is not None:
            close_devices({"simulated rover": opener.rover})


class _Opener:
    """Opens the devices of one configuration; those of a shared rover or replay share it."""

    def __init__(self, settings: HardwareSettings, clock: Clock) -> None:
        self._settings = settings
        self._clock = clock
        self.kinds: dict[str, HardwareKind | None] = {}
        """By device; None for one that says so itself, or not at all."""
        self._replays: dict[str, Any] = {}
        self.rover: SimulatedRover | None = None

    def head(self, device: DeviceSettings) -> Any:
        """Open the head, and wait for it."""
        make = partial(self._open, PAN_TILT, device, PanTilt)
        if device.driver in OURS:
            return make()
        opening = begin_opening(PAN_TILT, make)
        try:
            if not _ended(opening, OPENING_PATIENCE_S):
                log.warning(
                    "%s: driver %r is still opening it after %g s; %g s are allowed",
                    PAN_TILT, device.driver, OPENING_PATIENCE_S, HEAD_OPENING_S,
                )  # fmt: skip
                if not _ended(opening, HEAD_OPENING_S - OPENING_PATIENCE_S):
                    words = f"driver {device.driver!r} did not open it within {HEAD_OPENING_S:g} s"
                    raise NoReply(f"{words}: its factory has not returned", device=PAN_TILT)
            return opening.result()
        except BaseException:
            let_go(opening)
            raise

    def camera(self, name: str, device: DeviceSettings) -> Any:
        """Open a camera, or leave it absent."""

        make = partial(self.one, name, device)
        if device.driver in OURS:
            return make()
        opening = begin_opening(name, make)
        try:
            if not _ended(opening, OPENING_PATIENCE_S):
                log.warning(
                    "%s: driver %r is still opening it after %g s; going on without it",
                    name, device.driver, OPENING_PATIENCE_S,
                )  # fmt: skip
                return AbsentCamera(name, device.driver, make, opening=opening)
            return opening.result()
        except BadOptions:
            raise
        except DriverError as error:
            return AbsentCamera(name, device.driver, make, error=error)
        except BaseException:
            let_go(opening)
            raise

    def one(self, name: str, device: DeviceSettings) -> Any:
        """A camera with its stamps corrected. Raises DriverError."""
        return corrected(self._open(name, device, Camera), device.offset_s)

    def _open(self, name: str, device: DeviceSettings, protocol: type) -> Any:
        """Open one device and check that it does what the protocol asks."""
        if device.driver == "sim":
            self.kinds[name] = "simulated"
            return self._simulated(name, device)
        if device.driver == "replay":
            self.kinds[name] = "replayed"
            return self._replayed(name, device)
        if device.driver in HEADS:
            if protocol is not PanTilt:
                raise BadOptions(f"driver {device.driver!r} is for a pan/tilt head", device=name)
            self.kinds[name] = "real"
            return self._head(name, device)
        if device.driver in CAMERAS:
            if protocol is not Camera:
                words = f"driver {device.driver!r} is for cameras, it moves nothing"
                raise BadOptions(words, device=name)
            self.kinds[name] = "real"
            module = importlib.import_module(CAMERAS[device.driver])
            return module.open_camera(device.options, self._clock, name)
        factory = factory_of("head" if protocol is PanTilt else "camera", device.driver, name)
        self.kinds[name] = None
        return device_from_outside(name, factory, device.options, protocol)

    def _head(self, name: str, device: DeviceSettings) -> Any:
        """A real head; what it raises is told with the device's name in front."""
        module = importlib.import_module(HEADS[device.driver])
        try:
            return module.open_head(device.options, clock=self._clock)
        except BadOptions as error:
            raise BadOptions(f"driver {device.driver!r}: {error}", device=name) from None

    def _simulated(self, name: str, device: DeviceSettings) -> Any:
        """The head or a camera of the one simulated rover."""
        if device.options:
            raise BadOptions(
                f"driver 'sim' has no option {next(iter(device.options))!r}; "
                "the simulated rover is set up in the section 'simulation'",
                device=name,
            )
        if self.rover is None:
            from drivers.sim.rover import SimulatedRover
            from drivers.sim.settings import simulation_settings

            simulation = simulation_settings(self._settings.simulation, self._settings.folder)
            self.rover = SimulatedRover(simulation, self._clock)
        if name == PAN_TILT:
            return self.rover.pan_tilt
        if name not in self.rover.cameras:
            raise BadOptions(
                f"the simulated rover has no such camera{nearest(name, self.rover.cameras)}", device=name
            )
        from drivers.sim.cameras import HangingCamera

        mode = self.rover.sensor_modes[name]
        return HangingCamera(self.rover.cameras[name], mode, self._clock, self.rover.faults)

    def _replayed(self, name: str, device: DeviceSettings) -> Any:
        """The head or a camera of a recording; devices with the same options share one."""
        from drivers.recordings.replay import open_replay

        key = repr(sorted(device.options.items()))
        if key not in self._replays:
            self._replays[key] = open_replay(device.options, self._settings.folder, self._clock)
        replay = self._replays[key]
        if name == PAN_TILT:
            return replay.pan_tilt
        if name not in replay.cameras:
            raise BadOptions(f"the recording has no such camera{nearest(name, replay.cameras)}", device=name)
        return replay.cameras[name]


def _ended(opening: Opening, within_s: float) -> bool:
    """Wait for an opening; return whether it has ended."""
    return bool(wait([opening], within_s).done)
