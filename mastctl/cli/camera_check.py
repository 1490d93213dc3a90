"""``mastctl camera check``: what a camera can do, and what it really delivers."""

from __future__ import annotations

import argparse
import time
from typing import TYPE_CHECKING, Any

from mastctl.cli import output
from mastctl.cli.camera_choice import (
    FRAME_TIMEOUT_S,
    add_camera_options,
    config_of,
    opened_camera,
    with_cameras,
)
from mastctl.cli.output import positive_number

if TYPE_CHECKING:
    from drivers.v4l2.camera import V4l2Camera
    from mastctl.config import Config


def add_action(actions: Any) -> None:
    """Add check to the actions of ``camera``."""
    check = actions.add_parser("check", help="what a camera can do, and what it really delivers")
    add_camera_options(check)
    check.add_argument(
        "--seconds", type=positive_number, default=5.0, metavar="S", help="how long (default 5)"
    )
    check.add_argument(
        "--with-head", action="store_true",
        help="with --config: open the head first, for cameras of a simulator that look from it",
    )  # fmt: skip
    check.set_defaults(run=camera_check)


def camera_check(args: argparse.Namespace) -> int:
    """Measure what a camera delivers, and show what it can do."""
    from mastctl.setup.camera_check import quality_of

    if args.config is not None and (config := config_of(args)).hardware.cameras[args.camera].driver != "v4l2":
        return _check_any(args, config)
    if args.with_head:
        raise output.WrongUse("--with-head goes with --config and a camera of another driver than v4l2")
    with opened_camera(args) as camera:
        measured = _measured(camera, args.seconds)
        frame = camera.next_frame(time.monotonic(), FRAME_TIMEOUT_S)
        quality = quality_of(frame.image)
        problems = [problem.message for problem in camera.capture.problems]
        document: dict[str, Any] = {
            "card": camera.capture.identity.card,
            "bus": camera.capture.identity.bus,
            "driver": camera.capture.identity.driver,
            "format": camera.capture.format.code,
            "size_px": list(camera.capture.format.size_px),
            "asked_rate_hz": 1 / camera.capture.period_s,
            **measured,
            "quality": quality.told(),
            "problems": problems,
            **camera.abilities(),
        }
    if args.json:
        output.print_json(document)
    else:
        _print_check(document)
    return 0


def _check_any(args: argparse.Namespace, config: Config) -> int:
    """Hold a configured camera of any driver against what a driver promises."""
    from drivers.clock import SystemClock
    from mastctl.devices.opening import devices_beside, open_one_camera
    from mastctl.service.mast_in_use import bounds_of
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
    found |= {
        "driver": settings.cameras[args.camera].driver,
        "offset_s": settings.cameras[args.camera].offset_s,
    }
    if args.json:
        output.print_json(found)
    else:
        _print_any_check(found)
    return 0 if found["frames"] else 1


