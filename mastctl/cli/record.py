"""``mastctl record``: inspect, repair and replay recordings; `mastctl.cli.requests` has the rest."""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mastctl.cli.daemon import queue_output
from mastctl.cli.options import command, option
from mastctl.cli.output import Answer, Shown, WrongUse, tables_of
from mastctl.cli.service import LISTEN, serve_config

if TYPE_CHECKING:
    from mastctl.recorder.recorded import Recording

RECORDING = option("FILE", "an MCAP file, or a folder of segments")


@command("record show", RECORDING, help="say what a recording holds, whole or not", example="afternoon.mcap")
def _show(args: argparse.Namespace) -> Answer:
    from mastctl.recorder.recorded import read_whole

    found = read_whole(args.file).summary()
    whole = found["complete"] and not found["damaged"]
    state = "whole" if whole else f"'mastctl record repair {args.file}' writes what is whole anew"
    return Answer(found, [*tables_of(found, str(args.file)), state])


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
    option("--report DIR", "where the what-if's page goes"),
    LISTEN,
    help="serve a recording, or evaluate its pointings again with another mast file",
    example="afternoon.mcap --mast other.yaml",
)
def _replay(args: argparse.Namespace) -> Answer | int:
    from mastctl.recorder.recorded import read_whole

    if args.mast is None:
        if args.report is not None:
            raise WrongUse("--report goes with --mast: a recording that is served has no report")
        return _served(args)
    if args.listen is not None:
        raise WrongUse("--listen goes without --mast: a what-if is evaluated, not served")
    return _what_if(args, read_whole(args.file))


def _served(args: argparse.Namespace) -> int:
    """Serve a recording until it is ended."""
    from mastctl import signals
    from mastctl.config import load_config
    from mastctl.recorder.recorded import read_whole, replay_files

    queue_output()
    with tempfile.TemporaryDirectory(prefix="mastctl-replay-") as folder:
        path = replay_files(read_whole(args.file), Path(folder), {})
        with suppress(KeyboardInterrupt), signals.raised():
            serve_config(load_config(path), args)
    return 0


def _what_if(args: argparse.Namespace, recording: Recording) -> Answer:
    """Evaluate a recording's pointings and hand-offs again."""
    from calib.files.mast_file import load_rig
    from mastctl.drift.handoffs import handoff_of
    from mastctl.recorder.what_if import WhatIf, handoffs_with, pointings_with, seen_in, write_what_if

    mast = load_rig(args.mast)
    frames = {name: frame.facts for name, frame in recording.frames.items()}
    seen, others = seen_in(recording.operations, frames)
    handoffs = [handoff_of(args.file, at, found) for at, found in enumerate(recording.handoffs, start=1)]
    what_if = WhatIf(
        recording, mast, pointings_with(mast.rig, seen), handoffs_with(mast.rig, handoffs), others
    )
    page = None if args.report is None else write_what_if(what_if, args.report)
    return Answer(what_if.as_json() | {"report": None if page is None else str(page)}, _shown(what_if, page))


def _shown(what_if: Any, page: Path | None) -> Iterator[Shown]:
    from mastctl.recorder import what_if as report

    pointings, handoffs = report.pointing_table(what_if), report.handoff_table(what_if)
    for title, table in (("pointings", pointings), ("hand-offs", handoffs)):
        if table.rows:
            yield Shown(title, table.headings, table.rows)
    summary = report.summary_table(what_if)
    notes = [*report.other_lines(what_if), *([f"report: {page}"] if page else [])]
    yield Shown(f"with {what_if.mast.path.name}", summary.headings, summary.rows, notes)
