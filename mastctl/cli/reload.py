"""``mastctl reload``: have a running daemon read its configuration again."""

from __future__ import annotations

import argparse
import json
from typing import Any

from mastctl.cli import output
from mastctl.cli.service import add_daemon_options, client_of


def add_commands(subparsers: argparse._SubParsersAction[Any]) -> None:
    """Add reload."""
    reload = subparsers.add_parser(
        "reload", help="have the daemon read its configuration again; all of it comes into use, or nothing"
    )
    add_daemon_options(reload)
    reload.set_defaults(run=_reload)


def _reload(args: argparse.Namespace) -> int:
    with client_of(args) as client:
        told = client.reload()
    if args.json:
        output.print_json(told)
        return 0
    mast = told["mast"]
    output.print_table(
        f"mastctl at {client.url}: {'changed' if told['changed'] else 'nothing changed'}",
        ("key", "before", "now"),
        [(one["key"], _brief(one["before"]), _brief(one["after"])) for one in told["changed"]],
        [f"mast file {mast['file']} ({mast['digest'][:8]}...)", *told["notes"]],
    )
    return 0


def _brief(value: Any) -> str:
    """A value in a line."""
    return "-" if value is None else value if isinstance(value, str) else json.dumps(value)[:60]
