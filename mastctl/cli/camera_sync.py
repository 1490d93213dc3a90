"""``mastctl camera sync``: how late each camera's stamps are, measured by turning the head to and fro."""

from __future__ import annotations

import argparse
import signal
import threading
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

from mastctl import signals
from mastctl.cli import output
from mastctl.cli.output import positive_number

if TYPE_CHECKING:
    from calib.geometry.rig import Rig
    from drivers.hardware import HardwareSettings
    from drivers.registry import Driver
    from mastctl.config import Config
    from mastctl.setup.sync_sweep import Sweep


SIGNIFICANT_SIGMAS = 3.0
LEAST_TOLD_S = 0.0005  # what nobody needs to correct


def add_action(actions: Any) -> None:
    """Add sync to the actions of ``camera``."""
    sync = actions.add_parser(
        "sync", help="measure how late the stamps are against the joints; turns the head to and fro"
    )
    sync.add_argument(
        "cameras", nargs="*", metavar="NAME", help="cameras on the head (default: all of the configuration)"
    )
    sync.add_argument("--config", metavar="FILE", help="default: the packaged simulated rover")
    sync.add_argument(
        "--seconds", type=positive_number, default=30.0, metavar="S", help="how long it turns (default 30)"
    )
    sync.add_argument(
        "--amplitude", type=positive_number, metavar="RAD",
        help="how far pan goes to either side (default 0.07, or 0.15 of the narrowest view)",
    )  # fmt: skip
    sync.add_argument(
        "--speed", type=positive_number, metavar="RAD_PER_S",
        help="of the fastest ways (default five amplitudes a second, or the limit)",
    )  # fmt: skip
    sync.set_defaults(run=camera_sync)


def camera_sync(args: argparse.Namespace) -> int:
    """Measure, and tell each camera's offset_s; 1 if no camera's could be told."""
    from drivers.clock import SystemClock
    from mastctl.config import load_config
    from mastctl.devices.opening import devices_beside
    from mastctl.service.masts import bounds_of
    from mastctl.setup.sync_sweep import Sweep, plan_sweep

    config = load_config(args.config)
    bounds = bounds_of(config)
    assert bounds.stored is not None
    rig = bounds.stored.rig
    names = _chosen(args, config, rig)
    plan = plan_sweep(rig, names, config.limits, args.amplitude, args.speed, args.seconds)
    settings = with_cameras(config, names)
    clock = SystemClock()
    opened = devices_beside(settings, bounds, clock, moves=True, own_cameras=True)
    with _ending_signals() as stop, opened as (devices, cameras):
        sweep = Sweep(devices, cameras, rig, config.limits, stop, clock)
        if not args.json:
            output.tell(
                f"turning pan {plan.amplitude_rad:.3f} rad to either side for {plan.seconds:g} s, "
                f"at {plan.speed_rad_per_s:.3f} rad/s at most; Ctrl-C stops the head"
            )
        sweep.run(plan)
    found = {name: _found(sweep, name, settings.cameras[name].offset_s) for name in names}
    document = {"cameras": found, "sweep": vars(plan), "notes": _notes(found)}
    if args.json:
        output.print_json(document)
    else:
        _show(document)
    return 0 if any(camera["offset_s"] is not None for camera in found.values()) else 1


def _chosen(args: argparse.Namespace, config: Config, rig: Rig) -> list[str]:
    """The cameras that are meant: on the head, since others see no motion."""
    on_head = [name for name in config.hardware.cameras if rig.cameras[name].on == "head"]
    known = ", ".join(on_head) or "none"
    for name in args.cameras:
        if name not in on_head:
            words = "is not on the head" if name in config.hardware.cameras else "is not configured"
            raise output.WrongUse(f"camera {name} {words} in {config.path}; on the head are {known}")
    if not on_head:
        raise output.WrongUse(f"{config.path} has no camera on the head")
    return list(dict.fromkeys(args.cameras)) or on_head


@contextmanager
def _ending_signals() -> Iterator[threading.Event]:
    """An event that every ending signal sets, so that the head is stopped before the program ends."""
    stop = threading.Event()
    if threading.current_thread() is not threading.main_thread():
        yield stop
        return
    before = {number: signal.signal(number, lambda *ignored: stop.set()) for number in signals.wanted()}
    try:
        yield stop
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def _found(sweep: Sweep, name: str, in_use_s: float) -> dict[str, Any]:
    """One camera's result, as JSON."""
    from mastctl.setup.sync_motion import CannotTell

    seen = sweep.seen[name]
    told: dict[str, Any] = {
        "offset_s": None,
        "sigma_s": None,
        "in_use_s": in_use_s,
        "stated_uncertainty_s": seen.uncertainty_s,
        "frames": len(seen.stamps_s),
        "warning": None,
        "failure": None,
    }
    try:
        fit = sweep.fit(name)
    except CannotTell as error:
        return told | {"failure": str(error)}
    span_s = seen.stamps_s[-1] - seen.stamps_s[0]
    beyond_s = SIGNIFICANT_SIGMAS * fit.sigma_s + seen.uncertainty_s
    if abs(fit.offset_s) > max(beyond_s, LEAST_TOLD_S):
        side = "later" if fit.offset_s > 0 else "earlier"
        told["warning"] = (
            f"{name}: its pictures were taken {1e3 * abs(fit.offset_s):.1f} ms {side} than its stamps say, "
            f"which contradicts them: {1e3 * beyond_s:.1f} ms are explained (three sigma, and "
            f"{1e3 * seen.uncertainty_s:.1f} ms that the driver states)"
        )
    return told | {
        "offset_s": in_use_s + fit.offset_s,
        "sigma_s": fit.sigma_s,
        "left_s": fit.offset_s,
        "rolling_s": fit.rolling_s,
        "rolling_sigma_s": fit.rolling_sigma_s,
        "play_rad": fit.play_rad,
        "play_sigma_rad": fit.play_sigma_rad,
        "used_frames": fit.frames,
        "patches": fit.patches,
        "ways": fit.legs,
        "rms_px": fit.rms_px,
        "rate_hz": (len(seen.stamps_s) - 1) / span_s if span_s > 0 else None,
    }


