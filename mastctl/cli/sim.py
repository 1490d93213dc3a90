"""Simulated servos behind real bytes for any driver: `mastctl rig sim dynamixel|feetech|ptu`.

Each runs until SIGTERM or SIGINT (Ctrl-C).
"""

from __future__ import annotations

import argparse
import contextlib
import signal
import sys
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any, Literal

from mastctl import signals
from mastctl.cli import output
from mastctl.cli.options import GROUPS, command, one_of, option
from mastctl.cli.output import Answer, WrongUse

if TYPE_CHECKING:
    from drivers.clock import Clock
    from drivers.faults import FaultPanel
    from drivers.sim.axis import AxisSettings
    from drivers.sim.wire.carrier import WireDevice
    from drivers.sim.wire.line import PtyLine, TcpLine

GROUPS["rig sim"] = "simulated servos behind a serial line or a TCP port; a new simulated rover"

PTY = option("--pty", "a serial line as a pseudo terminal")
SERVED = (
    option("--link PATH", "with --pty: a stable name for the terminal"),
    option("--faults FILE", "a fault script, which begins at once"),
    option("--no-wire-time", "bytes take no time, and any baud rate is right"),
    option("--verbose", "log every piece that passes on standard error"),
)

_PAN_TILT: tuple[Literal[0], Literal[1]] = (0, 1)


@command(
    "rig sim dynamixel",
    option(
        "--servo MODEL:ID",
        "a servo on the bus; may be repeated: the first is pan, the second tilt "
        "(default: xm430_w350:1 and xm430_w350:2)",
        repeat=True,
    ),
    option("--baud B", "of all servos", type=int, default=57600),
    option("--return-delay N", "in units of 2 us", type=int, default=250),
    one_of(PTY, required=True),
    *SERVED,
    help="a bus of Dynamixel servos (protocol 2.0)",
    example="--servo xl330_m288:1 --servo xl330_m288:2 --pty",
)
def _dynamixel(args: argparse.Namespace) -> int:
    from drivers.sim.axis import WireAxis
    from drivers.sim.wire.dynamixel_bus import DynamixelBus
    from drivers.sim.wire.dynamixel_models import BAUD_RATES
    from drivers.sim.wire.dynamixel_servo import SimulatedServo

    if args.baud not in BAUD_RATES:
        raise WrongUse(f"--baud is {args.baud}, expected one of {', '.join(str(b) for b in BAUD_RATES)}")
    if not 0 <= args.return_delay <= 254:
        raise WrongUse(f"--return-delay is {args.return_delay}, expected 0 to 254")
    wanted = [_servo(text) for text in args.servo or ("xm430_w350:1", "xm430_w350:2")]
    panel, clock = _panel()
    registers = {"baud_rate": BAUD_RATES.index(args.baud), "return_delay_time": args.return_delay}
    servos = []
    for place, (model, servo_id) in enumerate(wanted):
        settings = _axis_settings("ph42" if model.startswith("ph") else "dynamixel_x", place)
        number: Literal[0, 1] = 1 if place % 2 else 0
        axis = WireAxis(settings, panel, number=number, time_s=clock.now_s())
        try:
            servos.append(SimulatedServo(model, servo_id, axis, settings=registers, time_s=clock.now_s()))
        except ValueError as error:
            raise WrongUse(f"--servo {model}:{servo_id}: {error}") from None
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
    from drivers.errors import BadOptions
    from drivers.sim.axis import WireAxis
    from drivers.sim.wire.feetech_bus import FeetechBus
    from drivers.sim.wire.feetech_servo import BAUDS, SimulatedFeetechServo

    if args.baud not in BAUDS:
        raise WrongUse(f"--baud is {args.baud}, expected one of {', '.join(str(b) for b in BAUDS)}")
    panel, clock = _panel()
    now_s, registers = clock.now_s(), {"baud": BAUDS.index(args.baud)}
    servos = []
    for place in _PAN_TILT:
        axis = WireAxis(_axis_settings("dynamixel_x", place), panel, number=place, time_s=now_s)
        try:
            servos.append(
                SimulatedFeetechServo(args.model, place + 1, axis, settings=registers, time_s=now_s)
            )
        except BadOptions as error:
            raise WrongUse(f"--model: {error}") from None
    facts = {"servos": [{"model": args.model, "id": place + 1} for place in _PAN_TILT], "baud": args.baud}
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
    from drivers.errors import BadOptions
    from drivers.sim.axis import WireAxis
    from drivers.sim.wire.ptu import SimulatedPtu

    panel, clock = _panel()
    pan, tilt = (
        WireAxis(_axis_settings("ptu_d46_70", place), panel, number=place, time_s=clock.now_s())
        for place in _PAN_TILT
    )
    try:
        unit = SimulatedPtu(args.model, pan, tilt, step_mode=args.step_mode, baud=args.baud)
    except BadOptions as error:
        raise WrongUse(str(error)) from None
    facts = {"model": args.model, "step_mode": unit.pan.mode, "baud": args.baud}
    return _serve(args, unit, panel, clock, facts, unit.banner)


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


def _axis_settings(preset: str, place: int) -> AxisSettings:
    """Backlash and sag of pan (even places) or tilt."""
    from drivers.sim.heads import PRESETS

    return PRESETS[preset].tilt if place % 2 else PRESETS[preset].pan


def _serve(
    args: argparse.Namespace,
    device: WireDevice,
    panel: FaultPanel,
    clock: Clock,
    facts: Mapping[str, Any],
    banner: bytes = b"",
) -> int:
    """Open the line, print its address, and keep it up until a signal."""
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
        host, number = _address(tcp)
        line = TcpLine(device, clock, panel, host, number, banner=banner, observer=observer)
        port = f"socket://{f'[{host}]' if ':' in host else host}:{line.port}"
    with line, contextlib.suppress(KeyboardInterrupt):
        output.show(args, Answer({"port": port, **facts}, port))
        while True:
            signal.pause()
    return 0


def _address(text: str) -> tuple[str, int]:
    """``[HOST:]PORT`` of --tcp."""
    host, _, number = text.rpartition(":")
    if not (number.isascii() and number.isdigit() and int(number) <= 65535):
        raise WrongUse(f"--tcp is '{text}', expected [HOST:]PORT with a port from 0 to 65535")
    return host.strip("[]") or "127.0.0.1", int(number)


def _observer(start_s: float) -> Callable[[Literal["host", "device"], bytes, float], None]:
    """A log of what passes: seconds, the sender, the bytes as text or in hex."""

    def observe(sender: Literal["host", "device"], data: bytes, time_s: float) -> None:
        plain = all(32 <= byte < 127 or byte in b"\r\n" for byte in data)
        shown = repr(data)[1:] if plain else data.hex(" ")
        with contextlib.suppress(OSError):
            sys.stderr.write(f"{time_s - start_s:10.4f} {'->' if sender == 'host' else '<-'} {shown}\n")

    return observe
