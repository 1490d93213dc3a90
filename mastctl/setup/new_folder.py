"""The folder of a new rig: configuration, drawing, udev rules, schemas for editors, and what to do next.

Nothing that is there is ever replaced. Without any hardware the folder holds the simulated twin, which runs.
"""

from __future__ import annotations

import math
import re
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from shlex import quote
from typing import Any

import numpy as np

from calib.files import save_bytes
from calib.files.mast_file import MAST_SCHEMA, load_rig
from calib.files.yaml_text import dump_mapping
from drivers.faults import PAN_TILT
from drivers.registry import ProbedCamera, ProbedHead, driver_of, drivers_of
from drivers.servo_bus.bench import USUAL_BAUD, ServoBench, ServosOnLine
from drivers.sim.heads import DEFAULT_HEADS
from mastctl.config import CONFIG_SCHEMA, check_cameras, load_config
from mastctl.packaged import SCHEMAS, config_folder, name_schema
from mastctl.setup.machine import ExaminedMachine
from mastctl.setup.plugged import Plugged, lone_servo, usb_of
from mastctl.setup.simulated_rig import CONFIG, MAST, TRUE_RIG, RigNumbers, built_rig, check_free, write_built

RULES, README = "60-mastctl.rules", "README.md"
RIG_FILES = (CONFIG, MAST, TRUE_RIG, RULES, README, SCHEMAS)
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
SLOW = (
    "the servos speak {baud} baud, which delays every reading: `mastctl rig servo set-id` with "
    f"`--new-baud {USUAL_BAUD}` raises it; then write `baud: {USUAL_BAUD}` and take `poll_hz` out of {CONFIG}"
)
TWIN_SIZE_PX, TWIN_SEED = (640, 480), 1
FORWARD_M, DOWN_M = 0.04, 0.02
"""Of the drawn cameras from the meeting point of the axes."""
MARGIN_RAD = 0.1
"""Between the limits that a head's driver holds and the soft ones."""
_NUMBERED = re.compile(r"/dev/tty(USB|ACM)\d+")
_USB = re.compile(rf"{_NUMBERED.pattern}|/dev/serial/by-.*")


@dataclass(frozen=True)
class NewRigFolder:
    """The ``files`` that were written, the ``next`` commands, and ``notes`` that a person must know."""

    files: tuple[str, ...]
    next: tuple[str, ...]
    notes: tuple[str, ...] = ()


def write_rig(
    folder: Path, plugged: Plugged, head: ProbedHead | None, numbers: RigNumbers, machine: ExaminedMachine
) -> NewRigFolder:
    """Write the files of a rig with a head, cameras or both, and read them as the daemon does.

    Raises InTheWay, and BadFile or BadOptions if the numbers make no rig.
    """
    cameras = list(plugged.cameras)
    port = LINE if head is None or _NUMBERED.fullmatch(head.port) else head.port
    name = re.sub(r"\W+", "_", folder.resolve().name) or "rig"
    servos = head is None or isinstance(head, ServosOnLine)
    note = f"{_CONFIG_NOTE}{_SERVO_NOTE if servos else _HEAD_NOTE}"
    names = camera_names(len(cameras))
    known = [tuple(_usb_of(camera, machine)) for camera in cameras]
    alike = [name for name, one in zip(names, known, strict=True) if one and known.count(one) > 1]
    notes = [f"{' and '.join(alike)} {SAME_SERIAL}"] if alike else []
    notes += [NO_HEAD] if head is None else []
    slow = []  # of the README alone: the rig runs
    if isinstance(head, ServosOnLine) and len(head.driven) > 1 and head.bauds[0] < USUAL_BAUD:
        slow.append(SLOW.format(baud=head.bauds[0]))
    steps = _steps(folder, head, len(cameras))
    files = {
        CONFIG: note.encode() + dump_mapping(configuration(head, cameras, numbers, port)),
        MAST: _MAST_NOTE.encode() + dump_mapping(drawing(name, cameras, numbers)),
        RULES: rules(head, plugged, machine, alike).encode(),
        README: _readme(plugged, steps, [*notes, *slow]),
    }
    with _all_or_nothing(folder) as draft:
        made = _written(draft, files, steps)
        device = load_config(draft / CONFIG).hardware.pan_tilt
        read_options = driver_of("head", device.driver, PAN_TILT).read_options
        if read_options is not None:
            read_options(device.options)
    return replace(made, notes=tuple(notes))


def write_simulated(folder: Path, plugged: Plugged, numbers: RigNumbers) -> NewRigFolder:
    """Write the simulated twin of a rig that is not plugged in yet. Raises as `write_rig`, and BadRig."""
    numbers = replace(numbers, size_px=TWIN_SIZE_PX)
    simulation = {"wire": next(iter(DEFAULT_HEADS)), "seed": TWIN_SEED}
    rig = built_rig(numbers, np.random.default_rng(TWIN_SEED))
    config = f"--config {quote(str(folder / CONFIG))}"
    steps = (
        f"mastctl rig doctor {config}",
        f"mastctl run {config}",
        f"mastctl point {config} --camera navcam_left --at 320 300",
    )
    limits_rad = _soft(_radians(numbers.pan_deg)), _soft(_radians(numbers.tilt_deg))
    with _all_or_nothing(folder) as draft:
        write_built(rig, draft, simulation, TWIN_SEED, limits_rad)
        made = _written(draft, {README: _readme(plugged, steps)}, steps)
    return replace(made, files=(CONFIG, MAST, TRUE_RIG, *made.files))


