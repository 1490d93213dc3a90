"""The folder of a new rig: configuration, drawing, udev rules, schemas for editors, and what to do next.

Nothing that is there is ever replaced. Without any hardware the folder holds the simulated twin, which runs.
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from pathlib import Path
from shlex import quote

import numpy as np

from calib.files.atomic import save_bytes
from calib.files.mast_file import load_rig
from calib.files.yaml_text import dump_mapping
from drivers.faults import PAN_TILT
from drivers.probes import ProbedCamera, ProbedHead
from drivers.registry import driver_of
from drivers.servo_bus.bench import USUAL_BAUD, ServosOnLine, line_words
from drivers.sim.heads import DEFAULT_HEADS
from mastctl.config import check_cameras, load_config
from mastctl.packaged import SCHEMAS, config_folder, name_schema
from mastctl.setup.drawing import (
    RigAnswers,
    camera_names,
    configuration,
    drawing,
    soft_limits,
)
from mastctl.setup.machine import ExaminedMachine
from mastctl.setup.new_rig import RigNumbers, built_rig, focal_of
from mastctl.setup.plugged import Plugged, lone_servo, usb_of
from mastctl.setup.rig_folder import CONFIG, MAST, TRUE_RIG, InTheWay, write_built

RULES, README = "60-mastctl.rules", "README.md"
RIG_FILES = (CONFIG, MAST, TRUE_RIG, RULES, README)
LINE = "/dev/mast"
"""What the rules call the head's line."""
NO_HEAD = (
    f"no head answered: {LINE} in {CONFIG} stands for its line. Plug the head in and run mastctl rig new "
    "with another folder, or write the line's name there"
)
SAME_SERIAL = (
    "have the same serial number: the udev rules and the configuration know them by their USB sockets, so "
    "leave each in its socket"
)
TWIN_SIZE_PX, TWIN_SEED = (640, 480), 1
_NUMBERED = re.compile(r"/dev/tty(USB|ACM)\d+")
_USB = re.compile(rf"{_NUMBERED.pattern}|/dev/serial/by-.*")


@dataclass(frozen=True)
class NewRigFolder:
    """The ``files`` that were written, the ``next`` commands, and ``notes`` that a person must know.

    ``simulated``: it is the twin, since no head and no camera is plugged in.
    """

    folder: Path
    files: tuple[str, ...]
    simulated: bool
    next: tuple[str, ...]
    notes: tuple[str, ...] = ()


def check_free(folder: Path) -> None:
    """Refuse a folder in which a file would be replaced. Raises InTheWay with the first."""
    for name in (*RIG_FILES, SCHEMAS):
        if os.path.lexists(folder / name):  # a link to nowhere too
            raise InTheWay(f"{folder / name} exists, and nothing is replaced; another folder is expected")


def write_rig(
    folder: Path, plugged: Plugged, head: ProbedHead | None, answers: RigAnswers, machine: ExaminedMachine
) -> NewRigFolder:
    """Write the files of a rig with a head, cameras or both, and read them as the daemon does.

    Raises InTheWay, and BadFile or BadOptions if the answers make no rig.
    """
    check_free(folder)
    cameras = list(plugged.cameras)
    port = LINE if head is None or _NUMBERED.fullmatch(head.port) else head.port
    name = re.sub(r"\W+", "_", folder.resolve().name) or "rig"
    servos = head is None or isinstance(head, ServosOnLine)
    note = f"{_CONFIG_NOTE}{_SERVO_NOTE if servos else _HEAD_NOTE}"
    files = {
        CONFIG: note.encode() + dump_mapping(configuration(head, cameras, answers, port)),
        MAST: _MAST_NOTE.encode() + dump_mapping(drawing(name, cameras, answers)),
    }
    names = camera_names(len(cameras))
    known = [tuple(_usb_of(camera, machine)) for camera in cameras]
    alike = [name for name, one in zip(names, known, strict=True) if one and known.count(one) > 1]
    files[RULES] = rules(head, plugged, machine, alike).encode()
    notes = [f"{' and '.join(alike)} {SAME_SERIAL}"] if alike else []
    notes += [NO_HEAD] if head is None else []
    steps = _steps(folder, head, len(cameras))
    files[README] = _readme(plugged, steps, notes).encode("utf-8", "surrogateescape")
    with nothing_left(folder):
        made = _written(folder, files, steps, simulated=False)
        device = load_config(folder / CONFIG).hardware.pan_tilt
        read_options = driver_of("head", device.driver, PAN_TILT).read_options
        if read_options is not None:
            read_options(device.options)
    return replace(made, notes=tuple(notes))


