"""What is plugged in: servos and pan/tilt heads that answer on serial lines, and cameras. Moves nothing.

Each line is asked in the words of each head that this program drives, until one answers. Nothing is written
to a servo. A PTU that answers in short form is set to its usual one, which it forgets at power-off.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from shlex import quote
from typing import Any

from drivers.aravis import find as genicam
from drivers.aravis import library as genicam_library
from drivers.dynamixel import workshop as dynamixel
from drivers.dynamixel.models import MODELS
from drivers.dynamixel.settings import POLL_BYTES
from drivers.errors import BadOptions, DriverError
from drivers.feetech import servos as feetech
from drivers.flir_ptu import workshop as flir_ptu
from drivers.flir_ptu.workshop import Facts
from drivers.servo_bus.bench import FoundServo, Scan
from drivers.servo_bus.exchange import REPLY_TIMEOUT_S
from drivers.servo_bus.settings import CountedModel
from drivers.v4l2 import find
from drivers.v4l2.node import Node, capture_nodes
from mastctl.setup.machine import ExaminedMachine, examine_port


@dataclass(frozen=True)
class ServoFamily:
    """Servos of one driver: how a line is asked for them, and at which rates, the likely ones first.

    Attributes
    ----------
    driver
        Its name in a configuration.
    scan
        Called with port, rates and a reply's patience.
    models
        Those that the driver turns, by name.
    poll_bytes
        Of one reading of both servos on the wire.
    """

    driver: str
    scan: Callable[[str, Sequence[int], float], Scan]
    bauds: tuple[int, ...]
    models: Mapping[str, CountedModel]
    poll_bytes: int


def set_id(port: str, family: ServoFamily, baud: int) -> str:
    """Return the command that gives a new servo, alone on a line, the second id."""
    named = "" if family.driver == "dynamixel" else f" --family {family.driver}"
    return f"mastctl servo set-id {quote(port)} 1 2 --baud {baud}{named}"


def one_id(port: str, family: ServoFamily, baud: int) -> str:
    """Return what to do where one id is all that answers."""
    return (
        f"new servos all have the id 1; connect one at a time, and give the second another id: "
        f"{set_id(port, family, baud)}; then connect both"
    )


FAMILIES = (
    ServoFamily(
        "dynamixel",
        dynamixel.scan,
        (1_000_000, 57_600, 115_200, 2_000_000, 3_000_000, 4_000_000),
        MODELS,
        POLL_BYTES,
    ),
    ServoFamily(
        "feetech",
        feetech.scan,
        (1_000_000, 115_200, 500_000),
        feetech.MODELS,
        feetech.POLL_BYTES,
    ),
)
PTU_BAUDS = (9600, 38_400)
"""As units come from the factory, and as docs/how-to/hardware.md has them set up."""
LEAST_PX, USUAL_HZ = (640, 480), 30.0
MOST_CAMERAS, BY_ID = 2, "by-id"
NO_GENICAM = (
    "no camera was found; GigE Vision and USB3 Vision cameras are found only with the library Aravis: "
    f"{genicam_library.INSTALL}"
)
NO_POWER = "; is its power on?"
BY_HAND = "write it into configuration and mast file by hand (configs/rigs/rover.yaml has six)"


@dataclass(frozen=True)
class PluggedHead:
    """What answered on a line.

    Attributes
    ----------
    port
        As it is named on this machine.
    family
        Whose servos they are; None for a PTU.
    servos
        Those that the driver turns, by id.
    others
        Models that answered and that it does not drive.
    unit, unit_baud
        A PTU's facts, and the rate at which it told them.
    """

    port: str
    family: ServoFamily | None = None
    servos: tuple[FoundServo, ...] = ()
    others: tuple[str, ...] = ()
    unit: Facts | None = None
    unit_baud: int = PTU_BAUDS[0]

    @property
    def words(self) -> str:
        """What it is, in one sentence."""
        if self.unit is not None:
            return f"{self.port}: a FLIR PTU, {self.unit.version}"
        servos = [f"{one.model} (id {one.servo_id}, {one.baud} baud)" for one in self.servos]
        others = [f"{name}, which mastctl does not drive" for name in self.others]
        return f"{self.port}: {', '.join([*servos, *others])}"

    @property
    def lacks(self) -> str:
        """The advice about a servo that is missing, in one sentence; empty if none is."""
        if self.family is None or len(self.servos) != 1:
            return ""
        (servo,) = self.servos
        told = f"{self.port}: only one servo answers (id {servo.servo_id}), and a head has two"
        if servo.servo_id != 1:
            return f"{told}; is the other one connected, with power and the same rate?"
        return f"{told}: {one_id(self.port, self.family, servo.baud)}"


@dataclass(frozen=True)
class PluggedCamera:
    """A camera that has a format that is read.

    Attributes
    ----------
    card, bus
        Its names.
    node
        Its node now; None for a camera of GigE Vision or USB3 Vision.
    options, driver
        Its options, and of which driver they are.
    """

    card: str
    bus: str
    node: Path | None
    options: dict[str, Any]
    driver: str = "v4l2"

    @property
    def words(self) -> str:
        """What it is, in one sentence."""
        width, height = self.options["size_px"]
        return f"{self.card} at {self.bus}: {self.options['format']} {width}x{height}"


@dataclass(frozen=True)
class Plugged:
    """All that was found, and a sentence for each line or camera that is of no use, with the reason."""

    heads: tuple[PluggedHead, ...] = ()
    cameras: tuple[PluggedCamera, ...] = ()
    unused: tuple[str, ...] = ()

    @property
    def words(self) -> list[str]:
        """A sentence for each head and camera."""
        return [*(one.words for one in self.heads), *(one.words for one in self.cameras)]


def look(
    ports: Sequence[str],
    machine: ExaminedMachine,
    say: Callable[[str], None],
) -> Plugged:
    """Ask every serial line and camera what it is.

    Parameters
    ----------
    ports
        The lines to ask; none: every USB adapter of the machine.
    machine
        Where devices lie.
    say
        Told what is being asked; a line takes some seconds.
    """
    heads: list[PluggedHead] = []
    unused: list[str] = []
    named = [port if "://" in port else str(Path(port).absolute()) for port in ports]
    for port in named or serial_lines(machine):
        say(f"asking {port}")
        found, why = ask_line(port, machine)
        if found is None:
            unused.append(why)
        elif found.unit is None and not found.servos:
            unused.append(found.words)
        else:
            heads.append(found)
            unused += [words] if (words := found.lacks) else []
    say("asking the cameras")
    cameras, no_cameras = ask_cameras()
    for one in cameras[MOST_CAMERAS:]:
        unused.append(f"{one.words}: a head has {MOST_CAMERAS} cameras at most here; {BY_HAND}")
    return Plugged(tuple(heads), tuple(cameras[:MOST_CAMERAS]), (*unused, *no_cameras))


def serial_lines(machine: ExaminedMachine) -> list[str]:
    """Return the USB serial adapters of a machine, each by its stable name where udev gives one."""
    named = {link.resolve(): link for link in sorted(machine.at("/dev/serial/by-id").glob("*"))}
    devices = sorted([*machine.at("/dev").glob("ttyUSB*"), *machine.at("/dev").glob("ttyACM*")])
    found = [named.get(device.resolve(), device) for device in devices]
    return [f"/{path.relative_to(machine.root)}" for path in found]


def ask_line(port: str, machine: ExaminedMachine) -> tuple[PluggedHead | None, str]:
    """Return what answers on a line, or None and why nothing does; a line in use is left alone."""
    path = port if "://" in port else str(machine.at(port))
    pseudo = os.path.realpath(path).startswith("/dev/pts/")  # both its ends are open in the program behind it
    for finding in examine_port(port, machine):
        if finding.level == "bad" or (finding.what == "port in use" and not pseudo):
            return None, f"{finding.sentence}; {finding.advice}"
    for baud in PTU_BAUDS:
        with suppress(DriverError):  # no PTU
            return PluggedHead(port, unit=flir_ptu.facts(path, baud), unit_baud=baud), ""
    noise = ""
    for family in FAMILIES:
        try:
            found, garbled = _servos(path, family)
        except DriverError as error:
            return None, str(error)
        if found:
            driven = tuple(one for one in found if one.model in family.models)
            others = tuple(one.model for one in found if one.model not in family.models)
            return PluggedHead(port, family, driven, others), ""
        if garbled:
            noise = f"; at {garbled[0]} baud something answers: {one_id(port, family, garbled[0])}"
    return None, f"{port}: no servo and no PTU answers{noise or NO_POWER}"


def _servos(path: str, family: ServoFamily) -> tuple[list[FoundServo], list[int]]:
    """The servos of a line, and the rates at which something else came; two servos end the search."""
    found: list[FoundServo] = []
    garbled: list[int] = []
    for baud in family.bauds:
        try:
            scan = family.scan(path, (baud,), REPLY_TIMEOUT_S)
        except BadOptions:
            continue  # a rate that the adapter does not have
        found += scan.found
        garbled += scan.garbled
        if len(found) > 1:
            break
    return found, garbled


def ask_cameras() -> tuple[list[PluggedCamera], list[str]]:
    """Return the cameras with a format that is read, and a sentence for each of the others."""
    cameras: list[PluggedCamera] = []
    others = list(find.refused_nodes(capture_nodes()))
    found = find.list_cameras()
    for one in found:
        try:
            options = _options(one, _by_id(one, found))
        except DriverError as error:
            others.append(f"{one.card} at {one.bus}: {error}")
            continue
        cameras.append(PluggedCamera(one.card, one.bus, one.node, options))
    industrial = sorted(genicam.list_cameras(), key=lambda one: (one.serial, one.id))
    serials = [one.serial for one in industrial]
    for camera in industrial:
        by_serial = bool(camera.serial) and serials.count(camera.serial) == 1
        try:
            options = genicam.options_for(camera, by_serial, USUAL_HZ)
        except DriverError as error:
            others.append(str(error))
            continue
        names = f"{camera.vendor} {camera.model} {camera.serial}", camera.address or camera.protocol
        cameras.append(PluggedCamera(*names, None, options, "aravis"))
    if not cameras and not genicam_library.installed():
        others.append(NO_GENICAM)
    return cameras, others


def _by_id(camera: find.FoundCamera, found: Sequence[find.FoundCamera]) -> bool:
    """Whether a link by-id can tell a camera: cameras with one serial number have one such link together."""
    alike = [one for one in found if one.card == camera.card]
    return len({link.name for one in alike for link in one.links if link.parent.name == BY_ID}) >= len(alike)


def _options(camera: find.FoundCamera, by_id: bool) -> dict[str, Any]:
    """A camera's options: its stable link, or card and bus; its format, size and rate, of now or usual."""
    now = find.options_for(str(camera.node), None, None, None, {})
    code, size_px = now["format"], tuple(now["size_px"])
    with Node(camera.node) as node:
        small = any(side < least for side, least in zip(size_px, LEAST_PX, strict=True))
        if small and LEAST_PX in node.sizes(code)[0]:
            size_px = LEAST_PX
        rates_hz = node.rates_hz(code, size_px)
    slow_hz = [rate for rate in rates_hz if rate <= USUAL_HZ + 1e-3]
    rate = {"rate_hz": round(max(slow_hz or rates_hz), 3)} if rates_hz else {}
    links = [link for link in camera.links if by_id or link.parent.name != BY_ID]
    address = {"device": str(links[0])} if links else {"card": camera.card, "bus": camera.bus}
    return {**address, "format": code, "size_px": list(size_px), **rate}


def usb_of(device: Path, machine: ExaminedMachine, by_socket: bool = False) -> Iterator[tuple[str, str]]:
    """Yield the udev matches that single out a USB device: by its serial number, else its socket.

    ``device`` is its folder in sysfs; nothing is yielded for what is not on USB. ``by_socket``: where others
    have the same serial number.
    """
    place = device.resolve()
    for folder in (place, *place.parents):
        if (folder / "idVendor").is_file():
            for name in ("idVendor", "idProduct"):
                if (folder / name).is_file():
                    yield f"ATTRS{{{name}}}", (folder / name).read_text().strip()
            serial = folder / "serial"
            if serial.is_file() and not by_socket:
                yield "ATTRS{serial}", serial.read_text().strip()
            else:
                yield "KERNELS", folder.name
            return
        if folder == machine.root:
            return
