"""Commands on cameras: camera list, grab, focus, settings; sync is in a module of its own."""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mastctl.cli import camera_mode, camera_sync, output
from mastctl.cli.camera_sync import (
    FRAME_TIMEOUT_S,
    add_camera_options,
    camera_driver,
    config_of,
    opened_camera,
    with_cameras,
)
from mastctl.cli.output import finite_number, positive_number
from mastctl.cli.service import add_daemon_options, client_of

if TYPE_CHECKING:
    from mastctl.config import Config
    from mastctl.devices.frames import StampedFrame


def add_actions(actions: Any) -> None:
    """Add list, check, grab, focus and sync to the actions of ``camera``."""
    listing = actions.add_parser("list", help="which cameras are connected, and their stable names")
    listing.set_defaults(run=camera_list)

    camera_sync.add_action(actions)
    camera_mode.add_action(actions)

    _add_check(actions)

    grab = actions.add_parser(
        "grab", help="one fresh picture as PNG, with time, joints and mast digest in it"
    )
    add_camera_options(grab)
    grab.add_argument("--out", required=True, type=Path, metavar="FILE.png", help="image to write")
    grab.add_argument("--aim", nargs=2, type=finite_number, metavar=("X", "Y"), help="mark this pixel")
    grab.set_defaults(run=camera_grab)

    focus = actions.add_parser("focus", help="sharpness again and again, while the lens is turned")
    add_camera_options(focus)
    focus.add_argument(
        "--aim", nargs=2, type=finite_number, metavar=("X", "Y"), help="around this pixel only"
    )
    focus.add_argument("--seconds", type=positive_number, default=60.0, metavar="S", help="default 60")
    focus.set_defaults(run=camera_focus)

    settings = actions.add_parser(
        "settings", help="show a daemon's camera's exposure, gain, white balance and focus, or change them"
    )
    settings.add_argument("camera", metavar="CAMERA", help="the camera's name in the configuration")
    settings.add_argument(
        "changes", nargs="*", type=_change, metavar="NAME=VALUE", help="as exposure_s=0.004 or gain=20"
    )
    settings.set_defaults(run=camera_settings)
    add_daemon_options(settings)


def _change(text: str) -> tuple[str, float]:
    """A change as it is typed. Raises ArgumentTypeError."""
    from drivers.interfaces import SETTINGS  # brings numpy, which no --help needs

    name, sign, value = text.partition("=")
    if not sign or name not in SETTINGS:
        words = f"{text!r} where NAME=VALUE is expected, with the name one of {', '.join(SETTINGS)}"
        raise argparse.ArgumentTypeError(words)
    return name, finite_number(value)


def camera_settings(args: argparse.Namespace) -> int:
    """Show what a camera is set to, after changing it if that is asked for."""
    with client_of(args) as client:
        if args.changes:
            told = client.set_camera(args.camera, **dict(args.changes))
        else:
            told = client.camera_settings(args.camera)
    if args.json:
        output.print_json(told)
        return 0
    rows = [
        (
            one["name"],
            "automatic" if one["automatic"] else "not known" if one["value"] is None else f"{one['value']:g}",
            f"{one['minimum']:g} to {one['maximum']:g}" + (f", step {one['step']:g}" if one["step"] else ""),
            one["unit"],
            one["refusal"] or "",
        )
        for one in told["settings"]
    ]
    if not rows:
        sys.stdout.write(f"nothing of {told['camera']} can be changed while it runs\n")
        return 0
    output.print_table(told["camera"], ("setting", "value", "bounds", "unit", "cannot change: it"), rows)
    for note in [*told["notes"], *(["an operation holds them"] if told["held"] else [])]:
        output.tell(note)
    return 0


def camera_list(args: argparse.Namespace) -> int:
    """Show the connected cameras."""
    from drivers.registry import drivers_of

    benches = [driver.bench for driver in drivers_of("camera").values() if driver.bench is not None]
    tables = [(bench, *bench.table()) for bench in benches]
    refused = [sentence for _, _, sentences in tables for sentence in sentences]
    if args.json:
        output.print_json({**{bench.key: rows for bench, rows, _ in tables}, "refused": refused})
        return 0
    if not any(rows for _, rows, _ in tables):
        sys.stdout.write("no camera is connected\n")
    for bench, rows, _ in tables:
        if rows:
            cells = [tuple(_cell(value) for value in row.values()) for row in rows]
            output.print_table(bench.title, tuple(rows[0]), cells)
    for line in refused:
        output.tell(line)
    return 0


def _cell(value: Any) -> str:
    return ("\n".join(value) or "-") if isinstance(value, list) else str(value)


def camera_grab(args: argparse.Namespace) -> int:
    """Write one fresh picture with its facts."""
    from mastctl.report.pictures import encoded, with_cross
    from mastctl.report.png_text import with_text

    if args.out.suffix.lower() != ".png":
        raise output.WrongUse(
            f"--out {args.out}: a .png is expected, which keeps every grey level and the facts"
        )
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
            facts = {"camera": camera.capture.identity.card, "bus": camera.capture.identity.bus}
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
            raise output.WrongUse(f"--aim {x:g} {y:g} is outside the picture of {size} px")
        facts |= {"aim_x_px": repr(x), "aim_y_px": repr(y)}
        image = with_cross(image, x, y)
    args.out.write_bytes(with_text(encoded(image, "png"), facts))
    if args.json:
        output.print_json({"out": str(args.out), "size_px": [image.shape[1], image.shape[0]], **facts})
    else:
        sys.stdout.write(
            f"{args.out}: {image.shape[1]}x{image.shape[0]} px, frame {sequence}, {facts['time_utc']}\n"
        )
    return 0


