"""``mastctl operations list|show|watch``, ``mastctl events``: what the daemon does and has done."""

from __future__ import annotations

import argparse
import json
import sys
from typing import TYPE_CHECKING, Any

from mastctl.cli import output
from mastctl.cli.output import CommandError, at_least, one_line, positive_number
from mastctl.cli.service import add_daemon_options, client_of, followed, show_pointings, tell_result
from mastctl.cli.track import track_line

if TYPE_CHECKING:
    from mastctl.client.answers import Event, OperationListed, OperationTold


def add_commands(subparsers: argparse._SubParsersAction[Any]) -> None:
    """Add operations and events."""
    operations = subparsers.add_parser("operations", help="what a daemon does, and has done since its start")
    acts = operations.add_subparsers(dest="act", required=True, metavar="ACT")
    every = acts.add_parser("list", help="show the newest operations, newest first")
    every.set_defaults(run=_list)
    show = acts.add_parser("show", help="show one operation with its steps and what it measured")
    show.set_defaults(run=_show)
    watch = acts.add_parser(
        "watch", help="wait for an operation's end; without an id show each that changes, a line each"
    )
    watch.set_defaults(run=_watch)
    show.add_argument("id", metavar="ID", help="as 'mastctl operations list' shows it")
    watch.add_argument("id", nargs="?", metavar="ID", help="as 'mastctl operations list' shows it")
    watch.add_argument(
        "--timeout", type=positive_number, default=120.0, metavar="S", help="how long to wait (default 120 s)"
    )

    events = subparsers.add_parser(
        "events", help="show each change of the daemon as it comes, a line each; --json: a document a line"
    )
    events.add_argument("topics", nargs="*", metavar="TOPIC", help="state, operation, ... (default: all)")
    events.add_argument("--key", action="append", default=[], help="of these keys only (a device, an id)")
    events.set_defaults(run=_events)
    for many in (watch, events):
        many.add_argument("--count", type=at_least(1), metavar="N", help="end after so many (default: never)")
    for one in (every, show, watch, events):
        add_daemon_options(one)


def _list(args: argparse.Namespace) -> int:
    with client_of(args) as client:
        found = client.operations()
    if args.json:
        output.print_json({"operations": found})
        return 0
    rows = [(one["id"], _asked(one), one["state"], _seconds(one), _residual(one)) for one in found]
    columns = ("operation", "what", "state", "seconds", "residual, px")
    output.print_table("operations", columns, rows)
    return 0


def _show(args: argparse.Namespace) -> int:
    with client_of(args) as client:
        record = client.operation(args.id)
    _tell(args, record)
    return 0


def _watch(args: argparse.Namespace) -> int:
    if args.id is None:
        return _lines(args, ["operation"], [])
    with client_of(args) as client:
        record = followed(client, args.id, args)
    _tell(args, record)
    return 0 if record["state"] == "done" else 1


def _events(args: argparse.Namespace) -> int:
    return _lines(args, args.topics, args.key)


def _lines(args: argparse.Namespace, topics: list[str], keys: list[str]) -> int:
    """A line for each event."""
    with client_of(args) as client:
        for number, event in enumerate(client.events(*topics, keys=keys), 1):
            tell_result(args, event, f"{event['topic']} {event['key']}: {_line(event)}")
            sys.stdout.flush()
            if number == args.count:
                return 0
    if args.count is not None:
        raise CommandError("ended", f"the daemon ended before {args.count} changes were shown")
    return 0


def _line(event: Event) -> str:
    """What an event says, in a line."""
    if event["topic"] == "state":
        return ", ".join(filter(None, (event["value"]["state"], event["value"]["reason"])))
    if event["topic"] == "operation":
        return f"{_asked(event['value'])}, {_progress(event['value'])}"
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
    """How far an operation is, in words."""
    if record["error"]:
        return f"{record['state']}: {record['error']['message']}"
    steps = record["steps"]
    return f"{record['state']} after {steps[-1]['name']}" if steps else str(record["state"])


def _tell(args: argparse.Namespace, record: OperationTold) -> None:
    if args.json:
        output.print_json(record)
        return
    for step in record["steps"]:
        mark = "✓" if step["state"] == "done" else "✗"
        sys.stdout.write(one_line(f"{mark} {step['name']} ({step['duration_s']:.2f} s)") + "\n")
    if record["pointings"]:
        show_pointings(record)
    sys.stdout.write(one_line(f"{record['id']}: {_asked(record)}, {_progress(record)}") + "\n")


def _asked(record: OperationListed) -> str:
    """What an operation was asked for, in words."""
    request = record["request"]
    kind = next((name for name in ("track", "jog", "look") if name in request), "point")
    found = request.get(kind)
    asked = found if isinstance(found, dict) else request
    if asked.get("pixel"):
        pixel = asked["pixel"]
        return f"{kind} at {pixel['camera']} ({pixel['x_px']:g}, {pixel['y_px']:g})"
    if asked.get("position_m"):
        x, y, z = asked["position_m"]
        return f"{kind} at ({x:g}, {y:g}, {z:g}) m"
    if "pan_rad" in asked:
        return f"{kind} at pan {asked['pan_rad']:g}, tilt {asked['tilt_rad']:g} rad"
    return kind


def _seconds(record: OperationListed) -> str:
    begun, ended = record["started_s"], record["ended_s"]
    return "-" if begun is None or ended is None else f"{ended - begun:.2f}"


def _residual(record: OperationListed) -> str:
    residual = record["residual_px"]
    return "-" if not residual or None in residual else f"{residual[0]:+.3f}, {residual[1]:+.3f}"
