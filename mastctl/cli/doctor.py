"""``mastctl doctor``: what this machine lacks for a configuration, and what to do about it."""

from __future__ import annotations

import argparse
import sys
from typing import TYPE_CHECKING, Any

from mastctl.cli import output

if TYPE_CHECKING:
    from mastctl.client.answers import Status

MARKS = {"good": "✓", "unsure": "?", "bad": "✗"}


def add_commands(subparsers: argparse._SubParsersAction[Any]) -> None:
    """Add doctor."""
    doctor = subparsers.add_parser(
        "doctor", help="look for what this machine lacks for a configuration; opens and moves nothing"
    )
    doctor.add_argument(
        "--config", metavar="FILE", help="configuration (default: the packaged simulated rover)"
    )
    doctor.set_defaults(run=_doctor)


def _doctor(args: argparse.Namespace) -> int:
    from mastctl.setup.doctor import examine

    found = []
    for finding in examine(args.config, _asked):
        found.append(finding)
        if args.json:
            continue
        told = f"{MARKS[finding.level]} {finding.what}: {finding.sentence}"
        sys.stdout.write(output.one_line(told) + "\n")
        if finding.advice:
            sys.stdout.write(f"    {output.one_line(finding.advice)}\n")
    bad = sum(finding.level == "bad" for finding in found)
    unsure = sum(finding.level == "unsure" for finding in found)
    if args.json:
        output.print_json({"bad": bad, "unsure": unsure, "findings": [vars(finding) for finding in found]})
    else:
        words = "nothing stands in the way" if not bad else f"{bad} to be mended before the daemon can work"
        sys.stdout.write(f"{words}{f'; {unsure} to think about' if unsure else ''}\n")
    return 1 if bad else 0


def _asked(url: str) -> Status | None:
    """The status of a daemon, if one answers."""
    from mastctl.client import Client, ClientError

    try:
        with Client(url) as client:
            return client.status()
    except ClientError:
        return None