def camera_focus(args: argparse.Namespace) -> int:
    """Show the sharpness twice a second, and the best so far."""
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
    if args.json:
        output.print_json({"sharpness": seen, "best": best})
    return 0


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
            raise place.error  # nobody waits here until it joins
        return devices.frames([args.camera], clock.now_s(), FRAME_TIMEOUT_S)[args.camera]


def _utc(monotonic_s: float) -> str:
    """A moment of the monotonic clock as UTC, by the difference of the clocks now."""
    from datetime import UTC, datetime

    moment = datetime.fromtimestamp(time.time() - (time.monotonic() - monotonic_s), UTC)
    return moment.isoformat(timespec="milliseconds")


def _add_check(actions: Any) -> None:
    """Add check to the actions of ``camera``."""
    check = actions.add_parser("check", help="check a camera's properties and what it really delivers")
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
    """Compare some seconds of a camera's frames with what a driver promises, and show what it can do."""
    if args.config is not None:
        config = config_of(args)
        if config.hardware.cameras[args.camera].driver != camera_driver()[0]:
            return _shown(args, _checked_beside(args, config))
    if args.with_head:
        raise output.WrongUse(
            f"--with-head goes with --config and a camera of another driver than {camera_driver()[0]}"
        )
    from drivers.clock import SystemClock
    from mastctl.setup.camera_check import CameraCheck

    with opened_camera(args) as camera:
        capture, before = camera.capture, camera.counters
        found = CameraCheck(args.camera, camera, SystemClock(), capture.format.size_px).run(args.seconds)
        after = camera.counters
        lost = {name: getattr(after, name) - getattr(before, name) for name in ("dropped", "damaged", "late")}
        found |= {
            "driver": capture.identity.driver,
            "card": capture.identity.card,
            "bus": capture.identity.bus,
            "format": capture.format.code,
            "asked_rate_hz": 1 / capture.period_s,
            **lost,
            **camera.abilities(),
        }
        found["problems"] += [problem.message for problem in capture.problems]
    return _shown(args, found)


def _checked_beside(args: argparse.Namespace, config: Config) -> dict[str, Any]:
    """Check a configured camera of any driver, after the head if that is asked for."""
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


def _shown(args: argparse.Namespace, found: dict[str, Any]) -> int:
    """Show a check; 1 if no frame came."""
    if args.json:
        output.print_json(found)
    else:
        _print_check(found)
    return 0 if found["frames"] else 1


def _mode_words(told: dict[str, Any]) -> str:
    """A sensor mode as a mast file has it."""
    mode = told.get("sensor_mode")
    if mode is None:
        return "not known"
    words = ", ".join(f"{key}: {value}" for key, value in mode.items())
    return words if "crop_px" in mode else f"{words}; the driver does not report a crop"


def _print_levels(quality: dict[str, Any]) -> None:
    """The histogram as bars."""
    most = max(quality["histogram"]) or 1.0
    bars = [
        (f"{16 * i:3d}-{16 * i + 15:3d}", f"{share:6.1%}", "#" * round(40 * share / most))
        for i, share in enumerate(quality["histogram"])
    ]
    output.print_table("grey levels", ("level", "share", ""), bars)


def _print_check(found: dict[str, Any]) -> None:
    """The check as tables for people."""
    problems = [f"problem: {p}" for p in found["problems"]] or ["no problem was found"]
    rows = [("driver", found["driver"]), ("frames", f"{found['frames']} in {found['seconds']:g} s")]
    if "card" in found:
        rows += [
            ("camera", f"{found['card']} at {found['bus']}"),
            ("format", f"{found['format']}, {found['asked_rate_hz']:.4g} Hz promised"),
            ("dropped, damaged, late", f"{found['dropped']}, {found['damaged']}, {found['late']}"),
        ]
    if found["frames"]:
        width, height = found["size_px"]
        low, median, high = (1e3 * delay_s for delay_s in found["delay_s"])
        shortest, longest = (1e3 * exposure_s for exposure_s in found["exposure_s"])
        uncertainty_s, quality = found["mid_exposure_uncertainty_s"], found["quality"]
        rows += [
            ("images", f"{width}x{height}, {'colour' if found['colour'] else 'grey'}"),
            ("rate", "-" if found["rate_hz"] is None else f"{found['rate_hz']:.2f} Hz by counts and stamps"),
            ("passed over, refused", f"{found['missed']}, {found['refused']}"),
            ("end of exposure to arrival", f"{low:.1f} to {high:.1f} ms, median {median:.1f} ms"),
            ("exposure", f"{shortest:.1f} to {longest:.1f} ms"),
            (
                "mid-exposure known to",
                "not known; mastctl camera sync measures it"
                if uncertainty_s is None
                else f"+-{1e3 * uncertainty_s:.1f} ms",
            ),
            ("sensor_mode", _mode_words(found)),
            ("offset_s in use", f"{found.get('offset_s', 0.0):g}"),
            ("states of itself", ", ".join(found["abilities"]) or "nothing"),
            ("grey levels", f"mean {quality['mean']:.0f}, median {quality['median']:.0f}"),
            (
                "dark, saturated",
                f"{quality['dark_share']:.1%}, {quality['saturated_share']:.1%} of the pixels",
            ),
            ("sharpness", f"{quality['sharpness']:.1f}"),
        ]
    output.print_table(f"check of {found['camera']}", ("what", "found"), rows, problems)
    if found["frames"]:
        _print_levels(found["quality"])
    if "formats" in found:
        formats = [(f["code"], f["sizes"]) for f in found["formats"] if f["readable"]]
        output.print_table("formats", ("code", "sizes"), formats)
        controls = [
            (c["name"], c["kind"], str(c["value"]), f"{c['minimum']} to {c['maximum']}")
            for c in found["controls"]
        ]
        output.print_table("controls", ("name", "kind", "value", "range"), controls)
