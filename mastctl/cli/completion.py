"""``mastctl completion``: what a shell completes, written from the commands themselves."""

from __future__ import annotations

import argparse
import sys
from typing import Any

from mastctl.cli.output import CommandError

SHELLS = ("bash", "zsh", "tcsh")


def add_commands(subparsers: argparse._SubParsersAction[Any]) -> None:
    """Add completion."""
    completion = subparsers.add_parser(
        "completion", help="print what makes a shell complete commands and options"
    )
    completion.add_argument("shell", choices=SHELLS)
    completion.set_defaults(run=_completion)


def _completion(args: argparse.Namespace) -> int:
    from mastctl.cli.main import build_parser

    try:
        import shtab
    except ImportError:
        words = "shtab is not installed, which writes completions: pip install 'mastctl[completion]'"
        raise CommandError("no_shtab", words) from None
    sys.stdout.write(shtab.complete(build_parser([]), shell=args.shell))
    return 0
