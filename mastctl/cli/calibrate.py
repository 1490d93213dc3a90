"""``mastctl calibrate``: from a survey folder to a mast file and a report, or a mast file refined."""

from __future__ import annotations

import argparse
import os
from collections.abc import Iterator
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mastctl.cli import output
from mastctl.cli.options import command, option
from mastctl.cli.output import (
    Answer,
    Shown,
    WrongUse,
    check_file,
    check_folder,
    tables_at,
    tables_of,
    unusable,
)

if TYPE_CHECKING:
    from calib.files.mast_file import StoredRig
    from calib.survey.records import Survey
    from mastctl.calibration.run import Calibrated

OUTLIERS_SHOWN = 20
TESTS_SHOWN = 4
REFINED = (
    "corrections.*.significant corrections.*.significance_sigmas corrections.*.shift_m "
    "corrections.*.turn_rad corrections.*.handoffs corrections.*.rms_px corrections.*.unseen "
    "corrections.*.outliers refusals.*.message other_mast"
)
"""What people see of a correction."""
SURVEY_FILES = ("survey.yaml", "station.csv", "images.csv", "dots.csv", "clicks.csv")


def _model(text: str) -> str:
    """Read a camera model's name (argparse ``type``)."""
    from calib.geometry.cahvor import KINDS

    if text.upper() not in KINDS:
        known = ", ".join(kind.lower() for kind in KINDS)
        raise argparse.ArgumentTypeError(f"'{text}' is not a camera model; known are {known}")
    return text.upper()


MODELS = (
    option(
        "--model MODEL",
        "camera model of all cameras: cahv, cahvor, cahvore, opencv4, opencv5, opencv8, opencv12, "
        "opencv14 or opencv_fisheye (default: as survey.yaml says)",
        type=_model,
    ),
    option(
        "--compare-models",
        "also fit each camera as other models, compare them by pictures left out of the fit, and name "
        "the one that earns its parameters",
    ),
)


@command(
    "calibrate",
    option("SURVEY", "the survey folder; with --refine the mast file"),
    option(
        "--refine HANDOFFS.jsonl",
        "record of hand-offs to correct the body cameras by; may be given several times",
        repeat=True,
    ),
    option("--out MAST.yaml", "the mast file to write", required=True),
    option("--report DIR", "folder for calibration.html"),
    option(
        "--method paper|joint",
        "paper: cameras first, then the mast; joint (default): everything together, weighted",
    ),
    option(
        "--mast 4|6|8",
        "mast parameters: 4 upright, 6 the paper's (default), 8 two skew axes",
        type=int,
        choices=(4, 6, 8),
    ),
    *MODELS,
    option("--in-use MAST.yaml", "the mast file to compare with (default: what --out was before)"),
    example="survey --out mast.yaml --report report",
    about="Reads a survey folder (docs/how-to/calibrate.md), checks it, finds dots where "
    "there are none, fits cameras and mast, and writes the mast file with its uncertainty. Every former "
    "version is kept: the last as NAME.previous.yaml, those before as NAME.previous-1.yaml and so on. "
    "With --refine it corrects the body cameras of a mast file by hand-offs instead, as a new mast file. "
    "If they show no significant correction, it writes nothing and exits with 1.",
)
def _calibrate(args: argparse.Namespace) -> Answer:
    """Read, check, find dots, fit, save, report; nothing is written before the fit is good."""
    if args.refine:
        return _refine(args)
    args.method, args.mast = args.method or "joint", args.mast or 6
    return _from_survey(args)


