"""Commands that steer: ``lease``, ``jog`` and ``track``."""

from __future__ import annotations

import argparse
import math
import sys
import time
from contextlib import suppress
from typing import TYPE_CHECKING, Any

from mastctl.cli.output import CommandError, WrongUse, at_least, finite_number, one_line, positive_number
from mastctl.cli.service import add_daemon_options, client_of, followed, steers, tell_result
from mastctl.cli.target import add_target_options, check_done, check_target, target_of

if TYPE_CHECKING:
    from mastctl.client import Client
    from mastctl.client.answers import TrackTold


def add_commands(subparsers: argparse._SubParsersAction[Any]) -> None:
    """Add lease, jog and track."""
    for add in (_add_lease, _add_jog, _add_track):
        add(subparsers)


def _add_lease(subparsers: argparse._SubParsersAction[Any]) -> None:
    """Add lease."""
    lease = subparsers.add_parser("lease", help="the lease: the right to steer the rover, and its holder")
    acts = lease.add_subparsers(dest="act", required=True, metavar="ACT")
    show = acts.add_parser("show", help="show who steers")
    show.set_defaults(run=_show_lease)
    take = acts.add_parser(
        "take", help="acquire the lease and print its id, for --lease; with --reason from its holder"
    )
    take.add_argument("--name", help="the holder's name (default: user@host)")
    take.add_argument(
        "--reason", metavar="WHY", help="take the lease from its holder, and show the holder this reason"
    )
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


def _show_lease(args: argparse.Namespace) -> int:
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


LOOK_S = 0.05  # how often it is seen whether the daemon still takes the heartbeats


def _add_jog(subparsers: argparse._SubParsersAction[Any]) -> None:
    """Add jog."""
    jog = subparsers.add_parser("jog", help="turn the head at a rate, until Ctrl-C or for some seconds")
    jog.add_argument(
        "--rates", nargs=2, type=finite_number, required=True, metavar=("PAN", "TILT"), help="rad/s"
    )
    jog.add_argument(
        "--seconds", type=positive_number, metavar="S", help="for how long (default: until Ctrl-C)"
    )
    jog.set_defaults(run=_jog)
    add_daemon_options(jog)


def _jog(args: argparse.Namespace) -> int:
    held: dict[str, str] = {}
    with client_of(args) as client:
        until_s = None if args.seconds is None else time.monotonic() + args.seconds
        with suppress(KeyboardInterrupt), client.jog() as jog:
            jog.rates(*args.rates)
            while until_s is None or time.monotonic() < until_s:
                time.sleep(LOOK_S)
                jog.check()
                held = jog.held
        joints = client.status()["joints"]
    where = {name: None if joints is None else joints[name] for name in ("pan_rad", "tilt_rad")}
    words = (
        f"let go at pan {where['pan_rad']:+.4f}, tilt {where['tilt_rad']:+.4f} rad" if joints else "let go"
    )
    tell_result(args, {**where, "held": held}, "; ".join([words, *held.values()]))
    return 0


def _add_track(subparsers: argparse._SubParsersAction[Any]) -> None:
    """Add track with its commands."""
    track = subparsers.add_parser("track", help="follow a target while the rover moves")
    commands = track.add_subparsers(dest="track_command", metavar="WHAT", required=True)

    start = commands.add_parser("start", help="start to follow a target")
    add_target_options(start, "the surface seen at a point, meters")
    start.set_defaults(run=_start)

    status = commands.add_parser("status", help="show the track, and offsets found by hand-offs")
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
        return _show_track(args, client.wait_track(operation_id, args.timeout))


def _status(args: argparse.Namespace) -> int:
    with client_of(args) as client:
        track = client.track()
        _show_track(args, track)
        if not args.json:
            for one in track["self_check"]["offsets"]:
                sys.stdout.write(one_line(one["sentence"]) + "\n")
        return 0


def _watch(args: argparse.Namespace) -> int:
    with client_of(args) as client:
        for number, track in enumerate(client.watch_track(), 1):
            _show_track(args, track)
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
        return _show_track(args, client.stop_track())


def _after_look(args: argparse.Namespace, client: Client, operation_id: str | None) -> int:
    """Wait for a look, if there is one, and show the track."""
    if operation_id is not None:
        followed(client, operation_id, args)
    return _show_track(args, client.wait_track(operation_id, args.timeout))


def _show_track(args: argparse.Namespace, track: TrackTold) -> int:
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
