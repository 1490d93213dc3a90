"""``mastctl rig sentinel``: reference pictures, taken again and again, and what has changed since."""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

from mastctl.cli import output
from mastctl.cli.daemon import DAEMON, client_of
from mastctl.cli.options import GROUPS, angle_rad, command, option
from mastctl.cli.output import Answer, CommandError

if TYPE_CHECKING:
    from mastctl.client import Client

NAME = "sentinel"
FOLDER = option("--folder DIR", "the folder of references and results", required=True)

GROUPS["rig sentinel"] = "notice a bumped camera, a slipped joint, a lens refocused"


def _pose(text: str) -> tuple[float, float]:
    angles = text.split(",")
    if len(angles) != 2:
        raise argparse.ArgumentTypeError(f"'{text}' where PAN,TILT in radians is expected")
    return angle_rad(angles[0]), angle_rad(angles[1])


@contextmanager
def _steering(args: argparse.Namespace, client: Client) -> Iterator[None]:
    """Steer alone: under the lease that was named, or one of its own."""
    if args.lease is not None:
        yield
        return
    with client.lease(NAME, for_s=120.0, ends_with_stop=True):
        yield


@command(
    "rig sentinel reference",
    option("--pose PAN,TILT", "a pose, radians (default: six)", type=_pose, repeat=True),
    FOLDER,
    *DAEMON,
    help="take the reference pictures",
    example="--folder sentinel --pose 0,-0.3",
)
def _reference(args: argparse.Namespace) -> Answer:
    from mastctl.watch.looks import head_cameras, take_pictures, usual_rests
    from mastctl.watch.sentinel import now_utc, save_reference

    with client_of(args) as client, _steering(args, client):
        rests = args.pose or usual_rests(client)
        _, cameras = head_cameras(client)
        if not cameras:
            raise CommandError("no_camera", "the daemon has no camera on the head")
        with output.waiting(args.json, f"taking images at {len(rests)} poses"):
            pictures, missing = take_pictures(client, rests, cameras)
    if missing:
        which, why = next(iter(missing.items()))
        raise CommandError("no_picture", f"no reference was taken: {which}: {why}")
    saved = save_reference(args.folder, now_utc(), rests, pictures)
    document = {
        "folder": str(args.folder), "pictures": len(saved.pictures), "rests": [list(rest) for rest in rests]
    }  # fmt: skip
    return Answer(document)


@command(
    "rig sentinel look",
    FOLDER,
    *DAEMON,
    help="take them again and report changes; 1 if there is one",
    example="--folder sentinel",
)
def _look(args: argparse.Namespace) -> Answer:
    from mastctl.watch.looks import look_again
    from mastctl.watch.sentinel import add_look, read_reference

    reference = read_reference(args.folder)
    with (
        client_of(args) as client,
        _steering(args, client),
        output.waiting(args.json, f"comparing {len(reference.rests)} poses"),
    ):
        drift = look_again(client, reference)
    return _standing(args, add_look(args.folder, reference, drift))


def _standing(args: argparse.Namespace, look: dict[str, Any] | None) -> Answer:
    from mastctl.watch.sentinel import read_looks, read_reference, standing

    reference = read_reference(args.folder)
    now = standing(reference, read_looks(args.folder, reference))
    document = {name: now[name] for name in ("level", "sentence", "since", "looks")} | {"look": look}
    missing = [f"{which}: no picture: {why}" for which, why in (look or {}).get("missing", {}).items()]
    return Answer(document, [now["sentence"], *missing], 1 if now["level"] == "bad" else 0)


@command(
    "rig sentinel watch",
    option(
        "--every-s S", "how often, from the reference's time of day on (default: once a day)", default=86400.0
    ),
    option("--idle-s S", "how long the head must have been idle", default=300.0),
    FOLDER,
    *DAEMON,
    help="look again and again, whenever the head is idle, until Ctrl-C",
    example="--folder sentinel --every-s 86400",
)
def _watch(args: argparse.Namespace) -> int:
    from mastctl.watch.looks import watch

    def report(look: dict[str, Any]) -> None:
        output.show(args, _standing(args, look))

    watch(args.folder, lambda: client_of(args), output.tell, report, args.every_s, args.idle_s)
    return 0


@command(
    "rig sentinel status",
    FOLDER,
    help="the result of the looks so far; 1 if something has changed",
    example="--folder sentinel",
)
def _status(args: argparse.Namespace) -> Answer:
    return _standing(args, None)
