"""The paper's hand-offs (section V) on a daemon, or on the packaged simulated rover, and their errors.

    .venv/bin/python -m tools.studies.handoff --simulated --targets 20 --out handed

Targets are handed from Pancam to Navcam at 6 m and on to Hazcam at 2 m. ``--out`` gets a page, the tables,
and handoffs.jsonl, by which ``mastctl calibrate --refine`` corrects body cameras.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np

from calib.files.mast_file import load_rig
from calib.geometry.rigid import FloatArray
from drivers.sim.rover import SimulatedRover
from mastctl.cli import output
from mastctl.cli.output import check_folder
from mastctl.cli.service import add_daemon_options, client_of, refuse_daemon_options
from mastctl.cli.tasks import refuse_task_options, run_bar, tell_report
from mastctl.client import Client
from mastctl.config import load_config
from mastctl.devices.frames import camera_and_sequence
from mastctl.experiment.simulated import Rover, SimulationTruth, running_rover
from tools.command import end, options, run_cases
from tools.studies.handoff_record import HandoffExperiment, HandoffRecord, summarise_handoffs
from tools.studies.handoff_report import bias_sentences, handoff_table, write_handoff_report
from tools.studies.handoff_run import STEPS, KnownPoint, run_handoff_experiment

PICTURES_PER_STEP = 4
TARGETS = {"ground": "textured ground", "corner": "bricks' corners", "face": "middles of bricks' faces"}
MOST_BRICKS = 24  # what a scene takes
MOST_POINTS = 9  # of one brick: its upper corners and its faces but the bottom
HIDDEN_M = 0.003
"""What stands before a point by less does not hide it: a ray at a corner meets the brick there or passes."""


class BrickPoints:
    """Corners and middles of faces of the simulated rover's bricks."""

    def __init__(self, rover: SimulatedRover) -> None:
        self._rover = rover

    def points(self) -> Sequence[KnownPoint]:
        """See `tools.studies.handoff_run.KnownPoints`."""
        rover_from_site = self._rover.site_from_rover.inverse
        found = []
        for group, brick in enumerate(self._rover.scene.bricks):
            # the corners at the bottom are in the ground
            for kind, places in (("corner", brick.corners_m[:4]), ("face", brick.faces_m)):
                found += [KnownPoint(kind, group, one) for one in np.asarray(rover_from_site.points(places))]
        return found

    def seen_px(self, frame_id: str, position_m: FloatArray) -> tuple[float, float] | None:
        """See `tools.studies.handoff_run.KnownPoints`."""
        truth = self._rover.frame_truth(*camera_and_sequence(frame_id))
        camera = truth.camera_in_rover
        pixel, valid = camera.project(position_m)
        if not valid or not camera.holds(pixel):
            return None
        ray = camera.ray(pixel)
        met_m = self._rover.scene.cast(
            truth.site_from_rover.points(ray.origins_m), truth.site_from_rover.vectors(ray.directions)
        )
        if float(met_m) < float(np.linalg.norm(position_m - ray.origins_m)) - HIDDEN_M:
            return None
        return float(pixel[0]), float(pixel[1])


@dataclass(frozen=True)
class HandoffTask:
    """One target of a hand-off from a pair; with bricks, all of them, ``targets`` at most."""

    rover: Rover
    source: str
    index: int
    click_px: float
    targets: int = 1
    pictures: int = 0


def one_handoff(task: HandoffTask) -> HandoffExperiment:
    """Hand over one target, or all bricks of a step, on a rover of its own."""
    with running_rover(task.rover) as (_, client, rover):
        return run_handoff_experiment(
            client,
            targets=task.targets,
            seed=task.rover.seed,
            click_px=task.click_px,
            truth=SimulationTruth(rover),
            points=BrickPoints(rover) if task.rover.bricks else None,
            pictures=task.pictures,
            first=task.index,
            chosen=(task.source,),
        )


def joined_handoffs(parts: Sequence[HandoffExperiment]) -> HandoffExperiment:
    """Return one experiment of many; its time is that of all targets one after another."""
    records = [record for part in parts for record in part.records]
    cameras = dict.fromkeys((row.step, row.camera) for part in parts for row in part.summaries)
    kinds = dict.fromkeys(record.kind for record in records)
    summaries = [
        summarise_handoffs(step, kind, camera, records)
        for step in dict.fromkeys(step for step, _ in cameras)
        for kind in kinds
        for of_step, camera in cameras
        if of_step == step
    ]
    return replace(
        parts[0],
        records=tuple(records),
        summaries=tuple(summaries),
        seconds=sum(part.seconds for part in parts),
    )


