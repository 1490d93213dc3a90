"""Cameras of this machine: camera list, check, grab and focus; and of a daemon: camera settings."""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

from mastctl.cli.options import command, option
from mastctl.cli.output import Answer, Shown, WrongUse, cell, tables_of

if TYPE_CHECKING:
    from drivers.hardware import HardwareSettings
    from drivers.registry import Driver
    from mastctl.config import Config
    from mastctl.devices.frames import StampedFrame

FRAME_TIMEOUT_S = 5.0

CAMERA = (
    option("CAMERA", "link, node, card name or bus; with --config its name there"),
    option("--config FILE", "a configuration that has the camera"),
    option("--format CODE", "YUYV, MJPG, GREY ... (default: the first it has)"),
    option("--size W H", "default: as it is set", type=int),
    option("--rate HZ", "default: as it is set"),
    option("--set CONTROL=VALUE", "a control; may be given often", repeat=True),
)


@command("camera list", help="which cameras are connected, and their stable names")
def camera_list(args: argparse.Namespace) -> Answer:
    """Return the connected cameras."""
    from drivers.registry import drivers_of

    benches = [driver.bench for driver in drivers_of("camera").values() if driver.bench is not None]
    tables = [(bench, *bench.table()) for bench in benches]
    refused = [sentence for _, _, sentences in tables for sentence in sentences]
    shown: list[str | Shown] = [
        Shown(bench.title, tuple(rows[0]), [tuple(map(cell, row.values())) for row in rows])
        for bench, rows, _ in tables
        if rows
    ]
    document = {**{bench.key: rows for bench, rows, _ in tables}, "refused": refused}
    return Answer(document, [*(shown or ["no camera is connected"]), *refused])


@command(
    "camera check",
    *CAMERA,
    option("--seconds S", "how long", default=5.0),
    option("--with-head", "with --config: open the head first, for cameras of a simulator that look from it"),
    help="check a camera's properties and what it really delivers",
    example="/dev/video0 --rate 30",
)
def camera_check(args: argparse.Namespace) -> Answer:
    """Compare some seconds of a camera's frames with what a driver promises, and show what it can do."""
    if args.config is not None:
        config = config_of(args)
        if config.hardware.cameras[args.camera].driver != camera_driver()[0]:
            return _check(_checked_beside(args, config))
    if args.with_head:
        raise WrongUse(
            f"--with-head goes with --config and a camera of another driver than {camera_driver()[0]}"
        )
    from drivers.clock import SystemClock
    from mastctl.setup.camera_check import CameraCheck

    with opened_camera(args) as camera:
        before = camera.counters
        found = CameraCheck(args.camera, camera, SystemClock(), camera.format.size_px).run(args.seconds)
        after = camera.counters
        lost = {name: getattr(after, name) - getattr(before, name) for name in ("dropped", "damaged", "late")}
        found |= {
            "driver": camera.identity.driver,
            "card": camera.identity.card,
            "bus": camera.identity.bus,
            "format": camera.format.code,
            "asked_rate_hz": 1 / camera.period_s,
            **lost,
            **camera.abilities(),
        }
        found["problems"] += [problem.message for problem in camera.problems]
    return _check(found)


def _checked_beside(args: argparse.Namespace, config: Config) -> dict[str, Any]:
    """Check a configured camera of any driver, with --with-head after the head."""
    from drivers.clock import SystemClock
    from mastctl.devices.opening import devices_beside, open_one_camera
    from mastctl.service.masts import bounds_of
    from mastctl.setup.camera_check import CameraCheck

    bounds = bounds_of(config)
    assert bounds.stored is not None
    settings = with_cameras(config, [args.camera])
    clock = SystemClock()
    size_px = bounds.stored.rig.cameras[args.camera].model.size_px
    if args.with_head:
        with devices_beside(settings, bounds, clock, moves=False, own_cameras=True) as (_, cameras):
            found = CameraCheck(args.camera, cameras[args.camera], clock, size_px).run(args.seconds)
    else:
        with open_one_camera(settings, args.camera, clock) as camera:
            found = CameraCheck(args.camera, camera, clock, size_px).run(args.seconds)
    device = settings.cameras[args.camera]
    return found | {"driver": device.driver, "offset_s": device.offset_s}


def _check(found: dict[str, Any]) -> Answer:
    """Return a check; 1 if no frame came."""
    problems = [f"problem: {one}" for one in found["problems"]] or ["no problem was found"]
    values = {key: value for key, value in found.items() if key not in ("problems", "formats", "controls")}
    lists = {
        key: [one for one in found[key] if one.get("readable", True)]
        for key in ("formats", "controls")
        if key in found
    }
    return Answer(
        found,
        [*tables_of(values | lists, f"check of {found['camera']}"), *problems],
        int(not found["frames"]),
    )


