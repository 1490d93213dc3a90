"""What a running daemon does and has: operations, events, its mast file, faults, its configuration."""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mastctl.cli import output
from mastctl.cli.output import (
    CommandError,
    WrongUse,
    at_least,
    check_file,
    finite_number,
    one_line,
    positive_number,
)
from mastctl.cli.service import add_daemon_options, client_of, followed, show_pointings, tell_result
from mastctl.cli.steering import track_line

if TYPE_CHECKING:
    from mastctl.client.answers import Event, FaultSet, MastsTold, OperationListed, OperationTold


def add_commands(subparsers: argparse._SubParsersAction[Any]) -> None:
    """Add operations, events, mast, fault and reload."""
    for add in (_add_operations, _add_mast, _add_reload):
        add(subparsers)


def _add_operations(subparsers: argparse._SubParsersAction[Any]) -> None:
    """Add operations and events."""
    operations = subparsers.add_parser("operations", help="the operations of a daemon since its start")
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


def _add_mast(subparsers: argparse._SubParsersAction[Any]) -> None:
    """Add mast and fault."""
    mast = subparsers.add_parser("mast", help="the mast file that a running daemon points by")
    acts = mast.add_subparsers(dest="act", required=True, metavar="ACT")
    show = acts.add_parser("show", help="show which is in use, and which was before")
    show.add_argument("--out", metavar="FILE", help="write it there too, byte for byte")
    show.set_defaults(run=_show_mast)
    use = acts.add_parser("use", help="use another of the same folder; pictures taken before are refused")
    use.add_argument("file", metavar="NAME", help="its name, without a folder")
    use.set_defaults(run=_use)
    back = acts.add_parser("back", help="go back to the one that was in use before")
    back.set_defaults(run=_back)

    fault = subparsers.add_parser("fault", help="the faults of a simulated rover")
    switches = fault.add_subparsers(dest="act", required=True, metavar="ACT")
    every = switches.add_parser("list", help="show which are switched on")
    every.set_defaults(run=_faults)
    begin = switches.add_parser("set", help="switch one on")
    begin.add_argument("device", metavar="DEVICE", help="pan_tilt, a camera, ... (docs/how-to/simulation.md)")
    begin.add_argument("word", metavar="WORD", help="the fault word: off, stuck, dark, ...")
    begin.add_argument("parameters", nargs="*", metavar="NAME=VALUE", help="how much of it")
    begin.set_defaults(run=_set)
    clear = switches.add_parser("clear", help="switch those of a device off, or all")
    clear.add_argument("device", nargs="?", metavar="DEVICE", help="only its faults (default: all)")
    clear.set_defaults(run=_clear)
    for one in (show, use, back, every, begin, clear):
        add_daemon_options(one)


def _show_mast(args: argparse.Namespace) -> int:
    if args.out is not None:
        check_file(Path(args.out), "--out")
    with client_of(args) as client:
        status = client.status()
        if args.out is not None:
            Path(args.out).write_bytes(client.mast_file())
    return _tell_masts(args, {"mast": status["mast"], "former_mast": status["former_mast"]})


def _use(args: argparse.Namespace) -> int:
    with client_of(args) as client:
        return _tell_masts(args, client.use_mast(args.file))


def _back(args: argparse.Namespace) -> int:
    with client_of(args) as client:
        return _tell_masts(args, client.use_former_mast())


def _tell_masts(args: argparse.Namespace, masts: MastsTold) -> int:
    now, former = masts["mast"], masts["former_mast"]
    words = f"{now['file']} ({now['name']}, {now['digest'][:8]}...)"
    if former is not None:
        words += f", before {former['file']} ({former['digest'][:8]}...)"
    tell_result(args, masts, words)
    return 0


def _faults(args: argparse.Namespace) -> int:
    with client_of(args) as client:
        return _tell_faults(args, client.faults())


def _set(args: argparse.Namespace) -> int:
    parameters = dict(_parameter(words) for words in args.parameters)
    with client_of(args) as client:
        return _tell_faults(args, client.set_fault(args.device, args.word, **parameters))


def _clear(args: argparse.Namespace) -> int:
    with client_of(args) as client:
        client.clear_faults(args.device)
        return _tell_faults(args, client.faults())


def _parameter(words: str) -> tuple[str, float]:
    """``NAME=VALUE``."""
    name, equals, value = words.partition("=")
    try:
        if equals and name.isidentifier():
            return name, finite_number(value)
    except argparse.ArgumentTypeError:
        pass
    raise WrongUse(f"'{words}' where NAME=VALUE with a finite number is expected, such as sigma=8")


def _tell_faults(args: argparse.Namespace, faults: list[FaultSet]) -> int:
    if args.json:
        output.print_json({"faults": faults})
        return 0
    lines = [" ".join((one["device"], one["word"], *_parameters(one))) for one in faults]
    tell_result(args, {}, "; ".join(lines) or "no fault is switched on")
    return 0


def _parameters(fault: FaultSet) -> list[str]:
    return [f"{name}={value:g}" for name, value in fault["parameters"].items()]


def _add_reload(subparsers: argparse._SubParsersAction[Any]) -> None:
    """Add reload."""
    reload = subparsers.add_parser(
        "reload", help="have the daemon read its configuration again; all of it comes into use, or nothing"
    )
    add_daemon_options(reload)
    reload.set_defaults(run=_reload)


def _reload(args: argparse.Namespace) -> int:
    with client_of(args) as client:
        told = client.reload()
    if args.json:
        output.print_json(told)
        return 0
    mast = told["mast"]
    output.print_table(
        f"mastctl at {client.url}: {'changed' if told['changed'] else 'nothing changed'}",
        ("key", "before", "now"),
        [(one["key"], _brief(one["before"]), _brief(one["after"])) for one in told["changed"]],
        [f"mast file {mast['file']} ({mast['digest'][:8]}...)", *told["notes"]],
    )
    return 0


def _brief(value: Any) -> str:
    """A value in a line."""
    return "-" if value is None else value if isinstance(value, str) else json.dumps(value)[:60]
