"""Commands of the service: the daemon itself, what it knows and does, and a picture of it."""

from __future__ import annotations

import argparse
import json
import logging
import math
import signal
import time
from collections.abc import Iterable, Iterator, Mapping
from contextlib import suppress
from dataclasses import replace
from typing import TYPE_CHECKING, Any

from mastctl import signals
from mastctl.cli import output
from mastctl.cli.daemon import DAEMON, client_of, followed, queue_output
from mastctl.cli.options import command, one_of, option
from mastctl.cli.output import Answer, CommandError, Shown, WrongUse
from mastctl.logs import QueuedHandler

if TYPE_CHECKING:
    from mastctl.answers import (
        ControlTold,
        Event,
        LeaseGranted,
        OperationListed,
        OperationTold,
        Status,
        TrackTold,
    )
    from mastctl.client import Client
    from mastctl.config import Config, Listen

POLL_S = 0.1  # how often `status --wait` requests the status
SUFFIXES = {".png": "png", ".jpg": "jpeg", ".jpeg": "jpeg"}


def _address(text: str) -> Listen:
    """Read --listen (argparse ``type``)."""
    from mastctl.config import parse_address

    try:
        return parse_address(text)
    except ValueError as error:
        raise argparse.ArgumentTypeError(str(error)) from None


@command(
    "run",
    option("--config FILE", "configuration (default: the packaged simulated rover)"),
    option("--log-format text|json", "of stderr (default: text, JSON where that goes to journald)"),
    option("-v,--verbose", "log what the drivers meet, too"),
    option("-q,--quiet", "log only what is wrong"),
    option("--listen ADDRESS", "HOST:PORT or path of a Unix socket, not the configuration's", type=_address),
    example="--config rover.yaml",
)
def _run(args: argparse.Namespace) -> int:
    queue_output()
    # A signal before it is up ends it: nothing has moved yet. Before the imports, which take a second.
    with suppress(KeyboardInterrupt), signals.raised(signal.SIGINT):
        _serve(args)
    return 0


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

    run(config, lambda url: output.show(args, Answer({"url": url}, url)), draws_ahead=True)


@command(
    "status",
    option("--wait S", "wait for a daemon that carries out commands, or for --operation's end; else exit 1"),
    one_of(
        option("--operations", "show the newest operations, newest first"),
        option("--operation ID", "show one operation with its steps and what it measured"),
        option(
            "--events TOPIC...", "show each change as it comes: of state, operation, ... or all", nargs="*"
        ),
    ),
    option("--key KEY", "with --events: of these keys only (a device, an id)", repeat=True),
    option("--count N", "with --events: end after so many (default: never)"),
    *DAEMON,
    example="--wait 30",
)
def _status(args: argparse.Namespace) -> Answer | int:
    if args.events is None and (args.key or args.count is not None):
        raise WrongUse("--key and --count go with --events")
    if args.wait is not None and (args.operations or args.events is not None):
        raise WrongUse("--wait goes with the status alone or with --operation")
    with client_of(args) as client:
        if args.events is not None:
            return _events(args, client)
        if args.operations:
            return _operations(client)
        if args.operation is not None:
            return _operation(args, client)
        status = client.status() if args.wait is None else _ready(client, args.wait)
    rows = _status_rows(status)
    return Answer(status, Shown(f"mastctl at {client.url}", ("what", "now"), rows, _fault_lines(status)))


def _ready(client: Client, wait_s: float) -> Status:
    """Return the status as soon as the daemon carries out commands.

    A fault is waited for, since it may clear. A latched emergency stop is not: only a reset releases it.
    """
    from mastctl.answers.kinds import WELL
    from mastctl.client import ClientError
    from mastctl.client.following import PASSING

    until_s = time.monotonic() + wait_s
    while True:
        try:
            status = client.status(max(until_s - time.monotonic(), POLL_S))
            if status["state"] in WELL:
                return status
            reason = status.get("reason")
            message = f"the daemon is {status['state']}{f': {reason}' if reason else ''}"
            if status["state"] == "stopped":
                raise CommandError("not_ready", message)
        except ClientError as error:
            if error.code not in PASSING:
                raise
            message = str(error)
        if time.monotonic() > until_s:
            raise CommandError("not_ready", f"not ready after {wait_s:g} s: {message}")
        time.sleep(POLL_S)


