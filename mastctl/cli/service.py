"""Commands of the service: the daemon itself, and its clients."""

from __future__ import annotations

import argparse
import atexit
import getpass
import logging
import os
import signal
import socket
import sys
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mastctl import signals
from mastctl.cli import output
from mastctl.cli.output import CommandError, WrongUse, finite_number, positive_number
from mastctl.cli.target import add_target_options, check_done, check_target, option_number, target_of
from mastctl.logs import QueuedHandler

if TYPE_CHECKING:
    from mastctl.client import Client
    from mastctl.client.answers import ControlTold, LeaseGranted, OperationTold, Status, StepTold
    from mastctl.config import Config, Listen

LOOK_S = 0.1  # how often `status --wait` asks
SUFFIXES = {".png": "png", ".jpg": "jpeg", ".jpeg": "jpeg"}


def add_commands(subparsers: argparse._SubParsersAction[Any]) -> None:
    """Add run, status, point and snapshot."""
    run = subparsers.add_parser(
        "run", help="run the daemon; its address is one line on stdout when it is ready"
    )
    run.add_argument("--config", metavar="FILE", help="configuration (default: the packaged simulated rover)")
    run.add_argument(
        "--log-format",
        choices=("text", "json"),
        help="of what it says on stderr (default: text, JSON where that goes to journald)",
    )
    run.add_argument("-v", "--verbose", action="store_true", help="say what the drivers meet, too")
    run.add_argument("-q", "--quiet", action="store_true", help="say only what is wrong")
    run.add_argument(
        "--listen",
        type=_address,
        metavar="ADDRESS",
        help="HOST:PORT or the path of a Unix socket, instead of the configuration's",
    )
    run.set_defaults(run=_run)

    status = subparsers.add_parser("status", help="show what a running daemon knows")
    status.add_argument(
        "--wait", type=positive_number, metavar="S",
        help="wait so long for a daemon that carries out commands; exit 1 if there is none by then",
    )  # fmt: skip
    status.set_defaults(run=_status)

    point = subparsers.add_parser("point", help="point a camera at something and measure the residual")
    what = add_target_options(point, "a point, metres")
    what.add_argument(
        "--angles", nargs=2, type=output.angle_rad, metavar=("PAN", "TILT"), help="joint angles, radians"
    )
    point.add_argument("--aim", nargs=3, metavar=("CAMERA", "X", "Y"), help="where the target shall come")
    far = point.add_mutually_exclusive_group()
    far.add_argument("--range", type=positive_number, metavar="M", help="how far what the pixel shows is")
    far.add_argument("--ground", type=finite_number, metavar="Z", help="it lies level at this z, rover frame")
    far.add_argument(
        "--plane", nargs=6, type=finite_number, metavar=("X", "Y", "Z", "NX", "NY", "NZ"),
        help="or in the plane through a point at right angles to a direction, rover frame",
    )  # fmt: skip
    point.add_argument("--pointings", type=int, choices=(1, 2), help="how often to point (default 1)")
    point.add_argument("--no-wait", action="store_true", help="print the operation's id and do not wait")
    point.add_argument(
        "--timeout", type=positive_number, default=120.0, metavar="S", help="how long to wait (default 120 s)"
    )
    point.set_defaults(run=_point)

    snapshot = subparsers.add_parser("snapshot", help="take a picture and write it to a file")
    snapshot.add_argument("camera", metavar="CAMERA", help="camera of the configuration")
    snapshot.add_argument("--out", required=True, metavar="FILE", help="where to: .png (lossless), .jpg")
    snapshot.add_argument("--frame-id", metavar="ID", help="a frame that the daemon still keeps")
    snapshot.set_defaults(run=_snapshot)

    for client in (status, point, snapshot):
        add_daemon_options(client)


def add_daemon_options(parser: argparse.ArgumentParser) -> None:
    """Add the options that say which daemon is meant; `client_of` reads them."""
    parser.add_argument("--url", help="the daemon's address (default: that of the configuration)")
    parser.add_argument("--config", metavar="FILE", help="the configuration that the daemon runs with")
    parser.add_argument("--lease", metavar="ID", help="the lease to steer under ('mastctl lease take')")


def _address(text: str) -> Listen:
    """Read --listen (argparse ``type``)."""
    from mastctl.config import parse_address

    try:
        return parse_address(text)
    except ValueError as error:
        raise argparse.ArgumentTypeError(str(error)) from None


def _run(args: argparse.Namespace) -> int:
    queue_output()
    # Told to end before it is up, it ends: nothing has moved yet. Before the imports, which take a second.
    with suppress(KeyboardInterrupt), signals.raised(signal.SIGINT):
        _serve(args)
    return 0


