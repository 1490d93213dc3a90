"""Commands that steer: ``point``, which also jogs, and ``track``."""

from __future__ import annotations

import argparse
import time
from contextlib import suppress
from typing import TYPE_CHECKING, Any

from mastctl.cli.daemon import DAEMON, TIMEOUT, client_of, followed, not_done
from mastctl.cli.options import command, finite_number, one_of, option
from mastctl.cli.output import Answer, WrongUse, cell, chosen
from mastctl.cli.requests import TRACK
from mastctl.cli.service import operation_shown

if TYPE_CHECKING:
    from mastctl.answers import OperationAnswer, TrackAnswer
    from mastctl.client import Client

POLL_S = 0.05  # how often it is checked that the daemon still takes the heartbeats

PIXEL = option("--pixel CAMERA FRAME_ID X Y", "a pixel of a named frame; X Y with --panorama", nargs="+")
CAMERA = option("--camera NAME", "a pixel (--at) of a snapshot taken now by this camera")
POSITION = option("--position X Y Z", "a point, metres")
AT = option("--at X Y", "the pixel, with --camera")
FRAME = option("--frame rover|site", "frame of --position (default rover)")


@command(
    "point",
    one_of(
        PIXEL,
        CAMERA,
        POSITION,
        option("--angles PAN TILT", "joint angles, radians"),
        option("--rates PAN TILT", "jog: turn at these, rad/s, until Ctrl-C or --seconds"),
        required=True,
    ),
    AT,
    FRAME,
    option("--panorama FOLDER", "the pixel (--pixel X Y) is one of this panorama's mosaic"),
    option("--recompute", "with --panorama: it may be of another mast file"),
    option("--by-direction", "with --panorama: nothing is found again in a picture"),
    option("--aim CAMERA X Y", "where the target shall come"),
    one_of(
        option("--range M", "the distance of what the pixel shows"),
        option("--ground Z", "it lies level at this z, rover frame"),
        option("--plane X Y Z NX NY NZ", "or in the plane through a point at right angles to a direction"),
    ),
    option("--pointings 1|2", "how often to point (default 1)"),
    option("--no-wait", "print the operation's id and do not wait"),
    option("--seconds S", "with --rates: for how long"),
    TIMEOUT,
    *DAEMON,
    example="--camera navcam_left --at 300 420",
)
def _point(args: argparse.Namespace) -> Answer:
    _check_target(args)
    if args.rates is not None:
        return _jog(args)
    request: dict[str, Any] = {"pointings": args.pointings, "aim": None}
    if args.aim is not None:
        request["aim"] = (args.aim[0], *_pixel("--aim", args.aim[1:]))
    if args.angles is not None:
        request["pan_rad"], request["tilt_rad"] = args.angles
    if args.range is not None:
        request["range_m"] = args.range
    elif args.ground is not None:
        request["plane"] = {"point_m": [0.0, 0.0, args.ground]}
    elif args.plane is not None:
        request["plane"] = {"point_m": args.plane[:3], "normal": args.plane[3:]}
    with client_of(args) as client:
        operation_id = client.point(**request, **_target(args, client))
        if args.no_wait:
            return Answer({"id": operation_id}, operation_id)
        record = _done(args, client, operation_id)
    return Answer(record, operation_shown(record))


def _check_target(args: argparse.Namespace) -> None:
    """Refuse what no request can say; the daemon refuses all else that does not go together."""
    if (args.camera is None) != (args.at is None):
        raise WrongUse("--camera and --at go together")
    panorama = getattr(args, "panorama", None) is not None
    if len(args.pixel or ()) != (2 if panorama else 4 if args.pixel else 0):
        raise WrongUse("--pixel CAMERA FRAME_ID X Y is expected, or --panorama FOLDER --pixel X Y")
    if not panorama and (getattr(args, "recompute", False) or getattr(args, "by_direction", False)):
        raise WrongUse("--recompute and --by-direction go with --panorama")
    if getattr(args, "seconds", None) is not None and args.rates is None:
        raise WrongUse("--seconds goes with --rates")


