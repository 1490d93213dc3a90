"""``mastctl record`` and ``mastctl replay``: begin, end, list, inspect, repair and serve recordings."""

from __future__ import annotations

import argparse
import tempfile
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mastctl.cli import output
from mastctl.cli.output import WrongUse
from mastctl.cli.service import add_daemon_options, client_of, queue_output, serve_config, tell_result

if TYPE_CHECKING:
    from mastctl.recorder.recorded import Recording


def add_commands(subparsers: argparse._SubParsersAction[Any]) -> None:
    """Add record and replay."""
    record = subparsers.add_parser("record", help="begin and end a recording; list, inspect and repair them")
    acts = record.add_subparsers(dest="act", metavar="ACT", required=True)

    start = acts.add_parser("start", help="have the daemon record until 'record stop'")
    start.add_argument("name", nargs="?", default="", help="a word for the file's name")
    start.set_defaults(run=_start)
    stop = acts.add_parser("stop", help="end the recording that 'record start' began")
    stop.set_defaults(run=_stop)
    listed = acts.add_parser("list", help="list the daemon's recordings: runs, what faults kept, the ring")
    listed.set_defaults(run=_list)
    for client in (start, stop, listed):
        add_daemon_options(client)

    show = acts.add_parser("show", help="say what a recording holds, whole or not")
    show.add_argument("file", metavar="FILE", type=Path, help="an MCAP file, or a folder of segments")
    show.set_defaults(run=_show)
    repair = acts.add_parser("repair", help="write what is whole in a recording into a file with an index")
    repair.add_argument("file", metavar="FILE", type=Path, help="an MCAP file, or a folder of segments")
    repair.add_argument("--out", metavar="FILE", type=Path, help="where to (default: FILE.repaired.mcap)")
    repair.set_defaults(run=_repair)

    replay = subparsers.add_parser(
        "replay", help="serve a recording, or work its pointings out again with another mast file"
    )
    replay.add_argument("file", metavar="FILE", type=Path, help="an MCAP file, or a folder of segments")
    replay.add_argument(
        "--mast", metavar="OTHER.yaml", type=Path, help="evaluate as if this mast file had been used"
    )
    replay.add_argument("--report", metavar="DIR", type=Path, help="where the what-if's page goes")
    replay.add_argument(
        "--listen", metavar="HOST:PORT", help="where to serve (default 127.0.0.1:8420; port 0: any)"
    )
    replay.set_defaults(run=_replay)


def _start(args: argparse.Namespace) -> int:
    with client_of(args) as client:
        found = client.start_recording(args.name)
    tell_result(args, found, f"recording {found['run']} in {found['folder']}; 'mastctl record stop' ends it")
    return 0


def _stop(args: argparse.Namespace) -> int:
    with client_of(args) as client:
        found = client.stop_recording()
    line = f"{found['file']}: {found['size_mb']:.1f} MB{_dropped(found['dropped'])}"
    tell_result(args, found, line)
    return 0


def _list(args: argparse.Namespace) -> int:
    with client_of(args) as client:
        found = client.recordings()
    if args.json:
        output.print_json(found)
        return 0
    rows = [
        (one["kind"], one["name"], f"{one['size_mb']:.1f}", str(one["files"])) for one in found["recordings"]
    ]
    now = found["recorder"]
    notes = [f"now: {now['run'] or now['file'] or 'nothing is recorded'}{_dropped(now['dropped'])}"]
    notes += [now["fault"]] if now["fault"] else []
    output.print_table(f"recordings in {now['folder']}", ("kind", "name", "MB", "files"), rows, notes)
    return 0


def _dropped(dropped: dict[str, int]) -> str:
    count = sum(dropped.values())
    return f", {count} values were dropped or overtaken by newer ones" if count else ""


def _show(args: argparse.Namespace) -> int:
    from mastctl.recorder.recorded import read_whole

    recording = read_whole(args.file)
    found = recording.summary()
    if args.json:
        output.print_json(found)
        return 0
    rows = [
        ("length", f"{found['seconds']:.1f} s, {found['messages']} messages, {found['size_mb']:.1f} MB"),
        (
            "holds",
            f"{found['frames']} pictures, {found['operations']} operations, {found['handoffs']} hand-offs",
        ),
        ("mast file", ", ".join(f"{one['name']} ({one['digest'][:12]})" for one in found["masts"]) or "none"),
        ("configuration", found["config"] or "none"),
        ("hardware", found["facts"].get("hardware", "unknown")),
        ("state", _state(recording)),
    ]
    output.print_table(str(args.file), ("what", "is"), rows)
    return 0


