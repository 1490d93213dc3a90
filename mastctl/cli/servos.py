"""Real heads on their lines: ``mastctl servo`` (each family) and ``mastctl ptu``."""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

from mastctl.cli import output
from mastctl.cli.output import CommandError, WrongUse

REPLY_TIMEOUT_S = 0.05

if TYPE_CHECKING:
    from drivers.probes import UnitBench
    from drivers.servo_bus.bench import ServoBench


def add_commands(subparsers: argparse._SubParsersAction[Any]) -> None:
    """Add servo and ptu."""
    for add in (_add_servo, _add_ptu):
        add(subparsers)


def _add_servo(subparsers: argparse._SubParsersAction[Any]) -> None:
    """Add servo with its three commands."""
    servo = subparsers.add_parser("servo", help="find, read and number servos on the bench")
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
        "--family", metavar="DRIVER", help="of the servos on it (default: the first of the drivers)"
    )


def _add_baud(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--baud", type=_whole, metavar="B",
        help="bits per second (default as the family's servos come from the factory)",
    )  # fmt: skip


def _bench(args: argparse.Namespace) -> ServoBench:
    """The bench of a family of servos. Raises WrongUse, with the commands for a head that has none."""
    from drivers.probes import UnitBench
    from drivers.registry import drivers_of
    from drivers.servo_bus.bench import ServoBench

    benches = {name: driver.bench for name, driver in drivers_of("head").items()}
    families = {name: bench for name, bench in benches.items() if isinstance(bench, ServoBench)}
    if args.family is None:
        return next(iter(families.values()))
    if isinstance(benches.get(args.family), UnitBench):
        raise WrongUse(
            f"--family: a {args.family} head has no servos: 'mastctl ptu info PORT' queries it, "
            "'pytest --pyargs mastctl.testing.drivers --rig FILE' tests it"
        )
    if args.family not in families:
        raise WrongUse(f"--family is '{args.family}', expected one of {', '.join(families)}")
    return families[args.family]


def _unit_bench() -> UnitBench:
    """The bench of pan/tilt units."""
    from drivers.probes import UnitBench
    from drivers.registry import drivers_of

    benches = (driver.bench for driver in drivers_of("head").values())
    return next(bench for bench in benches if isinstance(bench, UnitBench))


def _whole(text: str) -> int:
    """Read an option's value as a whole number, zero or more (argparse ``type``)."""
    if not (text.isascii() and text.isdigit() and len(text) < 10):
        raise argparse.ArgumentTypeError(f"'{text}' where a whole number is expected")
    return int(text)


@contextmanager
def _line(args: argparse.Namespace, bench: ServoBench) -> Iterator[Any]:
    """The open line of a command."""
    link = bench.open(args.port, bench.bauds[0] if args.baud is None else args.baud)
    try:
        yield link
    finally:
        link.close()


def _scan(args: argparse.Namespace) -> int:
    """List the servos of a line."""
    bench = _bench(args)
    result = bench.scan(args.port, args.baud or bench.bauds, REPLY_TIMEOUT_S)
    bauds = ", ".join(str(baud) for baud in result.bauds)
    garbled = [
        f"at {baud} baud something answered that cannot be understood: two servos of one id, or a bad line"
        for baud in result.garbled
    ]
    if not result.found:
        raise CommandError(
            "no_servo",
            f"no servo answered on {args.port} at {bauds} baud; "
            + ("; ".join(garbled) or f"is its power on, is it a {bench.family} servo?"),
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
    bench = _bench(args)
    with _line(args, bench) as link:
        found = bench.facts(link, args.id)
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

    bench = _bench(args)
    with line_held(args.port), _line(args, bench) as link:
        bench.set_id(link, args.id, args.new_id, args.new_baud, torque_off=args.torque_off)
        baud = link.baud
    if args.json:
        output.print_json({"id": args.new_id, "old_id": args.id, "baud": baud})
    else:
        output.tell(f"the servo now answers to id {args.new_id} at {baud} baud")
    return 0


def _add_ptu(subparsers: argparse._SubParsersAction[Any]) -> None:
    """Add ptu with its two commands."""
    ptu = subparsers.add_parser("ptu", help="read and home a pan/tilt unit on the bench")
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
        "--baud", type=_baud, metavar="B", help="bits a second (default: as units come from the factory)"
    )


def _baud(text: str) -> int:
    """Read a baud rate (argparse ``type``)."""
    bauds = sorted(_unit_bench().bauds)
    if not text.isascii() or not text.isdigit() or int(text) not in bauds:
        raise argparse.ArgumentTypeError(f"'{text}' where one of {', '.join(map(str, bauds))} is expected")
    return int(text)


def _ptu_info(args: argparse.Namespace) -> int:
    """Show a unit."""
    bench = _unit_bench()
    _show(args, bench.facts(args.port, args.baud or bench.bauds[0]))
    return 0


def _home(args: argparse.Namespace) -> int:
    """Reset a unit, if it is really meant."""
    from mastctl.devices.opening import line_held

    if not args.sweep_full_range:
        raise WrongUse(
            "homing sweeps both axes over their full range, whatever limits are set; "
            "clear the mast, then give --sweep-full-range"
        )
    bench = _unit_bench()
    output.tell("homing: both axes sweep their full range, up to half a minute")
    with line_held(args.port):
        found = bench.home(args.port, args.baud or bench.bauds[0])
    _show(args, found)
    return 0


def _show(args: argparse.Namespace, found: Any) -> None:
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
