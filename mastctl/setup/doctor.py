"""What a machine and a mast file lack for a configuration, in findings; nothing that could move is opened."""

from __future__ import annotations

import grp
import os
import re
import shutil
import stat
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from importlib.util import find_spec
from pathlib import Path
from shlex import quote
from typing import Any, Literal

from calib.errors import BadFile
from calib.files.mast_file import load_rig
from drivers.errors import BadOptions, CameraBusy, DriverError, NoCamera, NoPermission
from drivers.faults import PAN_TILT
from drivers.hardware import DeviceSettings, is_hardware
from drivers.registry import OURS, InstalledDriver, UnitBench, driver_of, installed_drivers
from drivers.servo_bus.bench import ServoBench, line_arguments
from mastctl.config import Config, check_cameras, load_config
from mastctl.safety.state_folder import usual_folder

Level = Literal["good", "unsure", "bad"]

OLD_DAYS = 180
LEAST_FREE_BYTES = 1_000_000_000  # the recorder's ring of some minutes of two cameras
BUILT = datetime(2025, 1, 1, tzinfo=UTC)  # no clock that is right says less
SLOWEST_MS = 2  # of an adapter's latency timer: at 50 readings a second 16 ms are most of the time there is
CORRECT = "correct the configuration; docs/reference/configuration.md has every key"
CALIBRATE = "calibrate again: mastctl calibrate"
_NUMBERED = re.compile(r"/dev/tty(USB|ACM)\d+")


@dataclass(frozen=True)
class DoctorFinding:
    """One thing that was examined: ``what``, a short name, and ``advice`` if it is not good.

    ``unsure``: it works, but not as well or not for sure; ``bad``: the daemon will not work.
    """

    what: str
    level: Level
    sentence: str
    advice: str = ""


Findings = Iterator[DoctorFinding]


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


def examine(
    path: str | None,
    status_at: Callable[[str], Mapping[str, Any] | None],
    machine: ExaminedMachine | None = None,
) -> Findings:
    """Examine all that a configuration (None: the packaged one) needs.

    ``status_at`` returns the status of the daemon at an address, None without an answer.
    """
    machine = machine or ExaminedMachine()
    try:
        config = load_config(path)
    except BadFile as error:
        yield DoctorFinding("configuration", "bad", str(error), CORRECT)
        yield examine_clock()
        return
    yield DoctorFinding("configuration", "good", str(config.path))
    yield from examine_mast_file(config)
    status = status_at(config.listen.url)
    yield from _daemon(config, status)
    yield from _head_line(config, machine)
    yield from examine_drivers(installed_drivers())
    for name, camera in config.hardware.cameras.items():
        yield _camera(name, camera, in_use=status is not None)
    yield from _simulation(config)
    yield _folder(config.state_folder or usual_folder(config.path, config.listen.url))
    yield examine_clock()


def next_command(config: str | None, found: Sequence[DoctorFinding]) -> str:
    """Return what comes next: the first thing to mend, else to start the daemon, else to point."""
    named = "" if config is None else f" --config {quote(config)}"
    bad = next((finding for finding in found if finding.level == "bad"), None)
    if bad is not None:
        return f"{bad.advice or bad.sentence}; then mastctl rig doctor{named}"
    runs = any(one.what == "daemon" and one.sentence.startswith("one runs") for one in found)
    return f"mastctl point{named} --angles 0.2 0.0" if runs else f"mastctl run{named}"


def _daemon(config: Config, status: Mapping[str, Any] | None) -> Findings:
    """What a daemon that runs already says is wrong."""
    if status is None:
        yield DoctorFinding("daemon", "good", f"none runs at {config.listen.url}")
        return
    yield DoctorFinding("daemon", "good", f"one runs at {config.listen.url}, state {status.get('state')}")
    for fault in status.get("faults", []):
        until = f"it lasts until {fault['until']}"
        yield DoctorFinding(f"fault of {fault['device']}", "bad", fault["message"], until)
    if (calibration := status.get("calibration")) is None:
        return
    sentence, verdict = calibration["sentence"], calibration["verdict"]
    level: Level = "unsure" if verdict in ("drifts", "unknown") else "good"
    advice = {"drifts": "calibrate again; docs/how-to/drift.md says where to look", "unknown": CALIBRATE}
    sentence = sentence if verdict == "drifts" else f"{sentence} ({calibration['pointings']} pointings)"
    yield DoctorFinding("calibration", level, sentence, advice.get(verdict, ""))


