"""Real heads on their lines: ``mastctl servo`` (two families), ``mastctl ptu`` and ``mastctl ptz``."""

from __future__ import annotations

import argparse
import math
from collections.abc import Iterator
from contextlib import contextmanager
from shlex import quote
from typing import TYPE_CHECKING, Any

from mastctl.cli import output
from mastctl.cli.output import CommandError, WrongUse, positive_number

REPLY_TIMEOUT_S = 0.05

if TYPE_CHECKING:
    from drivers.dynamixel.link import Link
    from drivers.feetech.link import FeetechLink
    from drivers.flir_ptu.workshop import Facts


FAMILIES = {
    "dynamixel": (57_600, 115_200, 1_000_000, 2_000_000, 3_000_000, 4_000_000),
    "feetech": (1_000_000, 115_200, 500_000, 57_600),
}
"""The baud rates that a scan tries, first that of the factory."""

NO_SERVOS = {
    "flir_ptu": "mastctl ptu info PORT",
    "visca": "mastctl ptz info PORT",
    "pelco": "mastctl ptz info PORT",
}
"""Heads without servos, and the command that asks one."""

FARTHEST_DEG = 20.0


def add_commands(subparsers: argparse._SubParsersAction[Any]) -> None:
    """Add servo, ptu and ptz."""
    for add in (_add_servo, _add_ptu, _add_ptz):
        add(subparsers)