def queue_output() -> None:
    """Let nothing that the daemon says wait for who reads it, on stderr as on stdout."""
    from mastctl.logs import QueuedText, writer_to

    for name in ("stdout", "stderr"):
        try:
            descriptor = getattr(sys, name).fileno()
        except OSError:  # a stream of a test, which does not wait
            continue
        writer = writer_to(descriptor)
        setattr(sys, name, QueuedText(writer))
        atexit.register(writer.flush)
    signals.write_from_background()


def _set_log(args: argparse.Namespace) -> None:
    """Set what is logged, and how its lines look."""
    from mastctl.logs import formatter

    for handler in logging.getLogger().handlers:
        if isinstance(handler, QueuedHandler):
            handler.setFormatter(formatter(args.log_format))
    level = logging.WARNING if args.quiet else logging.DEBUG if args.verbose else logging.INFO
    for name in ("mastctl", "drivers", "calib"):
        logging.getLogger(name).setLevel(level)


def _serve(args: argparse.Namespace) -> None:
    """Run the daemon until it is told to end."""
    from mastctl.config import load_config

    _set_log(args)
    config = load_config(args.config)
    if args.listen is not None:
        address = args.listen
        listen = address.model_copy(update={"hosts": config.listen.hosts})
        config = replace(config, listen=listen)
    serve_config(config, args)


def serve_config(config: Config, args: argparse.Namespace) -> None:
    """Run a daemon with a configuration until it is told to end; its address is a line on stdout."""
    from mastctl.daemon import run

    def ready(url: str) -> None:
        if args.json:
            output.print_json({"url": url})
        else:
            sys.stdout.write(f"{url}\n")
        sys.stdout.flush()

    run(config, ready, draws_ahead=True)


def _status(args: argparse.Namespace) -> int:
    with client_of(args) as client:
        status = client.status() if args.wait is None else _ready(client, args.wait)
    if args.json:
        output.print_json(status)
        return 0
    rows = [(name, text) for name, text in _status_rows(status)]
    output.print_table(f"mastctl at {client.url}", ("what", "now"), rows, _fault_lines(status))
    return 0


def _ready(client: Client, wait_s: float) -> Status:
    """Return the status as soon as the daemon carries out commands.

    A fault is waited for, since it may clear. A latched emergency stop is not: only a reset releases it.
    """
    from mastctl.answers.words import WELL
    from mastctl.client import ClientError
    from mastctl.client.following import PASSING

    until_s = time.monotonic() + wait_s
    while True:
        try:
            status = client.status(max(until_s - time.monotonic(), LOOK_S))
            if status["state"] in WELL:
                return status
            reason = status.get("reason")
            words = f"the daemon is {status['state']}{f': {reason}' if reason else ''}"
            if status["state"] == "stopped":
                raise CommandError("not_ready", words)
        except ClientError as error:
            if error.code not in PASSING:
                raise
            words = str(error)
        if time.monotonic() > until_s:
            raise CommandError("not_ready", f"not ready after {wait_s:g} s: {words}")
        time.sleep(LOOK_S)


def _point(args: argparse.Namespace) -> int:
    check_target(args)
    request: dict[str, Any] = {"pointings": args.pointings, "aim": _camera_pixel(args.aim)}
    if args.angles is not None:
        request["pan_rad"], request["tilt_rad"] = args.angles
    request |= _how_far(args)
    with client_of(args) as client:
        operation_id = client.point(**request, **target_of(args, client))
        if args.no_wait:
            tell_result(args, {"id": operation_id}, f"operation {operation_id}")
            return 0
        record = followed(client, operation_id, args)
    check_done(record)
    if args.json:
        output.print_json(record)
    else:
        show_pointings(record)
    return 0


def _angle(read_rad: float, true_rad: float) -> str:
    """An angle as read, and the true one where the mast file says that it is another."""
    truly = "" if read_rad == true_rad else f", truly {true_rad:+.6f} rad"
    return f"{read_rad:+.6f} rad{truly}"


def _range(record: Mapping[str, Any]) -> str:
    """How far the target is, and how sure that is where one camera tells it."""
    told = f"range {record['range_m']:.3f} m"
    if record["range_from"] not in ("parallax", "unknown"):
        return told
    near, far = record["range_interval_m"]
    reach = "infinity" if far is None else f"{far:.3f} m"
    return (
        f"{told} by {record['range_from'].replace('unknown', 'a guess')}: 95 % from {near:.3f} m to {reach}"
    )


