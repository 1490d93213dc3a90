"""Heads on their lines: ``rig servo`` and ``rig ptu`` for real ones, ``rig sim`` for simulated ones."""

from __future__ import annotations

import argparse
import contextlib
import signal
import sys
from collections.abc import Callable, Mapping
from contextlib import closing
from typing import TYPE_CHECKING, Any, Literal

from mastctl import signals
from mastctl.cli import output
from mastctl.cli.options import GROUPS, at_least, command, one_of, option
from mastctl.cli.output import Answer, CommandError, Shown, WrongUse, tables_of

if TYPE_CHECKING:
    from drivers.clock import Clock
    from drivers.faults import FaultPanel
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
LINE = (
    option("PORT", "serial device, or a URL such as socket://host:port"),
    option("--family DRIVER", "of the servos on it (default: the first of the drivers)"),
)
BAUD = option(
    "--baud B", "bits per second (default as the family's servos come from the factory)", type=WHOLE
)


def _benches() -> dict[str, Any]:
    from drivers.registry import drivers_of

    return {name: driver.bench for name, driver in drivers_of("head").items()}


def _bench(args: argparse.Namespace) -> ServoBench:
    """The bench of a family of servos. Raises WrongUse, with the commands for a head that has none."""
    from drivers.servo_bus.bench import ServoBench

    benches = _benches()
    families = {name: bench for name, bench in benches.items() if isinstance(bench, ServoBench)}
    family = args.family or next(iter(families))
    if family in benches and benches[family] is _unit_bench():
        raise WrongUse(
            f"--family: a {family} head has no servos: 'mastctl rig ptu info PORT' queries it, "
            "'pytest --pyargs mastctl.testing.drivers --rig FILE' tests it"
        )
    if family not in families:
        raise WrongUse(f"--family is '{family}', expected one of {', '.join(families)}")
    return families[family]


def _unit_bench() -> UnitBench:
    """The bench of pan/tilt units."""
    from drivers.registry import UnitBench

    return next(bench for bench in _benches().values() if isinstance(bench, UnitBench))


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
    from mastctl.devices.opening import line_held

    bench = _bench(args)
    with line_held(args.port), _link(args, bench) as link:
        bench.set_id(link, args.id, args.new_id, args.new_baud, torque_off=args.torque_off)
        return Answer({"id": args.new_id, "old_id": args.id, "baud": link.baud})


def _unit_baud(text: str) -> int:
    """Read a baud rate of units (argparse ``type``)."""
    bauds = sorted(_unit_bench().bauds)
    if not text.isascii() or not text.isdigit() or int(text) not in bauds:
        raise argparse.ArgumentTypeError(f"'{text}' where one of {', '.join(map(str, bauds))} is expected")
    return int(text)


