"""The one door to hardware: from a configuration's driver names to open devices.

Nothing else knows real and simulated drivers both. A name is ``dynamixel``, ``flir_ptu``, ``v4l2``, ``sim``,
``replay``, or ``package.module:factory`` for a driver from outside this repository (contract section 5).
"""

from __future__ import annotations

import importlib
import logging
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import wait
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from types import MappingProxyType, TracebackType
from typing import TYPE_CHECKING, Any, Literal

from drivers.absent_camera import AbsentCamera, Opening, begin_opening, let_go
from drivers.camera_offset import corrected
from drivers.clock import Clock, SystemClock
from drivers.errors import BadOptions, DriverError, NoReply
from drivers.faults import PAN_TILT, nearest
from drivers.interfaces import Camera, PanTilt
from drivers.simulation_clock import SimulationClock, simulation_speed

if TYPE_CHECKING:
    from drivers.sim.rover import SimulatedRover

log = logging.getLogger(__name__)

Kind = Literal["real", "simulated", "replayed", "mixed"]

HEADS = {"dynamixel": "drivers.dynamixel.head", "flir_ptu": "drivers.flir_ptu.head"}
"""Pan/tilt drivers of this repository: the module whose ``open_head(options, clock)`` opens them."""

OURS = ("sim", "replay")
"""No device behind them: they neither fail for a moment nor block, and live on any clock."""

BUILT_IN = (*HEADS, "v4l2", *OURS)

OPENING_PATIENCE_S = 5.0
"""A device that takes longer to open is named; if it is a camera, the others go on without it."""

CLOSING_PATIENCE_S = 0.5
"""After that the next device is closed beside one that is not closed yet."""

CLOSING_S = 10.0
"""Devices that are not closed by then are left behind, so that a driver that hangs holds no command's end."""

HEAD_OPENING_S = 60.0
"""A head that takes longer to open is refused: without its readings nothing can be done."""


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
        kinds: Mapping[str, Kind | None],
        simulation: SimulatedRover | None = None,
    ) -> None:
        self.pan_tilt = pan_tilt
        self.cameras = MappingProxyType(dict(cameras))
        self._kinds = dict(kinds)
        self.simulation = simulation

    @property
    def kind(self) -> Kind:
        """What the devices are, together."""
        devices = {PAN_TILT: self.pan_tilt, **self.cameras}
        found = {self._kinds.get(name) or _own_word(device) for name, device in devices.items()}
        return found.pop() if len(found) == 1 else "mixed"

    def close(self) -> None:
        """Close every device; one that fails to is logged and does not keep the others open."""
        devices = {PAN_TILT: self.pan_tilt, **self.cameras}
        _close(devices if self.simulation is None else {**devices, "simulated rover": self.simulation})

    def __enter__(self) -> Hardware:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self.close()


def clock_for(settings: HardwareSettings) -> Clock:
    """Return the clock that these devices live on: the simulation's, if it is not to go as life does.

    Raises
    ------
    BadOptions
        If a speed is asked for that is none, or that a device cannot follow: real ones, those from outside,
        and simulated wires live in real time.
    """
    speed = simulation_speed(settings.simulation.get("speed", 1.0))
    if speed == 1.0:
        return SystemClock()
    told = f"simulation.speed is {settings.simulation['speed']}, expected 1:"
    for name, device in {PAN_TILT: settings.pan_tilt, **settings.cameras}.items():
        if device.driver not in OURS:
            raise BadOptions(f"{told} driver {device.driver!r} lives in real time", device=name)
    if settings.simulation.get("wire") is not None:
        raise BadOptions(f"{told} the bytes of simulation.wire travel in real time")
    return SimulationClock(speed)


