"""The drivers of heads and cameras: those of this repository and of other packages, found and opened alike.

A package names its drivers by entry points in the groups ``mastctl.heads`` and ``mastctl.cameras``. Each is a
`Driver`, or a factory that takes the options as keywords. A configuration may also name either of them as
``package.module:name``. Foreign code may do anything while it is imported and called; one sentence says so.
"""

from __future__ import annotations

import importlib
import sys
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from functools import lru_cache
from inspect import getattr_static
from pathlib import Path
from types import MappingProxyType
from typing import Any, Literal

from drivers.clock import Clock, SystemClock
from drivers.errors import BadOptions
from drivers.faults import nearest
from drivers.interfaces import Camera, PanTilt

Ends = Mapping[str, tuple[float, float]]
"""The ends of pan and tilt, radians."""


class ProbedHead(ABC):
    """A head that answered on a line.

    ``usable``: whether it can be the head of a configuration.
    """

    driver: str
    port: str
    usable: bool = True
    speed_rad_per_s: float = 0.5

    @property
    @abstractmethod
    def summary(self) -> str:
        """What it is, in one sentence."""

    @abstractmethod
    def configured(self, ends: Ends, ids: Mapping[str, int]) -> tuple[dict[str, Any], Ends]:
        """Return its options without the port, and the ends that it can reach.

        ``ids`` are those of the servos of pan and tilt.
        """


@dataclass(frozen=True)
class ProbedCamera:
    """A camera that has a format that is read.

    ``node`` is its node now, which udev knows; None for a camera without one.
    """

    card: str
    bus: str
    node: Path | None
    options: dict[str, Any]
    driver: str

    @property
    def summary(self) -> str:
        """What it is, in one sentence."""
        width, height = self.options["size_px"]
        return f"{self.card} at {self.bus}: {self.options['format']} {width}x{height}"


@dataclass(frozen=True)
class UnitBench:
    """What is done with a pan/tilt unit on the bench; ``bauds`` has the usual rate first.

    ``facts(port, baud)`` returns what the unit reports; so does ``home``, after a reset.
    """

    bauds: Sequence[int]
    facts: Callable[[str, int], Any]
    home: Callable[[str, int], Any]


@dataclass(frozen=True)
class CameraBench:
    """What is done with a camera that no daemon has.

    ``table`` returns the connected cameras, each as column and text or list of texts (``key`` names it in
    JSON, ``title`` for people), and a sentence for each that this user may not open. ``present(options,
    name)`` says which camera has answered; no stream is begun. Raises DriverError. ``options_for`` returns
    options of a camera that a person names at the command line; None where only a configuration does.
    """

    key: str
    title: str
    table: Callable[[], tuple[list[dict[str, Any]], list[str]]]
    present: Callable[[Mapping[str, Any], str], str]
    options_for: Callable[..., dict[str, Any]] | None = None


Kind = Literal["head", "camera"]
GROUPS: Mapping[Kind, str] = MappingProxyType({"head": "mastctl.heads", "camera": "mastctl.cameras"})
OURS = "mastctl"
"""The distribution whose drivers come before those of the same name in another package."""

METHODS: Mapping[type, tuple[str, ...]] = MappingProxyType(
    {PanTilt: ("read", "move", "stop", "close"), Camera: ("next_frame", "close")}
)
"""The methods that every device has."""

HardwareKind = Literal["real", "simulated", "replayed", "mixed"]