@contextmanager
def _all_or_nothing(folder: Path) -> Iterator[Path]:
    """Give a folder whose files come into ``folder`` when all of them have been written. Raises InTheWay."""
    check_free(folder, RIG_FILES)
    new = [one for one in (folder, *folder.parents) if not one.exists()]
    folder.mkdir(parents=True, exist_ok=True)
    try:
        with tempfile.TemporaryDirectory(dir=folder) as draft:
            yield Path(draft)
            for path in Path(draft).iterdir():
                path.rename(folder / path.name)
    except BaseException:
        for one in new:
            with suppress(OSError):
                one.rmdir()
        raise


def _written(folder: Path, files: Mapping[str, bytes], steps: tuple[str, ...]) -> NewRigFolder:
    """Write the files and the schemas that their first lines name, and read configuration and drawing."""
    kinds = ((CONFIG, "config"), (MAST, "mast"))
    for name, data in files.items():
        save_bytes(folder / name, data)
    for name, kind in kinds:
        name_schema(folder / name, kind)
    config = load_config(folder / CONFIG)
    check_cameras(config, load_rig(config.mast_file).rig)
    return NewRigFolder((*files, *(f"{SCHEMAS}/{kind}.json" for _, kind in kinds)), steps)


def camera_names(count: int) -> list[str]:
    """Return the names of a rig's cameras: a pair, or one."""
    return ["cam_left", "cam_right"] if count > 1 else ["cam"][:count]


def configuration(
    head: ProbedHead | None, cameras: list[ProbedCamera], numbers: RigNumbers, port: str
) -> dict[str, Any]:
    """Return the configuration; without a head, that of two usual servos which are still to be plugged in.

    ``port`` is what the head's line is called.
    """
    if head is None:
        benches = (driver.bench for driver in drivers_of("head").values())
        head = ServosOnLine(next(bench for bench in benches if isinstance(bench, ServoBench)), "")
    ends = {"pan": _radians(numbers.pan_deg), "tilt": _radians(numbers.tilt_deg)}
    options, reached = head.configured(ends, {"pan": numbers.pan_id, "tilt": numbers.tilt_id})
    return {
        "schema": CONFIG_SCHEMA,
        "mast_file": MAST,
        "listen": {"host": "127.0.0.1", "port": 8420},
        "pan_tilt": {"driver": head.driver, "options": {"port": port, **options}},
        "cameras": {
            name: {"driver": camera.driver, "options": dict(camera.options)}
            for name, camera in zip(camera_names(len(cameras)), cameras, strict=False)
        },
        "limits": {
            **{f"{axis}_rad": _soft(of_axis) for axis, of_axis in reached.items()},
            "speed_rad_per_s": head.speed_rad_per_s,
        },
    }


def _radians(ends_deg: tuple[float, float]) -> tuple[float, float]:
    return round(math.radians(ends_deg[0]), 3), round(math.radians(ends_deg[1]), 3)


def _soft(ends: tuple[float, float]) -> list[float]:
    """Soft limits of an axis within what its driver holds."""
    return [round(ends[0] + MARGIN_RAD, 3), round(ends[1] - MARGIN_RAD, 3)]


def drawing(name: str, cameras: list[ProbedCamera], numbers: RigNumbers) -> dict[str, Any]:
    """Return the mast file: axes that meet over the rover's origin, and cameras that look ahead."""
    names = camera_names(len(cameras))
    drawn = {}
    for index, (camera, plugged) in enumerate(zip(names, cameras, strict=False)):
        width, height = plugged.options["size_px"]
        focal_px = round(numbers.focal_px(width), 1)
        y_m = (index - 0.5) * numbers.baseline_m if len(names) == 2 else 0.0
        drawn[camera] = {
            "on": "head",
            "size_px": [width, height],
            "model": "CAHVOR",
            "C": [FORWARD_M, y_m, DOWN_M],
            "A": [1.0, 0.0, 0.0],
            "H": [(width - 1) / 2, focal_px, 0.0],
            "V": [(height - 1) / 2, 0.0, focal_px],
            "O": [1.0, 0.0, 0.0],
            "R": [0.0, 0.0, 0.0],
        }
    return {
        "schema": MAST_SCHEMA,
        "name": name,
        "mast": {"translation_m": [0.0, 0.0, -numbers.height_m], "rotation_rad": [0.0, 0.0, 0.0]},
        "cameras": drawn,
        **({"stereo": {"cam": names}} if len(names) == 2 else {}),
        "provenance": {
            "kind": "drawn by mastctl rig new, not calibrated",
            "date": datetime.now(UTC).isoformat(timespec="seconds"),
        },
    }


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
    keys = "".join(f', {key}=="{value}"' for key, value in matches)
    return [f'{about}{keys}, SYMLINK+="{name}"'] if matches else []


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


def _readme(plugged: Plugged, steps: Sequence[str], notes: Sequence[str] = ()) -> bytes:
    """What was found, the next three commands, and what comes after them."""
    found = [
        f"- {one}" for one in (*plugged.summaries, *(f"not used: {one}" for one in plugged.unused), *notes)
    ]
    text = f"""\
# A rig of your own

{"Found by `mastctl rig new`:" if found else "`mastctl rig new` found no head and no camera."}

{chr(10).join(found)}

Next:

```console
{chr(10).join(f"$ {step}" for step in steps)}
```

`mastctl rig doctor` names what is missing, and the command that mends it. Ctrl-C ends `mastctl
run`. In another terminal, `mastctl point --angles 0.2 0.0` turns the head, `mastctl stop` stops it.
`mastctl calibrate bench` then replaces the drawing (docs/how-to/calibrate.md).
After an upgrade, `mastctl schema config > schemas/config.json` renews what editors check by.
"""
    return text.encode("utf-8", "surrogateescape")