def _refine(args: argparse.Namespace) -> Answer:
    """Propose a correction by hand-offs as a new mast file; 1, and no file, if they show none."""
    from calib.errors import NoCorrection
    from calib.files.mast_file import load_rig
    from mastctl.calibration.refined import refine
    from mastctl.calibration.run import save_new
    from mastctl.drift.handoffs import read_log

    for name in ("model", "report", "in_use", "method", "mast"):
        if getattr(args, name) is not None:
            option = f"--{name.replace('_', '-')}"
            raise WrongUse(f"{option} belongs to a survey; --refine corrects by hand-offs alone")
    if args.out.resolve() in {path.resolve() for path in (args.survey, *args.refine)}:
        raise WrongUse(f"--out {args.out} is what is read; name another file, for the proposal")
    check_file(args.out, "--out")
    mast = load_rig(args.survey)
    for note in mast.notes:
        output.tell(note)
    document, found = refine(mast, [read_log(path) for path in args.refine])
    shown: list[str | Shown] = [
        *tables_at(document, REFINED),
        *(one["sentence"] for one in document["bias"]),
    ]
    if isinstance(found, NoCorrection):
        if not args.json:
            output.show(args, Answer(document, shown))
        raise output.CommandError(found.code, f"{found}; nothing was written", detail=document)
    saved, previous = save_new(found, args.out)
    kept = None if previous is None else str(previous)
    document["mast_file"] = {"path": str(saved.path), "digest": saved.digest, "previous": kept}
    after = f"{mast.path} is as it was; a daemon uses the new one after 'mastctl rig mast use'"
    return Answer(document, [*tables_of(document["mast_file"], "proposed mast file"), *shown, after])


def _from_survey(args: argparse.Namespace) -> Answer:
    from calib.survey.reader import read_survey
    from mastctl.calibration.run import SurveyRefused, calibrate, checked_survey, sentence_of

    survey = read_survey(args.survey)
    if args.model is not None:
        survey = survey.as_model(args.model)
    try:
        checked_survey(survey, args.method)
    except SurveyRefused as refusal:
        for finding in refusal.findings[1:]:
            output.tell(str(finding))  # the first comes last, as the reason
        raise
    _check_out(args.out, survey)
    check_folder(args.report, "--report")
    in_use = _in_use(args)
    survey, undetected = _with_dots(args, survey)
    warnings = checked_survey(survey, args.method)  # once more, with the dots that were found
    for warning in warnings:
        output.tell(f"warning: {sentence_of(warning)}")
    with output.waiting(args.json, f"fitting {len(survey.images)} images ({args.method})"):
        former = None if in_use is None else in_use.rig
        done = calibrate(survey, args.out, args.method, args.mast, warnings, undetected, args.report, former)
    models, lines = families_of(args, survey)
    return Answer(_document(done, in_use) | models, chain(_shown(done, in_use), lines))


def families_of(args: argparse.Namespace, survey: Survey) -> tuple[dict[str, Any], list[str]]:
    """Return what ``--compare-models`` adds for programs and for people."""
    if not args.compare_models:
        return {}, []
    from mastctl.calibration.run import compared_models

    with output.waiting(args.json, "comparing camera models"):
        models = compared_models(survey)
    return {"models": models}, [f"{name}: {one['sentence']}" for name, one in models.items()]


def _check_out(out: Path, survey: Survey) -> None:
    """Refuse an impossible --out before the minutes of the search, not after them."""
    check_file(out, "--out")
    try:
        target = out.resolve()
        pictures = (survey.folder / image.file for image in survey.images if image.file != Path())
        texts = (survey.folder / name for name in SURVEY_FILES)
        if target in {path.resolve() for path in (*texts, *pictures)}:
            raise unusable(f"--out {out}", "is a file of the survey itself; name another one")
    except (OSError, ValueError) as error:
        raise unusable(f"--out {out}", str(error)) from None


def _in_use(args: argparse.Namespace) -> StoredRig | None:
    """The mast file to compare with; one at --out that cannot be read is no reason to stop."""
    from calib.errors import BadFile
    from calib.files.mast_file import load_rig

    if args.in_use is not None:
        return load_rig(args.in_use)
    if not args.out.exists():
        return None
    try:
        return load_rig(args.out)
    except BadFile as error:
        output.tell(f"warning: nothing to compare with: {error}")
        return None


