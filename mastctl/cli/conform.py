"""``mastctl conform``: a rig through its running daemon, a head or a camera, against what it promises."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from calib.errors import BadFile
from calib.files import read_bytes
from mastctl import signals
from mastctl.cli import output
from mastctl.cli.output import WrongUse, at_least, finite_number, positive_number

if TYPE_CHECKING:
    from drivers.hardware import HardwareSettings
    from mastctl.conform.checks import Check, CheckOutcome, ConformReport
    from mastctl.conform.head_trial import Angles
    from mastctl.devices.opening import Bounds

MARKS = {"passed": "ok", "failed": "FAILED", "skipped": "-"}


def add_commands(subparsers: argparse._SubParsersAction[Any]) -> None:
    """Add conform."""
    parser = subparsers.add_parser(
        "conform", help="accept a rig through its running daemon, or check a head or camera driver"
    )
    parser.add_argument("url", nargs="?", metavar="URL", help="a running daemon's address")
    what = parser.add_argument_group("a driver instead of a daemon")
    what.add_argument("--driver", metavar="NAME", help="package.module:factory, or a driver of this program")
    what.add_argument(
        "--options", metavar="JSON", help="its options: a JSON object, or a file that holds one"
    )
    what.add_argument("--config", metavar="FILE", help="a configuration that has the head or camera")
    kind = what.add_mutually_exclusive_group()
    kind.add_argument("--head", action="store_true", help="it is a pan/tilt head")
    kind.add_argument(
        "--camera", nargs="?", const="camera", metavar="NAME", help="it is a camera, of this name"
    )
    what.add_argument(
        "--limits", nargs=4, type=finite_number, metavar=("PAN", "PAN", "TILT", "TILT"),
        help="the head driver's own lowest and highest angles, radians; they are tried",
    )  # fmt: skip
    what.add_argument(
        "--speed", type=positive_number, default=0.5, metavar="RAD/S", help="of every move (default 0.5)"
    )
    what.add_argument(
        "--size", nargs=2, type=at_least(1), metavar=("W", "H"), help="of the camera's pictures"
    )
    what.add_argument(
        "--seconds",
        type=positive_number,
        default=3.0,
        metavar="S",
        help="how long frames are taken (default 3)",
    )
    what.add_argument(
        "--with-head", action="store_true",
        help="with --config: open the head first, for cameras of a simulator that look from it",
    )  # fmt: skip
    motion = parser.add_mutually_exclusive_group()
    motion.add_argument(
        "--motion", dest="motion", action="store_true", default=None, help="move the head unasked"
    )
    motion.add_argument(
        "--no-motion", dest="motion", action="store_false", help="only checks that move nothing"
    )
    parser.add_argument(
        "--reach", type=positive_number, default=0.3, metavar="RAD",
        help="how far from where it stands the head is moved (default 0.3 rad)",
    )  # fmt: skip
    parser.add_argument(
        "--only", action="append", metavar="CHECK", help="a check, or all of a group; may be given often"
    )
    parser.add_argument("--list", action="store_true", help="only list the checks")
    parser.add_argument("--junit", type=Path, metavar="FILE", help="write a JUnit report")
    parser.set_defaults(run=_conform)


def _conform(args: argparse.Namespace) -> int:
    """Check a daemon, or a driver where one is named."""
    device = args.driver is not None or args.config is not None
    if device == (args.url is not None) and not args.list:
        raise WrongUse("the address of a daemon, or --driver, or --config is expected, and one of them only")
    if args.with_head and (args.config is None or args.camera is None):
        raise WrongUse("--with-head goes with --config and --camera")
    _check_junit(args.junit)
    return _driver(args) if device or args.head or args.camera is not None else _daemon(args)


def _daemon(args: argparse.Namespace) -> int:
    """Check a rig through its running daemon."""
    from mastctl.conform.rig import check_rig, rig_under_test
    from mastctl.conform.rig_checks import RIG

    checks = chosen(RIG.checks, args.only)
    if args.list:
        return _list(checks, args.json)
    with rig_under_test(args.url, args.reach) as rig:
        motion = _motion(args, checks, f"the head at {args.url}", bool(rig.began.get("simulated")))
        return told(args, check_rig(rig, checks, motion, tell_of(args)))


def _driver(args: argparse.Namespace) -> int:
    """Check a head or a camera."""
    from mastctl.conform import devices

    kind = (
        "head" if args.head else "camera" if args.camera is not None else devices.kind_of(args.driver or "")
    )
    if not kind:
        raise WrongUse("--head or --camera is expected: the driver's name does not say which it is")
    checks = chosen(devices.ALL[kind], args.only)
    if args.list:
        return _list(checks, args.json)
    settings, name, bounds, size_px = _device(args, kind)
    if kind == "camera":
        driver = settings.cameras[name].driver
        with_head = bounds if args.with_head else None
        with devices.camera_under_test(settings, name, size_px, args.seconds, with_head) as camera:
            return told(args, devices.check_camera(camera, driver, checks, tell_of(args)))
    driver = settings.pan_tilt.driver
    if driver == "replay":
        raise WrongUse("a replayed head stands at recorded pointings only; there is no motion to check")
    motion = _motion(args, checks, f"the head of driver {driver}", driver == "sim")
    own = None if args.limits is None else _limits(args.limits, bounds)
    with devices.head_under_test(settings, bounds, args.reach, args.speed, own, moves=motion) as head:
        return told(args, devices.check_head(head, driver, checks, motion, tell_of(args)))


def _device(
    args: argparse.Namespace, kind: str
) -> tuple[HardwareSettings, str, Bounds | None, tuple[int, int] | None]:
    """What opens the device, its name, what bounds its moves, the size of its pictures; as far as known."""
    from mastctl.conform.devices import device_settings

    size_px = None if args.size is None else (int(args.size[0]), int(args.size[1]))
    if args.config is None:
        name = (
            "navcam_left"
            if args.driver == "sim" and args.camera in (None, "camera")
            else args.camera or "camera"
        )
        return device_settings(args.driver, _options(args.options), kind, name), name, None, size_px
    from mastctl.cli.camera_sync import with_cameras
    from mastctl.config import load_config
    from mastctl.service.masts import bounds_of

    if args.driver is not None or args.options is not None:
        raise WrongUse("--driver and --options do not go with --config, which says them")
    config = load_config(args.config)
    bounds = bounds_of(config)
    if kind == "head":
        return config.hardware, "", bounds, None
    if args.camera not in config.hardware.cameras:
        known = ", ".join(config.hardware.cameras) or "none"
        raise WrongUse(f"{config.path} has no camera {args.camera}; it has {known}")
    assert bounds.stored is not None
    size_px = size_px or bounds.stored.rig.cameras[args.camera].model.size_px
    return with_cameras(config, [args.camera]), args.camera, bounds, size_px


def _limits(numbers: Sequence[float], bounds: Bounds | None) -> tuple[Angles, Angles]:
    """The driver's own ends of both axes, inside those of its configuration. Raises WrongUse."""
    pan, tilt = (numbers[0], numbers[1]), (numbers[2], numbers[3])
    for low, high in (pan, tilt):
        if low >= high:
            raise WrongUse(f"--limits: {low:g} {high:g} where the lower angle first is expected")
    if bounds is not None:
        for axis, ends, most in (("pan", pan, bounds.limits.pan_rad), ("tilt", tilt, bounds.limits.tilt_rad)):
            if not most[0] <= ends[0] < ends[1] <= most[1]:
                words = f"{axis} {ends[0]:g} to {ends[1]:g} is not within {most[0]:g} to {most[1]:g}"
                raise WrongUse(f"--limits: {words}, where the configuration lets it be moved")
    return pan, tilt


