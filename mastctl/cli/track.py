"""Following a target with a running daemon: ``mastctl track start|status|watch|pose|look|stop``."""

from __future__ import annotations

import argparse
import math
import sys
from typing import TYPE_CHECKING, Any

from mastctl.cli.output import CommandError, at_least, finite_number, one_line, positive_number
from mastctl.cli.service import add_daemon_options, client_of, followed, tell_result
from mastctl.cli.target import add_target_options, check_done, check_target, target_of

if TYPE_CHECKING:
    from mastctl.client import Client
    from mastctl.client.answers import TrackTold


def add_commands(subparsers: argparse._SubParsersAction[Any]) -> None:
    """Add track with its commands."""
    track = subparsers.add_parser("track", help="follow a target while the rover moves")
    commands = track.add_subparsers(dest="track_command", metavar="WHAT", required=True)

    start = commands.add_parser("start", help="start to follow a target")
    add_target_options(start, "what is seen at a point, metres")
    start.set_defaults(run=_start)

    status = commands.add_parser("status", help="show the track, and offsets that hand-offs tell")
    status.set_defaults(run=_status)

    watch = commands.add_parser(
        "watch", help="show the track now and at each change, a line each; --json: a document a line"
    )
    watch.add_argument("--count", type=at_least(1), metavar="N", help="end after so many (default: never)")
    watch.set_defaults(run=_watch)

    pose = commands.add_parser("pose", help="say where the rover stands; the target is looked for from there")
    pose.add_argument(
        "--position", nargs=3, type=finite_number, required=True, metavar=("X", "Y", "Z"),
        help="of the rover in the site frame, metres",
    )  # fmt: skip
    pose.add_argument(
        "--quaternion", nargs=4, type=finite_number, default=[1.0, 0.0, 0.0, 0.0],
        metavar=("QW", "QX", "QY", "QZ"), help="site from rover (default: not turned)",
    )  # fmt: skip
    pose.add_argument(
        "--sigma", nargs=2, type=finite_number, metavar=("M", "RAD"),
        help="of the motion since the pose before, each axis; needed while a track runs",
    )  # fmt: skip
    pose.add_argument("--time", type=finite_number, metavar="S", help="by your clock, seconds")
    pose.add_argument("--no-look", action="store_true", help="carry the track over, do not look")
    pose.set_defaults(run=_pose)

    look = commands.add_parser("look", help="look for the target once more")
    look.set_defaults(run=_look)

    stop = commands.add_parser("stop", help="end the track")
    stop.set_defaults(run=_stop)

    for waiting in (start, pose, look):
        waiting.add_argument(
            "--timeout",
            type=positive_number,
            default=120.0,
            metavar="S",
            help="how long to wait (default 120 s)",
        )
    for command in (start, status, watch, pose, look, stop):
        add_daemon_options(command)


def _start(args: argparse.Namespace) -> int:
    check_target(args)
    with client_of(args) as client:
        operation_id = client.start_track(**target_of(args, client))
        check_done(followed(client, operation_id, args))
        return _show(args, client.wait_track(operation_id, args.timeout))


def _status(args: argparse.Namespace) -> int:
    with client_of(args) as client:
        track = client.track()
        _show(args, track)
        if not args.json:
            for one in track["self_check"]["offsets"]:
                sys.stdout.write(one_line(one["sentence"]) + "\n")
        return 0


def _watch(args: argparse.Namespace) -> int:
    with client_of(args) as client:
        for number, track in enumerate(client.watch_track(), 1):
            _show(args, track)
            sys.stdout.flush()
            if number == args.count:
                return 0
    if args.count is not None:
        raise CommandError("ended", f"the daemon ended before the track was shown {args.count} times")
    return 0


def _pose(args: argparse.Namespace) -> int:
    with client_of(args) as client:
        sigma = None if args.sigma is None else (args.sigma[0], args.sigma[1])
        answer = client.pose(
            args.position, args.quaternion, sigma=sigma, time_s=args.time, look=not args.no_look
        )
        return _after_look(args, client, answer["operation"])


def _look(args: argparse.Namespace) -> int:
    with client_of(args) as client:
        return _after_look(args, client, client.look())


def _stop(args: argparse.Namespace) -> int:
    with client_of(args) as client:
        return _show(args, client.stop_track())


def _after_look(args: argparse.Namespace, client: Client, operation_id: str | None) -> int:
    """Wait for a look, if there is one, and show the track."""
    if operation_id is not None:
        followed(client, operation_id, args)
    return _show(args, client.wait_track(operation_id, args.timeout))


def _show(args: argparse.Namespace, track: TrackTold) -> int:
    tell_result(args, track, track_line(track))
    return 0


def track_line(track: TrackTold) -> str:
    """Return a track in one line."""
    words: list[str] = [track["state"]]
    if track["pair"]:
        words.append(f"by {track['pair']}")
        if not track["predicted"]:
            words.append(f"{track['range_m']:.3f} m away")
    if track["position_m"]:
        x, y, z = track["position_m"]
        words.append(f"at ({x:.3f}, {y:.3f}, {z:.3f}) m")
        if track["covariance_m2"]:
            variance = sum(track["covariance_m2"][axis][axis] for axis in range(3))
            words[-1] += f" ± {math.sqrt(variance):.3f} m"
    if track["predicted"]:
        words.append("predicted")
    if track["operation"]:
        words.append("looking")
    if track["reason"]:
        words.append(track["reason"])
    return ", ".join(words)
