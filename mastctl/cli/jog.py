"""``mastctl jog``: turn the head at a rate for some seconds."""

from __future__ import annotations

import argparse
import time
from contextlib import suppress
from typing import Any

from mastctl.cli.output import finite_number, positive_number
from mastctl.cli.service import add_daemon_options, client_of, tell_result

LOOK_S = 0.05  # how often it is seen whether the daemon still takes the heartbeats


def add_commands(subparsers: argparse._SubParsersAction[Any]) -> None:
    """Add jog."""
    jog = subparsers.add_parser("jog", help="turn the head at a rate, until Ctrl-C or for some seconds")
    jog.add_argument(
        "--rates", nargs=2, type=finite_number, required=True, metavar=("PAN", "TILT"), help="rad/s"
    )
    jog.add_argument(
        "--seconds", type=positive_number, metavar="S", help="for how long (default: until Ctrl-C)"
    )
    jog.set_defaults(run=_jog)
    add_daemon_options(jog)


def _jog(args: argparse.Namespace) -> int:
    held: dict[str, str] = {}
    with client_of(args) as client:
        until_s = None if args.seconds is None else time.monotonic() + args.seconds
        with suppress(KeyboardInterrupt), client.jog() as jog:
            jog.rates(*args.rates)
            while until_s is None or time.monotonic() < until_s:
                time.sleep(LOOK_S)
                jog.check()
                held = jog.held
        joints = client.status()["joints"]
    where = {name: None if joints is None else joints[name] for name in ("pan_rad", "tilt_rad")}
    words = (
        f"let go at pan {where['pan_rad']:+.4f}, tilt {where['tilt_rad']:+.4f} rad" if joints else "let go"
    )
    tell_result(args, {**where, "held": held}, "; ".join([words, *held.values()]))
    return 0
