"""Commands for a FLIR / Directed Perception pan/tilt unit on the bench: ``mastctl ptu info|home``."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING, Any

from mastctl.cli import output
from mastctl.cli.output import WrongUse

if TYPE_CHECKING:
    from drivers.flir_ptu.workshop import Facts

DEFAULT_BAUD = 9600


def add_commands(subparsers: argparse._SubParsersAction[Any]) -> None:
    """Add ptu with its two commands."""
    ptu = subparsers.add_parser("ptu", help="read and home a FLIR pan/tilt unit on the bench")
    commands = ptu.add_subparsers(dest="ptu_command", metavar="WHAT", required=True)

    info = commands.add_parser("info", help="show what a unit says about itself; moves nothing")
    _add_line(info)
    info.set_defaults(run=_info)

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


def _info(args: argparse.Namespace) -> int:
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