def _notes(found: dict[str, Any]) -> list[str]:
    """What all results together say."""
    notes = [camera["warning"] for camera in found.values() if camera["warning"]]
    notes += [f"{name}: {camera['failure']}" for name, camera in found.items() if camera["failure"]]
    warned = [camera for camera in found.values() if camera["warning"]]
    if len(found) > 1 and len(warned) == len(found):
        low, high = min(c["left_s"] for c in warned), max(c["left_s"] for c in warned)
        if high - low < LEAST_TOLD_S + SIGNIFICANT_SIGMAS * max(c["sigma_s"] for c in warned):
            notes.append("all cameras are off by the same: the head's readings may as well be stamped wrong")
    return notes


def _show(document: dict[str, Any]) -> None:
    rows, lines = [], []
    for name, camera in document["cameras"].items():
        if camera["offset_s"] is None:
            rows.append((name, "-", "-", str(camera["frames"]), "-", "-"))
            continue
        rolling = "-" if camera["rolling_s"] is None else f"{1e3 * camera['rolling_s']:.1f}"
        rows.append(
            (
                name, f"{1e3 * camera['left_s']:+.2f} ± {1e3 * camera['sigma_s']:.2f}",
                f"{1e3 * camera['in_use_s']:+.2f}", f"{camera['used_frames']} of {camera['frames']}",
                rolling, f"{1e3 * camera['play_rad']:.2f}",
            )
        )  # fmt: skip
        lines.append(f"for the configuration: cameras.{name}.offset_s: {camera['offset_s']:.5f}")
    columns = (
        "camera",
        "pictures later than stamps, ms",
        "offset_s in use, ms",
        "frames",
        "rolling, ms",
        "play, mrad",
    )
    output.print_table("camera sync", columns, rows, [*lines, *document["notes"]])


FRAME_TIMEOUT_S = 5.0


def add_camera_options(parser: argparse.ArgumentParser) -> None:
    """Add the options that choose and set up a camera."""
    parser.add_argument(
        "camera", metavar="CAMERA", help="link, node, card name or bus; with --config its name there"
    )
    parser.add_argument("--config", metavar="FILE", help="a configuration that has the camera")
    parser.add_argument("--format", metavar="CODE", help="YUYV, MJPG, GREY ... (default: the first it has)")
    parser.add_argument("--size", nargs=2, type=int, metavar=("W", "H"), help="default: as it is set")
    parser.add_argument("--rate", type=positive_number, metavar="HZ", help="default: as it is set")
    parser.add_argument(
        "--set", action="append", default=[], metavar="CONTROL=VALUE", help="a control; may be given often"
    )


def camera_driver() -> tuple[str, Driver]:
    """Return the driver of cameras that a person names at the command line, with its name."""
    from drivers.registry import drivers_of

    found = drivers_of("camera").items()
    return next(one for one in found if one[1].bench is not None and one[1].bench.options_for is not None)


@contextmanager
def opened_camera(args: argparse.Namespace) -> Iterator[Any]:
    """Open the camera of the arguments, by itself or by its name in a configuration, and close it."""
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
            _settings(args.set),
        )
    camera = driver.open(options, Context(args.camera))
    try:
        yield camera
    finally:
        camera.close()


def config_of(args: argparse.Namespace) -> Config:
    """Return the configuration, which has the camera; options that it says are refused beside it.

    Raises
    ------
    WrongUse
        If it has no such camera, or an option does not go with it.
    """
    from mastctl.config import load_config

    for option in ("format", "size", "rate", "set"):
        if getattr(args, option):
            raise output.WrongUse(f"--{option} does not go with --config, which says it")
    config = load_config(args.config)
    if args.camera not in config.hardware.cameras:
        known = ", ".join(config.hardware.cameras)
        raise output.WrongUse(f"{config.path} has no camera {args.camera}; it has {known}")
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
        words = f"{args.camera} in {config.path} is of driver {device.driver!r}, not {wanted!r}"
        raise output.WrongUse(words)
    return dict(device.options)


def _settings(words: list[str]) -> dict[str, int | str]:
    """``CONTROL=VALUE`` words."""
    settings: dict[str, int | str] = {}
    for word in words:
        name, equals, value = word.partition("=")
        if not name or not equals or not value:
            raise output.WrongUse(f"--set {word}: CONTROL=VALUE is expected")
        try:
            settings[name] = int(value)
        except ValueError:
            settings[name] = value
    return settings