def _operations(client: Client) -> Answer:
    found = client.operations()
    rows = [(one["id"], _request(one), one["state"], _seconds(one), _residual(one)) for one in found]
    columns = ("operation", "request", "state", "seconds", "residual, px")
    return Answer({"operations": found}, Shown("operations", columns, rows))


def _operation(args: argparse.Namespace, client: Client) -> Answer:
    if args.wait is None:
        record, code = client.operation(args.operation), 0
    else:
        record = followed(client, args.operation, args.json, args.wait)
        code = int(record["state"] != "done")
    shown: list[str | Shown] = [
        f"{'✓' if step['state'] == 'done' else '✗'} {step['name']} ({step['duration_s']:.2f} s)"
        for step in record["steps"]
    ]
    shown += [pointings_shown(record)] if record["pointings"] else []
    return Answer(record, [*shown, f"{record['id']}: {_request(record)}, {_progress(record)}"], code)


def _events(args: argparse.Namespace, client: Client) -> int:
    lines = (
        Answer(event, f"{event['topic']} {event['key']}: {_event_line(event)}")
        for event in client.events(*args.events, keys=args.key)
    )
    return show_each(args, lines)


def show_each(args: argparse.Namespace, answers: Iterable[Answer]) -> int:
    """Show each answer as it comes, --count of them; they end with the daemon. Raises CommandError."""
    for number, answer in enumerate(answers, 1):
        output.show(args, answer)
        if number == args.count:
            return 0
    if args.count is not None:
        raise CommandError("ended", f"the daemon ended before {args.count} changes were shown")
    return 0


def _event_line(event: Event) -> str:
    """Return an event in a line."""
    if event["topic"] == "state":
        return ", ".join(filter(None, (event["value"]["state"], event["value"]["reason"])))
    if event["topic"] == "operation":
        return f"{_request(event['value'])}, {_progress(event['value'])}"
    if event["topic"] == "track":
        return track_line(event["value"])
    if event["topic"] == "fault":
        return "; ".join(fault["message"] for fault in event["value"]) or "nothing"
    if event["topic"] == "joints":
        head = event["value"]
        moving = ", moving" if head["moving"] else ""
        return f"pan {head['pan_rad']:+.6f}, tilt {head['tilt_rad']:+.6f} rad{moving}"
    return json.dumps(event["value"])


def _progress(record: OperationTold) -> str:
    """How far an operation is."""
    if record["error"]:
        return f"{record['state']}: {record['error']['message']}"
    steps = record["steps"]
    return f"{record['state']} after {steps[-1]['name']}" if steps else str(record["state"])


def _request(record: OperationListed) -> str:
    """The request of an operation in a line."""
    request = record["request"]
    kind = next((name for name in ("track", "jog", "look") if name in request), "point")
    found = request.get(kind)
    goal = found if isinstance(found, dict) else request
    if goal.get("pixel"):
        pixel = goal["pixel"]
        return f"{kind} at {pixel['camera']} ({pixel['x_px']:g}, {pixel['y_px']:g})"
    if goal.get("position_m"):
        x, y, z = goal["position_m"]
        return f"{kind} at ({x:g}, {y:g}, {z:g}) m"
    if "pan_rad" in goal:
        return f"{kind} at pan {goal['pan_rad']:g}, tilt {goal['tilt_rad']:g} rad"
    return kind


def _seconds(record: OperationListed) -> str:
    begun, ended = record["started_s"], record["ended_s"]
    return "-" if begun is None or ended is None else f"{ended - begun:.2f}"