def _options(text: str | None) -> dict[str, Any]:
    """Read the driver's options: JSON, or a file that holds it. Raises WrongUse."""
    if text is None:
        return {}
    words = "--options"
    try:
        if not text.lstrip().startswith("{"):
            words = f"--options {text}"
            text = read_bytes(text, 1 << 20).decode()
        options = json.loads(text)
    except (BadFile, ValueError) as error:
        raise WrongUse(f"{words}: a JSON object, or a file that holds one, is expected: {error}") from None
    if not isinstance(options, dict):
        raise WrongUse(f"{words}: a JSON object is expected")
    return options


def _motion(args: argparse.Namespace, checks: Sequence[Check[Any]], whose: str, simulated: bool) -> bool:
    """Whether the head may be moved: as the options say, or whoever sits at the terminal."""
    if args.motion is not None:
        return bool(args.motion)
    if simulated or not any(check.moves for check in checks):
        return True
    return _may_move(f"{whose} will be moved by up to {args.reach:g} rad from where it stands")


def _may_move(question: str) -> bool:
    """Ask whoever sits at the terminal. Raises WrongUse where nobody does."""
    if not signals.can_ask():
        raise WrongUse(f"{question}: --motion allows it, --no-motion leaves those checks out")
    sys.stderr.write(f"{question[0].upper()}{question[1:]}. Move it? [y/N] ")
    sys.stderr.flush()
    return sys.stdin.readline().strip().lower() in ("y", "yes")