def _head_line(config: Config, machine: ExaminedMachine) -> Findings:
    """The head's options and its line, if it has one; what queries such a head, which is not queried."""
    head = config.hardware.pan_tilt
    port = head.options.get("port")
    try:
        driver = driver_of("head", head.driver, PAN_TILT)
        if driver.hardware != "real":
            return
        if driver.read_options is None:
            yield DoctorFinding("head", "unsure", f"{head.driver} is from outside; it is not examined")
            return
        if isinstance(port, str):
            yield from examine_port(port, machine)
        read = driver.read_options(head.options)
    except BadOptions as error:
        yield DoctorFinding("head", "bad", str(error), CORRECT)
        return
    bench, message = driver.bench, f"driver {head.driver}, {read.baud} baud"
    if isinstance(bench, UnitBench):
        message += f"; 'mastctl rig ptu info {quote(read.port)} --baud {read.baud}' queries it"
    yield DoctorFinding("head", "good", message)
    if isinstance(bench, ServoBench):
        ids, line = (read.pan.servo_id, read.tilt.servo_id), line_arguments(read.port, head.driver)
        message = f"pan is servo {ids[0]} and tilt servo {ids[1]}; 'mastctl rig servo scan {line}' lists them"
        new = next((number for number in ids if number != 1), 2)
        advice = f"a new servo has the id 1: connect it alone, then mastctl rig servo set-id {line} 1 {new}"
        yield DoctorFinding("servos", "good", message, advice)


def _simulation(config: Config) -> Findings:
    """Whether what simulates can be had; a configuration's other options are the daemon's to judge."""
    cameras = config.hardware.cameras.values()
    simulated = is_hardware("simulated", "head", config.hardware.pan_tilt.driver)
    if simulated or any(is_hardware("simulated", "camera", camera.driver) for camera in cameras):
        if find_spec("numba") is None:
            message = "numba is not installed, which renders what simulated cameras see"
            yield DoctorFinding("simulation", "bad", message, "pip install 'mastctl[sim]'")
        else:
            yield DoctorFinding("simulation", "good", "a simulated rover, rendered by numba")


def _camera(name: str, camera: DeviceSettings, *, in_use: bool) -> DoctorFinding:
    """Examine one camera; no stream is begun. ``in_use``: whether a daemon that runs may have it."""
    level: Level = "bad"
    try:
        bench = driver_of("camera", camera.driver, name).bench
        message = f"driver {camera.driver}" if bench is None else bench.present(camera.options, name)
        level, advice = "good", ""
    except BadOptions as error:
        message, advice = str(error), CORRECT
    except NoPermission as error:
        message, advice = str(error), ""  # it names the group, and how to join it
    except CameraBusy as error:
        level, advice = ("good", "") if in_use else ("bad", "end the program that has it")
        message = str(error)
    except NoCamera as error:
        message, advice = str(error), "plug it in; mastctl camera list shows what is connected"
    except DriverError as error:
        message, advice = str(error), "mastctl camera check says more"
    return DoctorFinding(f"camera {name}", level, message, advice)


def examine_mast_file(config: Config, now: Callable[[], datetime] = lambda: datetime.now(UTC)) -> Findings:
    """Examine the mast file of a configuration."""
    try:
        stored = load_rig(config.mast_file)
        check_cameras(config, stored.rig)
    except BadFile as error:
        yield DoctorFinding("mast file", "bad", str(error), "name another, or calibrate: mastctl calibrate")
        return
    about = f"{config.mast_file.name} ({stored.digest[:8]}...), {len(stored.rig.cameras)} cameras"
    yield DoctorFinding("mast file", "good", about)
    for note in stored.notes:
        yield DoctorFinding("mast file", "unsure", note, "see docs/reference/configuration.md")
    yield _age(stored.rig.provenance, now())
    yield _verdict(stored.rig.fit)


