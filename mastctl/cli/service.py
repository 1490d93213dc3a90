"""The daemon itself, what it knows and does, its pictures and recordings, and its adapter to ROS 2."""

from __future__ import annotations

import argparse
import logging
import os
import re
import signal
import tempfile
import time
from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from mastctl import signals
from mastctl.cli import output
from mastctl.cli.daemon import CONFIG, DAEMON, URL, client_of, followed, queue_output
from mastctl.cli.options import command, one_of, option
from mastctl.cli.output import Answer, CommandError, Shown, WrongUse, cell, chosen, tables_at
from mastctl.logs import QueuedHandler

if TYPE_CHECKING:
    from mastctl.answers import Status
    from mastctl.client import Client
    from mastctl.config import Config, Listen

POLL_S = 0.1  # how often `status --wait` requests the status
ROS_NAME = re.compile(r"[A-Za-z_][A-Za-z0-9_]*")
SUFFIXES: Mapping[str, Literal["png", "jpeg"]] = {".png": "png", ".jpg": "jpeg", ".jpeg": "jpeg"}

STATUS = (
    "state reason hardware control.holder control.for_s joints.pan_rad joints.tilt_rad joints.true_pan_rad "
    "joints.true_tilt_rad joints.age_s moving limits.pan_rad limits.tilt_rad last_residual.residual_px "
    "last_residual.residual_sigma_px cameras.*.age_s track.state track.reason pose.position_m mast.file "
    "calibration.sentence sentinel.sentence uptime_s version faults"
)
OPERATION = (
    "state request error.message position_m range_m range_from range_interval_m pointings.residual_px "
    "pointings.residual_sigma_px pointings.note"
)
LISTED = "operations.id operations.state operations.request operations.residual_px"
EVENTS = {
    "state": "state reason",
    "operation": "state request error.message residual_px",
    "track": "state pair range_m position_m reason",
}
"""What people see of a status, an operation, one of many, and of events by their topic."""


def _address(text: str) -> Listen:
    """Read --listen (argparse ``type``)."""
    from mastctl.config import parse_address

    try:
        return parse_address(text)
    except ValueError as error:
        raise argparse.ArgumentTypeError(str(error)) from None


LISTEN = option("--listen ADDRESS", "HOST:PORT or path of a Unix socket, in place of listen", type=_address)


@command(
    "run",
    option("--config FILE", "configuration (default: the packaged simulated rover)"),
    option("--log-format text|json", "of stderr (default: text, JSON where that goes to journald)"),
    option("-v,--verbose", "log what the drivers meet, too"),
    option("-q,--quiet", "log only what is wrong"),
    LISTEN,
    example="--config rover.yaml",
)
def _run(args: argparse.Namespace) -> int:
    from mastctl.logs import formatter

    queue_output()
    # A signal before it is up ends it: nothing has moved yet. Before the imports, which take a second.
    with suppress(KeyboardInterrupt), signals.raised(signal.SIGINT):
        for handler in logging.getLogger().handlers:
            if isinstance(handler, QueuedHandler):
                handler.setFormatter(formatter(args.log_format))
        level = logging.WARNING if args.quiet else logging.DEBUG if args.verbose else logging.INFO
        for name in ("mastctl", "drivers", "calib"):
            logging.getLogger(name).setLevel(level)
        from mastctl.config import load_config

        serve_config(load_config(args.config), args)
    return 0


def serve_config(config: Config, args: argparse.Namespace) -> None:
    """Run a daemon until a signal ends it, at --listen if that is given; its address is a line on stdout."""
    from mastctl.daemon import run

    if args.listen is not None:
        config = replace(config, listen=args.listen.model_copy(update={"hosts": config.listen.hosts}))
    run(config, lambda url: output.show(args, Answer({"url": url}, url)), draws_ahead=True)


