"""``mastctl conform``: a running daemon, a head or a camera against what it promises."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mastctl.cli import output
from mastctl.cli.output import WrongUse, positive_number

if TYPE_CHECKING:
    from mastctl.conform.checks import Check, Outcome
    from mastctl.conform.report import Report

MARKS = {"passed": "ok", "failed": "FAILED", "skipped": "-"}


def add_commands(subparsers: argparse._SubParsersAction[Any]) -> None:
    """Add conform."""
    parser = subparsers.add_parser(
        "conform", help="check a running daemon against the contract, or a head or camera driver"
    )
    parser.add_argument("url", nargs="?", metavar="URL", help="a running daemon's address")
    motion = parser.add_mutually_exclusive_group()
    motion.add_argument(
        "--motion", dest="motion", action="store_true", default=None, help="move the head unasked"
    )
    motion.add_argument(
        "--no-motion", dest="motion", action="store_false", help="only checks that move nothing"
    )
    parser.add_argument(
        "--reach", type=positive_number, default=0.3, metavar="RAD",
        help="how far from where it stands the head is moved (default 0.3 rad)",
    )  # fmt: skip
    parser.add_argument(
        "--only", action="append", metavar="CHECK", help="a check, or all of a group; may be given often"
    )
    parser.add_argument("--list", action="store_true", help="only list the checks")
    parser.add_argument("--junit", type=Path, metavar="FILE", help="write a JUnit report")
    parser.set_defaults(run=_conform)


def _conform(args: argparse.Namespace) -> int:
    return _daemon(args)


def _daemon(args: argparse.Namespace) -> int:
    """Check a running daemon."""
    from mastctl.conform.daemon_run import CHECKS, check_daemon, daemon_under_test

    checks = chosen(CHECKS, args.only)
    if args.list:
        return _list(checks, args.json)
    if args.url is None:
        raise WrongUse("the address of a running daemon is expected")
    _check_junit(args.junit)
    with daemon_under_test(args.url, args.reach) as daemon:
        moves = any(check.moves for check in checks)
        question = f"the head at {args.url} will be moved by up to {args.reach:g} rad from where it stands"
        motion = moves and (bool(daemon.began.get("simulated")) or None)
        allowed = args.motion if args.motion is not None else motion
        if allowed is None:
            allowed = _may_move(question)
        return told(args, check_daemon(daemon, checks, allowed, tell_of(args)))


def _may_move(question: str) -> bool:
    """Ask whoever sits at the terminal. Raises WrongUse where nobody does."""
    if not (sys.stdin.isatty() and sys.stderr.isatty()):
        raise WrongUse(f"{question}: --motion allows it, --no-motion leaves those checks out")
    sys.stderr.write(f"{question[0].upper()}{question[1:]}, slowly if its limits are. Move it? [y/N] ")
    sys.stderr.flush()
    return sys.stdin.readline().strip().lower() in ("y", "yes")


def chosen(checks: Sequence[Check[Any]], names: Sequence[str] | None) -> list[Check[Any]]:
    """Return the checks that --only names, by name or group; all without it. Raises WrongUse."""
    if names is None:
        return list(checks)
    for name in names:
        if not any(name in (check.name, check.name.partition(".")[0]) for check in checks):
            groups = ", ".join(dict.fromkeys(check.name.partition(".")[0] for check in checks))
            raise WrongUse(f"--only {name}: no such check; groups are {groups}, --list shows all")
    return [c for c in checks if c.name in names or c.name.partition(".")[0] in names]


def _list(checks: Sequence[Check[Any]], as_json: bool) -> int:
    """Show the checks."""
    if as_json:
        told = [{"name": c.name, "promise": c.promise, "moves": c.moves} for c in checks]
        output.print_json({"checks": told})
    else:
        rows = [(check.name, "moves" if check.moves else "", check.promise) for check in checks]
        output.print_table("checks", ("name", "head", "what has to hold"), rows)
    return 0


def _check_junit(path: Path | None) -> None:
    """Refuse a report that cannot be written before anything moves. Raises WrongUse."""
    if path is not None and (path.is_dir() or not path.absolute().parent.is_dir()):
        raise WrongUse(f"--junit {path}: a file in a folder that is there is expected")


def tell_of(args: argparse.Namespace) -> Callable[[Outcome], None]:
    """Return what tells a person of each check as it ends, one line each."""

    def tell(outcome: Outcome) -> None:
        if args.json:
            return
        words = outcome.promise if outcome.state == "passed" else ""
        more = f" ({outcome.message})" if words and outcome.message else outcome.message
        line = output.one_line(f"{words}{more}")
        sys.stdout.write(f"{MARKS[outcome.state]:6} {outcome.name:22} {line}\n")
        sys.stdout.flush()

    return tell


def told(args: argparse.Namespace, report: Report) -> int:
    """Tell the whole and write the reports; return the exit code."""
    if args.junit is not None:
        report.write_junit(args.junit)
    if args.json:
        output.print_json(report.told())
    else:
        counts = ", ".join(f"{count} {state}" for state, count in report.counts.items())
        verdict = "conforms" if report.conforms else "does not conform"
        sys.stdout.write(f"{report.kind} {report.subject} {verdict}: {counts}\n")
    return 0 if report.conforms else 1