def _measured(camera: V4l2Camera, seconds: float) -> dict[str, Any]:
    """Rate, losses and delays over some seconds."""
    before = camera.counters
    frame = camera.next_frame(time.monotonic(), FRAME_TIMEOUT_S)
    first, until_s = frame, time.monotonic() + seconds
    delays_s, count = [frame.received_s - frame.stamp_s], 0
    while time.monotonic() < until_s:
        after_s = frame.mid_exposure_s - frame.exposure_s / 2
        frame = camera.next_frame(after_s, FRAME_TIMEOUT_S)
        delays_s.append(frame.received_s - frame.stamp_s)
        count += 1
    counters = camera.counters
    span_s = frame.stamp_s - first.stamp_s
    return {
        "rate_hz": (frame.sequence - first.sequence) / span_s if span_s > 0 else None,
        "dropped": counters.dropped - before.dropped,
        "damaged": counters.damaged - before.damaged,
        "late": counters.late - before.late,
        "delay_s": [min(delays_s), sorted(delays_s)[len(delays_s) // 2], max(delays_s)],
        "mid_exposure_uncertainty_s": frame.mid_uncertainty_s,
        "seconds": seconds,
    }


def _print_check(told: dict[str, Any]) -> None:
    """The check as tables for people."""
    quality = told["quality"]
    low, median, high = (1e3 * delay_s for delay_s in told["delay_s"])
    rate = "-" if told["rate_hz"] is None else f"{told['rate_hz']:.2f} Hz"
    width, height = told["size_px"]
    rows = [
        ("camera", f"{told['card']} at {told['bus']} ({told['driver']})"),
        ("format", f"{told['format']} {width}x{height}, {told['asked_rate_hz']:.4g} Hz promised"),
        ("rate", f"{rate} over {told['seconds']:g} s"),
        ("dropped, damaged, late", f"{told['dropped']}, {told['damaged']}, {told['late']}"),
        ("stamp to here", f"{low:.1f} to {high:.1f} ms, median {median:.1f} ms"),
        ("mid-exposure known to", f"+-{1e3 * told['mid_exposure_uncertainty_s']:.1f} ms"),
        ("grey levels", f"mean {quality['mean']:.0f}, median {quality['median']:.0f}"),
        ("dark, saturated", f"{quality['dark_share']:.1%}, {quality['saturated_share']:.1%} of the pixels"),
        ("sharpness", f"{quality['sharpness']:.1f}"),
    ]
    output.print_table("check", ("what", "found"), rows, [f"problem: {p}" for p in told["problems"]])
    _print_levels(quality)
    output.print_table(
        "formats", ("code", "sizes"), [(f["code"], f["sizes"]) for f in told["formats"] if f["readable"]]
    )
    controls = [
        (c["name"], c["kind"], str(c["value"]), f"{c['minimum']} to {c['maximum']}") for c in told["controls"]
    ]
    output.print_table("controls", ("name", "kind", "value", "range"), controls)


def _print_levels(quality: dict[str, Any]) -> None:
    """The histogram as bars."""
    most = max(quality["histogram"]) or 1.0
    bars = [
        (f"{16 * i:3d}-{16 * i + 15:3d}", f"{share:6.1%}", "#" * round(40 * share / most))
        for i, share in enumerate(quality["histogram"])
    ]
    output.print_table("grey levels", ("level", "share", ""), bars)


def _print_any_check(told: dict[str, Any]) -> None:
    """The check of any driver's camera as tables for people."""
    problems = [f"problem: {p}" for p in told["problems"]] or ["no problem was found"]
    rows = [("driver", told["driver"]), ("frames", f"{told['frames']} in {told['seconds']:g} s")]
    if told["frames"]:
        width, height = told["size_px"]
        low, median, high = (1e3 * delay_s for delay_s in told["delay_s"])
        shortest, longest = (1e3 * exposure_s for exposure_s in told["exposure_s"])
        uncertainty_s = told["mid_exposure_uncertainty_s"]
        rows += [
            ("pictures", f"{width}x{height}, {'colour' if told['colour'] else 'grey'}"),
            ("rate", "-" if told["rate_hz"] is None else f"{told['rate_hz']:.2f} Hz by counts and stamps"),
            ("passed over, refused", f"{told['missed']}, {told['refused']}"),
            ("exposure's end to here", f"{low:.1f} to {high:.1f} ms, median {median:.1f} ms"),
            ("exposure", f"{shortest:.1f} to {longest:.1f} ms"),
            (
                "mid-exposure known to",
                "not told; mastctl camera sync measures it"
                if uncertainty_s is None
                else f"+-{1e3 * uncertainty_s:.1f} ms",
            ),
            ("offset_s in use", f"{told['offset_s']:g}"),
            ("tells of itself", ", ".join(told["abilities"]) or "nothing"),
        ]
    output.print_table(f"check of {told['camera']}", ("what", "found"), rows, problems)
    if told["frames"]:
        _print_levels(told["quality"])