@command(
    "status",
    option("--wait S", "wait for a daemon that carries out commands, or for --operation's end; else exit 1"),
    one_of(
        option("--operations", "show the newest operations, newest first"),
        option("--operation ID", "show one operation with its steps and what it measured"),
        option("--events TOPIC...", "show each change as it comes, of all or some topics", nargs="*"),
    ),
    option("--count N", "with --events: end after so many (default: never)"),
    *DAEMON,
    example="--wait 30",
)
def _status(args: argparse.Namespace) -> Answer | int:
    if args.events is None and args.count is not None:
        raise WrongUse("--count goes with --events")
    if args.wait is not None and (args.operations or args.events is not None):
        raise WrongUse("--wait goes with the status alone or with --operation")
    with client_of(args) as client:
        if args.events is not None:
            return _events(args, client)
        if args.operations:
            listed = {"operations": client.operations()}
            return Answer(listed, tables_at(listed, LISTED))
        if args.operation is not None:
            wait = args.wait is not None
            record = (
                followed(client, args.operation, args.json, args.wait)
                if wait
                else client.operation(args.operation)
            )
            shown = operation_shown(record, "steps.name steps.state steps.duration_s")
            return Answer(record, shown, int(wait and record["state"] != "done"))
        status = client.status() if args.wait is None else _ready(client, args.wait)
    return Answer(status, tables_at(status, STATUS, f"mastctl at {client.url}"))


def _ready(client: Client, wait_s: float) -> Status:
    """Return the status as soon as the daemon carries out commands.

    A fault is waited for, since it may clear. A latched emergency stop is not: only a reset releases it.
    """
    from mastctl.answers import WELL
    from mastctl.client import ClientError
    from mastctl.client.connection import PASSING

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


def operation_shown(record: Mapping[str, Any], more: str = "") -> list[Shown]:
    """Return an operation for people: its request, what was measured, and ``more`` keys."""
    return tables_at(record, f"{OPERATION} {more}", f"operation {record['id']}")


def _events(args: argparse.Namespace, client: Client) -> int:
    """Show each event as it comes, --count of them; they end with the daemon. Raises CommandError."""
    for number, event in enumerate(client.events(*args.events), 1):
        value, keys = event["value"], EVENTS.get(event["topic"])
        shown = chosen(value, keys) if keys and isinstance(value, Mapping) else value
        output.show(args, Answer(event, f"{event['topic']} {event['key']}: {cell(shown)}"))
        if number == args.count:
            return 0
    if args.count is not None:
        raise CommandError("ended", f"the daemon ended before {args.count} changes were shown")
    return 0


@command(
    "snapshot",
    option("CAMERA", "camera of the configuration"),
    option("--out FILE", "where to: .png (lossless), .jpg", required=True),
    option("--frame-id ID", "a frame that the daemon still keeps"),
    *DAEMON,
    example="navcam_left --out left.png",
)
def _snapshot(args: argparse.Namespace) -> Answer:
    from mastctl.report.pictures import with_text

    out, kind = args.out, SUFFIXES.get(args.out.suffix.lower())
    if kind is None:
        raise WrongUse(f"--out is '{args.out}' where a name ending in {', '.join(SUFFIXES)} is expected")
    output.check_file(out, "--out")
    with client_of(args) as client:
        shot = client.snapshot(args.camera, frame_id=args.frame_id, format=kind)
    texts = {name: str(value) for name, value in shot.facts.items()}
    out.write_bytes(with_text(shot.data, texts) if kind == "png" else shot.data)
    facts = chosen(shot.facts, "frame_id pan_rad tilt_rad moving")
    return Answer({"file": str(out), **shot.facts}, f"{out}: {cell(facts)}")


@command(
    "ros2",
    URL,
    CONFIG,
    option("--prefix WORD", "stands before joints and frames", default=""),
    option("--base FRAME", "the rover's frame with the axes of ROS", default="base_link"),
    option(
        "--ros-args ...",
        "remappings and parameters of ROS: -r, -p, ...",
        nargs=argparse.REMAINDER,
        metavar="...",
        default=[],
    ),
    example="--url http://127.0.0.1:8420",
    about="Publishes joints, transforms, images, diagnostics and residuals of a running daemon, "
    "and takes trajectories, points and stops for it. Needs rclpy (ROS 2 Jazzy or Kilted).",
)
def _ros2(args: argparse.Namespace) -> int:
    from mastctl.client import Client
    from mastctl.ros2 import check_ros

    for name, text in (("--prefix", args.prefix), ("--base", args.base)):
        if not ROS_NAME.fullmatch(text) and (name == "--base" or text):
            raise WrongUse(f"{name} is '{text}' where a word of letters, digits and _ is expected")
    check_ros()
    from mastctl.ros2.node import run
    from mastctl.ros2.state import RosNames

    with client_of(args) as client:
        url = client.url
    client_name = f"ros2@{os.uname().nodename}:{os.getpid()}"
    queue_output()
    with suppress(KeyboardInterrupt):
        run(
            lambda: Client(url, timeout_s=10.0, name=client_name),
            RosNames(args.prefix, args.base),
            args.ros_args,
            lambda node: output.show(args, Answer({"node": node, "url": url}, f"{node} is a node of {url}")),
        )
    return 0


