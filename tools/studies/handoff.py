"""The paper's hand-offs (section V) on a daemon, or on the packaged simulated rover, and their errors.

    .venv/bin/python -m tools.studies.handoff --simulated --targets 20 --out handed

Targets are handed from Pancam to Navcam at 6 m and on to Hazcam at 2 m. ``--out`` gets handoffs.jsonl, by
which ``mastctl calibrate --refine`` corrects body cameras.
"""

from __future__ import annotations

import argparse
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from calib.files.mast_file import load_rig
from calib.matching.handoff import handoff_bias
from mastctl.cli import output
from mastctl.cli.daemon import DAEMON, client_of
from mastctl.cli.experiment import run_bar
from mastctl.cli.options import add_options, at_least
from mastctl.cli.output import check_folder
from mastctl.client import Client
from mastctl.config import load_config
from mastctl.drift.handoffs import handoff_log, line_of
from mastctl.experiment.simulated import Rover, running_rover, simulation_truth
from tools.command import end, options, results_of, show
from tools.studies.handoff_run import STEPS, HandoffRecord, run_handoff_experiment

PAPER_WORST_PX: Mapping[str, float] = {"pancam to navcam": 2.5, "navcam to hazcam": 4.0}
"""The paper's worst geometric hand-off, Pancam to Navcam at 6 m and Navcam to Hazcam at 2 m."""

COLUMNS = {
    "hand-off": "{step}", "camera": "{camera}", "targets": "{targets}",
    "failed": "{failed}",
    "geometric rms x, y": "{geometric_rms_px[0]:.2f}, {geometric_rms_px[1]:.2f}",
    "bias x, y": "{geometric_bias_px[0]:.2f}, {geometric_bias_px[1]:.2f}",
    "worst": "{geometric_worst_px:.2f}",
    "refined": "{accepted}", "rms": "{refined_rms_px:.2f}", "worst refined": "{refined_worst_px:.2f}",
    "paper worst": "{paper_worst_px:g}",
}  # fmt: skip


@dataclass(frozen=True)
class HandoffTask:
    """One target of a hand-off from a pair."""

    rover: Rover
    source: str
    index: int


def one_handoff(task: HandoffTask) -> list[HandoffRecord]:
    """Hand over one target on a rover of its own."""
    with running_rover(task.rover) as (_, client, rover):
        return run_handoff_experiment(
            client,
            targets=1,
            seed=task.rover.seed,
            truth=simulation_truth(rover),
            first=task.index,
            chosen=(task.source,),
        )


def handoff_rows(records: Sequence[HandoffRecord]) -> list[dict[str, Any]]:
    """Return the table's rows: one for each step and camera; lengths in pixels."""
    groups: dict[str, list[HandoffRecord]] = {}
    for record in records:
        groups.setdefault(record.step, []).append(record)
    rows = []
    for step, mine in groups.items():
        for camera in dict.fromkeys(one.camera for record in mine for one in record.handed) or [""]:
            seen = [one for record in mine for one in record.handed if one.camera == camera]
            geometric = _lengths([one.geometric_error_px for one in seen])
            refined = _lengths([one.refined_error_px for one in seen])
            verdicts = Counter(one.refined.verdict for one in seen)
            rows.append(
                {
                    "step": step,
                    "camera": camera,
                    "targets": len(mine),
                    "failed": sum(bool(record.error) for record in mine),
                    "geometric_rms_px": geometric[0],
                    "geometric_bias_px": geometric[1],
                    "geometric_worst_px": geometric[2],
                    "accepted": verdicts["accepted"],
                    "verdicts": dict(verdicts),
                    "refined_rms_px": None if refined[0] is None else float(np.hypot(*refined[0])),
                    "refined_worst_px": refined[2],
                    "paper_worst_px": PAPER_WORST_PX.get(step),
                }
            )
    return rows


def write_handoffs(folder: Path, records: Sequence[HandoffRecord]) -> None:
    """Write handoffs.jsonl into ``folder`` (made if need be)."""
    folder.mkdir(parents=True, exist_ok=True)
    log = handoff_log(folder / "handoffs.jsonl")
    log.path.unlink(missing_ok=True)
    for record in records:
        if record.matched is not None:
            log.append(line_of(record.matched))


