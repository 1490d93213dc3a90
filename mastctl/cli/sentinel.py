"""``mastctl sentinel``: reference pictures, looked at again, and what has changed since."""

from __future__ import annotations

import argparse
import time
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mastctl.cli import output
from mastctl.cli.output import positive_number
from mastctl.cli.service import add_daemon_options, client_of, tell_result

if TYPE_CHECKING:
    from mastctl.client import Client

NAME = "sentinel"


def add_commands(subparsers: argparse._SubParsersAction[Any]) -> None:
    """Add sentinel."""
    sentinel = subparsers.add_parser(
        "sentinel",
        help="notice a bumped camera, a slipped joint, a lens refocused",
        description="Keeps pictures of a few rests of the head, takes them again, names what has changed.",
    )
    acts = sentinel.add_subparsers(dest="act", required=True, metavar="ACT")
    reference = acts.add_parser("reference", help="take the pictures that later looks are compared with")
    reference.add_argument(
        "--rest", action="append", type=_rest, metavar="PAN,TILT", help="a rest, radians (default: six)"
    )
    reference.set_defaults(run=_reference)
    look = acts.add_parser("look", help="take them again and tell what has changed; 1 if something has")
    look.set_defaults(run=_look)
    watch = acts.add_parser("watch", help="look again and again, whenever nobody steers, until Ctrl-C")
    watch.add_argument(
        "--every-s",
        type=positive_number,
        default=86400.0,
        metavar="S",
        help="how often (default: once a day)",
    )
    watch.set_defaults(run=_watch)
    status = acts.add_parser("status", help="what the looks so far say; 1 if something has changed")
    status.set_defaults(run=_status)
    for one in (reference, look, watch, status):
        one.add_argument(
            "--folder", type=Path, required=True, metavar="DIR", help="where pictures and looks are"
        )
    for one in (reference, look, watch):
        add_daemon_options(one)


def _rest(text: str) -> tuple[float, float]:
    try:
        pan, tilt = (float(word) for word in text.split(","))
    except ValueError:
        raise argparse.ArgumentTypeError(f"'{text}' where PAN,TILT in radians is expected") from None
    if not max(abs(pan), abs(tilt)) < 10.0:
        raise argparse.ArgumentTypeError(f"'{text}' where PAN,TILT in radians is expected")
    return pan, tilt


def _now() -> str:
    return datetime.now(UTC).isoformat(timespec="seconds")


def _reference(args: argparse.Namespace) -> int:
    from mastctl.sentinel.folder import save_reference
    from mastctl.sentinel.look import head_cameras, take_pictures, usual_rests

    with client_of(args) as client, client.lease(NAME, for_s=120.0):
        rests = args.rest or usual_rests(client)
        _, cameras = head_cameras(client)
        if not cameras:
            raise output.CommandError("no_camera", "the daemon has no camera on the head")
        with output.waiting(args.json, f"taking {len(rests)} rests"):
            pictures = take_pictures(client, rests, cameras)
    saved = save_reference(args.folder, _now(), rests, pictures)
    taken = f"{len(saved.pictures)} pictures at {len(rests)} rests"
    words = f"{args.folder}: {taken}, mast file {saved.mast_digest[:12]}"
    told = {
        "folder": str(args.folder),
        "pictures": len(saved.pictures),
        "rests": [list(rest) for rest in rests],
    }
    tell_result(args, told, words)
    return 0


def _look_once(args: argparse.Namespace, client: Client) -> dict[str, Any]:
    from mastctl.sentinel.folder import add_look, read_reference
    from mastctl.sentinel.look import look_again

    reference = read_reference(args.folder)
    with (
        client.lease(NAME, for_s=120.0),
        output.waiting(args.json, f"looking at {len(reference.rests)} rests"),
    ):
        drift = look_again(client, reference)
    return add_look(args.folder, _now(), drift)


def _look(args: argparse.Namespace) -> int:
    with client_of(args) as client:
        told = _look_once(args, client)
    return _tell(args, told)


def _tell(args: argparse.Namespace, look: dict[str, Any] | None) -> int:
    from mastctl.sentinel.folder import read_looks, standing

    now = standing(read_looks(args.folder), datetime.now(UTC))
    told = {
        "level": now.level,
        "sentence": now.sentence,
        "since": now.since,
        "looks": now.looks,
        "look": look,
    }
    tell_result(args, told, now.sentence)
    return 1 if now.level == "bad" else 0


def _watch(args: argparse.Namespace) -> int:
    from mastctl.client import ClientError
    from mastctl.errors import MastctlError
    from mastctl.sentinel.folder import read_reference
    from mastctl.sentinel.look import is_idle

    read_reference(args.folder)
    while True:
        try:
            with client_of(args) as client:
                if why := is_idle(client):
                    output.tell(f"no look now: {why}")
                else:
                    _look_once(args, client)
                    _tell(args, None)
        except (ClientError, MastctlError) as error:
            output.tell(f"no look now: {error}")
        time.sleep(args.every_s)


def _status(args: argparse.Namespace) -> int:
    from mastctl.sentinel.folder import read_reference

    read_reference(args.folder)
    return _tell(args, None)
