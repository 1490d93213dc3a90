"""Real heads on their lines: ``mastctl servo`` (two families) and ``mastctl ptu``."""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

from mastctl.cli import output
from mastctl.cli.output import CommandError, WrongUse

REPLY_TIMEOUT_S = 0.05

if TYPE_CHECKING:
    from drivers.dynamixel.link import Link
    from drivers.feetech.servos import FeetechLink
    from drivers.flir_ptu.workshop import Facts


FAMILIES = {
    "dynamixel": (
        57_600, 115_200, 1_000_000, 2_000_000, 3_000_000, 4_000_000, 4_500_000, 6_000_000, 10_500_000, 9600,
    ),
    "feetech": (1_000_000, 115_200, 500_000, 250_000, 128_000, 76_800, 57_600, 38_400),
}  # fmt: skip
"""The baud rates that a scan tries: every rate that ``set-id`` can give, first that of the factory."""

NO_SERVOS = {"flir_ptu": "mastctl ptu info PORT"}
"""Heads without servos, and the command that asks one."""


def add_commands(subparsers: argparse._SubParsersAction[Any]) -> None:
    """Add servo and ptu."""
    for add in (_add_servo, _add_ptu):
        add(subparsers)


def _add_servo(subparsers: argparse._SubParsersAction[Any]) -> None:
    """Add servo with its three commands."""
    servo = subparsers.add_parser(
        "servo", help="find, read and number Dynamixel or Feetech servos on the bench"
    )
    commands = servo.add_subparsers(dest="servo_command", metavar="WHAT", required=True)

    scan = commands.add_parser("scan", help="ask at every baud rate which servos are there; moves nothing")
    _add_port(scan)
    scan.add_argument(
        "--baud", nargs="+", type=_whole, metavar="B", help="the rates to try (default: all usual ones)",
    )  # fmt: skip
    scan.set_defaults(run=_scan)

    info = commands.add_parser("info", help="show everything that a servo says about itself; moves nothing")
    _add_port(info)
    info.add_argument("id", type=_whole, metavar="ID", help="as 'mastctl servo scan' finds it")
    _add_baud(info)
    info.set_defaults(run=_info)

    set_id = commands.add_parser("set-id", help="give a servo another id (connect that servo alone)")
    _add_port(set_id)
    set_id.add_argument("id", type=_whole, metavar="ID", help="its id now")
    set_id.add_argument("new_id", type=_whole, metavar="NEW", help="the id that it shall have")
    _add_baud(set_id)
    set_id.add_argument("--new-baud", type=_whole, metavar="B", help="and the baud rate that it shall have")
    set_id.add_argument(
        "--torque-off", action="store_true", help="switch its torque off for that (what hangs on it may fall)"
    )
    set_id.set_defaults(run=_set_id)


