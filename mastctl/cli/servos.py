"""Heads on their lines: ``rig servo`` and ``rig ptu`` for real ones, ``rig sim`` for simulated ones."""

from __future__ import annotations

import argparse
import contextlib
import re
import signal
from collections.abc import Mapping
from contextlib import closing
from typing import TYPE_CHECKING, Any, Literal

from mastctl import signals
from mastctl.cli import output
from mastctl.cli.options import GROUPS, at_least, command, one_of, option
from mastctl.cli.output import Answer, CommandError, Shown, WrongUse, tables_at

if TYPE_CHECKING:
    from drivers.registry import UnitBench
    from drivers.servo_bus.bench import ServoBench
    from drivers.sim.axis import WireAxis
    from drivers.sim.wire.carrier import WireDevice
    from drivers.sim.wire.line import PtyLine, TcpLine

GROUPS |= {
    "rig servo": "find, read and number servos on the bench",
    "rig ptu": "read and home a pan/tilt unit on the bench",
    "rig sim": "simulated servos behind a serial line or a TCP port; a new simulated rover",
}

REPLY_TIMEOUT_S = 0.05
WHOLE = at_least(0)
WIRE_ID = re.compile(r"([\w-]+):(\d{1,3})", re.ASCII)
LINE = (
    option("PORT", "serial device, or a URL such as socket://host:port"),
    option("--family DRIVER", "of the servos on it (default: the first of the drivers)"),
)
BAUD = option(
    "--baud B", "bits per second (default as the family's servos come from the factory)", type=WHOLE
)


def _bench(args: argparse.Namespace) -> ServoBench:
    """The bench of a family of servos. Raises WrongUse."""
    from drivers.registry import drivers_of
    from drivers.servo_bus.bench import ServoBench

    heads = drivers_of("head").items()
    families = {name: one.bench for name, one in heads if isinstance(one.bench, ServoBench)}
    family = args.family or next(iter(families))
    if family not in families:
        raise WrongUse(f"--family is '{family}', expected one of {', '.join(families)}")
    return families[family]


def _unit_bench() -> UnitBench:
    """The bench of pan/tilt units."""
    from drivers.registry import UnitBench, drivers_of

    return next(one.bench for one in drivers_of("head").values() if isinstance(one.bench, UnitBench))


def _link(args: argparse.Namespace, bench: ServoBench) -> Any:
    """The opened line of a command, a context."""
    return closing(bench.open(args.port, bench.bauds[0] if args.baud is None else args.baud))


@command(
    "rig servo scan",
    *LINE,
    option("--baud B...", "the rates to try (default: all usual ones)", type=WHOLE),
    help="search at every baud rate for servos; moves nothing",
    example="/dev/ttyUSB0",
)
def _scan(args: argparse.Namespace) -> Answer:
    bench = _bench(args)
    result = bench.scan(args.port, args.baud or bench.bauds, REPLY_TIMEOUT_S)
    garbled = [
        f"at {baud} baud something answered that cannot be understood: two servos of one id, or a bad line"
        for baud in result.garbled
    ]
    if not result.found:
        bauds = ", ".join(str(baud) for baud in result.bauds)
        why = "; ".join(garbled) or f"is its power on, is it a {bench.family} servo?"
        raise CommandError("no_servo", f"no servo answered on {args.port} at {bauds} baud; {why}")
    names = ("baud", "model", "model_number", "firmware", "hardware_errors")
    rows = [{"id": one.servo_id} | {name: getattr(one, name) for name in names} for one in result.found]
    document = {"port": args.port, "servos": rows, "garbled_bauds": list(result.garbled)}
    return Answer(document, [*tables_at({f"Servos on {args.port}": rows}), *garbled])


