"""``mastctl record``: inspect, repair and replay recordings; `mastctl.cli.requests` has the rest."""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Iterator, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

from mastctl.cli.daemon import queue_output
from mastctl.cli.options import command, option
from mastctl.cli.output import Answer, Shown, WrongUse, tables_of
from mastctl.cli.service import LISTEN, serve_config

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
    from mastctl import signals
    from mastctl.config import load_config
    from mastctl.recorder.recorded import read_whole, replay_files

    queue_output()
    with tempfile.TemporaryDirectory(prefix="mastctl-replay-") as folder:
        path = replay_files(read_whole(args.file), Path(folder), {})
        with suppress(KeyboardInterrupt), signals.raised():
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