def _age(provenance: Mapping[str, Any], now: datetime) -> DoctorFinding:
    what = "mast file's age"
    try:
        made = datetime.fromisoformat(str(provenance.get("date", "")))
    except ValueError:
        return DoctorFinding(what, "unsure", "it does not say when it was made", CALIBRATE)
    days = (now - (made if made.tzinfo else made.replace(tzinfo=UTC))).days
    if days < 0:
        sentence = f"it was made on {made:%Y-%m-%d}, in the future"
        advice = "check this machine's clock, or that of the machine that made it"
        return DoctorFinding(what, "unsure", sentence, advice)
    sentence = f"made on {made:%Y-%m-%d}, {days} days ago"
    if days <= OLD_DAYS:
        return DoctorFinding(what, "good", sentence)
    return DoctorFinding(what, "unsure", sentence, f"check whether residuals have grown, or {CALIBRATE}")


def _verdict(fit: Mapping[str, Any]) -> DoctorFinding:
    what, verdict = "calibration's verdict", fit.get("verdict")
    verdict = verdict if isinstance(verdict, Mapping) else {}
    if not isinstance(sentence := verdict.get("words"), str):
        return DoctorFinding(what, "unsure", "it does not say how well it fits", CALIBRATE)
    if verdict.get("grade") == "good":
        return DoctorFinding(what, "good", sentence)
    level: Level = "bad" if verdict.get("grade") == "bad" else "unsure"
    return DoctorFinding(what, level, sentence, "the calibration's report says why")


def examine_clock(now_s: Callable[[], float] = time.time) -> DoctorFinding:
    """Examine the wall clock, which dates records, logs and mast files; motion does not depend on it."""
    now = datetime.fromtimestamp(now_s(), UTC)
    if now < BUILT:
        message = f"the clock says {now:%Y-%m-%d}, which is past"
        return DoctorFinding("clock", "bad", message, "set it: records and mast files are dated by it")
    return DoctorFinding("clock", "good", f"{now:%Y-%m-%d %H:%M} UTC")


def _folder(folder: Path) -> DoctorFinding:
    """Examine whether the state folder, or the one that it would be made in, may be written and has room."""
    what = "state folder"
    present = next(one for one in (folder, *folder.parents) if one.exists())
    if not present.is_dir():
        return DoctorFinding(what, "bad", f"{present} is no folder", "name another, or move it away")
    if not os.access(present, os.W_OK | os.X_OK):
        message = f"{present} may not be written by this user"
        return DoctorFinding(what, "bad", message, f'sudo chown "$USER" {present}, or name another folder')
    free = shutil.disk_usage(present).free
    sentence = f"{folder}: {free / 1e9:.1f} GB free"
    if free >= LEAST_FREE_BYTES:
        return DoctorFinding(what, "good", sentence)
    advice = "make room: what happened before a fault may not be recorded"
    return DoctorFinding(what, "unsure", sentence, advice)


def examine_drivers(installed: Sequence[InstalledDriver]) -> Findings:
    """List the drivers that other packages offer, and those that cannot be meant by their name."""
    own = {(one.kind, one.name) for one in installed if one.distribution == OURS}
    others = [one for one in installed if one.distribution != OURS]
    offered = Counter((one.kind, one.name) for one in others)
    for one in others:
        what, sentence = f"driver {one.name}", f"for a {one.kind}: {one.path} of {one.package}"
        if (one.kind, one.name) in own:
            message = f"{sentence}; mastctl's own driver of this name is used instead"
            yield DoctorFinding(what, "unsure", message, f"name it {one.path} in the configuration")
        elif offered[one.kind, one.name] > 1:
            message = f"{sentence}; another package offers one of this name"
            yield DoctorFinding(what, "unsure", message, "uninstall one of them, or name the factory itself")
        else:
            yield DoctorFinding(what, "good", sentence)