UNIT = (
    option("PORT", "serial device or socket://HOST:4000"),
    option("--baud B", "bits a second (default: as units come from the factory)", type=_unit_baud),
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
    from mastctl.devices.opening import line_held

    if not args.sweep_full_range:
        raise WrongUse(
            "homing sweeps both axes over their full range, whatever limits are set; "
            "clear the mast, then give --sweep-full-range"
        )
    bench = _unit_bench()
    output.tell("homing: both axes sweep their full range, up to half a minute")
    with line_held(args.port):
        return _unit(bench.home(args.port, args.baud or bench.bauds[0]))


def _unit(found: Any) -> Answer:
    return Answer(
        {"version": found.version, "supply": found.supply, "pan": vars(found.pan), "tilt": vars(found.tilt)}
    )


PTY = option("--pty", "a serial line as a pseudo terminal")
SERVED = (
    option("--link PATH", "with --pty: a stable name for the terminal"),
    option("--faults FILE", "a fault script, which begins at once"),
    option("--no-wire-time", "bytes take no time, and any baud rate is right"),
    option("--verbose", "log every piece that passes on standard error"),
)


@command(
    "rig sim dynamixel",
    option(
        "--servo MODEL:ID",
        "a servo on the bus; may be repeated: the first is pan, the second tilt "
        "(default: xm430_w350:1 and xm430_w350:2)",
        repeat=True,
    ),
    option("--baud B", "of all servos", type=int, default=57600),
    one_of(PTY, required=True),
    *SERVED,
    help="a bus of Dynamixel servos (protocol 2.0)",
    example="--servo xl330_m288:1 --servo xl330_m288:2 --pty",
)
def _dynamixel(args: argparse.Namespace) -> int:
    from drivers.sim.wire.dynamixel_bus import DynamixelBus
    from drivers.sim.wire.dynamixel_models import BAUD_RATES
    from drivers.sim.wire.dynamixel_servo import SimulatedServo

    wanted = [_servo(text) for text in args.servo or ("xm430_w350:1", "xm430_w350:2")]
    registers = {"baud_rate": _rate(args.baud, BAUD_RATES)}
    panel, clock = _panel()
    servos = []
    for place, (model, servo_id) in enumerate(wanted):
        axis = _axis("ph42" if model.startswith("ph") else "dynamixel_x", place, panel, clock)
        with _wrong_use(f"--servo {model}:{servo_id}: "):
            servos.append(SimulatedServo(model, servo_id, axis, settings=registers, time_s=clock.now_s()))
    facts = {"servos": [{"model": model, "id": servo_id} for model, servo_id in wanted], "baud": args.baud}
    return _serve(args, DynamixelBus(servos), panel, clock, facts)


@command(
    "rig sim feetech",
    option("--model MODEL", "of both", default="sts3215"),
    option("--baud B", "of both", type=int, default=1_000_000),
    option("--echo", "the adapter gives back what is sent"),
    one_of(PTY, required=True),
    *SERVED,
    help="a bus of two Feetech servos, ids 1 and 2",
    example="--pty",
)
def _feetech(args: argparse.Namespace) -> int:

    from drivers.sim.wire.feetech_bus import FeetechBus
    from drivers.sim.wire.feetech_servo import BAUDS, SimulatedFeetechServo

    registers = {"baud": _rate(args.baud, BAUDS)}
    panel, clock = _panel()
    with _wrong_use("--model: "):
        servos = [
            SimulatedFeetechServo(
                args.model, place + 1, _axis("dynamixel_x", place, panel, clock), settings=registers,
                time_s=clock.now_s(),
            )
            for place in (0, 1)
        ]  # fmt: skip
    facts = {"servos": [{"model": args.model, "id": place} for place in (1, 2)], "baud": args.baud}
    return _serve(args, FeetechBus(servos, echoes=args.echo), panel, clock, facts)


@command(
    "rig sim ptu",
    option("--model MODEL", "the unit", default="d46_70"),
    option("--step-mode MODE", "F, H, Q, E or A; as delivered when left out"),
    option("--baud B", "of the serial line", type=int, default=9600),
    one_of(PTY, option("--tcp [HOST:]PORT", "a TCP port; 0 is any free one"), required=True),
    *SERVED,
    help="a FLIR / Directed Perception pan/tilt unit",
    example="--pty",
)
def _ptu(args: argparse.Namespace) -> int:
    from drivers.sim.wire.ptu import SimulatedPtu

    panel, clock = _panel()
    pan, tilt = (_axis("ptu_d46_70", place, panel, clock) for place in (0, 1))
    with _wrong_use(""):
        unit = SimulatedPtu(args.model, pan, tilt, step_mode=args.step_mode, baud=args.baud)
    facts = {"model": args.model, "step_mode": unit.pan.mode, "baud": args.baud}
    return _serve(args, unit, panel, clock, facts, unit.banner)


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


def _servo(text: str) -> tuple[str, int]:
    """``MODEL:ID`` of --servo."""
    model, _, number = text.partition(":")
    if not (number.isascii() and number.isdigit() and int(number) <= 252):
        raise WrongUse(f"--servo is '{text}', expected MODEL:ID with an id from 0 to 252")
    return model.lower().replace("-", "_"), int(number)


def _panel() -> tuple[FaultPanel, Clock]:
    """A panel of faults on the machine's clock."""
    from drivers.clock import SystemClock
    from drivers.faults import FaultPanel

    clock = SystemClock()
    return FaultPanel(clock.now_s, ()), clock


def _axis(preset: str, place: int, panel: FaultPanel, clock: Clock) -> WireAxis:
    """An axis with backlash and sag of pan (even places) or tilt."""
    from drivers.sim.axis import WireAxis
    from drivers.sim.heads import PRESETS

    number: Literal[0, 1] = 1 if place % 2 else 0
    settings = PRESETS[preset].tilt if number else PRESETS[preset].pan
    return WireAxis(settings, panel, number=number, time_s=clock.now_s())


def _serve(
    args: argparse.Namespace,
    device: WireDevice,
    panel: FaultPanel,
    clock: Clock,
    facts: Mapping[str, Any],
    banner: bytes = b"",
) -> int:
    """Open the line, print its address, and keep it up until SIGTERM or SIGINT."""
    from drivers.faults import read_script
    from drivers.sim.wire.line import PtyLine, TcpLine

    tcp = getattr(args, "tcp", None)
    if tcp is not None and args.link is not None:
        raise WrongUse("--link goes with --pty")
    signals.write_from_background()
    observer = _observer(clock.now_s()) if args.verbose else None
    if args.faults is not None:
        panel.set_all(read_script(args.faults), origin=str(args.faults))
    line: PtyLine | TcpLine
    if tcp is None:
        line = PtyLine(
            device, clock, panel, link=args.link, wire_time=not args.no_wire_time, observer=observer
        )
        port = line.path
    else:
        host, _, number = tcp.rpartition(":")
        if not (number.isascii() and number.isdigit() and int(number) <= 65535):
            raise WrongUse(f"--tcp is '{tcp}', expected [HOST:]PORT with a port from 0 to 65535")
        host = host.strip("[]") or "127.0.0.1"
        line = TcpLine(device, clock, panel, host, int(number), banner=banner, observer=observer)
        port = f"socket://{f'[{host}]' if ':' in host else host}:{line.port}"
    with line, contextlib.suppress(KeyboardInterrupt):
        output.show(args, Answer({"port": port, **facts}, port))
        while True:
            signal.pause()
    return 0


def _observer(start_s: float) -> Callable[[Literal["host", "device"], bytes, float], None]:
    """A log of what passes: seconds, the sender, the bytes as text or in hex."""

    def observe(sender: Literal["host", "device"], data: bytes, time_s: float) -> None:
        plain = all(32 <= byte < 127 or byte in b"\r\n" for byte in data)
        shown = repr(data)[1:] if plain else data.hex(" ")
        with contextlib.suppress(OSError):
            sys.stderr.write(f"{time_s - start_s:10.4f} {'->' if sender == 'host' else '<-'} {shown}\n")

    return observe