def _with_dots(args: argparse.Namespace, survey: Survey) -> tuple[Survey, tuple[tuple[str, str], ...]]:
    """Find dots in the images that dots.csv does not name, with a progress bar on stderr."""

    from mastctl.calibration.run import with_dots, without_dots
    from mastctl.experiment.tasks import open_executor

    count = len(without_dots(survey))
    if not count:
        return survey, ()
    workers = min(count, os.cpu_count() or 1)
    with output.progress_bar(args.json) as progress, open_executor("local", workers) as executor:
        task = progress.add_task("finding dots", total=count)
        survey, undetected = with_dots(
            survey, executor, lambda done, _, name: progress.update(task, completed=done)
        )
    for name, reason in undetected:
        output.tell(f"warning: no dots in image {name}: {reason}")
    return survey, undetected


def _document(done: Calibrated, in_use: StoredRig | None) -> dict[str, Any]:
    """The document that ``--json`` prints."""
    from calib.adjust.result import HELD_FIXED
    from mastctl.as_json import as_json
    from mastctl.calibration.landing import pointing_change
    from mastctl.calibration.run import findings_as_json, fit_document, picked

    fit = done.calibration
    document = fit_document(done.survey, fit, done.verdict, done.saved)
    document["mast_file"]["previous"] = None if done.previous is None else str(done.previous)
    document |= {
        **picked(fit, "method", "mast_parameters"),
        "survey_digest": done.survey.digest,
        "wider_models": findings_as_json(fit.wider),
        "cross_validation": findings_as_json(fit.contradictions),
        "outliers": [picked(one, "kind", "name", "sentence", "size") for one in fit.outliers],
        "held_fixed": list(HELD_FIXED),
        "warnings": as_json(done.warnings),
        "undetected": [{"image": name, "reason": reason} for name, reason in done.undetected],
        "report": None if done.page is None else str(done.page),
    }
    if in_use is not None:
        document["in_use"] = {
            "path": str(in_use.path),
            "digest": in_use.digest,
            "pointing_change": pointing_change(fit.rig, in_use.rig),
        }
    return document


def _shown(done: Calibrated, in_use: StoredRig | None) -> Iterator[Shown]:
    from mastctl.calibration.landing import pointing_change
    from mastctl.calibration.report import camera_table, finding_table, mast_table, sigma_table

    fit = done.calibration
    yield Shown(
        f"Mast ({fit.method}, {fit.mast_parameters} parameters, {fit.seconds:.1f} s)", *mast_table(fit)
    )
    yield Shown("Cameras", *camera_table(fit), fit.notes)
    if (components := sigma_table(done.survey, fit)) is not None:
        yield Shown("Measurements", *components)
    if (wider := finding_table("wider model", fit.wider, TESTS_SHOWN)) is not None:
        yield Shown("Wider models, the likeliest first", *wider)
    if (boards := finding_table("placement", fit.contradictions, TESTS_SHOWN)) is not None:
        yield Shown("Boards by the others, the least likely first", *boards)
    tables: dict[str, list[dict[str, Any]]] = {
        f"left out ({len(fit.outliers)})": [
            {"measurement": one.name, "reason": one.sentence} for one in fit.outliers[:OUTLIERS_SHOWN]
        ],
        "left open by the survey": [
            {"parameters": one.parameters[:4], "reason": one.sentence} for one in fit.degenerate
        ],
    }
    if in_use is not None:
        changes = pointing_change(fit.rig, in_use.rig)
        tables[f"pointing against {in_use.path.name}"] = [
            {"pair": name, **one} for name, one in changes.items()
        ]
    yield from tables_of({name: rows for name, rows in tables.items() if rows}, "more")
    reasons = [[reason.grade, reason.sentence] for reason in done.verdict.reasons]
    notes = [f"mast file: {done.saved.path} ({done.saved.digest[:12]})"]
    notes += [f"kept from before: {done.previous}"] if done.previous is not None else []
    notes += [f"report: {done.page}"] if done.page is not None else []
    yield Shown(f"Verdict: {done.verdict.advice}", ["", "reason"], reasons, notes)