def main(words: Sequence[str] | None = None) -> int:
    """Run the experiment; 1 if no target at all was handed over."""
    parser = options(__doc__, as_json=True)
    add_daemon_options(parser)
    parser.add_argument(
        "--simulated", action="store_true",
        help="on the packaged simulated rover, a fresh one for each target, compared with the truth",
    )  # fmt: skip
    parser.add_argument(
        "--mast-file", type=Path, metavar="MAST.yaml",
        help="with --simulated: the mast file that its daemon uses (default: the packaged one)",
    )  # fmt: skip
    parser.add_argument(
        "--targets", type=output.at_least(1), metavar="N",
        help="targets of each hand-off (default 10, with --bricks all that show)",
    )  # fmt: skip
    parser.add_argument(
        "--bricks", type=output.at_least(1), metavar="N",
        help="put N bricks (at most 24) into the simulation, by turns at 2 m and at 6 m; their corners and "
        "the middles of their faces are the targets",
    )  # fmt: skip
    parser.add_argument(
        "--click-px", type=output.not_negative, default=0.2, metavar="PX",
        help="sigma of the noise added to the clicks (default 0.2)",
    )  # fmt: skip
    parser.add_argument(
        "--out", type=Path, metavar="DIR",
        help="folder for report.html, targets.csv, handoffs.jsonl and record.json",
    )  # fmt: skip
    args = parser.parse_args(words)
    if args.mast_file is not None and not args.simulated:
        raise output.WrongUse("--mast-file belongs to --simulated; a running daemon has its own mast file")
    if args.bricks is not None and not (args.simulated and args.bricks <= MOST_BRICKS):
        raise output.WrongUse(f"--bricks {args.bricks}: 1 to {MOST_BRICKS} are possible, with --simulated")
    check_folder(args.out, "--out")
    if args.simulated:
        return _tell(args, _simulated(args))
    refuse_task_options(args)
    with client_of(args) as client:
        return _tell(args, _on_daemon(args, client))


def _simulated(args: argparse.Namespace) -> HandoffExperiment:
    """Run each target on a simulated rover of its own; bricks, all of a step on one."""
    refuse_daemon_options(args)
    stereo = load_rig(args.mast_file or load_config(None).mast_file).rig.stereo
    sources = [source for source, to, _ in STEPS if {source, to} <= set(stereo)]
    if not sources:
        raise output.CommandError(
            "no_handoff", f"{args.mast_file} has neither pancam and navcam nor navcam and hazcam pairs"
        )
    mast_file = None if args.mast_file is None else args.mast_file.read_bytes()
    rover = Rover("ptu_d46_70", args.seed, args.bricks or 0, mast_file)
    shown = PICTURES_PER_STEP if args.out is not None else 0
    if args.bricks:
        most = args.targets or MOST_POINTS * args.bricks
        tasks = [HandoffTask(rover, source, 0, args.click_px, most, shown) for source in sources]
    else:
        tasks = [
            HandoffTask(rover, source, index, args.click_px, pictures=int(index < shown))
            for source in sources
            for index in range(args.targets or 10)
        ]
    parts = run_cases(
        args,
        "hand-off",
        one_handoff,
        tasks,
        lambda task: f"from {task.source}, " + ("all bricks" if args.bricks else f"target {task.index}"),
        failure=lambda part: next((record.error for record in part.records if record.error), ""),
    )
    return joined_handoffs(parts)


def _on_daemon(args: argparse.Namespace, client: Client) -> HandoffExperiment:
    """Run on a running daemon, with a progress bar on stderr, one step a target."""
    targets = args.targets or 10
    with run_bar(args, "hand-off", targets * len(STEPS)) as step:

        def show(record: HandoffRecord) -> None:
            where = f"{record.step}, target {record.index}"
            step(record.step, record.error and f"{where}: {record.error}")

        return run_handoff_experiment(
            client,
            targets=targets,
            seed=args.seed,
            click_px=args.click_px,
            on_target=show,
            pictures=PICTURES_PER_STEP if args.out is not None else 0,
        )


def _tell(args: argparse.Namespace, experiment: HandoffExperiment) -> int:
    def show(notes: list[str]) -> None:
        noise = f"clicks with {experiment.click_px:g} px of noise; lengths in px of the destination camera"
        kinds = list(dict.fromkeys(row.kind for row in experiment.summaries))
        if not kinds:
            sys.stdout.write("\n".join(["no target was found to hand over", *notes]) + "\n")
        for kind in kinds:
            table = handoff_table([row for row in experiment.summaries if row.kind == kind])
            title = f"Hand-off errors of {TARGETS[kind]}, px ({experiment.status.get('hardware')} hardware)"
            last = [noise, *bias_sentences(experiment), *notes] if kind == kinds[-1] else []
            output.print_table(title, *table.turned(), last)

    tell_report(args, partial(write_handoff_report, experiment), experiment.as_json, show)
    return 0 if any(record.handed for record in experiment.records) else 1


if __name__ == "__main__":
    end(main)
