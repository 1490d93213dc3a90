"""From a survey folder to a saved mast file; a refusal on the way leaves every file as it was."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

from calib.adjust.result import BenchCalibration, Calibration
from calib.adjust.terms import ImageTerm, image_terms
from calib.calibrate.bench import bench_terms
from calib.calibrate.families import FOLDS, compare_families, earned
from calib.calibrate.paper import fit_paper
from calib.calibrate.survey import fit_joint
from calib.errors import BadFile, CalibError
from calib.files.mast_file import StoredRig
from calib.geometry.rig import Rig
from calib.geometry.rigid import Rigid
from calib.survey.check import check_survey
from calib.survey.find_dots import Progress, detect_survey
from calib.survey.records import Survey, SurveyFinding
from mastctl.calibration.mast_file import save_new, with_fit
from mastctl.calibration.verdict import CalibrationVerdict, judge
from mastctl.errors import MastctlError

Method = Literal["paper", "joint"]

FITS: dict[Method, Callable[[Survey, int], Calibration]] = {"paper": fit_paper, "joint": fit_joint}


class SurveyRefused(MastctlError):
    """A survey that cannot be fitted as it is; ``detail`` holds every finding of the check."""

    code = "survey_refused"
    exit_code = 2

    def __init__(self, survey: Survey, findings: Sequence[SurveyFinding]) -> None:
        errors = [finding for finding in findings if finding.severity == "error"]
        self.findings = tuple(findings)
        keys = "severity", "place", "message", "advice"
        self.detail = {"findings": [{key: getattr(one, key) for key in keys} for one in findings]}
        more = f" There are {len(errors) - 1} more errors." if len(errors) > 1 else ""
        super().__init__(f"{survey.folder}: {sentence_of(errors[0])}{more}")


class NotReported(MastctlError):
    """The mast file is saved, its report is not."""

    code = "report_not_written"


@dataclass(frozen=True, eq=False)
class Calibrated:
    """The result of a survey: the fit, the verdict, the file with its former version, and the report."""

    survey: Survey
    calibration: Calibration
    verdict: CalibrationVerdict
    warnings: tuple[str, ...]
    undetected: tuple[tuple[str, str], ...]
    saved: StoredRig
    previous: Path | None
    page: Path | None


def without_dots(survey: Survey) -> tuple[str, ...]:
    """Return the names of images with a file whose dots are not known."""
    return tuple(i.name for i in survey.images if i.name not in survey.dots and i.file != Path())


def with_dots(
    survey: Survey, executor: Executor, progress: Progress | None = None
) -> tuple[Survey, tuple[tuple[str, str], ...]]:
    """Return the survey with the dots of every image that shows them, and (image, reason) of the others.

    ``progress`` is called after each image: how many are done, of how many, and its name.
    """
    clicked = {click.image for click in survey.clicks}  # a picture of a check point need not show a board
    found = detect_survey(survey, executor, progress)
    failures = [(name, reason) for name, reason in found.failures.items() if name not in clicked]
    return replace(survey, dots=found.dots), tuple(failures)


def checked_survey(survey: Survey, method: Method = "joint") -> tuple[SurveyFinding, ...]:
    """Return the warnings of the check; ``method`` decides which images have to show a camera.

    Raises SurveyRefused if the check found an error.
    """
    findings = check_survey(survey, only_camera_images=method == "paper")
    if any(finding.severity == "error" for finding in findings):
        raise SurveyRefused(survey, findings)
    return findings


def calibrate(
    survey: Survey,
    out: Path,
    method: Method = "joint",
    mast_parameters: int = 6,
    warnings: tuple[SurveyFinding, ...] = (),
    undetected: tuple[tuple[str, str], ...] = (),
    report: Path | None = None,
    former: Rig | None = None,
) -> Calibrated:
    """Fit a checked survey with its dots, judge the result, and save it as a mast file.

    Every former version of ``out`` is kept, the last as ``NAME.previous.yaml``. ``warnings`` and
    ``undetected``, from the check and from the search for dots, are for the verdict; ``report`` is a folder,
    ``former`` the rig to compare with there. Raises SurveyNotFitted if the fit finds no good minimum: nothing
    is written; else as `conclude`.
    """
    calibration = FITS[method](survey, mast_parameters)
    jointly: Calibration | CalibError | None = None
    if method != "joint":
        try:
            jointly = fit_joint(survey, mast_parameters)
        except CalibError as error:
            jointly = error
    verdict = judge(survey, calibration, warnings, [name for name, _ in undetected], jointly)
    sentences = tuple(sentence_of(finding) for finding in warnings)
    rig = with_fit(calibration, survey, verdict)
    own = {"warnings": sentences, "undetected": [f"{name}: {reason}" for name, reason in undetected]}
    saved = conclude(survey, calibration, verdict, rig, out, report, former, **own)
    return Calibrated(survey, calibration, verdict, sentences, undetected, *saved)


def conclude(
    survey: Survey,
    fit: Calibration | BenchCalibration,
    verdict: CalibrationVerdict,
    rig: Rig,
    out: Path,
    report: Path | None,
    former: Rig | None,
    **own: Any,
) -> tuple[StoredRig, Path | None, Path | None]:
    """Save a judged fit's rig as a mast file, and write its report if a folder is given for it.

    Returns the file, the name of its former version, and the page; ``own`` as of `write_report`. Raises
    BadFile if ``out`` cannot be written: it holds what it held before; NotReported.
    """
    saved, previous = save_new(rig, out)
    if report is None:
        return saved, previous, None
    from mastctl.calibration.report import write_report

    try:
        return saved, previous, write_report(report, survey, fit, verdict, saved, former, **own)
    except (OSError, BadFile) as error:
        raise NotReported(f"the mast file {saved.path} is saved, but its report is not: {error}") from None


def compared_models(survey: Survey) -> dict[str, Any]:
    """Return for each camera the model that it earns, with a sentence, and how well each predicts.

    That is by pictures left out of a fit; a camera of fewer than five images with points has none.
    """
    terms: Sequence[ImageTerm]
    if survey.boards:
        terms = bench_terms(survey, [])[0]
    else:
        anywhere = {(image.setup, image.placement): Rigid.identity() for image in survey.images}
        terms = image_terms(survey, anywhere, [])[0]
    found = {}
    for name, camera in survey.cameras.items():
        mine, fitted = [term for term in terms if term.camera == name], camera.kind
        scores = compare_families(mine, camera.size_px, camera.focal_px) if len(mine) >= FOLDS else ()
        if not scores:
            continue
        best = earned(scores, fitted)
        off_px = {one.kind: f"{one.left_out_px:.3f}" for one in scores}
        if best.kind == fitted:
            sentence = (
                f"{fitted} is right: no other model predicts left-out pictures better than chance explains"
            )
        else:
            before = f"{off_px[fitted]} px" if fitted in off_px else "no prediction"
            sentence = (
                f"{best.kind} predicts left-out pictures to {off_px[best.kind]} px, {fitted} to {before}: "
                f"fit again with --model {best.kind.lower()}"
            )
        found[name] = {
            "fitted": fitted,
            "proposed": best.kind,
            "sentence": f"{sentence} (px: {', '.join(map(' '.join, off_px.items()))})",
            "models": [
                {"model": one.kind, "parameters": one.parameters, "left_out_px": one.left_out_px}
                for one in scores
            ],
        }
    return found


def sentence_of(finding: SurveyFinding) -> str:
    """Return a finding as one sentence: where, what, and what to measure next."""
    return str(finding).removeprefix(f"{finding.severity}: ")