@dataclass(frozen=True)
class Context:
    """What a driver gets beside its options; relative paths in options start at ``folder``.

    ``shared`` is what devices of one configuration have in common, by a key of the driver's own, such as one
    simulated rover. What has a ``close`` is closed after the devices.
    """

    name: str
    clock: Clock = field(default_factory=SystemClock)
    folder: Path = Path()
    simulation: Mapping[str, Any] = field(default_factory=dict)
    shared: dict[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class Driver:
    """A driver of heads or cameras.

    Attributes
    ----------
    open
        ``open(options, context)`` returns a `PanTilt` or `Camera`. Raises BadOptions and DriverError.
    hardware
        What its devices are; devices of a ``real`` one may say that they are simulated (``info``).
    any_clock
        Whether it waits on the context's clock alone, so that it runs at any ``simulation.speed``.
    read_options
        ``read_options(options)`` checks options without a device and returns them as the driver has them.
        Raises BadOptions.
    halt
        ``halt(options)`` stops a head that no daemon drives any more, and returns the actions on each axis in
        sentences. Raises DriverError if the head did not confirm.
    probe
        Of a head: ``probe(port, path)`` returns the `ProbedHead` on a line, or None, and a
        reason that may be empty; DriverError: no other head is to be tried. Of cameras: ``probe()`` returns
        each `ProbedCamera`, a sentence for each of no use, and what this machine lacks. Nothing moves.
    probe_order
        Heads of a lower number probe a line first.
    bench
        What a person does with a device on the bench: a `UnitBench`, a `CameraBench`, or a `ServoBench`.
    """

    open: Callable[[Mapping[str, Any], Context], Any]
    hardware: HardwareKind = "real"
    any_clock: bool = False
    read_options: Callable[[Mapping[str, Any]], Any] | None = None
    halt: Callable[[Mapping[str, Any]], Sequence[str]] | None = None
    probe: Callable[..., tuple[Any, ...]] | None = None
    probe_order: int = 0
    bench: Any = None


@dataclass(frozen=True)
class InstalledDriver:
    """A driver that an installed package offers."""

    kind: Kind
    name: str
    path: str
    distribution: str
    version: str

    @property
    def package(self) -> str:
        """The distribution with its version."""
        return f"{self.distribution} {self.version}".strip()


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
    from importlib.metadata import entry_points  # loads 50 modules

    every, found = entry_points(), []
    for kind, group in GROUPS.items():
        for entry in sorted(every.select(group=group), key=lambda entry: (entry.name, entry.value)):
            name, version = ("", "") if entry.dist is None else (entry.dist.name, entry.dist.version)
            found.append(InstalledDriver(kind, entry.name, entry.value, name, version))
    return tuple(dict.fromkeys(found))


def drivers_of(kind: Kind) -> Mapping[str, Driver]:
    """Return every installed driver of a kind that can be imported, by name, in the order of probing."""
    found: dict[str, Driver] = {}
    for one in installed_drivers():
        if one.kind == kind:
            with suppress(BadOptions):
                found[one.name] = driver_of(kind, one.name, one.name)
    return dict(sorted(found.items(), key=lambda item: (item[1].probe_order, item[0])))


def driver_of(kind: Kind, driver: str, device: str) -> Driver:
    """Return a driver by the name by which a package offers it, or its path ``package.module:name``.

    Raises BadOptions if no package offers it for this kind, several do, or it cannot be imported.
    """
    path = driver if ":" in driver else _path_of(kind, driver, device)
    found = _object(path, device)
    return found if isinstance(found, Driver) else Driver(lambda options, context: found(**options))


def _path_of(kind: Kind, driver: str, device: str) -> str:
    installed = installed_drivers()
    named = [one for one in installed if one.name == driver]
    fitting = [one for one in named if one.kind == kind]
    fitting = [one for one in fitting if one.distribution == OURS] or fitting
    if len(fitting) == 1:
        return fitting[0].path
    if fitting:
        packages = " and ".join(one.package for one in fitting)
        raise BadOptions(f"{packages} both offer a driver {driver!r}; uninstall one of them", device=device)
    if named:
        message = f"driver {driver!r} of {named[0].package} is for a {named[0].kind}, not for a {kind}"
        raise BadOptions(message, device=device)
    known = [one.name for one in installed if one.kind == kind]
    raise BadOptions(
        f"there is no driver {driver!r}{nearest(driver, known)}; a driver from outside is named "
        f"package.module:name, or as its package names it in the group {GROUPS[kind]}",
        device=device,
    )


def _object(name: str, device: str) -> Any:
    """The driver or callable that ``package.module:name`` names. Raises BadOptions."""
    module_name, _, attribute = name.partition(":")
    try:
        found: Any = importlib.import_module(module_name)
    except (Exception, SystemExit) as error:  # whatever a foreign module does while it is imported
        message = f"driver {name!r}: cannot import {module_name!r} ({one_line(error)})"
        raise BadOptions(message, device=device) from error
    for part in attribute.split("."):
        if not hasattr(found, part):
            raise BadOptions(f"driver {name!r}: {module_name!r} has no {attribute!r}", device=device)
        found = getattr(found, part)
    if not callable(found) and not isinstance(found, Driver):
        raise BadOptions(f"driver {name!r}: {attribute!r} cannot be called", device=device)
    return found


def one_line(error: BaseException) -> str:
    """Return a foreign error as one line."""
    return " ".join(f"{type(error).__name__}: {error}".split())


def whole(device: Any, kind: type) -> Any:
    """Return a device with all members of `PanTilt` or `Camera`.

    One that is not derived from the class keeps its own members; the others are the class's.
    """
    if isinstance(device, kind):
        return device
    members = {
        name: _member(device, name)
        for name in vars(kind)
        if not name.startswith("_") and (name in METHODS[kind] or getattr_static(device, name, None))
    }
    return type(f"Outside{kind.__name__}", (kind,), members)()


def _member(device: object, name: str) -> property:
    return property(lambda self: getattr(device, name))