@command(
    "camera grab",
    *CAMERA,
    option("--out FILE.png", "image to write", required=True),
    option("--aim X Y", "mark this pixel"),
    help="one fresh picture as PNG, with time, joints and mast digest in it",
    example="/dev/video0 --out picture.png",
)
def camera_grab(args: argparse.Namespace) -> Answer:
    """Write one fresh picture with its facts."""
    from mastctl.report.pictures import encoded, with_cross
    from mastctl.report.png_text import with_text

    if args.out.suffix.lower() != ".png":
        raise WrongUse(f"--out {args.out}: a .png is expected, which keeps every grey level and the facts")
    if args.config is not None:
        frame = _configured_frame(args)
        facts = {
            "camera": frame.camera,
            "frame_id": frame.frame_id,
            "pan_rad": repr(frame.pan_rad),
            "tilt_rad": repr(frame.tilt_rad),
            "moving": str(frame.moving).lower(),
            "mast_digest": frame.mast_digest,
        }
        image, mid_s, window_s, sequence = frame.image, frame.mid_exposure_s, frame.exposure_s, frame.sequence
    else:
        with opened_camera(args) as camera:
            taken = camera.next_frame(time.monotonic(), FRAME_TIMEOUT_S)
            facts = {"camera": camera.identity.card, "bus": camera.identity.bus}
        image, mid_s, window_s, sequence = taken.image, taken.mid_exposure_s, taken.exposure_s, taken.sequence
    facts |= {
        "sequence": str(sequence),
        "mid_exposure_s": repr(mid_s),
        "exposure_s": repr(window_s),
        "time_utc": _utc(mid_s),
    }
    if args.aim is not None:
        x, y = args.aim
        if not (-0.5 <= x < image.shape[1] - 0.5 and -0.5 <= y < image.shape[0] - 0.5):
            size = f"{image.shape[1]}x{image.shape[0]}"
            raise WrongUse(f"--aim {x:g} {y:g} is outside the picture of {size} px")
        facts |= {"aim_x_px": repr(x), "aim_y_px": repr(y)}
        image = with_cross(image, x, y)
    args.out.write_bytes(with_text(encoded(image, "png"), facts))
    height, width = image.shape[:2]
    line = f"{args.out}: {width}x{height} px, frame {sequence}, {facts['time_utc']}"
    return Answer({"out": str(args.out), "size_px": [width, height], **facts}, line)


def _configured_frame(args: argparse.Namespace) -> StampedFrame:
    """One fresh frame of a configured camera (of any driver) with the joint angles of its moment."""
    from drivers.absent import AbsentCamera
    from drivers.clock import SystemClock
    from mastctl.devices.opening import devices_beside
    from mastctl.service.masts import bounds_of

    config = config_of(args)
    settings, clock = with_cameras(config, [args.camera]), SystemClock()
    with devices_beside(settings, bounds_of(config), clock, moves=False) as (devices, cameras):
        place = cameras[args.camera]
        if isinstance(place, AbsentCamera) and place.error is not None:
            raise place.error  # no wait until it joins
        return devices.frames([args.camera], clock.now_s(), FRAME_TIMEOUT_S)[args.camera]


def _utc(monotonic_s: float) -> str:
    """A moment of the monotonic clock as UTC, by the difference of the clocks now."""
    from datetime import UTC, datetime

    moment = datetime.fromtimestamp(time.time() - (time.monotonic() - monotonic_s), UTC)
    return moment.isoformat(timespec="milliseconds")


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
    from mastctl.setup.camera_check import sharpness

    best, seen = 0.0, []
    with opened_camera(args) as camera:
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


def camera_driver() -> tuple[str, Driver]:
    """Return the driver of cameras that a person names at the command line, with its name."""
    from drivers.registry import drivers_of

    found = drivers_of("camera").items()
    return next(one for one in found if one[1].bench is not None and one[1].bench.options_for is not None)


@contextmanager
def opened_camera(args: argparse.Namespace) -> Iterator[Any]:
    """Open the camera of the options, by itself or by its name in a configuration."""
    from drivers.registry import Context

    driver = camera_driver()[1]
    if args.config is not None:
        options = _configured_options(args)
    else:
        options = driver.bench.options_for(
            args.camera,
            args.format,
            None if args.size is None else tuple(args.size),
            args.rate,
            _controls(args.set),
        )
    camera = driver.open(options, Context(args.camera))
    try:
        yield camera
    finally:
        camera.close()


def config_of(args: argparse.Namespace) -> Config:
    """Return the configuration, which has the camera. Raises WrongUse, also for options that it contains."""
    from mastctl.config import load_config

    for name in ("format", "size", "rate", "set"):
        if getattr(args, name):
            raise WrongUse(f"--{name} does not go with --config, which has it")
    config = load_config(args.config)
    if args.camera not in config.hardware.cameras:
        known = ", ".join(config.hardware.cameras)
        raise WrongUse(f"{config.path} has no camera {args.camera}; it has {known}")
    return config


def with_cameras(config: Config, names: Iterable[str]) -> HardwareSettings:
    """Return the configuration's hardware with these cameras only."""
    from dataclasses import replace

    return replace(config.hardware, cameras={name: config.hardware.cameras[name] for name in names})


def _configured_options(args: argparse.Namespace) -> dict[str, Any]:
    """A camera's options in a configuration."""
    config = config_of(args)
    device = config.hardware.cameras[args.camera]
    if device.driver != (wanted := camera_driver()[0]):
        raise WrongUse(f"{args.camera} in {config.path} is of driver {device.driver!r}, not {wanted!r}")
    return dict(device.options)


def _controls(texts: list[str]) -> dict[str, int | str]:
    """``CONTROL=VALUE`` texts."""
    controls: dict[str, int | str] = {}
    for text in texts:
        name, _, value = text.partition("=")
        if not name or not value:
            raise WrongUse(f"--set {text}: CONTROL=VALUE is expected")
        try:
            controls[name] = int(value)
        except ValueError:
            controls[name] = value
    return controls
