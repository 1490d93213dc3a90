"""``mastctl lease``: who steers, and taking, renewing, releasing the right to."""

from __future__ import annotations

import argparse
from typing import Any

from mastctl.cli.output import WrongUse, positive_number
from mastctl.cli.service import add_daemon_options, client_of, steers, tell_result


def add_commands(subparsers: argparse._SubParsersAction[Any]) -> None:
    """Add lease."""
    lease = subparsers.add_parser("lease", help="who steers the rover, and the right to")
    acts = lease.add_subparsers(dest="act", required=True, metavar="ACT")
    show = acts.add_parser("show", help="show who steers")
    show.set_defaults(run=_show)
    take = acts.add_parser(
        "take", help="acquire the lease and print its id, for --lease; with --reason from whoever has it"
    )
    take.add_argument("--name", help="the holder's name (default: user@host)")
    take.add_argument("--reason", metavar="WHY", help="take over from whoever steers, and tell them why")
    take.set_defaults(run=_take)
    renew = acts.add_parser("renew", help="have a lease run on from now")
    renew.set_defaults(run=_renew)
    for one, default_s in ((take, 30.0), (renew, None)):
        words = "30 s" if default_s else "as long as at first"
        one.add_argument(
            "--for", dest="for_s", type=positive_number, default=default_s, metavar="S",
            help=f"how long, seconds up to 3600 (default: {words})",
        )  # fmt: skip
    release = acts.add_parser("release", help="let others steer")
    release.set_defaults(run=_release)
    for one in (show, take, renew, release):
        add_daemon_options(one)


def _show(args: argparse.Namespace) -> int:
    with client_of(args) as client:
        control = client.control()
    tell_result(args, {"control": control}, steers(control))
    return 0


def _take(args: argparse.Namespace) -> int:
    with client_of(args) as client:
        granted = client.acquire_lease(args.name, args.for_s, args.reason)
    tell_result(args, granted, granted["lease_id"])
    return 0


def _renew(args: argparse.Namespace) -> int:
    _check_named(args)
    with client_of(args) as client:
        granted = client.renew_lease(args.for_s)
    tell_result(args, granted, steers(granted))
    return 0


def _release(args: argparse.Namespace) -> int:
    _check_named(args)
    with client_of(args) as client:
        client.release_lease()
    tell_result(args, {"released": True}, "released")
    return 0


def _check_named(args: argparse.Namespace) -> None:
    if args.lease is None:
        raise WrongUse("--lease is missing; the id that 'mastctl lease take' printed is expected")
