"""``mastctl camera sync``: how late each camera's stamps are, measured by turning the head to and fro."""

from __future__ import annotations

import argparse
import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

from mastctl import signals
from mastctl.cli import output
from mastctl.cli.cameras import with_cameras
from mastctl.cli.options import command, option, positive_number
from mastctl.cli.output import Answer, Shown, WrongUse, tables_of

if TYPE_CHECKING:
    from calib.geometry.rig import Rig
    from mastctl.config import Config
    from mastctl.setup.sync_sweep import Sweep


SIGNIFICANT_SIGMAS = 3.0
LEAST_S = 0.0005
"""An offset that small needs no correction."""


@command(
    "camera sync",
    option("[NAME...]", "cameras on the head (default: all of the configuration)", dest="cameras"),
    option("--config FILE", "default: the packaged simulated rover"),
    option("--seconds S", "how long it turns", default=30.0),
    option(
        "--amplitude RAD",
        "how far pan goes to either side (default 0.07, or 0.15 of the narrowest view)",
        type=positive_number,
    ),
    option(
        "--speed RAD_PER_S",
        "of the fastest turns (default five amplitudes a second, or the limit)",
        type=positive_number,
    ),
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
    measured = any(camera["offset_s"] is not None for camera in found.values())
    return Answer(document, _shown(document), 0 if measured else 1)


def _chosen(args: argparse.Namespace, config: Config, rig: Rig) -> list[str]:
    """The cameras that are meant: on the head, since others see no motion."""
    on_head = [name for name in config.hardware.cameras if rig.cameras[name].on == "head"]
    known = ", ".join(on_head) or "none"
    for name in args.cameras:
        if name not in on_head:
            why = "is not on the head" if name in config.hardware.cameras else "is not configured"
            raise WrongUse(f"camera {name} {why} in {config.path}; on the head are {known}")
    if not on_head:
        raise WrongUse(f"{config.path} has no camera on the head")
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
    found: dict[str, Any] = {
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
        return found | {"failure": str(error)}
    span_s = seen.stamps_s[-1] - seen.stamps_s[0]
    beyond_s = SIGNIFICANT_SIGMAS * fit.sigma_s + seen.uncertainty_s
    if abs(fit.offset_s) > max(beyond_s, LEAST_S):
        side = "later" if fit.offset_s > 0 else "earlier"
        found["warning"] = (
            f"{name}: its pictures were taken {1e3 * abs(fit.offset_s):.1f} ms {side} than its stamps say, "
            f"which contradicts them: {1e3 * beyond_s:.1f} ms are explained (three sigma, and "
            f"{1e3 * seen.uncertainty_s:.1f} ms that the driver states)"
        )
    return found | {
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
    """The notes on all results together."""
    notes = [camera["warning"] for camera in found.values() if camera["warning"]]
    notes += [f"{name}: {camera['failure']}" for name, camera in found.items() if camera["failure"]]
    warned = [camera for camera in found.values() if camera["warning"]]
    if len(found) > 1 and len(warned) == len(found):
        low, high = min(c["left_s"] for c in warned), max(c["left_s"] for c in warned)
        if high - low < LEAST_S + SIGNIFICANT_SIGMAS * max(c["sigma_s"] for c in warned):
            notes.append("all cameras are off by the same: the head's readings may as well be stamped wrong")
    return notes


def _shown(document: dict[str, Any]) -> Iterator[str | Shown]:
    """What a person needs of each camera, the line for the configuration, and the notes."""
    keys = ("left_s", "sigma_s", "frames", "rolling_s", "play_rad")
    rows = [
        {"camera": name, **{key: found.get(key) for key in keys}}
        for name, found in document["cameras"].items()
    ]
    yield from tables_of({"camera sync (left_s: pictures later than their stamps)": rows})
    for name, found in document["cameras"].items():
        if found["offset_s"] is not None:
            yield f"for the configuration: cameras.{name}.offset_s: {found['offset_s']:.5f}"
    yield from document["notes"]