def _add_port(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("port", metavar="PORT", help="serial device, or a URL such as socket://host:port")
    parser.add_argument(
        "--family", type=_family, choices=FAMILIES, default="dynamixel",
        help="of the servos on it (default dynamixel)",
    )  # fmt: skip


def _family(text: str) -> str:
    """Read a family; a head without servos is told which commands are for it (argparse ``type``)."""
    if text in NO_SERVOS:
        raise argparse.ArgumentTypeError(
            f"a {text} head has no servos: '{NO_SERVOS[text]}' asks it, 'mastctl conform --config FILE "
            "--head' tries it"
        )
    return text


def _add_baud(parser: argparse.ArgumentParser) -> None:
    told = ", ".join(f"{family} {bauds[0]}" for family, bauds in FAMILIES.items())
    parser.add_argument(
        "--baud", type=_whole, metavar="B",
        help=f"bits per second (default as servos come from the factory: {told})",
    )  # fmt: skip


def _workshop(args: argparse.Namespace) -> Any:
    """The workshop of a family of servos."""
    from drivers.dynamixel import workshop as dynamixel
    from drivers.feetech import servos as feetech

    return feetech if args.family == "feetech" else dynamixel


def _whole(text: str) -> int:
    """Read an option's value as a whole number, zero or more (argparse ``type``)."""
    if not (text.isascii() and text.isdigit() and len(text) < 10):
        raise argparse.ArgumentTypeError(f"'{text}' where a whole number is expected")
    return int(text)


@contextmanager
def _line(args: argparse.Namespace) -> Iterator[Any]:
    """The open line of a command."""
    baud = FAMILIES[args.family][0] if args.baud is None else args.baud
    link: Link | FeetechLink
    if args.family == "feetech":
        from drivers.feetech.servos import open_link

        link = open_link(args.port, baud)
    else:
        from drivers.dynamixel.link import Link

        link = Link(args.port, baud)
    try:
        yield link
    finally:
        link.close()


def _scan(args: argparse.Namespace) -> int:
    """List the servos of a line."""
    result = _workshop(args).scan(args.port, args.baud or FAMILIES[args.family], REPLY_TIMEOUT_S)
    bauds = ", ".join(str(baud) for baud in result.bauds)
    garbled = [
        f"at {baud} baud something answered that cannot be understood: two servos of one id, or a bad line"
        for baud in result.garbled
    ]
    if not result.found:
        raise CommandError(
            "no_servo",
            f"no servo answered on {args.port} at {bauds} baud; "
            + ("; ".join(garbled) or f"is its power on, is it a {args.family} servo?"),
        )
    if args.json:
        rows = [
            {
                "id": servo.servo_id,
                "baud": servo.baud,
                "model": servo.model,
                "model_number": servo.model_number,
                "firmware": servo.firmware,
                "hardware_errors": list(servo.hardware_errors),
            }
            for servo in result.found
        ]
        output.print_json({"port": args.port, "servos": rows, "garbled_bauds": list(result.garbled)})
        return 0
    output.print_table(
        f"Servos on {args.port}",
        ("id", "baud", "model", "firmware", "hardware errors"),
        [
            (str(s.servo_id), str(s.baud), s.model, str(s.firmware), ", ".join(s.hardware_errors) or "none")
            for s in result.found
        ],
        garbled,
    )
    return 0


def _info(args: argparse.Namespace) -> int:
    """Show a servo's registers."""
    with _line(args) as link:
        found = _workshop(args).facts(link, args.id)
    if args.json:
        output.print_json(
            {
                "id": found.servo_id,
                "model": found.model,
                "firmware": found.firmware,
                "registers": found.values,
                "words": found.words,
            }
        )
        return 0
    output.print_table(
        f"Servo {found.servo_id}: {found.model}, firmware {found.firmware}",
        ("register", "value", "meaning"),
        [(name, str(value), found.words.get(name, "")) for name, value in found.values.items()],
    )
    return 0


def _set_id(args: argparse.Namespace) -> int:
    """Change a servo's id and baud rate."""
    from mastctl.devices.opening import line_held

    with line_held(args.port), _line(args) as link:
        _workshop(args).set_id(link, args.id, args.new_id, args.new_baud, torque_off=args.torque_off)
        baud = link.baud
    if args.json:
        output.print_json({"id": args.new_id, "old_id": args.id, "baud": baud})
    else:
        output.tell(f"the servo now answers to id {args.new_id} at {baud} baud")
    return 0


DEFAULT_BAUD = 9600


def _add_ptu(subparsers: argparse._SubParsersAction[Any]) -> None:
    """Add ptu with its two commands."""
    ptu = subparsers.add_parser("ptu", help="read and home a FLIR pan/tilt unit on the bench")
    commands = ptu.add_subparsers(dest="ptu_command", metavar="WHAT", required=True)

    info = commands.add_parser("info", help="show what a unit says about itself; moves nothing")
    _add_line(info)
    info.set_defaults(run=_ptu_info)

    home = commands.add_parser(
        "home", help="reset a unit: both axes SWEEP THEIR FULL RANGE, whatever limits are set"
    )
    _add_line(home)
    home.add_argument(
        "--sweep-full-range",
        action="store_true",
        help="needed: nothing is in the way of the mast over its full range",
    )
    home.set_defaults(run=_home)


def _add_line(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "port", metavar="PORT", help="serial device, socket://HOST:4000 or rfc2217://HOST:PORT"
    )
    parser.add_argument(
        "--baud",
        type=_baud,
        default=DEFAULT_BAUD,
        metavar="B",
        help=f"bits a second (default {DEFAULT_BAUD})",
    )


def _baud(text: str) -> int:
    """Read a baud rate (argparse ``type``)."""
    from drivers.flir_ptu.options import BAUDS

    if not text.isascii() or not text.isdigit() or int(text) not in BAUDS:
        raise argparse.ArgumentTypeError(f"'{text}' where one of {', '.join(map(str, BAUDS))} is expected")
    return int(text)


def _ptu_info(args: argparse.Namespace) -> int:
    """Show a unit."""
    from drivers.flir_ptu.workshop import facts

    _show(args, facts(args.port, args.baud))
    return 0


def _home(args: argparse.Namespace) -> int:
    """Reset a unit, if it is really meant."""
    from drivers.flir_ptu.workshop import home
    from mastctl.devices.opening import line_held

    if not args.sweep_full_range:
        raise WrongUse(
            "homing sweeps both axes over their full range, whatever limits are set; "
            "clear the mast, then give --sweep-full-range"
        )
    output.tell("homing: both axes sweep their full range, up to half a minute")
    with line_held(args.port):
        found = home(args.port, args.baud)
    _show(args, found)
    return 0


def _show(args: argparse.Namespace, found: Facts) -> None:
    """Print a unit as a table or as JSON."""
    axes = {"pan": vars(found.pan), "tilt": vars(found.tilt)}
    if args.json:
        output.print_json({"version": found.version, "supply": found.supply, **axes})
        return
    rows = [
        (
            name.replace("_", " "),
            *("-" if axis[name] in (None, "") else str(axis[name]) for axis in axes.values()),
        )
        for name in axes["pan"]
    ]
    notes = [f"supply: {found.supply}"] if found.supply else []
    output.print_table(found.version, ("", "pan", "tilt"), rows, notes)
