"""What a machine and a mast file lack for a configuration, in findings."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from datetime import UTC, datetime
from shlex import quote
from typing import Any

from calib.errors import BadFile
from calib.files.mast_file import load_rig
from drivers.errors import BadOptions, CameraBusy, DriverError, NoCamera, NoPermission
from drivers.faults import PAN_TILT
from drivers.hardware import DeviceSettings, clock_for, is_hardware
from drivers.registry import Driver, UnitBench, driver_of, installed_drivers
from drivers.servo_bus.bench import ServoBench, line_arguments
from mastctl.config import Config, check_cameras, load_config
from mastctl.safety.state_folder import usual_folder
from mastctl.setup.machine import (
    DoctorFinding,
    ExaminedMachine,
    Level,
    examine_clock,
    examine_drivers,
    examine_folder,
    examine_port,
)


def examine(
    path: str | None,
    status_at: Callable[[str], Mapping[str, Any] | None],
    machine: ExaminedMachine | None = None,
) -> Iterator[DoctorFinding]:
    """Examine all that a configuration (None: the packaged one) needs; nothing that could move is opened.

    ``status_at`` returns the status of the daemon at an address, None without an answer.
    """
    machine = machine or ExaminedMachine()
    try:
        config = load_config(path)
    except BadFile as error:
        yield DoctorFinding(
            "configuration", "bad", str(error), "correct it; docs/reference/configuration.md has every key"
        )
        yield examine_clock()
        return
    yield DoctorFinding("configuration", "good", str(config.path))
    yield from examine_mast_file(config)
    status = status_at(config.listen.url)
    yield from _daemon(config, status)
    yield from _head_line(config, machine)
    yield from examine_drivers(installed_drivers())
    for name, camera in config.hardware.cameras.items():
        yield from examine_camera(name, camera, in_use=status is not None)
    yield from _simulation(config)
    folder = config.state_folder or usual_folder(config.path, config.listen.url)
    yield from examine_folder("state folder", folder)
    yield examine_clock()


def next_command(config: str | None, found: Sequence[DoctorFinding]) -> str:
    """Return what comes next: the first thing to mend, else to start the daemon, else to point."""
    named = "" if config is None else f" --config {quote(config)}"
    bad = next((finding for finding in found if finding.level == "bad"), None)
    if bad is not None:
        return f"{bad.advice or bad.sentence}; then mastctl rig doctor{named}"
    runs = any(one.what == "daemon" and one.sentence.startswith("one runs") for one in found)
    return f"mastctl point{named} --angles 0.2 0.0" if runs else f"mastctl run{named}"


def _daemon(config: Config, status: Mapping[str, Any] | None) -> Iterator[DoctorFinding]:
    """What a daemon that runs already says is wrong."""
    if status is None:
        yield DoctorFinding("daemon", "good", f"none runs at {config.listen.url}")
        return
    yield DoctorFinding("daemon", "good", f"one runs at {config.listen.url}, state {status.get('state')}")
    for fault in status.get("faults", []):
        yield DoctorFinding(
            f"fault of {fault['device']}", "bad", fault["message"], f"it lasts until {fault['until']}"
        )
    yield from _calibration(status.get("calibration"))


def _calibration(calibration: Mapping[str, Any] | None) -> Iterator[DoctorFinding]:
    """Whether the mast file still holds."""
    if calibration is None:
        return
    sentence, verdict = calibration["sentence"], calibration["verdict"]
    if verdict == "drifts":
        advice = "calibrate again; docs/how-to/drift.md says where to look"
        yield DoctorFinding("calibration", "unsure", sentence, advice)
        return
    sentence = f"{sentence} ({calibration['pointings']} pointings)"
    unknown = verdict == "unknown"
    advice = "calibrate again: mastctl calibrate writes it" if unknown else ""
    yield DoctorFinding("calibration", "unsure" if unknown else "good", sentence, advice)


def _head_line(config: Config, machine: ExaminedMachine) -> Iterator[DoctorFinding]:
    """The head's line, if it has one."""
    head = config.hardware.pan_tilt
    port = head.options.get("port")
    try:
        driver = driver_of("head", head.driver, PAN_TILT)
    except BadOptions as error:
        advice = "correct the configuration; docs/drivers.md lists the drivers"
        yield DoctorFinding("head", "bad", str(error), advice)
        return
    if driver.hardware != "real":
        return
    if driver.read_options is None:
        yield DoctorFinding("head", "unsure", f"{head.driver} is from outside; it is not examined", "")
    elif isinstance(port, str):
        yield from examine_port(port, machine)
        yield from _head_options(head, driver, port)
    else:
        message = f"driver {head.driver} has no 'port' in its options"
        yield DoctorFinding("port", "bad", message, "name the serial device; docs/reference/configuration.md")


