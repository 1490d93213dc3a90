"""What this machine has for a rig: clock, folders, descriptors, serial lines; and how a finding reads."""

from __future__ import annotations

import grp
import os
import re
import shutil
import stat
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Literal

from drivers.registry import OURS, InstalledDriver

Level = Literal["good", "unsure", "bad"]


@dataclass(frozen=True)
class DoctorFinding:
    """One thing that was examined: ``what``, a short name, and ``advice`` if it is not good.

    ``unsure``: it works, but not as well or not for sure; ``bad``: the daemon will not work.
    """

    what: str
    level: Level
    sentence: str
    advice: str = ""


@dataclass(frozen=True)
class ExaminedMachine:
    """The machine that is examined; tests give it a folder of their own in place of ``/``."""

    root: Path = field(default_factory=lambda: Path("/"))

    def at(self, path: str | Path) -> Path:
        """Return where an absolute path lies."""
        return self.root / str(path).lstrip("/")

    def text(self, path: str | Path) -> str | None:
        """Return a small file's text, None if it cannot be read."""
        try:
            return self.at(path).read_text().strip()
        except (OSError, ValueError):
            return None


LEAST_FREE_BYTES = 1_000_000_000  # the recorder's ring of some minutes of two cameras
BUILT = datetime(2025, 1, 1, tzinfo=UTC)  # no clock that is right says less


def examine_clock(now_s: Callable[[], float] = time.time) -> DoctorFinding:
    """Examine the wall clock, which dates records, logs and mast files; motion does not depend on it."""
    now = datetime.fromtimestamp(now_s(), UTC)
    if now < BUILT:
        message = f"the clock says {now:%Y-%m-%d}, which is past"
        return DoctorFinding("clock", "bad", message, "set it: records and mast files are dated by it")
    return DoctorFinding("clock", "good", f"{now:%Y-%m-%d %H:%M} UTC")


def examine_folder(what: str, folder: Path) -> Iterator[DoctorFinding]:
    """Examine whether a folder, or the one that it would be made in, may be written and has room."""
    present = next(one for one in (folder, *folder.parents) if one.exists())
    if not present.is_dir():
        yield DoctorFinding(what, "bad", f"{present} is no folder", "name another, or move it away")
        return
    if not os.access(present, os.W_OK | os.X_OK):
        message = f"{present} may not be written by this user"
        yield DoctorFinding(what, "bad", message, f'sudo chown "$USER" {present}, or name another folder')
        return
    free = shutil.disk_usage(present).free
    sentence = f"{folder}: {free / 1e9:.1f} GB free"
    if free < LEAST_FREE_BYTES:
        yield DoctorFinding(
            what, "unsure", sentence, "make room: what happened before a fault may not be recorded"
        )
    else:
        yield DoctorFinding(what, "good", sentence)


def examine_drivers(installed: Sequence[InstalledDriver]) -> Iterator[DoctorFinding]:
    """List the drivers that other packages offer, and those that cannot be meant by their name."""
    own = {(one.kind, one.name) for one in installed if one.distribution == OURS}
    others = [one for one in installed if one.distribution != OURS]
    names = [(one.kind, one.name) for one in others]
    for one in others:
        what, sentence = f"driver {one.name}", f"for a {one.kind}: {one.path} of {one.package}"
        if (one.kind, one.name) in own:
            message = f"{sentence}; mastctl's own driver of this name is used instead"
            yield DoctorFinding(what, "unsure", message, f"name it {one.path} in the configuration")
        elif names.count((one.kind, one.name)) > 1:
            message = f"{sentence}; another package offers one of this name"
            yield DoctorFinding(what, "unsure", message, "uninstall one of them, or name the factory itself")
        else:
            yield DoctorFinding(what, "good", sentence)


SLOWEST_MS = 2  # of an adapter's latency timer: at 50 readings a second 16 ms are most of the time there is
_NUMBERED = re.compile(r"/dev/tty(USB|ACM)\d+")


def serial_lines(machine: ExaminedMachine) -> list[str]:
    """Return the USB serial adapters of a machine, each by its stable name where udev gives one."""
    stable = {link.resolve(): link for link in sorted(machine.at("/dev/serial/by-id").glob("*"))}
    devices = sorted([*machine.at("/dev").glob("ttyUSB*"), *machine.at("/dev").glob("ttyACM*")])
    found = [stable.get(device.resolve(), device) for device in devices]
    return [f"/{path.relative_to(machine.root)}" for path in found]


