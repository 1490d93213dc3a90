"""Commands on connected cameras: camera list, grab, focus; check and sync are in modules of their own."""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mastctl.cli import camera_check, camera_sync, output
from mastctl.cli.camera_choice import (
    FRAME_TIMEOUT_S,
    add_camera_options,
    config_of,
    opened_camera,
    with_cameras,
)
from mastctl.cli.output import finite_number, positive_number

if TYPE_CHECKING:
    from mastctl.devices.frames import StampedFrame


def add_actions(actions: Any) -> None:
    """Add list, check, grab, focus and sync to the actions of ``camera``."""
    listing = actions.add_parser("list", help="which cameras are connected, and their stable names")
    listing.set_defaults(run=camera_list)

    camera_sync.add_action(actions)

    camera_check.add_action(actions)

    grab = actions.add_parser(
        "grab", help="one fresh picture as PNG, with time, joints and mast digest in it"
    )
    add_camera_options(grab)
    grab.add_argument("--out", required=True, type=Path, metavar="FILE.png")
    grab.add_argument("--aim", nargs=2, type=finite_number, metavar=("X", "Y"), help="mark this pixel")
    grab.set_defaults(run=camera_grab)

    focus = actions.add_parser("focus", help="sharpness again and again, while the lens is turned")
    add_camera_options(focus)
    focus.add_argument(
        "--aim", nargs=2, type=finite_number, metavar=("X", "Y"), help="around this pixel only"
    )
    focus.add_argument("--seconds", type=positive_number, default=60.0, metavar="S", help="default 60")
    focus.set_defaults(run=camera_focus)


def camera_list(args: argparse.Namespace) -> int:
    """Show the connected cameras."""
    from drivers.v4l2 import find
    from drivers.v4l2.node import capture_nodes

    found = find.list_cameras()
    told: list[dict[str, Any]] = [
        {
            "node": str(c.node), "driver": c.driver, "card": c.card, "bus": c.bus,
            "links": [str(link) for link in c.links],
        }
        for c in found
    ]  # fmt: skip
    refused = list(find.refused_nodes(capture_nodes()))
    if args.json:
        output.print_json({"cameras": told, "refused": refused})
        return 0
    if not found:
        sys.stdout.write("no camera is connected\n")
    else:
        rows = [(c["card"], c["bus"], c["driver"], c["node"], "\n".join(c["links"]) or "-") for c in told]
        output.print_table("cameras", ("card", "bus", "driver", "node now", "stable links"), rows)
    for line in refused:
        output.tell(line)
    return 0


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
    from mastctl.service.mast_in_use import bounds_of

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