def _head_options(head: DeviceSettings, driver: Driver, port: str) -> Iterator[DoctorFinding]:
    """Whether the driver takes the head's options, and what queries such a head; it is not queried."""
    assert driver.read_options is not None
    try:
        read = driver.read_options(head.options)
    except BadOptions as error:
        advice = "correct the configuration; docs/how-to/hardware.md has every option"
        yield DoctorFinding("head", "bad", str(error), advice)
        return
    message = f"driver {head.driver}, {read.baud} baud"
    if isinstance(driver.bench, UnitBench):
        message += f"; 'mastctl rig ptu info {quote(read.port)} --baud {read.baud}' queries it"
    yield DoctorFinding("head", "good", message)
    if not isinstance(driver.bench, ServoBench):
        return
    ids, line = (read.pan.servo_id, read.tilt.servo_id), line_arguments(port, head.driver)
    message = f"pan is servo {ids[0]} and tilt servo {ids[1]}; 'mastctl rig servo scan {line}' lists them"
    new = next((number for number in ids if number != 1), 2)
    advice = f"a new servo has the id 1: connect it alone, then mastctl rig servo set-id {line} 1 {new}"
    yield DoctorFinding("servos", "good", message, advice)


def _simulation(config: Config) -> Iterator[DoctorFinding]:
    """Whether what simulates can be had."""
    cameras = config.hardware.cameras.values()
    if not is_hardware("simulated", "head", config.hardware.pan_tilt.driver) and not any(
        is_hardware("simulated", "camera", camera.driver) for camera in cameras
    ):
        return
    try:
        clock_for(config.hardware)
        import numba
    except BadOptions as error:
        yield DoctorFinding("simulation", "bad", str(error), "correct the configuration")
    except ImportError:
        message = "numba is not installed, which renders what simulated cameras see"
        yield DoctorFinding("simulation", "bad", message, "pip install 'mastctl[sim]'")
    else:
        yield DoctorFinding("simulation", "good", f"a simulated rover, rendered by numba {numba.__version__}")


def examine_camera(name: str, camera: DeviceSettings, *, in_use: bool) -> Iterator[DoctorFinding]:
    """Examine one camera; no stream is begun. ``in_use``: whether a daemon that runs may have it."""
    what = f"camera {name}"
    level: Level = "bad"
    try:
        bench = driver_of("camera", camera.driver, name).bench
        if bench is not None:
            yield DoctorFinding(what, "good", bench.present(camera.options, name))
        return
    except BadOptions as error:
        message, advice = str(error), "correct the configuration"
    except NoPermission as error:
        message, advice = str(error), ""  # it names the group, and how to join it
    except CameraBusy as error:
        message, advice = str(error), "" if in_use else "end the program that has it"
        level = "good" if in_use else "bad"
    except NoCamera as error:
        message, advice = str(error), "plug it in; mastctl camera list shows what is connected"
    except DriverError as error:
        message, advice = str(error), "mastctl camera check says more"
    yield DoctorFinding(what, level, message, advice)


OLD_DAYS = 180


def examine_mast_file(
    config: Config, now: Callable[[], datetime] = lambda: datetime.now(UTC)
) -> Iterator[DoctorFinding]:
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
    what, advice = "mast file's age", "calibrate again: mastctl calibrate"
    try:
        made = datetime.fromisoformat(str(provenance.get("date", "")))
    except ValueError:
        return DoctorFinding(what, "unsure", "it does not say when it was made", advice)
    days = (now - (made if made.tzinfo else made.replace(tzinfo=UTC))).days
    sentence = f"made on {made:%Y-%m-%d}, {days} days ago"
    if days < 0:
        sentence = f"it was made on {made:%Y-%m-%d}, in the future"
        advice = "check this machine's clock, or that of the machine that made it"
    elif days > OLD_DAYS:
        advice = f"check whether residuals have grown, or {advice}"
    else:
        return DoctorFinding(what, "good", sentence)
    return DoctorFinding(what, "unsure", sentence, advice)


def _verdict(fit: Mapping[str, Any]) -> DoctorFinding:
    what = "calibration's verdict"
    verdict = fit.get("verdict")
    sentence = verdict.get("words") if isinstance(verdict, Mapping) else None
    if not isinstance(sentence, str):
        return DoctorFinding(
            what, "unsure", "it does not say how well it fits", "calibrate with mastctl calibrate"
        )
    levels: dict[object, Level] = {"good": "good", "bad": "bad"}
    level = levels.get(verdict.get("grade") if isinstance(verdict, Mapping) else None, "unsure")
    return DoctorFinding(
        what, level, sentence, "" if level == "good" else "the calibration's report says why"
    )
