"""``mastctl experiment calibration``: how good a survey must be."""

from __future__ import annotations

import argparse
import time
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mastctl.cli import output

if TYPE_CHECKING:
    from mastctl.experiment.calibration import CalibrationExperiment

DEFAULT_SURVEYS = 10
DEFAULT_TARGETS = 20


def add_parser(kinds: Any) -> None:
    """Add ``calibration`` to the experiments."""
    from mastctl.cli.experiment_common import add_run_options, at_least_one
    from mastctl.cli.tasks import add_task_options

    parser = kinds.add_parser(
        "calibration",
        help="simulated surveys, larger and smaller, better and worse: what pointing by them is worth",
    )
    parser.add_argument(
        "--rig", type=Path, metavar="MAST.yaml", help="the true rig (default: the packaged simulated rover's)"
    )
    parser.add_argument(
        "--surveys", type=at_least_one, default=DEFAULT_SURVEYS, metavar="N",
        help="surveys of each kind (default 10, some 6 minutes on two processors)",
    )  # fmt: skip
    parser.add_argument(
        "--targets", type=at_least_one, default=DEFAULT_TARGETS, metavar="N",
        help="targets of each survey at each distance (default 20)",
    )  # fmt: skip
    parser.add_argument(
        "--study", action="append", metavar="NAME",
        choices=("placements", "boards", "station", "prisms", "hazcam", "mast"),
        help="placements, boards, station, prisms, hazcam or mast; may be given several times (default: all)",
    )  # fmt: skip
    add_run_options(parser, "of everything random", "folder for report.html, surveys.csv and record.json")
    add_task_options(parser)
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Run the study; 1 if no survey at all could be fitted."""
    from calib.files.mast_file import load_rig
    from mastctl.cli.places import check_folder
    from mastctl.cli.tasks import results_of
    from mastctl.experiment.calibration import CalibrationExperiment, survey_tasks
    from mastctl.experiment.calibration_survey import one_survey
    from mastctl.experiment.calibration_variants import variants
    from mastctl.packaged import config_folder

    rig = load_rig(args.rig or config_folder() / "sim" / "rocky8.yaml").rig
    if "navcam" not in rig.stereo:
        raise output.CommandError(
            "no_navcam", "the rig has no stereo pair navcam, which the study clicks in", exit_code=2
        )
    check_folder(args.out, "--out")
    chosen = [v for v in variants() if args.study is None or v.study.startswith(tuple(args.study))]
    begun_s = time.monotonic()
    outcomes = results_of(
        args,
        "surveys",
        one_survey,
        survey_tasks(rig, surveys=args.surveys, targets=args.targets, seed=args.seed, chosen=chosen),
        lambda task: f"{task.variant.study} {task.variant.label}, survey {task.seed[1]}",
        lambda outcome: outcome.failure,
    )
    if outcomes is None:
        return 0
    seconds = time.monotonic() - begun_s
    return _tell(args, CalibrationExperiment(rig, args.seed, args.surveys, tuple(outcomes), seconds))


def _tell(args: argparse.Namespace, experiment: CalibrationExperiment) -> int:
    from mastctl.cli.experiment_common import tell_report
    from mastctl.experiment.calibration_report import (
        short_rows,
        study_as_json,
        table_iv,
        table_v,
        write_study_report,
    )

    def show(notes: list[str]) -> None:
        mast = table_iv(experiment)
        if len(mast.rows) > 1:
            output.print_table("Table IV, mast parameters", *mast.turned())
            output.print_table("Table V, rms residuals of the mast's images, px", *table_v(experiment))
        output.print_table("Errors, px: rms an axis, and worst", *short_rows(experiment.summaries), notes)

    tell_report(args, partial(write_study_report, experiment), lambda: study_as_json(experiment), show)
    return 0 if any(not outcome.failure for outcome in experiment.outcomes) else 1
