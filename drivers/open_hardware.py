"""From a configuration's driver names to open devices; nothing else knows real and simulated drivers both."""

from __future__ import annotations

import logging
from collections.abc import Iterator, Mapping
from concurrent.futures import wait
from contextlib import contextmanager
from functools import partial
from typing import Any

from drivers.absent import AbsentCamera, Opening, begin_opening, let_go
from drivers.clock import Clock, SystemClock
from drivers.errors import BadOptions, DriverError, NoReply
from drivers.faults import PAN_TILT
from drivers.frame_times import corrected
from drivers.hardware import DeviceSettings, Hardware, HardwareSettings, closable, close_devices
from drivers.interfaces import Camera, PanTilt
from drivers.registry import METHODS, Context, HardwareKind, Kind, driver_of, one_line, whole

log = logging.getLogger(__name__)

OPENING_PATIENCE_S = 5.0
"""A device that takes longer to open is named; if it is a camera, the others go on without it."""

HEAD_OPENING_S = 60.0
"""A head that takes longer to open is refused: without its readings nothing can be done."""


def open_hardware(settings: HardwareSettings, clock: Clock | None = None) -> Hardware:
    """Open the head and every camera that the settings name, one after the other.

    A camera that cannot be reached is absent (`AbsentCamera`), as is one whose opening takes longer than
    `OPENING_PATIENCE_S`; it joins when it can be opened. A head is waited for `HEAD_OPENING_S`.

    ``clock`` is time for simulated and replayed devices, as a rule that of `drivers.hardware.clock_for`; the
    machine's monotonic clock when left out. Raises BadOptions for a driver that does not exist or cannot be
    loaded, and options that it refuses; DriverError from a driver that cannot reach its head; NoReply if it
    does not return in time. Devices opened before are closed again, and those that come later too.
    """
    opener = _Opener(settings, clock or SystemClock())
    devices: dict[str, Any] = {}
    try:
        devices[PAN_TILT] = opener.head(settings.pan_tilt)
        for name, device in settings.cameras.items():
            devices[name] = opener.camera(name, device)
    except BaseException:
        close_devices({**devices, **closable(opener.shared)})
        raise
    pan_tilt = devices.pop(PAN_TILT)
    return Hardware(pan_tilt, devices, opener.kinds, opener.shared)


def halt_head(settings: HardwareSettings) -> list[str]:
    """Stop a head that no daemon drives: open its line, say stop, and leave it holding.

    Nothing is set up, no other device is opened. A head whose driver has no ``halt`` is opened, stopped and
    closed. Raises BadOptions if the settings say too little; DriverError if the head did not confirm; it may
    still move.
    """
    device = settings.pan_tilt
    driver = driver_of("head", device.driver, PAN_TILT)
    if driver.halt is not None:
        return list(driver.halt(device.options))
    if driver.hardware != "real":
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

    Raises BadOptions, DriverError.
    """
    opener = _Opener(settings, clock or SystemClock())
    try:
        camera: Camera = opener.one(name, settings.cameras[name])
        try:
            yield camera
        finally:
            close_devices({name: camera})
    finally:
        close_devices(closable(opener.shared))


class _Opener:
    """Opens the devices of one configuration."""

    def __init__(self, settings: HardwareSettings, clock: Clock) -> None:
        self._settings = settings
        self._clock = clock
        self.kinds: dict[str, HardwareKind] = {}
        self.shared: dict[str, Any] = {}

    def head(self, device: DeviceSettings) -> PanTilt:
        """Open the head, and wait for it."""
        make = partial(self._open, "head", PAN_TILT, device)
        if self._opens_at_once("head", PAN_TILT, device):
            opened: PanTilt = make()
            return opened
        opening = begin_opening(PAN_TILT, make)
        try:
            if not _ended(opening, OPENING_PATIENCE_S):
                log.warning(
                    "%s: driver %r is still opening it after %g s; %g s are allowed",
                    PAN_TILT, device.driver, OPENING_PATIENCE_S, HEAD_OPENING_S,
                )  # fmt: skip
                if not _ended(opening, HEAD_OPENING_S - OPENING_PATIENCE_S):
                    message = f"driver {device.driver!r} did not open it within {HEAD_OPENING_S:g} s"
                    raise NoReply(f"{message}: its factory has not returned", device=PAN_TILT)
            head: PanTilt = opening.result()
            return head
        except BaseException:
            let_go(opening)
            raise

    def camera(self, name: str, device: DeviceSettings) -> Camera:
        """Open a camera, or leave it absent."""
        make = partial(self.one, name, device)
        if self._opens_at_once("camera", name, device):
            return make()
        opening = begin_opening(name, make)
        try:
            if not _ended(opening, OPENING_PATIENCE_S):
                log.warning(
                    "%s: driver %r is still opening it after %g s; going on without it",
                    name, device.driver, OPENING_PATIENCE_S,
                )  # fmt: skip
                return AbsentCamera(name, device.driver, make, opening=opening)
            camera: Camera = opening.result()
            return camera
        except BadOptions:
            raise
        except DriverError as error:
            return AbsentCamera(name, device.driver, make, error=error)
        except BaseException:
            let_go(opening)
            raise

    def one(self, name: str, device: DeviceSettings) -> Camera:
        """Open a camera; its stamps are corrected. Raises DriverError."""
        return corrected(self._open("camera", name, device), device.offset_s)

    def _opens_at_once(self, kind: Kind, name: str, device: DeviceSettings) -> bool:
        """Note what a device is; return whether it is in memory, so that it neither fails nor blocks."""
        self.kinds[name] = driver_of(kind, device.driver, name).hardware
        return self.kinds[name] != "real"

    def _open(self, kind: Kind, name: str, device: DeviceSettings) -> Any:
        settings = self._settings
        context = Context(name, self._clock, settings.folder, settings.simulation, self.shared)
        return open_device(kind, device.driver, device.options, context)


def open_device(kind: Kind, name: str, options: Mapping[str, Any], context: Context) -> Any:
    """Open one device by its driver's name; return a whole `PanTilt` or `Camera`.

    Raises BadOptions if there is no such driver, it refuses the options, or what it opens lacks a method;
    DriverError from the driver, as it is.
    """
    driver = driver_of(kind, name, context.name)
    try:
        made = driver.open(options, context)
    except BadOptions as error:
        raise _named(error, name, context.name) from None
    except DriverError:
        raise
    except (Exception, SystemExit) as error:  # a foreign driver may raise anything: one sentence reports it
        message = f"driver {name!r} refuses the options {dict(options)!r} ({one_line(error)})"
        raise BadOptions(message, device=context.name) from error
    wanted = PanTilt if kind == "head" else Camera
    missing = [method for method in METHODS[wanted] if not callable(getattr(made, method, None))]
    if missing:
        message = f"driver {name!r} made a {type(made).__name__} without {', '.join(missing)}"
        raise BadOptions(message, device=context.name)
    return whole(made, wanted)


def _named(error: BadOptions, driver: str, device: str) -> BadOptions:
    """A refusal with the device's name in front; one that has a name already is as it is."""
    return error if error.device else BadOptions(f"driver {driver!r}: {error}", device=device)


def _ended(opening: Opening, within_s: float) -> bool:
    """Wait for an opening; return whether it has ended."""
    return bool(wait([opening], within_s).done)