@command(
    "rig servo info",
    *LINE,
    option("ID", "as 'mastctl rig servo scan' finds it", type=WHOLE),
    BAUD,
    help="show all registers of a servo; moves nothing",
    example="/dev/ttyUSB0 1",
)
def _info(args: argparse.Namespace) -> Answer:
    bench = _bench(args)
    with _link(args, bench) as link:
        found = bench.facts(link, args.id)
    document = {
        "id": found.servo_id, "model": found.model, "firmware": found.firmware, "registers": found.values,
        "meanings": found.meanings,
    }  # fmt: skip
    rows = [(name, str(value), found.meanings.get(name, "")) for name, value in found.values.items()]
    title = f"Servo {found.servo_id}: {found.model}, firmware {found.firmware}"
    return Answer(document, Shown(title, ("register", "value", "meaning"), rows))


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
    from mastctl.devices.opening import line_locked

    bench = _bench(args)
    with line_locked(args.port), _link(args, bench) as link:
        bench.set_id(link, args.id, args.new_id, args.new_baud, torque_off=args.torque_off)
        return Answer({"id": args.new_id, "old_id": args.id, "baud": link.baud})


UNIT = (
    option("PORT", "serial device or socket://HOST:4000"),
    option("--baud B", "bits a second (default: as units come from the factory)", type=WHOLE),
)


@command("rig ptu info", *UNIT, help="show all values of a unit; moves nothing", example="/dev/ttyUSB0")
def _unit_info(args: argparse.Namespace) -> Answer:
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
    from mastctl.devices.opening import line_locked

    if not args.sweep_full_range:
        raise WrongUse(
            "homing sweeps both axes over their full range, whatever limits are set; "
            "clear the mast, then give --sweep-full-range"
        )
    bench = _unit_bench()
    output.show_line("homing: both axes sweep their full range, up to half a minute")
    with line_locked(args.port):
        return _unit(bench.home(args.port, args.baud or bench.bauds[0]))


def _unit(found: Any) -> Answer:
    return Answer(
        {"version": found.version, "supply": found.supply, "pan": vars(found.pan), "tilt": vars(found.tilt)}
    )


PTY = option("--pty", "a serial line as a pseudo terminal")
SERVED = (
    option("--baud B", "of all; as they come from the factory when left out", type=WHOLE),
    option("--link PATH", "with --pty: a stable name for the terminal"),
    option("--faults FILE", "a fault script, which begins at once"),
)


@command(
    "rig sim dynamixel",
    option(
        "--servo MODEL:ID",
        "a servo on the bus; may be repeated: the first is pan, the second tilt "
        "(default: xm430_w350:1 and xm430_w350:2)",
        repeat=True,
    ),
    one_of(PTY, required=True),
    *SERVED,
    help="a bus of Dynamixel servos (protocol 2.0)",
    example="--servo xl330_m288:1 --servo xl330_m288:2 --pty",
)
def _dynamixel(args: argparse.Namespace) -> int:
    from drivers.sim.wire.dynamixel_bus import DynamixelBus
    from drivers.sim.wire.dynamixel_models import BAUD_RATES
    from drivers.sim.wire.dynamixel_servo import SimulatedServo

    line, servos, facts = _SimulatedLine(args), [], []
    registers = {"baud_rate": _rate(args.baud or 57600, BAUD_RATES)}
    for place, text in enumerate(args.servo or ("xm430_w350:1", "xm430_w350:2")):
        found = WIRE_ID.fullmatch(text)
        if found is None or int(found[2]) > 252:
            raise WrongUse(f"--servo is '{text}', expected MODEL:ID with an id from 0 to 252")
        model, servo_id = found[1].lower().replace("-", "_"), int(found[2])
        axis = line.axis("ph42" if model.startswith("ph") else "dynamixel_x", place)
        with _wrong_use(f"--servo {text}: "):
            servos.append(SimulatedServo(model, servo_id, axis, settings=registers, time_s=line.now_s))
        facts.append({"model": model, "id": servo_id})
    return line.serve(DynamixelBus(servos), {"servos": facts, "baud": args.baud or 57600})


