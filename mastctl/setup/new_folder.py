"""``rig new``: what is plugged in, and the folder of a new rig made of it, with what to do next.

Heads that answer on serial lines and cameras are found by their drivers; nothing moves. Nothing that is there
is ever replaced. Without any hardware the folder holds the simulated twin, which runs.
"""

from __future__ import annotations

import math
import os
import re
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from shlex import quote
from typing import Any

import numpy as np

from calib.files import save_bytes
from calib.files.mast_file import load_rig, save_rig
from calib.files.yaml_text import dump_mapping
from calib.geometry.rig import Mast, Rig, RigCamera
from drivers.errors import DriverError
from drivers.faults import PAN_TILT
from drivers.registry import ProbedCamera, ProbedHead, driver_of, drivers_of
from drivers.servo_bus.bench import USUAL_BAUD, ServoBench, ServosOnLine
from drivers.sim.heads import DEFAULT_HEADS
from mastctl.config import CONFIG_SCHEMA, check_cameras, load_config
from mastctl.packaged import SCHEMAS, config_folder, name_schema
from mastctl.setup.doctor import ExaminedMachine, examine_port, serial_lines
from mastctl.setup.simulated_rig import (
    CONFIG,
    MAST,
    TRUE_RIG,
    RigNumbers,
    built_rig,
    camera_ahead,
    check_free,
    write_rover,
)

RULES, README = "60-mastctl.rules", "README.md"
RIG_FILES = (CONFIG, MAST, TRUE_RIG, RULES, README, SCHEMAS)
LINE = "/dev/mast"
"""What stands for a head's line that is not known yet."""
NO_HEAD = (
    f"no head answered: {LINE} in {CONFIG} stands for its line. Plug the head in and run mastctl rig new "
    "with another folder, or write the line's name there"
)
SLOW = (
    "the servos speak {baud} baud, which delays every reading: `mastctl rig servo set-id` with "
    f"`--new-baud {USUAL_BAUD}` raises it; then write `baud: {USUAL_BAUD}` and take `poll_hz` out of {CONFIG}"
)
TWIN_SIZE_PX, TWIN_SEED = (640, 480), 1
MARGIN_RAD = 0.1
"""Between the limits that a head's driver holds and the soft ones."""
MOST_CAMERAS = 2
NO_POWER = "; is its power on?"
BY_HAND = "write it into configuration and mast file by hand (configs/rigs/rover.yaml has six)"


def missing_servo(head: ProbedHead | None) -> tuple[str, str]:
    """Return a sentence about a head's second servo, if that is missing, and the command that numbers one."""
    if not isinstance(head, ServosOnLine) or len(head.driven) != 1:
        return "", ""
    (servo,) = head.driven.values()
    sentence = f"{head.port}: only one servo answers (id {servo.servo_id}), and a head has two"
    if servo.servo_id != 1:
        return f"{sentence}; is the other one connected, with power and the same rate?", ""
    bench, port, baud = head.bench, head.port, servo.baud
    return f"{sentence}: {bench.one_id(port, baud)}", bench.numbering(port, baud)


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


def find_plugged(ports: Sequence[str], machine: ExaminedMachine, say: Callable[[str], None]) -> Plugged:
    """Query the given serial lines, or every USB adapter, and all cameras.

    ``say`` gets what is being queried; a line takes some seconds.
    """
    heads: list[ProbedHead] = []
    unused: list[str] = []
    named = [port if "://" in port else str(Path(port).absolute()) for port in ports]
    for port in named or serial_lines(machine):
        say(f"querying {port}")
        found, why = query_line(port, machine)
        if found is None:
            unused.append(why)
        elif not found.usable:
            unused.append(found.summary)
        else:
            heads.append(found)
            unused += [sentence] if (sentence := missing_servo(found)[0]) else []
    say("querying the cameras")
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
    probed = [driver.probe() for driver in drivers_of("camera").values() if driver.probe is not None]
    cameras = [camera for found, _, _ in probed for camera in found]
    others = [sentence for _, unread, _ in probed for sentence in unread]
    if not cameras:
        others += [f"no camera was found; {lacks}" for _, _, lacks in probed if lacks]
    return cameras, others


@dataclass(frozen=True)
class NewRigFolder:
    """The ``files`` that were written, the ``next`` commands, and ``notes`` that a person must know."""

    files: tuple[str, ...]
    next: tuple[str, ...]
    notes: tuple[str, ...] = ()