def examine_port(port: str, machine: ExaminedMachine) -> Iterator[DoctorFinding]:
    """Examine the port of a head without opening it: opening a line may move what is connected to it."""
    if "://" in port:
        yield DoctorFinding(
            "port", "unsure", f"{port} is on the network; it is not queried here", "try mastctl run"
        )
        return
    path = machine.at(port)
    if not path.exists():
        connected = ", ".join(serial_lines(machine))
        present = f"connected: {connected}" if connected else "no USB serial adapter is connected"
        yield DoctorFinding(
            "port",
            "bad",
            f"{port} does not exist; {present}",
            "plug the adapter in, or name the port as it is called here",
        )
        return
    yield from _permission(port, path)
    yield from _holder(port, path, machine)
    yield from _name(port, machine)
    yield from _latency(port, path, machine)


def _permission(port: str, path: Path) -> Iterator[DoctorFinding]:
    if os.access(path, os.R_OK | os.W_OK):
        yield DoctorFinding("port permission", "good", f"{port} may be read and written")
        return
    about = path.stat()
    group = _group(about.st_gid)
    message = f"{port} may not be opened by this user; it is of group {group}, {stat.filemode(about.st_mode)}"
    if about.st_gid == 0 or about.st_mode & 0o060 != 0o060:
        advice = (
            "install the udev rules (docs/how-to/hardware.md), which give it to dialout; for now: "
            f"sudo chgrp dialout {port} && sudo chmod g+rw {port}"
        )
        yield DoctorFinding("port permission", "bad", message, advice)
        return
    yield DoctorFinding(
        "port permission", "bad", message, f'sudo usermod -aG {group} "$USER", then log in again'
    )


def _holder(port: str, path: Path, machine: ExaminedMachine) -> Iterator[DoctorFinding]:
    """Another program that has the device open: two on one bus garble each other's bytes."""
    real = path.resolve()
    for process in sorted(machine.at("/proc").glob("[0-9]*"), key=lambda entry: int(entry.name)):
        if process.name == str(os.getpid()):
            continue
        try:
            in_use = any(Path(os.path.realpath(one)) == real for one in (process / "fd").iterdir())
        except OSError:  # of another user, or gone
            continue
        if in_use:
            name = machine.text(f"/proc/{process.name}/comm") or "a program"
            yield DoctorFinding(
                "port in use",
                "unsure",
                f"{port} is open in {name} (process {process.name})",
                "fine if that is the daemon; else end it (ModemManager: see configs/udev/60-mastctl.rules)",
            )


def _name(port: str, machine: ExaminedMachine) -> Iterator[DoctorFinding]:
    if not _NUMBERED.fullmatch(port):
        return
    links = [
        link
        for link in sorted(machine.at("/dev/serial/by-id").glob("*"))
        if link.resolve() == machine.at(port).resolve()
    ]
    stable = f"/dev/serial/by-id/{links[0].name}" if links else "a name made by configs/udev/60-mastctl.rules"
    yield DoctorFinding(
        "port name", "unsure", f"{port} changes with the order of plugging", f"configure {stable}"
    )


def _latency(port: str, path: Path, machine: ExaminedMachine) -> Iterator[DoctorFinding]:
    timer = machine.text(f"/sys/bus/usb-serial/devices/{path.resolve().name}/latency_timer")
    if timer is None or not timer.isdecimal():
        return
    if int(timer) <= SLOWEST_MS:
        yield DoctorFinding("latency timer", "good", f"{port} holds bytes back for {timer} ms at most")
        return
    yield DoctorFinding(
        "latency timer",
        "unsure",
        f"{port} holds bytes back for up to {timer} ms; the Dynamixel driver asks for less when it opens it",
        "install configs/udev/60-mastctl.rules, or: "
        f"echo 1 | sudo tee /sys/bus/usb-serial/devices/{path.resolve().name}/latency_timer",
    )


def _group(number: int) -> str:
    try:
        return grp.getgrgid(number).gr_name
    except KeyError:
        return str(number)
