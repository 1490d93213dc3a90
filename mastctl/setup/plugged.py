"""What is plugged in: heads that answer on serial lines, and cameras, by their drivers. Moves nothing."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from drivers.errors import DriverError
from drivers.registry import ProbedCamera, ProbedHead, drivers_of
from drivers.servo_bus.bench import FoundServo, ServoBench, ServosOnLine
from mastctl.setup.machine import ExaminedMachine, examine_port, serial_lines

MOST_CAMERAS = 2
NO_POWER = "; is its power on?"
BY_HAND = "write it into configuration and mast file by hand (configs/rigs/rover.yaml has six)"


def lone_servo(head: ProbedHead | None) -> tuple[ServoBench, FoundServo] | None:
    """Return the one servo of a head that lacks another, with its bench; None for any other head."""
    if not isinstance(head, ServosOnLine) or len(head.driven) != 1:
        return None
    (servo,) = head.driven.values()
    return head.bench, servo


def lacking(head: ProbedHead) -> str:
    """Return the advice about a servo that is missing, in one sentence; empty if none is."""
    if (lone := lone_servo(head)) is None:
        return ""
    bench, servo = lone
    sentence = f"{head.port}: only one servo answers (id {servo.servo_id}), and a head has two"
    if servo.servo_id != 1:
        return f"{sentence}; is the other one connected, with power and the same rate?"
    return f"{sentence}: {bench.one_id(head.port, servo.baud)}"


@dataclass(frozen=True)
class Plugged:
    """All that was found, and a sentence for each line or camera that is of no use, with the reason."""

    heads: tuple[ProbedHead, ...] = ()
    cameras: tuple[ProbedCamera, ...] = ()
    unused: tuple[str, ...] = ()

    @property
    def summaries(self) -> list[str]:
        """A sentence for each head and camera."""
        return [*(one.summary for one in self.heads), *(one.summary for one in self.cameras)]


def find_plugged(
    ports: Sequence[str],
    machine: ExaminedMachine,
    say: Callable[[str], None],
) -> Plugged:
    """Query the given serial lines, or every USB adapter, and all cameras.

    ``say`` gets what is being queried; a line takes some seconds.
    """
    heads: list[ProbedHead] = []
    unused: list[str] = []
    named = [port if "://" in port else str(Path(port).absolute()) for port in ports]
    for port in named or serial_lines(machine):
        say(f"asking {port}")
        found, why = query_line(port, machine)
        if found is None:
            unused.append(why)
        elif not found.usable:
            unused.append(found.summary)
        else:
            heads.append(found)
            unused += [sentence] if (sentence := lacking(found)) else []
    say("asking the cameras")
    cameras, no_cameras = query_cameras()
    for one in cameras[MOST_CAMERAS:]:
        unused.append(f"{one.summary}: a head has {MOST_CAMERAS} cameras at most here; {BY_HAND}")
    return Plugged(tuple(heads), tuple(cameras[:MOST_CAMERAS]), (*unused, *no_cameras))


def query_line(port: str, machine: ExaminedMachine) -> tuple[ProbedHead | None, str]:
    """Return what answers on a line, or None and why nothing does; a line in use is left alone."""
    path = port if "://" in port else str(machine.at(port))
    pseudo = os.path.realpath(path).startswith("/dev/pts/")  # both its ends are open in the program behind it
    for finding in examine_port(port, machine):
        if finding.level == "bad" or (finding.what == "port in use" and not pseudo):
            return None, f"{finding.sentence}; {finding.advice}"
    reasons = []
    for probe in head_probes():
        try:
            found, reason = probe(port, path)
        except DriverError as error:
            return None, str(error)
        if found is not None:
            return found, ""
        reasons += [f"; {reason}"] if reason else []
    return None, f"{port}: no head answers{reasons[-1] if reasons else NO_POWER}"


def head_probes() -> list[Callable[[str, str], tuple[ProbedHead | None, str]]]:
    """Return what queries a line for the heads of each installed driver."""
    return [driver.probe for driver in drivers_of("head").values() if driver.probe is not None]


def query_cameras() -> tuple[list[ProbedCamera], list[str]]:
    """Return the cameras with a format that is read, and a sentence for each of the others."""
    cameras: list[ProbedCamera] = []
    others: list[str] = []
    lacking: list[str] = []
    for driver in drivers_of("camera").values():
        if driver.probe is not None:
            found, unread, lacks = driver.probe()
            cameras += found
            others += unread
            lacking += [f"no camera was found; {lacks}"] if lacks else []
    return cameras, others if cameras else [*others, *lacking]


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
