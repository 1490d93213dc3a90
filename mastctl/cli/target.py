"""What point and track have in common: the options that say which target, and how its operation ended."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING, Any

from mastctl.cli.output import CommandError, WrongUse, finite_number

if TYPE_CHECKING:
    from mastctl.client import Client
    from mastctl.client.answers import OperationTold


def add_target_options(
    parser: argparse.ArgumentParser, position_help: str
) -> argparse._MutuallyExclusiveGroup:
    """Add the options that `target_of` reads; return the group of which exactly one must be given."""
    what = parser.add_mutually_exclusive_group(required=True)
    what.add_argument(
        "--pixel", nargs=4, metavar=("CAMERA", "FRAME_ID", "X", "Y"), help="a pixel of a named frame"
    )
    what.add_argument(
        "--camera", metavar="NAME", help="a pixel (--at) of a snapshot taken now by this camera"
    )
    what.add_argument("--position", nargs=3, type=finite_number, metavar=("X", "Y", "Z"), help=position_help)
    parser.add_argument(
        "--at", nargs=2, type=finite_number, metavar=("X", "Y"), help="the pixel, with --camera"
    )
    parser.add_argument("--frame", choices=("rover", "site"), help="frame of --position (default rover)")
    return what


def check_target(args: argparse.Namespace) -> None:
    """Refuse options that do not go together, before any daemon is asked. Raises WrongUse."""
    if (args.camera is None) != (args.at is None):
        raise WrongUse("--camera and --at go together")
    if args.frame is not None and args.position is None:
        raise WrongUse("--frame goes with --position")


def target_of(args: argparse.Namespace, client: Client) -> dict[str, Any]:
    """Return the target as `Client.point` and `Client.start_track` take it; empty if the options name none.

    Raises
    ------
    WrongUse
        If --pixel names no numbers.
    ClientError
        If the snapshot that --camera asks for cannot be taken.
    """
    if args.pixel is not None:
        camera, frame_id, x, y = args.pixel
        return {"pixel": (camera, frame_id, option_number("--pixel", x), option_number("--pixel", y))}
    if args.camera is not None:
        return {"pixel": (args.camera, client.snapshot(args.camera).frame_id, *args.at)}
    return {} if args.position is None else {"position_m": args.position, "frame": args.frame}


def check_done(record: OperationTold) -> None:
    """Pass an ended operation that did what it was asked. Raises CommandError with the operation's words."""
    if record["state"] == "done":
        return
    words = f"operation {record['id']} ended as {record['state']}"
    error = record["error"] or {"code": record["state"], "message": words}
    raise CommandError(error["code"], error["message"], detail={"operation": record})


def option_number(option: str, word: str) -> float:
    """Read one word of an option as a finite number. Raises WrongUse."""
    try:
        return finite_number(word)
    except argparse.ArgumentTypeError as error:
        raise WrongUse(f"{option}: {error}") from None