def write_simulated(folder: Path, plugged: Plugged, answers: RigAnswers) -> NewRigFolder:
    """Write the simulated twin of a rig that is not plugged in yet. Raises as `write_rig`, and BadRig."""
    check_free(folder)
    numbers = RigNumbers(
        height_m=answers.height_m,
        baseline_m=answers.baseline_m,
        focal_px=focal_of(np.deg2rad(answers.view_deg), TWIN_SIZE_PX[0]),
        size_px=TWIN_SIZE_PX,
    )
    simulation = {"wire": next(iter(DEFAULT_HEADS)), "seed": TWIN_SEED}
    rig = built_rig(numbers, np.random.default_rng(TWIN_SEED))
    config = f"--config {quote(str(folder / CONFIG))}"
    steps = (
        f"mastctl rig doctor {config}",
        f"mastctl run {config}",
        f"mastctl point {config} --camera navcam_left --at 320 300",
    )
    with nothing_left(folder):
        write_built(rig, folder, simulation, TWIN_SEED, soft_limits(answers))
        made = _written(
            folder,
            {README: _readme(plugged, steps).encode("utf-8", "surrogateescape")},
            steps,
            simulated=True,
        )
    return NewRigFolder(folder, (CONFIG, MAST, TRUE_RIG, *made.files), True, steps)


@contextmanager
def nothing_left(folder: Path) -> Iterator[None]:
    """Make a folder for files of a rig, and take them away again if they cannot all be written.

    A second try, with other answers or more room, finds no file in its way.
    """
    made = next((one for one in (folder, *folder.parents) if one.parent.exists()), folder)
    new = not made.exists()
    folder.mkdir(parents=True, exist_ok=True)
    try:
        yield
    except BaseException:
        for name in (*RIG_FILES, *(f"{SCHEMAS}/{kind}.json" for kind in ("config", "mast"))):
            with suppress(OSError):
                (folder / name).unlink()
        for one in (folder / SCHEMAS, folder, *folder.parents):
            if one == folder / SCHEMAS or (new and one.is_relative_to(made)):
                with suppress(OSError):
                    one.rmdir()
        raise


def _written(
    folder: Path, files: Mapping[str, bytes], steps: tuple[str, ...], simulated: bool
) -> NewRigFolder:
    """Write the files and the schemas that their first lines name, and read configuration and drawing."""
    kinds = ((CONFIG, "config"), (MAST, "mast"))
    names = [*files, *(f"{SCHEMAS}/{kind}.json" for _, kind in kinds)]
    for name, data in files.items():
        save_bytes(folder / name, data)
    for name, kind in kinds:
        name_schema(folder / name, kind)
    config = load_config(folder / CONFIG)
    check_cameras(config, load_rig(config.mast_file).rig)
    return NewRigFolder(folder, tuple(names), simulated, steps)


_CONFIG_NOTE = """\
# Written by `mastctl rig new`; every key: docs/reference/configuration.md. Angles are radians.
"""
_SERVO_NOTE = """\
# Check before the first move: which servo turns which axis, its sign (sign: -1), and the limits.
# `mastctl rig servo info PORT ID` shows its position: turn it by hand, with its torque off, and ask again.
"""
_HEAD_NOTE = """\
# Check before the first move: the sign of each axis (pan positive to the right, tilt up), zero_rad, and the
# limits. `pytest --pyargs mastctl.testing.drivers --rig FILE --motion --reach 0.1` turns the head a little.
"""
_MAST_NOTE = """\
# Drawn, not calibrated: `mastctl calibrate bench` replaces it. Lengths to 2 cm are enough (meters, z down).
# C: the camera from the meeting point of the axes at pan and tilt zero.
# H and V: the image's center, and the focal length in pixels.
"""


def _usb_of(
    camera: ProbedCamera, machine: ExaminedMachine, by_socket: bool = False
) -> Iterator[tuple[str, str]]:
    """What singles out a camera's node for udev; nothing for a camera without one."""
    if camera.node is None:
        return iter(())
    return usb_of(machine.at("/sys/class/video4linux") / camera.node.name / "device", machine, by_socket)


