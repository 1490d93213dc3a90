"""``mastctl sentinel``: reference pictures, looked at again, and what has changed since."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mastctl.cli import output
from mastctl.cli.output import angle_rad, positive_number
from mastctl.cli.service import add_daemon_options, client_of, tell_result

if TYPE_CHECKING:
    from mastctl.client import Client

NAME = "sentinel"


def add_commands(subparsers: argparse._SubParsersAction[Any]) -> None:
    """Add sentinel."""
    sentinel = subparsers.add_parser(
        "sentinel",
        help="notice a bumped camera, a slipped joint, a lens refocused",
        description="Keeps images of a few poses of the head, takes them again, reports a change.",
    )
    acts = sentinel.add_subparsers(dest="act", required=True, metavar="ACT")
    reference = acts.add_parser("reference", help="take the pictures that later looks are compared with")
    reference.add_argument(
        "--pose", action="append", type=_pose, metavar="PAN,TILT", help="a pose, radians (default: six)"
    )
    reference.set_defaults(run=_reference)
    look = acts.add_parser("look", help="take them again and report changes; 1 if there is one")
    look.set_defaults(run=_look)
    watch = acts.add_parser("watch", help="look again and again, whenever the head is idle, until Ctrl-C")
    watch.add_argument(
        "--every-s",
        type=positive_number,
        default=86400.0,
        metavar="S",
        help="how often, from the reference's time of day on (default: once a day)",
    )
    watch.add_argument(
        "--idle-s",
        type=positive_number,
        default=300.0,
        metavar="S",
        help="how long the head must have been idle (default 300 s)",
    )
    watch.set_defaults(run=_watch)
    status = acts.add_parser("status", help="the result of the looks so far; 1 if something has changed")
    status.set_defaults(run=_status)
    for one in (reference, look, watch, status):
        one.add_argument(
            "--folder", type=Path, required=True, metavar="DIR", help="where pictures and looks are"
        )
    for one in (reference, look, watch):
        add_daemon_options(one)


def _pose(text: str) -> tuple[float, float]:
    words = text.split(",")
    if len(words) != 2:
        raise argparse.ArgumentTypeError(f"'{text}' where PAN,TILT in radians is expected")
    return angle_rad(words[0]), angle_rad(words[1])


@contextmanager
def _steering(args: argparse.Namespace, client: Client) -> Iterator[None]:
    """Steer alone: under the lease that was named, or one of its own."""
    if args.lease is not None:
        yield
        return
    with client.lease(NAME, for_s=120.0, ends_with_stop=True):
        yield


def _reference(args: argparse.Namespace) -> int:
    from mastctl.watch.looks import head_cameras, now_utc, take_pictures, usual_rests
    from mastctl.watch.reference import save_reference

    with client_of(args) as client, _steering(args, client):
        rests = args.pose or usual_rests(client)
        _, cameras = head_cameras(client)
        if not cameras:
            raise output.CommandError("no_camera", "the daemon has no camera on the head")
        with output.waiting(args.json, f"taking images at {len(rests)} poses"):
            taken = take_pictures(client, rests, cameras)
    if taken.missing:
        which, why = next(iter(taken.missing.items()))
        raise output.CommandError("no_picture", f"no reference was taken: {which}: {why}")
    saved = save_reference(args.folder, now_utc().isoformat(timespec="seconds"), rests, taken.pictures)
    counts = f"{len(saved.pictures)} images at {len(rests)} poses"
    words = f"{args.folder}: {counts}, mast file {saved.mast_digest[:12]}"
    result = {
        "folder": str(args.folder),
        "pictures": len(saved.pictures),
        "rests": [list(rest) for rest in rests],
    }
    tell_result(args, result, words)
    return 0


def _look(args: argparse.Namespace) -> int:
    from mastctl.watch.looks import look_again, now_utc
    from mastctl.watch.reference import add_look, read_reference

    reference = read_reference(args.folder)
    with (
        client_of(args) as client,
        _steering(args, client),
        output.waiting(args.json, f"looking at {len(reference.rests)} poses"),
    ):
        drift = look_again(client, reference)
    return _tell(args, add_look(args.folder, reference, now_utc().isoformat(timespec="seconds"), drift))


def _tell(args: argparse.Namespace, look: dict[str, Any] | None) -> int:
    from mastctl.watch.looks import now_utc
    from mastctl.watch.reference import read_looks, read_reference
    from mastctl.watch.sentinel import standing

    reference = read_reference(args.folder)
    now = standing(reference, read_looks(args.folder, reference), now_utc())
    result = {name: now[name] for name in ("level", "sentence", "since", "looks")} | {"look": look}
    tell_result(args, result, now["sentence"])
    for which, why in (look or {}).get("missing", {}).items():
        output.tell(f"{which}: no picture: {why}")
    return 1 if now["level"] == "bad" else 0


def _watch(args: argparse.Namespace) -> int:
    from mastctl.watch.looks import watch

    watch(
        args.folder,
        lambda: client_of(args),
        output.tell,
        lambda look: _flush(_tell(args, look)),
        args.every_s,
        args.idle_s,
    )
    return 0


def _flush(_code: int) -> None:
    """What a look found is to be read at once, also through a pipe."""
    sys.stdout.flush()


def _status(args: argparse.Namespace) -> int:
    return _tell(args, None)
