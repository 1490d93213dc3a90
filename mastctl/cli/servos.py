"""Real heads on their lines: ``mastctl rig servo`` (each family) and ``mastctl rig ptu``."""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

from mastctl.cli import output
from mastctl.cli.options import GROUPS, at_least, command, option
from mastctl.cli.output import Answer, CommandError, Shown, WrongUse, cell, tables_of

REPLY_TIMEOUT_S = 0.05

if TYPE_CHECKING:
    from drivers.probes import UnitBench
    from drivers.servo_bus.bench import ServoBench

GROUPS |= {
    "rig servo": "find, read and number servos on the bench",
    "rig ptu": "read and home a pan/tilt unit on the bench",
}

WHOLE = at_least(0)
LINE = (
    option("PORT", "serial device, or a URL such as socket://host:port"),
    option("--family DRIVER", "of the servos on it (default: the first of the drivers)"),
)
BAUD = option(
    "--baud B", "bits per second (default as the family's servos come from the factory)", type=WHOLE
)


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
            f"--family: a {args.family} head has no servos: 'mastctl rig ptu info PORT' queries it, "
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


@contextmanager
def _line(args: argparse.Namespace, bench: ServoBench) -> Iterator[Any]:
    """Open the line of a command."""
    link = bench.open(args.port, bench.bauds[0] if args.baud is None else args.baud)
    try:
        yield link
    finally:
        link.close()


@command(
    "rig servo scan",
    *LINE,
    option("--baud B...", "the rates to try (default: all usual ones)", type=WHOLE),
    help="search at every baud rate for servos; moves nothing",
    example="/dev/ttyUSB0",
)
def _scan(args: argparse.Namespace) -> Answer:
    """Return the servos of a line."""
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
    document = {"port": args.port, "servos": rows, "garbled_bauds": list(result.garbled)}
    return Answer(document, [*tables_of({f"Servos on {args.port}": rows}), *garbled])


@command(
    "rig servo info",
    *LINE,
    option("ID", "as 'mastctl rig servo scan' finds it", type=WHOLE),
    BAUD,
    help="show all registers of a servo; moves nothing",
    example="/dev/ttyUSB0 1",
)
def _info(args: argparse.Namespace) -> Answer:
    """Return a servo's registers."""
    bench = _bench(args)
    with _line(args, bench) as link:
        found = bench.facts(link, args.id)
    title = f"Servo {found.servo_id}: {found.model}, firmware {found.firmware}"
    rows = [(name, str(value), found.meanings.get(name, "")) for name, value in found.values.items()]
    return Answer(
        {
            "id": found.servo_id,
            "model": found.model,
            "firmware": found.firmware,
            "registers": found.values,
            "words": found.meanings,
        },
        Shown(title, ("register", "value", "meaning"), rows),
    )


@command(
    "rig servo set-id",
    *LINE,
    option("ID", "its id now", type=WHOLE),
    option("NEW", "the id that it shall have", dest="new_id", type=WHOLE),
    BAUD,
    option("--new-baud B", "and the baud rate that it shall have", type=WHOLE),
    option("--torque-off", "switch its torque off for that (what hangs on it may fall)"),
    help="give a servo another id (connect that servo alone)",
    example="/dev/ttyUSB0 1 2",
)
def _set_id(args: argparse.Namespace) -> Answer:
    """Change a servo's id and baud rate."""
    from mastctl.devices.opening import line_held

    bench = _bench(args)
    with line_held(args.port), _line(args, bench) as link:
        bench.set_id(link, args.id, args.new_id, args.new_baud, torque_off=args.torque_off)
        baud = link.baud
    line = f"the servo now answers to id {args.new_id} at {baud} baud"
    return Answer({"id": args.new_id, "old_id": args.id, "baud": baud}, line)


def _unit_baud(text: str) -> int:
    """Read a baud rate of units (argparse ``type``)."""
    bauds = sorted(_unit_bench().bauds)
    if not text.isascii() or not text.isdigit() or int(text) not in bauds:
        raise argparse.ArgumentTypeError(f"'{text}' where one of {', '.join(map(str, bauds))} is expected")
    return int(text)


UNIT = (
    option("PORT", "serial device, socket://HOST:4000 or rfc2217://HOST:PORT"),
    option("--baud B", "bits a second (default: as units come from the factory)", type=_unit_baud),
)


@command("rig ptu info", *UNIT, help="show all values of a unit; moves nothing", example="/dev/ttyUSB0")
def _unit_info(args: argparse.Namespace) -> Answer:
    """Return the values of a unit."""
    bench = _unit_bench()
    return _unit(bench.facts(args.port, args.baud or bench.bauds[0]))


@command(
    "rig ptu home",
    *UNIT,
    option("--sweep-full-range", "needed: nothing is in the way of the mast over its full range"),
    help="reset a unit: both axes SWEEP THEIR FULL RANGE, whatever limits are set",
    example="/dev/ttyUSB0",
)
def _home(args: argparse.Namespace) -> Answer:
    """Reset a unit, with the option that states that the range is free."""
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
    return _unit(found)


def _unit(found: Any) -> Answer:
    axes = {"pan": vars(found.pan), "tilt": vars(found.tilt)}
    rows = [(name.replace("_", " "), *(cell(axis[name]) for axis in axes.values())) for name in axes["pan"]]
    notes = [f"supply: {found.supply}"] if found.supply else []
    document = {"version": found.version, "supply": found.supply, **axes}
    return Answer(document, Shown(found.version, ("", "pan", "tilt"), rows, notes))
