"""One examination: everything that a configuration needs of this machine."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from calib.errors import BadFile
from drivers.errors import BadOptions
from drivers.hardware import CAMERAS, HEADS, OURS, clock_for, installed_drivers
from mastctl.config import Config, load_config
from mastctl.doctor.cameras import examine_camera
from mastctl.doctor.findings import Finding, Level, Machine
from mastctl.doctor.host import (
    examine_clock,
    examine_descriptors,
    examine_drivers,
    examine_folder,
    examine_kept,
)
from mastctl.doctor.mast_file import examine_mast_file
from mastctl.doctor.serial_lines import examine_port
from mastctl.safety.state_folder import usual_folder
from mastctl.watch.reference import SENTINEL_FOLDER
from mastctl.watch.sentinel import read_folder, standing

Asked = Callable[[str], Mapping[str, Any] | None]
"""Returns the status of the daemon at an address, None if nobody answers there."""


def examine(path: str | None, asked: Asked, machine: Machine | None = None) -> Iterator[Finding]:
    """Look at everything that a configuration needs; nothing is opened that could move.

    Parameters
    ----------
    path
        The configuration; None for the packaged one.
    asked
        Asks a daemon that may run already.
    machine
        Where devices and their descriptions lie; this machine by default.
    """
    machine = machine or Machine()
    try:
        config = load_config(path)
    except BadFile as error:
        yield Finding(
            "configuration", "bad", str(error), "correct it; docs/reference/configuration.md has every key"
        )
        yield examine_clock()
        yield examine_descriptors()
        return
    yield Finding("configuration", "good", str(config.path))
    yield from examine_mast_file(config)
    status = asked(config.listen.url)
    yield from _daemon(config, status)
    yield from _head(config, machine)
    yield from examine_drivers(installed_drivers())
    for name, camera in config.hardware.cameras.items():
        if camera.driver in CAMERAS:
            yield examine_camera(name, camera.options, in_use=status is not None)
    yield from _simulation(config)
    yield from examine_folder(
        "state folder", config.state_folder or usual_folder(config.path, config.listen.url)
    )
    state_folder = config.state_folder or usual_folder(config.path, config.listen.url)
    yield from _sentinel(state_folder / SENTINEL_FOLDER)
    yield examine_kept()
    yield examine_clock()
    yield examine_descriptors()


def _sentinel(folder: Path) -> Iterator[Finding]:
    """What the drift sentinel's looks say, where it keeps them in the state folder."""
    reference, looks, wrong = read_folder(folder)
    if wrong:
        yield Finding("drift", "unsure", wrong, "take a new reference: mastctl sentinel reference")
    if reference is None:
        return
    now = standing(reference, looks, datetime.now(UTC))
    advice = "" if now.level == "good" else "look again: mastctl sentinel look; if it stays, calibrate again"
    level: Level = "unsure" if now.level != "good" else "good"  # the daemon works all the same
    yield Finding("drift", level, now.sentence, advice)


def _daemon(config: Config, status: Mapping[str, Any] | None) -> Iterator[Finding]:
    """What a daemon that runs already says is wrong."""
    if status is None:
        yield Finding("daemon", "good", f"none runs at {config.listen.url}")
        return
    yield Finding("daemon", "good", f"one runs at {config.listen.url}, state {status.get('state')}")
    for fault in status.get("faults", []):
        yield Finding(
            f"fault of {fault['device']}", "bad", fault["message"], f"it lasts until {fault['until']}"
        )
    yield from _calibration(status.get("calibration"))


def _calibration(told: Mapping[str, Any] | None) -> Iterator[Finding]:
    """What the residuals of the last days say of the mast file."""
    if told is None:
        return
    what, sentence = "residuals", f"{told['sentence']} ({told['pointings']} pointings)"
    if told["verdict"] == "drifts":
        yield Finding(
            what, "unsure", told["sentence"], "calibrate again; docs/how-to/operations.md says where to look"
        )
    elif told["verdict"] == "unknown":
        yield Finding(what, "unsure", sentence, "calibrate again: mastctl calibrate writes it")
    else:
        yield Finding(what, "good", sentence)


def _head(config: Config, machine: Machine) -> Iterator[Finding]:
    """The head's line, if it has one."""
    head = config.hardware.pan_tilt
    port = head.options.get("port")
    if head.driver in HEADS and isinstance(port, str):
        yield from examine_port(port, machine)
    elif head.driver in HEADS:
        words = f"driver {head.driver} has no 'port' in its options"
        yield Finding("port", "bad", words, "name the serial device; docs/reference/configuration.md")
    elif head.driver not in OURS:
        yield Finding("head", "unsure", f"{head.driver} is from outside; it is not looked at", "")


def _simulation(config: Config) -> Iterator[Finding]:
    """Whether what simulates can be had."""
    drivers = [config.hardware.pan_tilt.driver, *(one.driver for one in config.hardware.cameras.values())]
    if "sim" not in drivers:
        return
    try:
        clock_for(config.hardware)
        import numba
    except BadOptions as error:
        yield Finding("simulation", "bad", str(error), "correct the configuration")
    except ImportError:
        words = "numba is not installed, which renders what simulated cameras see"
        yield Finding("simulation", "bad", words, "pip install 'mastctl[sim]'")
    else:
        yield Finding("simulation", "good", f"a simulated rover, rendered by numba {numba.__version__}")