def _state(recording: Recording) -> str:
    """Whether it is whole, and what would be done about it."""
    found = recording.summary()
    if found["complete"] and not found["damaged"]:
        return "whole"
    parts = [f"{found['damaged']} damaged chunks"] if found["damaged"] else []
    parts += (
        [] if found["complete"] else [f"not ended, {found['left_over_bytes']} bytes at its end are no record"]
    )
    return f"{'; '.join(parts)}; 'mastctl record repair {recording.path}' writes what is whole anew"


def _repair(args: argparse.Namespace) -> int:
    from drivers.recordings.frames import recording_files
    from mastctl.recorder.repair import repair

    out = args.out or args.file.with_name(f"{args.file.stem}.repaired.mcap")
    found = repair(recording_files(args.file), out)
    result = {
        "file": str(out), "messages": found.messages, "seconds": found.seconds, "damaged": found.damaged,
        "left_over_bytes": found.left_over_bytes, "was_complete": found.was_complete,
    }  # fmt: skip
    lost = f", {found.damaged} damaged chunks were left out" if found.damaged else ""
    lost += f", {found.left_over_bytes} bytes at the end were no record" if found.left_over_bytes else ""
    tell_result(args, result, f"{out}: {found.messages} messages, {found.seconds:.1f} s{lost}")
    return 0


def _replay(args: argparse.Namespace) -> int:
    from mastctl.recorder.recorded import read_whole

    if args.mast is None:
        if args.report is not None:
            raise WrongUse("--report goes with --mast: a recording that is served has no report")
        return _served(args)
    if args.listen is not None:
        raise WrongUse("--listen goes without --mast: a what-if is worked out, not served")
    return _what_if(args, read_whole(args.file))


def _served(args: argparse.Namespace) -> int:
    """Serve a recording until it is ended."""
    from mastctl import signals
    from mastctl.config import load_config
    from mastctl.recorder.recorded import read_whole, replay_files

    listen = _listen(args.listen)
    queue_output()
    with tempfile.TemporaryDirectory(prefix="mastctl-replay-") as folder:
        path = replay_files(read_whole(args.file), Path(folder), listen)
        with suppress(KeyboardInterrupt), signals.raised():
            serve_config(load_config(path), args)
    return 0


def _listen(text: str | None) -> dict[str, Any]:
    """``HOST:PORT`` as the configuration has it."""
    if text is None:
        return {}
    host, _, port = text.rpartition(":")
    if not host or not port.isdecimal() or int(port) > 65535:
        raise WrongUse(f"--listen is '{text}' where HOST:PORT is expected, e.g. 127.0.0.1:8421")
    return {"host": host.strip("[]"), "port": int(port)}


def _what_if(args: argparse.Namespace, recording: Recording) -> int:
    """Work a recording's pointings and hand-offs out again."""
    from calib.files.mast_file import load_rig
    from mastctl.recorder.what_if import handoffs_with, pointings_with, seen_in
    from mastctl.recorder.what_if_report import WhatIf, write_what_if
    from mastctl.watch.handoffs import handoff_of

    mast = load_rig(args.mast)
    frames = {name: frame.facts for name, frame in recording.frames.items()}
    seen, others = seen_in(recording.operations, frames)
    handoffs = [handoff_of(args.file, at, found) for at, found in enumerate(recording.handoffs, start=1)]
    what_if = WhatIf(
        recording, mast, pointings_with(mast.rig, seen), handoffs_with(mast.rig, handoffs), others
    )
    page = None if args.report is None else write_what_if(what_if, args.report)
    if args.json:
        output.print_json(what_if.as_json() | {"report": None if page is None else str(page)})
        return 0
    _show_what_if(what_if, page)
    return 0


def _show_what_if(what_if: Any, page: Path | None) -> None:
    from mastctl.recorder import what_if_report as report

    for title, table in (
        ("pointings", report.pointing_table(what_if)),
        ("hand-offs", report.handoff_table(what_if)),
    ):
        if table.rows:
            output.print_table(title, table.headings, table.rows)
    summary = report.summary_table(what_if)
    notes = [*report.other_lines(what_if), *([f"report: {page}"] if page else [])]
    output.print_table(f"with {what_if.mast.path.name}", summary.headings, summary.rows, notes)