def write_rig(folder: Path, plugged: Plugged, head: ProbedHead | None, numbers: RigNumbers) -> NewRigFolder:
    """Write the files of a rig with a head, cameras or both, and read them as the daemon does.

    Raises InTheWay, and BadFile or BadOptions if the numbers make no rig.
    """
    notes = [NO_HEAD] if head is None else []
    slow = []  # of the README alone: the rig runs
    if isinstance(head, ServosOnLine) and len(head.driven) > 1 and head.bauds[0] < USUAL_BAUD:
        slow.append(SLOW.format(baud=head.bauds[0]))
    steps = _steps(folder, head, len(plugged.cameras))
    note = _SERVO_NOTE if head is None or isinstance(head, ServosOnLine) else _HEAD_NOTE
    files = {
        CONFIG: f"{_CONFIG_NOTE}{note}".encode() + dump_mapping(configuration(head, plugged, numbers)),
        RULES: (config_folder() / "udev" / RULES).read_bytes(),
        README: _readme(plugged, steps, [*notes, *slow]),
    }
    with _all_or_nothing(folder) as draft:
        save_rig(drawing(re.sub(r"\W+", "_", folder.resolve().name) or "rig", plugged, numbers), draft / MAST)
        save_bytes(draft / MAST, _MAST_NOTE.encode() + (draft / MAST).read_bytes())
        made = _written(draft, files, steps)
    return replace(made, files=(CONFIG, MAST, *made.files[1:]), notes=tuple(notes))


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
        write_rover(rig, draft, simulation, TWIN_SEED, limits_rad)
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
    head = config.hardware.pan_tilt
    if (read_options := driver_of("head", head.driver, PAN_TILT).read_options) is not None:
        read_options(head.options)
    return NewRigFolder((*files, *(f"{SCHEMAS}/{kind}.json" for _, kind in kinds)), steps)


def camera_names(plugged: Plugged) -> list[str]:
    """Return the names of a rig's cameras: a pair, or one."""
    count = len(plugged.cameras)
    return ["cam_left", "cam_right"] if count > 1 else ["cam"][:count]


def configuration(head: ProbedHead | None, plugged: Plugged, numbers: RigNumbers) -> dict[str, Any]:
    """Return the configuration; without a head, that of two usual servos which are still to be plugged in."""
    if head is None:
        benches = (driver.bench for driver in drivers_of("head").values())
        head = ServosOnLine(next(bench for bench in benches if isinstance(bench, ServoBench)), LINE)
    ends = {"pan": _radians(numbers.pan_deg), "tilt": _radians(numbers.tilt_deg)}
    options, reached = head.configured(ends, {"pan": numbers.pan_id, "tilt": numbers.tilt_id})
    return {
        "schema": CONFIG_SCHEMA,
        "mast_file": MAST,
        "listen": {"host": "127.0.0.1", "port": 8420},
        "pan_tilt": {"driver": head.driver, "options": {"port": head.port, **options}},
        "cameras": {
            name: {"driver": camera.driver, "options": dict(camera.options)}
            for name, camera in zip(camera_names(plugged), plugged.cameras, strict=True)
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


def drawing(name: str, plugged: Plugged, numbers: RigNumbers) -> Rig:
    """Return the rig as drawn: axes that meet over the rover's origin, and cameras that look ahead."""
    names = camera_names(plugged)
    cameras = {}
    for side, camera, found in zip((-0.5, 0.5), names, plugged.cameras, strict=False):
        width, height = found.options["size_px"]
        focal_px = round(numbers.focal_px(width), 1)
        y_m = side * numbers.baseline_m if len(names) == 2 else 0.0
        cameras[camera] = RigCamera("head", camera_ahead((width, height), (focal_px, focal_px), y_m))
    return Rig(
        name,
        Mast(np.array([0.0, 0.0, -numbers.height_m]), np.zeros(3)),
        cameras,
        {"cam": (names[0], names[1])} if len(names) == 2 else {},
        provenance={
            "kind": "drawn by mastctl rig new, not calibrated",
            "date": datetime.now(UTC).isoformat(timespec="seconds"),
        },
    )


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


def _steps(folder: Path, head: ProbedHead | None, cameras: int) -> tuple[str, ...]:
    """The next three commands."""
    config = f"--config {quote(str(folder / CONFIG))}"
    rules = (
        f"sudo cp {quote(str(folder / RULES))} /etc/udev/rules.d/ && sudo udevadm control --reload "
        "&& sudo udevadm trigger"
    )
    doctor, run = f"mastctl rig doctor {config}", f"mastctl run {config}"
    if head is None:
        return rules, "mastctl rig servo scan PORT", doctor
    by_rule = head.port.startswith(("/dev/ttyUSB", "/dev/ttyACM", "/dev/serial/by-")) or cameras
    point = f"mastctl point {config} --angles 0.2 0.0"
    steps = (rules, doctor, run) if by_rule else (doctor, run, point)
    numbering = missing_servo(head)[1]
    return (numbering, *steps[:2]) if numbering else steps


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