def _target(args: argparse.Namespace, client: Client) -> dict[str, Any]:
    """The target as `Client.point` and `Client.start_track` take it; empty if the options name none."""
    if getattr(args, "panorama", None) is not None:
        from mastctl.panorama.compose import picture_at
        from mastctl.panorama.folder import Folder

        x, y = _pixel("--pixel", args.pixel)
        folder = Folder(args.panorama)
        seen = picture_at(folder, (x, y))  # by this folder's mosaic; the daemon's own may be another
        x, y = seen.pixel_px.tolist()
        target = {"id": folder.index.id, "view": seen.view, "x_px": x, "y_px": y}
        given = {name: True for name in ("recompute", "by_direction") if getattr(args, name)}
        return {"panorama": target | given, "frame": args.frame}
    pixel = None
    if args.pixel is not None:
        camera, frame_id, *numbers = args.pixel
        pixel = (camera, frame_id, *_pixel("--pixel", numbers))
    elif args.camera is not None:
        pixel = (args.camera, client.snapshot(args.camera).frame_id, *args.at)
    return {"pixel": pixel, "position_m": args.position, "frame": args.frame}


def _pixel(option: str, texts: list[str]) -> list[float]:
    """The numbers of an option that begins with names. Raises WrongUse."""
    try:
        return [finite_number(text) for text in texts]
    except argparse.ArgumentTypeError as error:
        raise WrongUse(f"{option}: {error}") from None


def _done(args: argparse.Namespace, client: Client, operation_id: str) -> OperationAnswer:
    """Wait for an operation that has to end as done. Raises CommandError with its error."""
    record = followed(client, operation_id, args.json, args.timeout)
    if record["state"] == "done":
        return record
    raise not_done(record)


def _jog(args: argparse.Namespace) -> Answer:
    stopped_by: dict[str, str] = {}
    with client_of(args) as client:
        until_s = None if args.seconds is None else time.monotonic() + args.seconds
        with suppress(KeyboardInterrupt), client.jog() as jog:
            jog.rates(*args.rates)
            while until_s is None or time.monotonic() < until_s:
                time.sleep(POLL_S)
                jog.check()
                stopped_by = jog.held
        joints = client.status()["joints"]
    ended = {name: None if joints is None else joints[name] for name in ("pan_rad", "tilt_rad")}
    return Answer({**ended, "held": stopped_by}, f"released at {cell(ended | stopped_by)}")


@command(
    "track start",
    one_of(PIXEL, CAMERA, POSITION, required=True),
    AT,
    FRAME,
    TIMEOUT,
    *DAEMON,
    help="start to follow a target",
    example="--camera navcam_left --at 300 420",
)
def _start(args: argparse.Namespace) -> Answer:
    _check_target(args)
    with client_of(args) as client:
        operation_id = client.start_track(**_target(args, client))
        _done(args, client, operation_id)
        return _track(client.wait_track(operation_id, args.timeout))


@command(
    "track pose",
    option("--position X Y Z", "of the rover in the site frame, metres", required=True),
    option("--quaternion QW QX QY QZ", "site from rover (default: not turned)", default=[1.0, 0.0, 0.0, 0.0]),
    option("--sigma M RAD", "of the motion since the pose before; for a track", type=finite_number),
    option("--time S", "by your clock, seconds", type=finite_number),
    option("--no-look", "carry the track over, without a new measurement"),
    TIMEOUT,
    *DAEMON,
    help="state the rover's pose; the target is searched from there",
    example="--position 4.1 0.2 0 --sigma 0.02 0.009",
)
def _pose(args: argparse.Namespace) -> Answer:
    with client_of(args) as client:
        answer = client.pose(
            args.position, args.quaternion, sigma=args.sigma and tuple(args.sigma), time_s=args.time,
            look=not args.no_look,
        )  # fmt: skip
        return _measured(args, client, answer["operation"])


@command("track look", TIMEOUT, *DAEMON, help="measure the target once more")
def _look(args: argparse.Namespace) -> Answer:
    with client_of(args) as client:
        return _measured(args, client, client.look())


def _measured(args: argparse.Namespace, client: Client, operation_id: str | None) -> Answer:
    """Wait for a measurement, if there is one, and return the track."""
    if operation_id is not None:
        followed(client, operation_id, args.json, args.timeout)
    return _track(client.wait_track(operation_id, args.timeout))


def _track(track: TrackAnswer) -> Answer:
    return Answer(track, cell(chosen(track, TRACK)))