def serial_lines(machine: ExaminedMachine) -> list[str]:
    """Return the USB serial adapters of a machine, each by its stable name where udev gives one."""
    stable = {link.resolve(): link for link in sorted(machine.at("/dev/serial/by-id").glob("*"))}
    devices = sorted([*machine.at("/dev").glob("ttyUSB*"), *machine.at("/dev").glob("ttyACM*")])
    found = [stable.get(device.resolve(), device) for device in devices]
    return [f"/{path.relative_to(machine.root)}" for path in found]


def examine_port(port: str, machine: ExaminedMachine) -> Findings:
    """Examine the port of a head without opening it: opening a line may move what is connected to it."""
    if "://" in port:
        message = f"{port} is on the network; it is not queried here"
        yield DoctorFinding("port", "unsure", message, "try mastctl run")
        return
    path = machine.at(port)
    if not path.exists():
        connected = ", ".join(serial_lines(machine))
        present = f"connected: {connected}" if connected else "no USB serial adapter is connected"
        advice = "plug the adapter in, or name the port as it is called here"
        yield DoctorFinding("port", "bad", f"{port} does not exist; {present}", advice)
        return
    yield _permission(port, path)
    yield from _holders(port, path, machine)
    if _NUMBERED.fullmatch(port):
        links = sorted(machine.at("/dev/serial/by-id").glob("*"))
        link = next((link.name for link in links if link.resolve() == path.resolve()), None)
        stable = (
            "a name made by configs/udev/60-mastctl.rules" if link is None else f"/dev/serial/by-id/{link}"
        )
        message = f"{port} changes with the order of plugging"
        yield DoctorFinding("port name", "unsure", message, f"configure {stable}")
    yield from _latency(port, path, machine)


def _permission(port: str, path: Path) -> DoctorFinding:
    what = "port permission"
    if os.access(path, os.R_OK | os.W_OK):
        return DoctorFinding(what, "good", f"{port} may be read and written")
    about = path.stat()
    try:
        group = grp.getgrgid(about.st_gid).gr_name
    except KeyError:
        group = str(about.st_gid)
    message = f"{port} may not be opened by this user; it is of group {group}, {stat.filemode(about.st_mode)}"
    advice = f'sudo usermod -aG {group} "$USER", then log in again'
    if about.st_gid == 0 or about.st_mode & 0o060 != 0o060:
        advice = (
            "install the udev rules (docs/how-to/hardware.md), which give it to dialout; for now: "
            f"sudo chgrp dialout {port} && sudo chmod g+rw {port}"
        )
    return DoctorFinding(what, "bad", message, advice)


def _holders(port: str, path: Path, machine: ExaminedMachine) -> Findings:
    """Other programs that have the device open: two on one bus garble each other's bytes."""
    for process in sorted(machine.at("/proc").glob("[0-9]*"), key=lambda entry: int(entry.name)):
        if process.name == str(os.getpid()):
            continue
        try:
            in_use = any(Path(os.path.realpath(one)) == path.resolve() for one in (process / "fd").iterdir())
        except OSError:  # of another user, or gone
            continue
        if in_use:
            name = machine.text(f"/proc/{process.name}/comm") or "a program"
            message = f"{port} is open in {name} (process {process.name})"
            advice = (
                "fine if that is the daemon; else end it (ModemManager: see configs/udev/60-mastctl.rules)"
            )
            yield DoctorFinding("port in use", "unsure", message, advice)


def _latency(port: str, path: Path, machine: ExaminedMachine) -> Findings:
    file = f"/sys/bus/usb-serial/devices/{path.resolve().name}/latency_timer"
    timer = machine.text(file)
    if timer is None or not timer.isdecimal():
        return
    message = f"{port} holds bytes back for up to {timer} ms"
    if int(timer) <= SLOWEST_MS:
        yield DoctorFinding("latency timer", "good", message)
        return
    message = f"{message}; the Dynamixel driver sets less when it opens it"
    advice = f"install configs/udev/60-mastctl.rules, or: echo 1 | sudo tee {file}"
    yield DoctorFinding("latency timer", "unsure", message, advice)