def open_hardware(settings: HardwareSettings, clock: Clock | None = None) -> Hardware:
    """Open the head and every camera that the settings name, one after the other.

    A camera that cannot be reached is absent (`AbsentCamera`), as is one whose opening takes longer than
    `OPENING_PATIENCE_S`; it joins when it can be opened. A head is waited for `HEAD_OPENING_S`.

    Parameters
    ----------
    settings
        Drivers and their options.
    clock
        Time for simulated and replayed devices, as a rule that of `clock_for`; the machine's monotonic clock
        when left out.

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
        _close(devices if opener.rover is None else {**devices, "simulated rover": opener.rover})
        raise
    pan_tilt = devices.pop(PAN_TILT)
    return Hardware(pan_tilt, devices, opener.kinds, opener.rover)


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
            _close({name: camera})
    finally:
        if opener.rover is not None:
            _close({"simulated rover": opener.rover})


class _Opener:
    """Opens the devices of one configuration; those of a shared rover or replay share it."""

    def __init__(self, settings: HardwareSettings, clock: Clock) -> None:
        self._settings = settings
        self._clock = clock
        self.kinds: dict[str, Kind | None] = {}
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
        if ":" in device.driver:
            self.kinds[name] = None
            return _from_outside(name, device, protocol)
        if device.driver == "sim":
            self.kinds[name] = "simulated"
            return self._simulated(name, device)
        if device.driver == "replay":
            self.kinds[name] = "replayed"
            return self._replayed(name, device)
        if device.driver == "v4l2":
            self.kinds[name] = "real"
            return self._v4l2(name, device)
        if device.driver in HEADS:
            if protocol is not PanTilt:
                raise BadOptions(f"driver {device.driver!r} is for a pan/tilt head", device=name)
            self.kinds[name] = "real"
            return self._head(name, device)
        raise BadOptions(
            f"there is no driver {device.driver!r}{nearest(device.driver, BUILT_IN)}; "
            "a driver from outside is named package.module:factory",
            device=name,
        )

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
            from drivers.sim.rover import SimulatedRover, simulation_settings

            simulation = simulation_settings(self._settings.simulation, self._settings.folder)
            self.rover = SimulatedRover(simulation, self._clock)
        if name == PAN_TILT:
            return self.rover.pan_tilt
        if name not in self.rover.cameras:
            raise BadOptions(
                f"the simulated rover has no such camera{nearest(name, self.rover.cameras)}", device=name
            )
        return self.rover.cameras[name]

    def _replayed(self, name: str, device: DeviceSettings) -> Any:
        """The head or a camera of a recording; devices with the same options share one."""
        from drivers.replay import open_replay

        key = repr(sorted(device.options.items()))
        if key not in self._replays:
            self._replays[key] = open_replay(device.options, self._settings.folder, self._clock)
        replay = self._replays[key]
        if name == PAN_TILT:
            return replay.pan_tilt
        if name not in replay.cameras:
            raise BadOptions(f"the recording has no such camera{nearest(name, replay.cameras)}", device=name)
        return replay.cameras[name]

    def _v4l2(self, name: str, device: DeviceSettings) -> Any:
        """A camera of this machine."""
        if name == PAN_TILT:
            raise BadOptions("driver 'v4l2' is for cameras, it moves nothing", device=name)
        from drivers.v4l2.camera import open_camera

        return open_camera(device.options, self._clock, name)


def _ended(opening: Opening, within_s: float) -> bool:
    """Wait for an opening; return whether it has ended."""
    return bool(wait([opening], within_s).done)


def _factory(name: str, driver: str) -> Callable[..., Any]:
    """The callable that ``package.module:factory`` names."""
    module_name, _, attribute = driver.partition(":")
    try:
        found: Any = importlib.import_module(module_name)
    except (Exception, SystemExit) as error:  # whatever a foreign module does while it is imported
        raise BadOptions(
            f"driver {driver!r}: cannot import {module_name!r} ({_one_line(error)})", device=name
        ) from error
    for part in attribute.split("."):
        if not hasattr(found, part):
            raise BadOptions(f"driver {driver!r}: {module_name!r} has no {attribute!r}", device=name)
        found = getattr(found, part)
    if not callable(found):
        raise BadOptions(f"driver {driver!r}: {attribute!r} cannot be called", device=name)
    factory: Callable[..., Any] = found
    return factory


def _from_outside(name: str, device: DeviceSettings, protocol: type) -> Any:
    """A device made by a factory that is not in this repository."""
    factory = _factory(name, device.driver)
    try:
        made = factory(**device.options)
    except DriverError:
        raise
    except (Exception, SystemExit) as error:  # a foreign factory may raise anything: one sentence tells it
        raise BadOptions(
            f"driver {device.driver!r} refuses the options {dict(device.options)!r} ({_one_line(error)})",
            device=name,
        ) from error
    wanted = [m for m in ("read", "move", "stop", "next_frame", "close") if hasattr(protocol, m)]
    missing = [method for method in wanted if not callable(getattr(made, method, None))]
    if missing:
        raise BadOptions(
            f"driver {device.driver!r} made a {type(made).__name__} without {', '.join(missing)}", device=name
        )
    return made


def _own_word(device: object) -> Kind:
    """What a device from outside says that it is."""
    if isinstance(device, AbsentCamera):
        device = device.camera
    try:
        return "simulated" if getattr(device, "simulated", False) is True else "real"
    except Exception:  # a property of somebody else's: what cannot be told is taken as real
        return "real"


def _one_line(error: BaseException) -> str:
    """An error as one line."""
    return " ".join(f"{type(error).__name__}: {error}".split())


def _close(devices: Mapping[str, Any]) -> None:
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