@command(
    "rig sim feetech",
    option("--model MODEL", "of both", default="sts3215"),
    one_of(PTY, required=True),
    *SERVED,
    help="a bus of two Feetech servos, ids 1 and 2",
    example="--pty",
)
def _feetech(args: argparse.Namespace) -> int:
    from drivers.sim.wire.feetech_bus import FeetechBus
    from drivers.sim.wire.feetech_servo import BAUDS, SimulatedFeetechServo

    line, baud = _SimulatedLine(args), args.baud or 1_000_000
    registers = {"baud": _rate(baud, BAUDS)}
    with _wrong_use("--model: "):
        servos = [
            SimulatedFeetechServo(
                args.model, place + 1, line.axis("dynamixel_x", place), settings=registers, time_s=line.now_s
            )
            for place in (0, 1)
        ]
    facts = {"servos": [{"model": args.model, "id": place} for place in (1, 2)], "baud": baud}
    return line.serve(FeetechBus(servos), facts)


@command(
    "rig sim ptu",
    option("--model MODEL", "the unit", default="d46_70"),
    one_of(PTY, option("--tcp [HOST:]PORT", "a TCP port; 0 is any free one"), required=True),
    *SERVED,
    help="a FLIR / Directed Perception pan/tilt unit",
    example="--pty",
)
def _ptu(args: argparse.Namespace) -> int:
    from drivers.sim.wire.ptu import SimulatedPtu

    line, baud = _SimulatedLine(args), args.baud or 9600
    with _wrong_use(""):
        unit = SimulatedPtu(args.model, *(line.axis("ptu_d46_70", place) for place in (0, 1)), baud=baud)
    return line.serve(unit, {"model": args.model, "step_mode": unit.pan.mode, "baud": baud}, unit.banner)


@contextlib.contextmanager
def _wrong_use(where: str) -> Any:
    """Refuse as wrong use what a simulator does not take."""
    from drivers.errors import BadOptions

    try:
        yield
    except (BadOptions, ValueError) as error:
        raise WrongUse(f"{where}{error}") from None


def _rate(baud: int, rates: Any) -> int:
    """The number of a baud rate in a servo's register."""
    if baud not in rates:
        raise WrongUse(f"--baud is {baud}, expected one of {', '.join(map(str, rates))}")
    return int(rates.index(baud))


class _SimulatedLine:
    """What simulated devices on a line have in common: the machine's clock, faults, and the line."""

    def __init__(self, args: argparse.Namespace) -> None:
        from drivers.clock import SystemClock
        from drivers.faults import FaultPanel

        self._args, self._clock = args, SystemClock()
        self._panel = FaultPanel(self._clock.now_s, ())
        self.now_s = self._clock.now_s()

    def axis(self, preset: str, place: int) -> WireAxis:
        """Return an axis with backlash and sag of pan (even places) or tilt."""
        from drivers.sim.axis import WireAxis
        from drivers.sim.heads import PRESETS

        number: Literal[0, 1] = 1 if place % 2 else 0
        settings = PRESETS[preset].tilt if number else PRESETS[preset].pan
        return WireAxis(settings, self._panel, number=number, time_s=self.now_s)

    def serve(self, device: WireDevice, facts: Mapping[str, Any], banner: bytes = b"") -> int:
        """Open the line, print its address, and keep it up until SIGTERM or SIGINT."""
        from drivers.faults import read_script
        from drivers.sim.wire.line import PtyLine, TcpLine

        args, tcp = self._args, getattr(self._args, "tcp", None)
        if tcp is not None and args.link is not None:
            raise WrongUse("--link goes with --pty")
        signals.write_from_background()
        if args.faults is not None:
            self._panel.set_all(read_script(args.faults), origin=str(args.faults))
        line: PtyLine | TcpLine
        if tcp is None:
            line = PtyLine(device, self._clock, self._panel, link=args.link)
            port = line.path
        else:
            host, _, number = tcp.rpartition(":")
            if not (number.isascii() and number.isdigit() and int(number) <= 65535):
                raise WrongUse(f"--tcp is '{tcp}', expected [HOST:]PORT with a port from 0 to 65535")
            host = host.strip("[]") or "127.0.0.1"
            line = TcpLine(device, self._clock, self._panel, host, int(number), banner=banner)
            port = f"socket://{f'[{host}]' if ':' in host else host}:{line.port}"
        with line, contextlib.suppress(KeyboardInterrupt):
            output.show(args, Answer({"port": port, **facts}, port))
            while True:
                signal.pause()
        return 0