def _how_far(args: argparse.Namespace) -> dict[str, Any]:
    """What says how far a pixel's thing is, as `Client.point` takes it. Raises WrongUse."""
    told: dict[str, Any] = {}
    if args.range is not None:
        told = {"range_m": args.range}
    elif args.ground is not None:
        told = {"plane": {"point_m": [0.0, 0.0, args.ground]}}
    elif args.plane is not None:
        told = {"plane": {"point_m": args.plane[:3], "normal": args.plane[3:]}}
    if told and args.pixel is None and args.camera is None:
        raise WrongUse("--range, --ground and --plane go with --pixel or --camera")
    return told


def _snapshot(args: argparse.Namespace) -> int:
    out = Path(args.out)
    kind = SUFFIXES.get(out.suffix.lower())
    if kind is None:
        raise WrongUse(f"--out is '{args.out}' where a name ending in {', '.join(SUFFIXES)} is expected")
    with client_of(args) as client:
        shot = client.snapshot(args.camera, frame_id=args.frame_id, format="png" if kind == "png" else "jpeg")
    try:
        out.write_bytes(shot.data)
    except OSError as error:
        raise CommandError("file_system", f"{out}: cannot be written: {error.strerror}", 2) from None
    line = f"{out}: frame {shot.frame_id}, pan {shot.pan_rad:.6f} rad, tilt {shot.tilt_rad:.6f} rad"
    tell_result(args, {"file": str(out), **shot.facts}, line + (", head moving" if shot.moving else ""))
    return 0


def refuse_daemon_options(args: argparse.Namespace) -> None:
    """Refuse --url and --config beside --simulated, which asks no running daemon."""
    for option in ("url", "config", "lease"):
        if getattr(args, option) is not None:
            raise WrongUse(f"--{option} names a running daemon; --simulated starts rovers of its own")


@contextmanager
def client_of(args: argparse.Namespace, *, whatever_configured: bool = False) -> Iterator[Client]:
    """A client of the daemon that the options, or MASTCTL_URL, name.

    Where nothing names one, it is that of the packaged configuration, and a daemon of another user is only
    read there. ``whatever_configured``: where the configuration cannot be read, the usual address is asked.
    """
    from calib.errors import BadFile
    from mastctl.client import Client
    from mastctl.config import Listen, load_config

    url, reads_only = args.url or os.environ.get("MASTCTL_URL"), ""
    if url is None:
        named = args.config is not None
        try:
            listen = load_config(args.config).listen
        except BadFile as error:
            if not whatever_configured:
                raise
            listen, named = Listen(), False
            output.tell(f"{error}; asking the usual address {listen.url}")
        if listen.socket is None and listen.port == 0:
            raise WrongUse("the configuration listens at any free port (0); give --url")
        url = listen.url
        if not named:
            reads_only = _not_ours(listen)
    with Client(url, name=_person(), reads_only=reads_only) as client:
        client.use_lease(getattr(args, "lease", None))
        yield client


def _not_ours(listen: Listen) -> str:
    """Why a daemon that nothing names is not commanded; empty if this user started it, or it is not there."""
    owner = listener_of(listen.host, listen.port)
    if owner is None or owner == os.getuid():
        return ""
    return (
        f"the daemon at {listen.url} was started by {output.user_name(owner)}, not by this user; "
        f"if it is the one that is meant, name it: --url {listen.url}"
    )


LISTENING = "0A"  # the state TCP_LISTEN of Linux, include/net/tcp_states.h


def listener_of(host: str, port: int) -> int | None:
    """Return the user id of who listens at an IPv4 address of this machine; None if nobody does (proc(5))."""
    found = None
    for table in (Path("/proc/net/tcp"), Path("/proc/net/tcp6")):
        lines = table.read_text(encoding="ascii").splitlines()[1:] if table.exists() else []
        for _, local, _, state, _, _, _, owner, *_ in map(str.split, lines):
            address, _, number = local.partition(":")
            if state != LISTENING or int(number, 16) != port:
                continue
            if address == socket.inet_aton(host)[::-1].hex().upper():
                return int(owner)
            if set(address) == {"0"}:  # every address of the machine
                found = int(owner)
    return found


def _person() -> str:
    """Who types: commands of one user of a machine are one party, however many processes they are."""
    try:
        return f"{getpass.getuser()}@{socket.gethostname()}"
    except (OSError, KeyError):  # a user without a name
        return f"{os.getuid()}@{socket.gethostname()}"


def followed(client: Client, operation_id: str, args: argparse.Namespace) -> OperationTold:
    """Wait for an operation, showing its steps to a person."""
    if args.json:
        return client.wait(operation_id, args.timeout)
    from rich.console import Console
    from rich.text import Text

    console = Console(stderr=True)

    def show(step: StepTold) -> None:
        mark = "✓" if step.get("state") == "done" else "✗"
        line = f"  {mark} {step.get('name')} ({step.get('duration_s') or 0.0:.2f} s)"
        console.print(Text(output.one_line(line)))

    try:
        with console.status(f"operation {operation_id}"):
            return client.wait(operation_id, args.timeout, show)
    except KeyboardInterrupt:
        output.tell(f"operation {operation_id} goes on; 'mastctl stop' stops it")
        raise