def _add_servo(subparsers: argparse._SubParsersAction[Any]) -> None:
    """Add servo with its four commands."""
    servo = subparsers.add_parser(
        "servo", help="find, read, number and try Dynamixel or Feetech servos on the bench"
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

    test = commands.add_parser(
        "test", help="turn a servo a few degrees to each side and back, slowly and weakly"
    )
    _add_port(test)
    test.add_argument("id", type=_whole, metavar="ID", help="as 'mastctl servo scan' finds it")
    _add_baud(test)
    test.add_argument(
        "--degrees", type=positive_number, default=5.0, metavar="DEG", help="how far (default 5, at most 20)"
    )
    test.add_argument(
        "--torque-percent", type=positive_number, default=30.0, metavar="P",
        help="bound of the motor's drive, percent of full (default 30)",
    )  # fmt: skip
    test.set_defaults(run=_test)


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
    from drivers.feetech import workshop as feetech

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
        from drivers.feetech.link import open_link

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
            f"no servo answered on {args.port} at {bauds} baud"
            + (
                f"; {'; '.join(garbled)}; "
                if garbled
                else f"; is its power on, is it a {args.family} servo? "
            )
            + f"'mastctl ptz info {quote(args.port)}' asks for VISCA and Pelco heads",
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


def _test(args: argparse.Namespace) -> int:
    """Turn a servo a little."""
    from mastctl.devices.opening import line_held

    if args.degrees > FARTHEST_DEG:
        raise WrongUse(f"--degrees is {args.degrees:g}, expected at most {FARTHEST_DEG:g} for a careful test")
    if args.torque_percent > 100:
        raise WrongUse(f"--torque-percent is {args.torque_percent:g}, expected at most 100")
    output.tell(
        f"servo {args.id} is to turn {args.degrees:g} degrees to each side and back, at most "
        f"{args.torque_percent:g} % of its strength"
    )
    with line_held(args.port), _line(args) as link:
        trial = _workshop(args).try_out(link, args.id, math.radians(args.degrees), args.torque_percent)
    count_deg = math.degrees(trial.count_rad)
    worst = max(abs(step.left_counts) for step in trial.steps)
    if args.json:
        rows = [
            {
                "goal_counts": step.goal_counts,
                "measured_counts": step.measured_counts,
                "left_counts": step.left_counts,
                "seconds": step.seconds,
                "most_current_A": step.most_current_A,
                "voltage_V": step.voltage_V,
                "temperature_C": step.temperature_C,
            }
            for step in trial.steps
        ]
        told = {"id": trial.servo_id, "model": trial.model, "count_deg": count_deg, "steps": rows}
        if trial.speed_unit_counts is not None:
            told["speed_unit_counts"] = trial.speed_unit_counts
        output.print_json(told)
        return 0
    notes = [f"It missed its goals by {worst} counts ({worst * count_deg:.3f} deg) at most."]
    if trial.speed_unit_counts is not None:
        notes.append(f"Its unit of speed is {trial.speed_unit_counts} counts/s: speed_unit_counts.")
    output.print_table(
        f"Servo {trial.servo_id}: {trial.model}, one count is {count_deg:.4f} degrees",
        ("goal", "measured", "left", "seconds", "most A", "V", "C"),
        [
            (
                str(s.goal_counts),
                str(s.measured_counts),
                str(s.left_counts),
                f"{s.seconds:.2f}",
                "-" if s.most_current_A is None else f"{s.most_current_A:.3f}",
                f"{s.voltage_V:.1f}",
                str(s.temperature_C),
            )
            for s in trial.steps
        ],
        notes,
    )
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


def _add_ptz(subparsers: argparse._SubParsersAction[Any]) -> None:
    """Add ptz with its command."""
    ptz = subparsers.add_parser("ptz", help="ask for a VISCA or Pelco head on the bench")
    commands = ptz.add_subparsers(dest="ptz_command", metavar="WHAT", required=True)
    info = commands.add_parser(
        "info", help="show which VISCA or Pelco head answers, and where it stands; moves nothing"
    )
    info.add_argument(
        "port", metavar="PORT", help="serial device, udp://HOST, socket://HOST:PORT or rfc2217://HOST:PORT"
    )
    for name, letter, usual in (
        ("baud", "B", "VISCA 9600 and 38400, Pelco 2400, 4800 and 9600"),
        ("address", "N", "VISCA 1 to 7, Pelco 1 and 2"),
    ):
        info.add_argument(
            f"--{name}", nargs="+", type=_whole, default=[], metavar=letter,
            help=f"to ask at (default: {usual})",
        )  # fmt: skip
    info.set_defaults(run=_ptz_info)


def _ptz_info(args: argparse.Namespace) -> int:
    """Show the heads of a line."""
    from drivers.errors import BadOptions
    from drivers.ptz.inquiry import find_heads
    from mastctl.rig.plugged import PTZ_DIALECTS

    asked = [one for one in PTZ_DIALECTS if one.takes(args.port)] or PTZ_DIALECTS
    bauds = sorted({baud for dialect in asked for baud in dialect.possible_bauds})
    highest = max(dialect.highest_address for dialect in asked)
    for baud in args.baud:
        if baud not in bauds:
            raise BadOptions(f"--baud is {baud}, expected one of {', '.join(map(str, bauds))}")
    for address in args.address:
        if not 1 <= address <= highest:
            raise BadOptions(f"--address is {address}, expected 1 to {highest}")
    found = find_heads(args.port, PTZ_DIALECTS, args.baud, args.address)
    if not found:
        raise CommandError(
            "no_head",
            f"no VISCA or Pelco head answered on {args.port}; is its power on, does it answer position "
            "queries? --baud and --address name others than the usual ones",
        )
    rows = [
        {
            "driver": one.dialect.driver,
            **one.dialect.options,
            "baud": one.baud,
            "address": one.address,
            "pan_counts": one.places[0],
            "tilt_counts": one.places[1],
        }
        for one in found
    ]
    if args.json:
        output.print_json({"port": args.port, "heads": rows})
        return 0
    names = ("protocol", "baud", "address", "pan, counts", "tilt, counts")
    output.print_table(
        f"Heads on {args.port}",
        names,
        [(one.dialect.name, *map(str, (one.baud, one.address, *one.places))) for one in found],
        ["A count of Pelco is 0.01 degree; that of VISCA is in the head's data sheet, like its speed."],
    )
    return 0