def _residual(record: OperationListed) -> str:
    residual = record["residual_px"]
    return "-" if not residual or None in residual else f"{residual[0]:+.3f}, {residual[1]:+.3f}"


@command(
    "snapshot",
    option("CAMERA", "camera of the configuration"),
    option("--out FILE", "where to: .png (lossless), .jpg", required=True),
    option("--frame-id ID", "a frame that the daemon still keeps"),
    *DAEMON,
    example="navcam_left --out left.png",
)
def _snapshot(args: argparse.Namespace) -> Answer:
    out = args.out
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
    return Answer({"file": str(out), **shot.facts}, line + (", head moving" if shot.moving else ""))


def pointings_shown(record: OperationTold) -> Shown:
    """Return what was measured as a table, and in which frames."""
    rows, notes = [], []
    for number, pointing in enumerate(record["pointings"], 1):
        residual = pointing.get("residual_px") or (None, None)
        sigma = pointing.get("residual_sigma_px") or (None, None)
        measured = [
            "-" if value is None or one_sigma is None else f"{value:+.3f} ± {one_sigma:.3f}"
            for value, one_sigma in zip(residual, sigma, strict=True)
        ]
        rows.append((str(number), *measured))
        parts = [f"measured in frame {pointing['frame_id']}"] if pointing.get("frame_id") else []
        parts += [pointing["note"]] if pointing.get("note") else []
        notes.append(f"pointing {number}: {'; '.join(parts)}")
    position_m = record["position_m"]
    if position_m is not None:
        x, y, z = position_m
        notes.append(f"target at ({x:.3f}, {y:.3f}, {z:.3f}) m in the rover frame")
    if record["range_m"] is not None:
        notes.append(_range(record))
    return Shown(f"operation {record['id']}", ("pointing", "residual x, px", "residual y, px"), rows, notes)


def _angle(read_rad: float, true_rad: float) -> str:
    """An angle as read, and the true one where the mast file says that it is another."""
    truly = "" if read_rad == true_rad else f", truly {true_rad:+.6f} rad"
    return f"{read_rad:+.6f} rad{truly}"


def _range(record: Mapping[str, Any]) -> str:
    """How far the target is, and within what where one camera measured it."""
    line = f"range {record['range_m']:.3f} m"
    if record["range_from"] not in ("parallax", "unknown"):
        return line
    near, far = record["range_interval_m"]
    reach = "infinity" if far is None else f"{far:.3f} m"
    return (
        f"{line} by {record['range_from'].replace('unknown', 'a guess')}: 95 % from {near:.3f} m to {reach}"
    )


def _status_rows(status: Status) -> Iterator[tuple[str, str]]:
    """The rows of the status."""
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
    """Return the client that steers, in a line."""
    if control is None:
        return "no client steers"
    left_s = control["for_s"]
    until = "until what runs has ended" if left_s is None else f"for {left_s:.0f} s more"
    return f"{control['holder']} steers, {until}"


def _fault_lines(status: Status) -> list[str]:
    return [
        f"fault: {fault['message']} (for {fault['for_s']:.0f} s, until {fault['until']})"
        for fault in status["faults"]
    ]


def track_line(track: TrackTold) -> str:
    """Return a track in one line."""
    parts: list[str] = [track["state"]]
    if track["pair"]:
        parts.append(f"by {track['pair']}")
        if not track["predicted"]:
            parts.append(f"{track['range_m']:.3f} m away")
    if track["position_m"]:
        x, y, z = track["position_m"]
        parts.append(f"at ({x:.3f}, {y:.3f}, {z:.3f}) m")
        if track["covariance_m2"]:
            variance = sum(track["covariance_m2"][axis][axis] for axis in range(3))
            parts[-1] += f" ± {math.sqrt(variance):.3f} m"
    if track["predicted"]:
        parts.append("predicted")
    if track["operation"]:
        parts.append("measuring")
    if track["reason"]:
        parts.append(track["reason"])
    return ", ".join(parts)
