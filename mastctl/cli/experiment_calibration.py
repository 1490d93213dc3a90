"""``mastctl experiment calibration``: how good a survey must be."""

from __future__ import annotations

import argparse
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mastctl.cli import output

if TYPE_CHECKING:
    from mastctl.experiment.calibration import CalibrationExperiment
    from mastctl.experiment.calibration_survey import SurveyOutcome
    from mastctl.experiment.calibration_variants import Variant

DEFAULT_SURVEYS = 10
DEFAULT_TARGETS = 20


def add_parser(kinds: Any) -> None:
    """Add ``calibration`` to the experiments."""
    from mastctl.cli.experiment_common import add_run_options, at_least_one

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
    parser.add_argument(
        "--executor", default="local", metavar="WHERE",
        help="local: processes of this machine (default); dask:ADDRESS: a Dask cluster",
    )  # fmt: skip
    parser.add_argument(
        "--workers", type=at_least_one, metavar="N", help="local processes (default: one a processor)"
    )
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Run the study; 1 if no survey at all could be fitted."""
    from calib.files.mast_file import load_rig
    from mastctl.cli.places import check_folder
    from mastctl.experiment.calibration_variants import variants
    from mastctl.packaged import config_folder

    rig = load_rig(args.rig or config_folder() / "sim" / "rocky8.yaml").rig
    if "navcam" not in rig.stereo:
        raise output.CommandError(
            "no_navcam", "the rig has no stereo pair navcam, which the study clicks in", exit_code=2
        )
    check_folder(args.out, "--out")
    chosen = [v for v in variants() if args.study is None or v.study.startswith(tuple(args.study))]
    experiment = _run(args, rig, chosen)
    return _tell(args, experiment)


def _run(args: argparse.Namespace, rig: Any, chosen: list[Variant]) -> CalibrationExperiment:
    """Run with a progress bar on stderr, one step a survey."""

    from mastctl.cli.experiment_common import run_bar
    from mastctl.experiment.calibration import run_calibration_experiment
    from mastctl.experiment.executors import open_executor

    with (
        open_executor(args.executor, args.workers) as executor,
        run_bar(args, "surveys", len(chosen) * args.surveys) as step,
    ):

        def done(outcome: SurveyOutcome) -> None:
            variant = outcome.variant
            step("", outcome.failure and f"{variant.study} {variant.label}: {outcome.failure}")

        return run_calibration_experiment(
            rig,
            surveys=args.surveys,
            targets=args.targets,
            seed=args.seed,
            executor=executor,
            chosen=chosen,
            done=done,
        )


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