RECORDING = option("FILE", "an MCAP file, or a folder of segments")


@command("record show", RECORDING, help="say what a recording holds, whole or not", example="afternoon.mcap")
def _show_recording(args: argparse.Namespace) -> Answer:
    from mastctl.recorder.recorded import read_whole

    found = read_whole(args.file).summary()
    whole = found["complete"] and not found["damaged"]
    state = "whole" if whole else f"'mastctl record repair {args.file}' writes what is whole anew"
    return Answer(found, [*tables_at(found, "", str(args.file)), state])


@command(
    "record repair",
    RECORDING,
    option("--out FILE", "where to (default: FILE.repaired.mcap)"),
    help="write what is whole in a recording into a file with an index",
    example="broken.mcap --out whole.mcap",
)
def _repair(args: argparse.Namespace) -> Answer:
    from drivers.recordings.frames import recording_files
    from mastctl.recorder.recorded import repair

    out = args.out or args.file.with_name(f"{args.file.stem}.repaired.mcap")
    found = dict(repair(recording_files(args.file), out))
    return Answer({"file": str(out), "was_complete": found.pop("complete"), **found})


@command(
    "record replay",
    RECORDING,
    option("--mast OTHER.yaml", "evaluate as if this mast file had been used"),
    LISTEN,
    help="serve a recording, or evaluate its pointings again with another mast file",
    example="afternoon.mcap --mast other.yaml",
)
def _replay(args: argparse.Namespace) -> Answer | int:
    from calib.files.mast_file import load_rig
    from mastctl.recorder.recorded import read_whole
    from mastctl.recorder.what_if import what_if

    if args.mast is None:
        return _served(args)
    if args.listen is not None:
        raise WrongUse("--listen goes without --mast: a what-if is evaluated, not served")
    document = what_if(read_whole(args.file), load_rig(args.mast))
    return Answer(document, _shown(document, args.mast.name))


def _served(args: argparse.Namespace) -> int:
    """Serve a recording until it is ended."""
    from mastctl.config import load_config
    from mastctl.recorder.recorded import read_whole, replay_files

    queue_output()
    with tempfile.TemporaryDirectory(prefix="mastctl-replay-") as folder, suppress(KeyboardInterrupt):
        path = replay_files(read_whole(args.file), Path(folder), {})
        serve_config(load_config(path), args)
    return 0


def _shown(document: Mapping[str, Any], name: str) -> Iterator[Shown]:
    """The pointings and hand-offs, and what they are together, with a mast file of this name."""
    from mastctl.report.pages import x_y

    for title, keys in (("pointings", ("operation", "pointing")), ("handoffs", ("time", "camera"))):
        rows = [
            [*(str(one[key]) for key in keys), x_y(one["recorded_px"], 3),
             one["error"] or x_y(one["would_be_px"], 3), x_y(one["sigma_px"], 3)]
            for one in document[title]
        ]  # fmt: skip
        if rows:
            yield Shown(title, (*keys, "recorded (px)", "would be (px)", "sigma (px)"), rows)
    rows = [
        [kind, str(one["number"]), x_y(one["recorded"], 3), x_y(one["would_be"], 3)]
        for kind, one in document["rms_px"].items()
    ]
    headings = ("what", "number", "recorded rms x, y (px)", "would be rms x, y (px)")
    others = document["not_worked_out"].items()
    yield Shown(
        f"with {name}", headings, rows, [f"operation {one} is not worked out: {why}" for one, why in others]
    )