def show_pointings(record: OperationTold) -> None:
    """A table of what was measured, and in which pictures."""
    rows, notes = [], []
    for number, pointing in enumerate(record["pointings"], 1):
        residual = pointing.get("residual_px") or (None, None)
        sigma = pointing.get("residual_sigma_px") or (None, None)
        measured = [
            "-" if value is None or one_sigma is None else f"{value:+.3f} ± {one_sigma:.3f}"
            for value, one_sigma in zip(residual, sigma, strict=True)
        ]
        rows.append((str(number), *measured))
        told = [f"looked at in frame {pointing['frame_id']}"] if pointing.get("frame_id") else []
        told += [pointing["note"]] if pointing.get("note") else []
        notes.append(f"pointing {number}: {'; '.join(told)}")
    position_m = record["position_m"]
    if position_m is not None:
        x, y, z = position_m
        notes.append(f"target at ({x:.3f}, {y:.3f}, {z:.3f}) m in the rover frame")
    if record["range_m"] is not None:
        notes.append(_range(record))
    output.print_table(
        f"operation {record['id']}", ("pointing", "residual x, px", "residual y, px"), rows, notes
    )


def _status_rows(status: Status) -> Iterator[tuple[str, str]]:
    """The lines of the status table."""
    reason = status.get("reason")
    yield "state", f"{status['state']} ({status['hardware']})" + (f": {reason}" if reason else "")
    if status.get("control"):
        yield "control", steers(status["control"])
    joints = status["joints"]
    if joints is None:
        yield "joints", "not read yet"
    else:
        yield "pan", _angle(joints["pan_rad"], joints["true_pan_rad"])
        yield "tilt", _angle(joints["tilt_rad"], joints["true_tilt_rad"])
        yield "measured", f"{joints['age_s']:.3f} s ago{', moving' if status['moving'] else ''}"
    limits = status["limits"]
    for axis, (low, high) in (("pan", limits["pan_rad"]), ("tilt", limits["tilt_rad"])):
        yield f"{axis} limits", f"{low:+.4f} to {high:+.4f} rad"
    residual = status["last_residual"]
    if residual is not None:
        (x, y), (sx, sy) = residual["residual_px"], residual["residual_sigma_px"]
        yield "last residual", f"{x:+.3f} ± {sx:.3f}, {y:+.3f} ± {sy:.3f} px"
    for name, camera in status["cameras"].items():
        age_s = camera["age_s"]
        yield name, "no frame yet" if age_s is None else f"newest frame {age_s:.1f} s old"
    track = status["track"]
    yield "track", track["state"] + (f": {track['reason']}" if track["reason"] else "")
    if status["pose"] is not None:
        x, y, z = status["pose"]["position_m"]
        yield "rover", f"at ({x:.3f}, {y:.3f}, {z:.3f}) m of the site, {status['pose']['age_s']:.1f} s ago"
    mast = status["mast"]
    yield "mast file", f"{mast['file']} ({mast['digest'][:8]}...)"
    calibration = status["calibration"]
    if calibration is not None:
        yield "calibration", calibration["sentence"]
    sentinel = status["sentinel"]
    if sentinel is not None and sentinel["level"] != "none":
        yield "drift", sentinel["sentence"]
    yield "up", f"{status['uptime_s']:.0f} s, version {status['version']}"


def steers(control: ControlTold | LeaseGranted | None) -> str:
    """Who steers, in a line."""
    if control is None:
        return "nobody steers"
    left_s = control["for_s"]
    until = "until what runs has ended" if left_s is None else f"for {left_s:.0f} s more"
    return f"{control['holder']} steers, {until}"


def _fault_lines(status: Status) -> list[str]:
    return [
        f"fault: {fault['message']} (for {fault['for_s']:.0f} s, until {fault['until']})"
        for fault in status["faults"]
    ]


def _camera_pixel(words: list[str] | None) -> tuple[str, float, float] | None:
    """``CAMERA X Y`` of --aim."""
    if words is None:
        return None
    return words[0], option_number("--aim", words[1]), option_number("--aim", words[2])


def tell_result(args: argparse.Namespace, document: Mapping[str, Any], line: str) -> None:
    """One JSON document for programs, or one line for people, on stdout."""
    if args.json:
        output.print_json(document)
    else:
        sys.stdout.write(output.one_line(line) + "\n")
