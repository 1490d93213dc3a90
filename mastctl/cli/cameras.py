"""Cameras of this machine, without a daemon: camera list, check, grab, focus and sync."""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Any

from mastctl.cli.options import command, option
from mastctl.cli.output import Answer, Shown, WrongUse, check_file, show_line, tables_at

if TYPE_CHECKING:
    from drivers.hardware import HardwareSettings
    from drivers.interfaces import Camera
    from mastctl.config import Config

FRAME_TIMEOUT_S = 5.0


def _control(text: str) -> tuple[str, int | str]:
    """Read ``CONTROL=VALUE`` (argparse ``type``)."""
    name, _, value = text.partition("=")
    if not name or not value:
        raise argparse.ArgumentTypeError(f"'{text}' where CONTROL=VALUE is expected")
    return name, int(value) if value.lstrip("-").isdecimal() else value


CAMERA = (
    option("CAMERA", "link, node, card name or bus; with --config its name there"),
    option("--config FILE", "a configuration that has the camera"),
    option("--format CODE", "YUYV, MJPG, GREY ... (default: the first it has)"),
    option("--size W H", "default: as it is set", type=int),
    option("--rate HZ", "default: as it is set"),
    option("--set CONTROL=VALUE", "a control; may be given often", repeat=True, type=_control),
)


@command("camera list", help="which cameras are connected, and their stable names")
def camera_list(args: argparse.Namespace) -> Answer:
    """Return the connected cameras."""
    from drivers.registry import drivers_of

    found: dict[str, Any] = {}
    refused: list[str] = []
    for driver in drivers_of("camera").values():
        if driver.bench is not None:
            found[driver.bench.key], sentences = driver.bench.table()
            refused += sentences
    shown: list[str | Shown] = [
        *tables_at({key: rows for key, rows in found.items() if rows}, "", "connected"),
        *refused,
    ]
    return Answer({**found, "refused": refused}, shown or ["no camera is connected"])


@command(
    "camera check",
    *CAMERA,
    option("--seconds S", "how long", default=5.0),
    help="check a camera's properties and what it really delivers; 1 if no frame came",
    example="/dev/video0 --rate 30",
)
def camera_check(args: argparse.Namespace) -> Answer:
    """Compare some seconds of a camera's frames with what a driver promises, and show what it can do."""
    from mastctl.conform.device_checks import CameraTrial

    with opened_camera(args) as (camera, size_px):
        found = CameraTrial(args.camera, camera, size_px, args.seconds).summary
        found |= getattr(camera, "abilities", dict)()  # and what else a driver knows of its camera
        if (identity := getattr(camera, "identity", None)) is not None:
            found |= {name: getattr(identity, name) for name in ("driver", "card", "bus")}
        if (counters := getattr(camera, "counters", None)) is not None:
            found |= {name: getattr(counters, name) for name in ("dropped", "damaged", "late")}
        found["problems"] += [problem.message for problem in getattr(camera, "problems", ())]
    shown = {key: value for key, value in found.items() if key != "problems"}
    problems = [f"problem: {one}" for one in found["problems"]] or ["no problem was found"]
    return Answer(
        found, [*tables_at(shown, "", f"check of {args.camera}"), *problems], int(not found["frames"])
    )


@command(
    "camera grab",
    *CAMERA,
    option("--out FILE.png", "image to write", required=True),
    help="one fresh picture as PNG, with its time in it",
    example="/dev/video0 --out picture.png",
)
def camera_grab(args: argparse.Namespace) -> Answer:
    """Write one fresh picture."""
    from mastctl.report.pictures import encoded, with_text

    check_file(args.out, "--out")
    with opened_camera(args) as (camera, _):
        frame = camera.next_frame(time.monotonic(), FRAME_TIMEOUT_S)
    taken_s = time.time() - (time.monotonic() - frame.mid_exposure_s)
    facts = {
        "camera": args.camera,
        "time_utc": datetime.fromtimestamp(taken_s, UTC).isoformat(timespec="milliseconds"),
        "mid_exposure_s": repr(frame.mid_exposure_s),
        "exposure_s": repr(frame.exposure_s),
    }
    args.out.write_bytes(with_text(encoded(frame.image, "png"), facts))
    return Answer({"out": str(args.out), "size_px": list(frame.image.shape[1::-1]), **facts})


@command(
    "camera focus",
    *CAMERA,
    option("--aim X Y", "around this pixel only"),
    option("--seconds S", "how long", default=60.0),
    help="sharpness again and again, while the lens is turned",
    example="/dev/video0 --seconds 30",
)
def camera_focus(args: argparse.Namespace) -> Answer:
    """Show the sharpness twice a second, and the best so far, as bars."""
    from mastctl.conform.device_checks import sharpness

    best, seen = 0.0, []
    with opened_camera(args) as (camera, _):
        until_s = time.monotonic() + args.seconds
        while True:
            frame = camera.next_frame(time.monotonic(), FRAME_TIMEOUT_S)
            now = sharpness(frame.image, None if args.aim is None else tuple(args.aim))
            best = max(best, now)
            seen.append(now)
            if not args.json:
                bar = "#" * round(50 * now / best) if best else ""
                sys.stdout.write(f"sharpness {now:10.1f}   best {best:10.1f}  {bar}\n")
                sys.stdout.flush()
            if time.monotonic() + 0.5 > until_s:
                break
            time.sleep(0.5)
    return Answer({"sharpness": seen, "best": best}, ())