def chosen(checks: Sequence[Check[Any]], names: Sequence[str] | None) -> list[Check[Any]]:
    """Return the checks that --only names, by name or group; all without it. Raises WrongUse."""
    if names is None:
        return list(checks)
    for name in names:
        if not any(name in (check.name, check.name.partition(".")[0]) for check in checks):
            groups = ", ".join(dict.fromkeys(check.name.partition(".")[0] for check in checks))
            raise WrongUse(f"--only {name}: no such check; groups are {groups}, --list shows all")
    return [c for c in checks if c.name in names or c.name.partition(".")[0] in names]


def _list(checks: Sequence[Check[Any]], as_json: bool) -> int:
    """Show the checks."""
    if as_json:
        told = [{"name": c.name, "promise": c.promise, "moves": c.moves} for c in checks]
        output.print_json({"checks": told})
    else:
        rows = [(check.name, "moves" if check.moves else "", check.promise) for check in checks]
        output.print_table("checks", ("name", "head", "what has to hold"), rows)
    return 0


def _check_junit(path: Path | None) -> None:
    """Refuse a report that cannot be written before anything moves. Raises WrongUse."""
    if path is not None and (path.is_dir() or not path.absolute().parent.is_dir()):
        raise WrongUse(f"--junit {path}: a file in a folder that is there is expected")


def tell_of(args: argparse.Namespace) -> Callable[[CheckOutcome], None]:
    """Return what tells a person of each check as it ends, one line each."""

    def tell(outcome: CheckOutcome) -> None:
        if args.json:
            return
        words = outcome.promise if outcome.state == "passed" else ""
        more = f" ({outcome.message})" if words and outcome.message else outcome.message
        line = output.one_line(f"{words}{more}")
        sys.stdout.write(f"{MARKS[outcome.state]:6} {outcome.name:22} {line}\n")
        sys.stdout.flush()

    return tell


def told(args: argparse.Namespace, report: ConformReport) -> int:
    """Tell the whole and write the reports; return the exit code."""
    if args.junit is not None:
        report.write_junit(args.junit)
    if args.json:
        output.print_json(report.told())
    else:
        counts = ", ".join(f"{count} {state}" for state, count in report.counts.items())
        verdict = "conforms" if report.conforms else "does not conform"
        sys.stdout.write(f"{report.kind} {report.subject} {verdict}: {counts}\n")
    return 0 if report.conforms else 1