def rules(
    head: ProbedHead | None, plugged: Plugged, machine: ExaminedMachine, alike: Sequence[str] = ()
) -> str:
    """Return the packaged udev rules, and a stable name for each device of this rig.

    ``alike`` are cameras of one serial number.
    """
    text = (config_folder() / "udev" / RULES).read_text(encoding="utf-8")
    lines = ["", "# This rig:"]
    if head is not None and "://" not in head.port:
        device = machine.at("/sys/class/tty") / machine.at(head.port).resolve().name / "device"
        lines += _rule('SUBSYSTEM=="tty", SUBSYSTEMS=="usb"', list(usb_of(device, machine)), LINE[5:])
    for name, camera in zip(camera_names(len(plugged.cameras)), plugged.cameras, strict=False):
        about = 'SUBSYSTEM=="video4linux", ATTR{index}=="0"'
        matches = list(_usb_of(camera, machine, by_socket=name in alike))
        lines += _rule(about, matches, f"v4l/by-id/mast-{name.replace('_', '-')}")
    return text + "\n".join(lines) + "\n" if len(lines) > 2 else text


def _rule(about: str, matches: Sequence[tuple[str, str]], name: str) -> list[str]:
    """One line of a rule, if there is something to know the device by."""
    if not matches:
        return []
    keys = "".join(f', {key}=="{value}"' for key, value in matches)
    return [f'{about}{keys}, SYMLINK+="{name}"']


def _steps(folder: Path, head: ProbedHead | None, cameras: int) -> tuple[str, ...]:
    """The next three commands."""
    config = f"--config {quote(str(folder / CONFIG))}"
    rules = f"sudo cp {quote(str(folder / RULES))} /etc/udev/rules.d/ && sudo udevadm control --reload"
    doctor, run = f"mastctl rig doctor {config}", f"mastctl run {config}"
    if head is None:
        return f"{rules} && sudo udevadm trigger", "mastctl rig servo scan PORT", doctor
    point = f"mastctl point {config} --angles 0.2 0.0"
    by_rule = _USB.fullmatch(head.port) or cameras
    steps = (f"{rules} && sudo udevadm trigger", doctor, run) if by_rule else (doctor, run, point)
    lone = lone_servo(head)
    if lone is not None and lone[1].servo_id == 1:
        return lone[0].numbering(head.port, lone[1].baud), *steps[:2]
    return steps


def _readme(plugged: Plugged, steps: Sequence[str], notes: Sequence[str] = ()) -> str:
    """What was found, the next three commands, and what comes after them."""
    found = [f"- {one}" for one in plugged.summaries]
    found += [f"- not used: {one}" for one in plugged.unused]
    found += [f"- {note}" for note in notes]
    return "\n".join(
        [
            "# A rig of your own",
            "",
            "Found by `mastctl rig new`:" if found else "`mastctl rig new` found no head and no camera.",
            *(["", *found] if found else []),
            "",
            "Next:",
            "",
            "```console",
            *(f"$ {step}" for step in steps),
            "```",
            "",
            "`mastctl rig doctor` names what is missing, and the command that mends it. Ctrl-C ends `mastctl",
            "run`. In another terminal, `mastctl point --angles 0.2 0.0` turns the head,",
            "`mastctl stop` stops it.",
            "`mastctl calibrate bench` then replaces the drawing (docs/how-to/calibrate.md).",
            *_slow(plugged),
            "After an upgrade, `mastctl schema config > schemas/config.json` renews what editors check by.",
            "",
        ]
    )


def _slow(plugged: Plugged) -> list[str]:
    """How to raise the rate of servos as they come from the factory."""
    for head in plugged.heads:
        if isinstance(head, ServosOnLine) and len(head.driven) > 1 and head.bauds[0] < USUAL_BAUD:
            servo = min(head.driven.values(), key=lambda one: one.baud)
            number, line = servo.servo_id, line_words(head.port, head.driver)
            command = f"mastctl rig servo set-id {line} {number} {number}"
            return [
                "",
                f"The servos speak {servo.baud} baud, which delays every reading. This raises one's rate:",
                "",
                f"`{command} --baud {servo.baud} --new-baud {USUAL_BAUD}`",
                "",
                f"Do so for each, then write `baud: {USUAL_BAUD}` and take `poll_hz` out of {CONFIG}.",
                "",
            ]
    return []
