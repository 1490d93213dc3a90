"""Is a serial device there, may it be opened, does somebody have it, does its adapter hold bytes back?"""

from __future__ import annotations

import grp
import os
import re
import stat
from collections.abc import Iterator
from pathlib import Path

from mastctl.doctor.findings import Finding, Machine

SLOWEST_MS = 2  # of an adapter's latency timer: at 50 readings a second 16 ms are most of the time there is
_NUMBERED = re.compile(r"/dev/tty(USB|ACM)\d+")
_ADAPTERS = {
    "0403": "FTDI",
    "fff1": "ROBOTIS",
    "2f5d": "ROBOTIS",
    "10c4": "Silicon Labs",
    "1a86": "WCH",
    "067b": "Prolific",
}


def examine_port(port: str, machine: Machine) -> Iterator[Finding]:
    """Look at the port of a head without opening it: whoever opens a line may move what hangs on it."""
    if "://" in port:
        yield Finding("port", "unsure", f"{port} is on the network; it is not asked here", "try mastctl run")
        return
    path = machine.at(port)
    if not path.exists():
        there = _connected(machine)
        yield Finding(
            "port",
            "bad",
            f"{port} does not exist; {there}",
            "plug the adapter in, or name the port as it is called here",
        )
        return
    yield from _permission(port, path)
    yield from _holder(port, path, machine)
    yield from _name(port, machine)
    yield from _latency(port, path, machine)


def _permission(port: str, path: Path) -> Iterator[Finding]:
    if os.access(path, os.R_OK | os.W_OK):
        yield Finding("port permission", "good", f"{port} may be read and written")
        return
    about = path.stat()
    group = _group(about.st_gid)
    words = f"{port} may not be opened by this user; it is of group {group}, {stat.filemode(about.st_mode)}"
    yield Finding("port permission", "bad", words, f'sudo usermod -aG {group} "$USER", then log in again')


def _holder(port: str, path: Path, machine: Machine) -> Iterator[Finding]:
    """Another program that has the device open: two on one bus garble each other's bytes."""
    real = path.resolve()
    for process in sorted(machine.at("/proc").glob("[0-9]*"), key=lambda entry: int(entry.name)):
        if process.name == str(os.getpid()):
            continue
        try:
            held = any(Path(os.path.realpath(one)) == real for one in (process / "fd").iterdir())
        except OSError:  # of another user, or gone
            continue
        if held:
            name = machine.text(f"/proc/{process.name}/comm") or "a program"
            yield Finding(
                "port in use",
                "unsure",
                f"{port} is open in {name} (process {process.name})",
                "fine if that is the daemon; else end it (ModemManager: see configs/udev/60-mastctl.rules)",
            )


def _name(port: str, machine: Machine) -> Iterator[Finding]:
    if not _NUMBERED.fullmatch(port):
        return
    links = [
        link
        for link in sorted(machine.at("/dev/serial/by-id").glob("*"))
        if link.resolve() == machine.at(port).resolve()
    ]
    stable = f"/dev/serial/by-id/{links[0].name}" if links else "a name made by configs/udev/60-mastctl.rules"
    yield Finding("port name", "unsure", f"{port} changes with the order of plugging", f"configure {stable}")


def _latency(port: str, path: Path, machine: Machine) -> Iterator[Finding]:
    timer = machine.text(f"/sys/bus/usb-serial/devices/{path.resolve().name}/latency_timer")
    if timer is None or not timer.isdecimal():
        return
    if int(timer) <= SLOWEST_MS:
        yield Finding("latency timer", "good", f"{port} holds bytes back for {timer} ms at most")
        return
    yield Finding(
        "latency timer",
        "unsure",
        f"{port} holds bytes back for up to {timer} ms; the Dynamixel driver asks for less when it opens it",
        "install configs/udev/60-mastctl.rules, or: "
        f"echo 1 | sudo tee /sys/bus/usb-serial/devices/{path.resolve().name}/latency_timer",
    )


def _connected(machine: Machine) -> str:
    """The serial devices that are there, with the makers of their adapters."""
    found = []
    for device in sorted([*machine.at("/dev").glob("ttyUSB*"), *machine.at("/dev").glob("ttyACM*")]):
        vendor = _vendor(device, machine)
        found.append(f"/dev/{device.name}{f' ({vendor})' if vendor else ''}")
    return f"there are {', '.join(found)}" if found else "no USB serial adapter is connected"


def _vendor(device: Path, machine: Machine) -> str:
    """The maker of a USB serial device, by the numbers that its parents in sysfs tell."""
    place = machine.at(f"/sys/class/tty/{device.name}/device").resolve()
    for folder in (place, *place.parents):
        number = folder / "idVendor"
        if number.is_file():
            return _ADAPTERS.get(number.read_text().strip(), "")
        if folder == machine.root:
            break
    return ""


def _group(number: int) -> str:
    try:
        return grp.getgrgid(number).gr_name
    except KeyError:
        return str(number)