@command(
    "camera sync",
    option("[NAME...]", "cameras on the head (default: all of the configuration)", dest="cameras"),
    option("--config FILE", "default: the packaged simulated rover"),
    option("--seconds S", "how long it turns", default=30.0),
    option("--amplitude RAD", "how far pan goes to a side (default 0.07, or 0.15 of a view)"),
    help="measure how late the stamps are against the joints; turns the head to and fro",
    example="navcam_left navcam_right --config rover.yaml",
)
def camera_sync(args: argparse.Namespace) -> Answer:
    """Measure each camera's offset_s; 1 if none could be measured."""
    from drivers.clock import SystemClock
    from mastctl.config import load_config
    from mastctl.devices.opening import devices_beside
    from mastctl.service.masts import bounds_of
    from mastctl.setup.sync_sweep import Sweep, plan_sweep

    config = load_config(args.config)
    bounds = bounds_of(config)
    assert bounds.stored is not None
    rig = bounds.stored.rig
    on_head = [name for name in config.hardware.cameras if rig.cameras[name].on == "head"]
    for name in args.cameras:
        if name not in on_head:
            known = ", ".join(on_head) or "none"
            raise WrongUse(f"camera {name} is not on the head in {config.path}; on the head are {known}")
    if not on_head:
        raise WrongUse(f"{config.path} has no camera on the head")
    names = list(dict.fromkeys(args.cameras)) or on_head
    plan = plan_sweep(rig, names, config.limits, args.amplitude, args.seconds)
    settings, clock = with_cameras(config, names), SystemClock()
    opened = devices_beside(settings, bounds, clock, moves=True, own_cameras=True)
    with opened as (devices, cameras):
        sweep = Sweep(devices, cameras, rig, config.limits, clock)
        if not args.json:
            show_line(
                f"turning pan {plan.amplitude_rad:.3f} rad to either side for {plan.seconds:g} s, "
                f"at {plan.speed_rad_per_s:.3f} rad/s at most; Ctrl-C stops the head"
            )
        sweep.run(plan)
    found = {name: sweep.found(name, settings.cameras[name].offset_s) for name in names}
    measured = {name: one for name, one in found.items() if one["offset_s"] is not None}
    notes = [one["warning"] for one in found.values() if one["warning"]]
    if len(notes) == len(found) > 1:
        notes.append("where all are off by the same, the head's readings may as well be stamped wrong")
    notes += [f"{name}: {one['failure']}" for name, one in found.items() if one["failure"]]
    lines = [f"cameras.{name}.offset_s: {one['offset_s']:.5f}" for name, one in measured.items()]
    document = {"cameras": found, "sweep": vars(plan), "notes": notes}
    keys = " ".join(f"cameras.*.{key}" for key in ("left_s", "sigma_s", "frames", "rolling_s", "play_rad"))
    tables = tables_at(document, keys, "left_s: pictures later than their stamps") if measured else []
    heading = ["for the configuration:"] if lines else []
    return Answer(document, [*tables, *heading, *lines, *notes], 0 if measured else 1)


@contextmanager
def opened_camera(args: argparse.Namespace) -> Iterator[tuple[Camera, tuple[int, int] | None]]:
    """Open the camera of the options, with its (width, height) by a mast file where it is configured.

    A simulated camera is on a simulated head, which is opened before it and not moved.
    """
    from drivers.clock import SystemClock
    from drivers.hardware import DeviceSettings, HardwareSettings, is_hardware
    from drivers.registry import drivers_of
    from mastctl.config import load_config
    from mastctl.devices.opening import devices_beside, open_one_camera
    from mastctl.service.masts import bounds_of

    if args.config is None:
        name, options_for = next(
            (name, one.bench.options_for)
            for name, one in drivers_of("camera").items()
            if one.bench is not None and one.bench.options_for is not None
        )
        size = None if args.size is None else tuple(args.size)
        device = DeviceSettings(name, options_for(args.camera, args.format, size, args.rate, dict(args.set)))
        with open_one_camera(
            HardwareSettings(DeviceSettings("none"), {args.camera: device}), args.camera
        ) as one:
            yield one, None
        return
    if any(getattr(args, name) for name in ("format", "size", "rate", "set")):
        raise WrongUse("--format, --size, --rate and --set do not go with --config, which has them")
    config = load_config(args.config)
    if args.camera not in config.hardware.cameras:
        known = ", ".join(config.hardware.cameras)
        raise WrongUse(f"{config.path} has no camera {args.camera}; it has {known}")
    settings, bounds = with_cameras(config, [args.camera]), bounds_of(config)
    assert bounds.stored is not None
    size_px = bounds.stored.rig.cameras[args.camera].model.size_px
    if not is_hardware("simulated", "camera", settings.cameras[args.camera].driver):
        with open_one_camera(settings, args.camera) as camera:
            yield camera, size_px
        return
    with devices_beside(settings, bounds, SystemClock(), moves=False, own_cameras=True) as (_, cameras):
        yield cameras[args.camera], size_px


def with_cameras(config: Config, names: Iterable[str]) -> HardwareSettings:
    """Return the configuration's hardware with these cameras only."""
    return replace(config.hardware, cameras={name: config.hardware.cameras[name] for name in names})
