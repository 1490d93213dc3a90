"""``mastctl conform``: acceptance of a rig through its running daemon."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from typing import TYPE_CHECKING

from mastctl.cli import output
from mastctl.cli.options import command, one_of, option, positive_number
from mastctl.cli.output import Answer, Shown, WrongUse

if TYPE_CHECKING:
    from mastctl.conform.rig import Check, CheckOutcome

MARKS = {"passed": "ok", "failed": "FAILED", "skipped": "-"}


@command(
    "conform",
    option("[URL]", "a running daemon's address"),
    one_of(
        option("--motion", "move the head, also a real one", default=None),
        option("--no-motion", "only checks that move nothing", dest="motion", action="store_false"),
    ),
    option(
        "--reach RAD",
        "how far from its present pose the head is moved (default 0.3 rad)",
        type=positive_number,
        default=0.3,
    ),
    option("--only CHECK", "a check, or all of a group; may be given often", repeat=True),
    option("--list", "only list the checks"),
    example="http://127.0.0.1:8420",
)
def _conform(args: argparse.Namespace) -> Answer:
    from mastctl.conform.rig import check_rig, rig_under_test
    from mastctl.conform.rig_checks import RIG

    checks = _chosen(RIG, args.only)
    if args.list:
        rows = [(check.name, "moves" if check.moves else "", check.promise) for check in checks]
        document = {"checks": [{"name": c.name, "promise": c.promise, "moves": c.moves} for c in checks]}
        return Answer(document, Shown("checks", ("name", "head", "what has to hold"), rows))
    if args.url is None:
        raise WrongUse("the address of a daemon is expected, e.g. http://127.0.0.1:8420")
    with rig_under_test(args.url, args.reach) as rig:
        motion = _may_move(args, checks, bool(rig.began.get("simulated")))
        report = check_rig(rig, checks, motion, (lambda outcome: None) if args.json else _show)
    counts = ", ".join(f"{count} {state}" for state, count in report.counts.items())
    document = report.as_json()
    verdict = "conforms" if document["conforms"] else "does not conform"
    return Answer(document, f"daemon {report.subject} {verdict}: {counts}", int(not document["conforms"]))


def _may_move(args: argparse.Namespace, checks: Sequence[Check], simulated: bool) -> bool:
    """Whether the head may be moved: a simulated one may, any other by the options. Raises WrongUse."""
    if args.motion is not None:
        return bool(args.motion)
    if not simulated and any(check.moves for check in checks):
        moved = f"the head at {args.url} would be moved by up to {args.reach:g} rad from its present pose"
        raise WrongUse(f"{moved}: --motion allows it, --no-motion leaves those checks out")
    return True


def _chosen(checks: Sequence[Check], names: Sequence[str]) -> list[Check]:
    """The checks that --only names, by name or group; all without it. Raises WrongUse."""
    if not names:
        return list(checks)
    for name in names:
        if not any(name in (check.name, check.name.partition(".")[0]) for check in checks):
            groups = ", ".join(dict.fromkeys(check.name.partition(".")[0] for check in checks))
            raise WrongUse(f"--only {name}: no such check; groups are {groups}, --list shows all")
    return [c for c in checks if c.name in names or c.name.partition(".")[0] in names]


def _show(outcome: CheckOutcome) -> None:
    """Show a check that has ended, in one line."""
    promise = outcome.promise if outcome.state == "passed" else ""
    measured = f" ({outcome.message})" if promise and outcome.message else outcome.message
    line = output.one_line(f"{promise}{measured}")
    sys.stdout.write(f"{MARKS[outcome.state]:6} {outcome.name:22} {line}\n")
    sys.stdout.flush()