def bias_sentences(records: Sequence[HandoffRecord]) -> list[str]:
    """Return the constant offsets of three sigma and more as sentences, and their remedy."""
    biases = handoff_bias([record.matched for record in records if record.matched is not None])
    found = [one.sentence for one in biases if one.significant]
    return [*found, "mastctl calibrate --refine corrects body cameras by handoffs.jsonl"] if found else []


def main(words: Sequence[str] | None = None) -> int:
    """Run the experiment; 1 if no target at all was handed over."""
    parser = options(__doc__, as_json=True)
    add_options(parser, *DAEMON)
    parser.add_argument(
        "--simulated", action="store_true",
        help="on the packaged simulated rover, a fresh one for each target, compared with the truth",
    )  # fmt: skip
    parser.add_argument(
        "--mast-file", type=Path, metavar="MAST.yaml",
        help="with --simulated: the mast file that its daemon uses (default: the packaged one)",
    )  # fmt: skip
    parser.add_argument(
        "--targets", type=at_least(1), metavar="N",
        default=10, help="targets of each hand-off (default 10)",
    )  # fmt: skip
    parser.add_argument("--out", type=Path, metavar="DIR", help="folder for handoffs.jsonl")
    args = parser.parse_args(words)
    if args.mast_file is not None and not args.simulated:
        raise output.WrongUse("--mast-file belongs to --simulated; a running daemon has its own mast file")
    check_folder(args.out, "--out")
    if args.simulated:
        return _report(args, _simulated(args))
    with client_of(args) as client:
        return _report(args, _on_daemon(args, client))


def _simulated(args: argparse.Namespace) -> list[HandoffRecord]:
    """Run each target on a simulated rover of its own."""
    stereo = load_rig(args.mast_file or load_config(None).mast_file).rig.stereo
    sources = [source for source, to, _ in STEPS if {source, to} <= set(stereo)]
    if not sources:
        raise output.CommandError(
            "no_handoff", f"{args.mast_file} has neither pancam and navcam nor navcam and hazcam pairs"
        )
    mast_file = None if args.mast_file is None else args.mast_file.read_bytes()
    rover = Rover("ptu_d46_70", args.seed, mast_file)
    tasks = [HandoffTask(rover, source, index) for source in sources for index in range(args.targets)]
    parts = results_of(
        args, "hand-off", one_handoff, tasks, "from {0.source}, target {0.index}".format,
        failure=lambda part: next((record.error for record in part if record.error), ""),
    )  # fmt: skip
    return [record for part in parts for record in part]


def _on_daemon(args: argparse.Namespace, client: Client) -> list[HandoffRecord]:
    """Run on a running daemon, with a progress bar on stderr, one step a target."""
    with run_bar(args, "hand-off", args.targets * len(STEPS)) as step:

        def step_done(record: HandoffRecord) -> None:
            step(record.step, record.error and f"{record.step}, target {record.index}: {record.error}")

        return run_handoff_experiment(client, targets=args.targets, seed=args.seed, on_target=step_done)


def _report(args: argparse.Namespace, records: Sequence[HandoffRecord]) -> int:
    if args.out is not None:
        write_handoffs(args.out, records)
    rows = handoff_rows(records)
    if rows:
        rows[-1]["notes"] = bias_sentences(records)
    show(args, rows, COLUMNS, "notes")
    return 0 if any(record.handed for record in records) else 1


def _lengths(
    errors_px: Iterable[tuple[float, float] | None],
) -> tuple[tuple[float, float], tuple[float, float], float] | tuple[None, None, None]:
    """Rms and mean (x, y) of the errors that exist, and the longest; None without any."""
    errors = np.array([error for error in errors_px if error is not None])
    if not len(errors):
        return None, None, None
    rms, mean = np.sqrt(np.mean(errors**2, axis=0)), errors.mean(axis=0)
    worst = float(np.linalg.norm(errors, axis=1).max())
    return (float(rms[0]), float(rms[1])), (float(mean[0]), float(mean[1])), worst


if __name__ == "__main__":
    end(main)
