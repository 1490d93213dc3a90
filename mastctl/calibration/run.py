"""From a survey folder, or records of hand-offs, to a mast file; a refusal leaves every file as it was."""

from __future__ import annotations

import platform
from collections.abc import Callable, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path
from typing import Any, Literal

import numpy as np

from calib.adjust.hypotheses import Finding
from calib.adjust.result import BenchCalibration, Calibration, FittedRig
from calib.adjust.terms import ImageTerm, image_terms
from calib.adjust.uncertainty import sigma_by_key
from calib.calibrate.bench import bench_terms
from calib.calibrate.body import (
    PRIOR_SHIFT_M,
    PRIOR_TURN_RAD,
    BodyPose,
    body_groups,
    corrected_covariance,
    corrected_rig,
    fit_body_pose,
)
from calib.calibrate.families import FOLDS, compare_families, earned
from calib.calibrate.paper import fit_paper
from calib.calibrate.survey import fit_joint
from calib.errors import BadFile, CalibError, NoCorrection
from calib.files import keep_previous, previous_path
from calib.files.mast_file import StoredRig, joint_keys, save_rig
from calib.files.yaml_text import plain
from calib.geometry.covariance import stored_covariance
from calib.geometry.rig import Rig
from calib.geometry.rigid import Rigid
from calib.matching.handoff import HandoffBias, MatchedHandoff, handoff_bias
from calib.survey.check import check_survey
from calib.survey.find_dots import Progress, detect_survey
from calib.survey.records import Survey, SurveyFinding
from mastctl.as_json import as_json
from mastctl.calibration.verdict import OWN, CalibrationVerdict, judge, stated
from mastctl.drift.handoffs import ReadLog
from mastctl.errors import MastctlError

DIGITS = 9
"""Significant digits of the covariance: enough that it stays positive definite."""

LIBRARIES = ("numpy", "scipy", "opencv-python-headless")

SHIFT_FIRST = (3, 4, 5, 0, 1, 2)
"""In files and on the terminal a correction is its shift, then its turn."""

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
    calibration = _testable(FITS[method](survey, mast_parameters))
    jointly: Calibration | CalibError | None = None
    if method != "joint":
        try:
            jointly = _testable(fit_joint(survey, mast_parameters))
        except CalibError as error:
            jointly = error
    verdict = judge(survey, calibration, warnings, [name for name, _ in undetected], jointly)
    sentences = tuple(sentence_of(finding) for finding in warnings)
    rig = with_fit(calibration, survey, verdict)
    own = {"warnings": sentences, "undetected": [f"{name}: {reason}" for name, reason in undetected]}
    saved = conclude(survey, calibration, verdict, rig, out, report, former, **own)
    return Calibrated(survey, calibration, verdict, sentences, undetected, *saved)


def _testable(fit: Calibration) -> Calibration:
    """Without wider models where the survey leaves something open: what they gain there is by chance."""
    return replace(fit, wider=()) if fit.degenerate else fit


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
        sentence = f"{fitted} is right: no other model predicts left-out pictures better than chance explains"
        if best.kind != fitted:
            sentence = (
                f"{best.kind} predicts left-out pictures best: fit again with --model {best.kind.lower()}"
            )
        found[name] = {
            "fitted": fitted,
            "proposed": best.kind,
            "sentence": f"{sentence} (px: {', '.join(map(' '.join, off_px.items()))})",
            "models": [{"model": one.kind, **picked(one, "parameters", "left_out_px")} for one in scores],
        }
    return found


def sentence_of(finding: SurveyFinding) -> str:
    """Return a finding as one sentence: where, what, and what to measure next."""
    return str(finding).removeprefix(f"{finding.severity}: ")


def mast_document(saved: StoredRig) -> dict[str, Any]:
    """Return what a command prints of a calibrated mast file with ``--json``: its ``fit`` and its mast."""
    rig, large = saved.rig, ("covariance", "parameters")
    kept = {key: value for key, value in rig.fit.items() if key not in large}
    sigma = kept.get("sigma", {})
    return {
        **kept,
        "mast": picked(rig.mast, "translation_m", "rotation_rad", "axis_offset_m", "axis_twist_rad"),
        "joints": joint_keys(rig.joints),
        # The mast's own keys stand at the top beside the file's two sections.
        "sigma": {**sigma.get("mast", {}), **sigma},
        "mast_file": {"path": str(saved.path), "digest": saved.digest},
    }


def picked(record: object, *names: str) -> dict[str, Any]:
    """Return some attributes of a record as JSON."""
    return {name: as_json(getattr(record, name)) for name in names}


def findings_as_json(findings: Sequence[Finding]) -> list[dict[str, Any]]:
    """Return what hypotheses would gain."""
    keys = ("name", "sentence", "numbers", "gain", "chance", "significant", "size_px")
    return [picked(one, *keys) for one in findings]


def sigmas_as_json(survey: Survey, fit: FittedRig) -> list[dict[str, Any]]:
    """Return stated and found sigmas as JSON or YAML."""
    found = []
    for c in fit.components:
        sigma, unit, key = stated(survey, fit.images, c.kind)
        known = bool(np.isfinite(c.factor))
        found.append(
            {
                "kind": c.kind,
                "stated": sigma,
                "unit": unit,
                "key": "sigma_px" if key == OWN else f"sigma.{key}",
                "count": c.count,
                "redundancy": c.redundancy,
                "factor": c.factor if known else None,
                "factor_sigma": c.factor_sigma if known else None,
                "taken_times": c.weighed,
                "chance": c.chance,
                "small_chance": c.small_chance,
            }
        )
    return found


def with_fit(fit: Calibration | BenchCalibration, survey: Survey, verdict: CalibrationVerdict) -> Rig:
    """Return the calibrated rig with ``fit`` and ``provenance`` filled in.

    ``fit.covariance`` is square, its rows and columns in the order of ``fit.parameters``: ``mast.KEY.x`` and
    ``cameras.NAME.C.x``; A and O have two each (``A.1``, ``A.2``), radians along
    `calib.geometry.parameters.tangents`.
    """
    if isinstance(fit, Calibration):
        own = {
            **picked(fit, "method", "mast_parameters"),
            "needed": [model.sentence for model in fit.wider if model.significant],
        }
    else:
        terms = [term.as_json() for term in fit.terms]
        own = {"method": "bench", "terms": terms, **picked(fit, "bows_m", "gauges")}
    whole = {
        **picked(fit, "rms_px", "check_rms_px", "chi2", "degrees_of_freedom"),
        "sigma": plain(fit.sigma),
        "sigmas_found": sigmas_as_json(survey, fit),
        "verdict": verdict.as_json(),
        **own,
        "outliers": [outlier.name for outlier in fit.outliers],
        "degenerate": [direction.sentence for direction in fit.degenerate],
        "parameters": list(fit.parameter_names),
        "covariance": rounded_matrix(fit.covariance).tolist(),
    }
    provenance = {
        "survey": survey.folder.resolve().name,
        "survey_digest": survey.digest,
        "versions": {"python": platform.python_version(), **{name: version(name) for name in LIBRARIES}},
        **made(),
    }
    return replace(fit.rig, fit=whole, provenance=provenance)


def save_new(rig: Rig, out: Path) -> tuple[StoredRig, Path | None]:
    """Save a mast file and keep every former version; return it, and the name of the last one.

    Raises BadFile if ``out`` cannot be written; it is as it was then.
    """
    was_there = out.exists()
    kept = keep_previous(out) if was_there else None
    try:
        return save_rig(rig, out), previous_path(out) if was_there else None
    except BaseException:
        if kept is not None:
            kept.unlink(missing_ok=True)
        raise


def rounded_matrix(matrix: np.ndarray) -> np.ndarray:
    """Return a symmetric matrix with ``DIGITS`` significant digits in each number."""
    half = np.vectorize(lambda number: float(f"{number:.{DIGITS - 1}e}"))(matrix)
    return np.asarray(np.tril(half) + np.tril(half, -1).T)


def made() -> dict[str, Any]:
    """Return by which program a mast file is made, and when."""
    date = datetime.now(UTC).isoformat(timespec="seconds")
    return {"program": f"mastctl {version('mastctl')}", "date": date}


def refine(mast: StoredRig, logs: Sequence[ReadLog]) -> tuple[dict[str, Any], Rig | NoCorrection]:
    """Return the record of a refinement as JSON, and the corrected rig, or why there is none.

    Hand-offs of this very mast file are used, each once. Of each body pair the record has the correction,
    significant or not, or why there is none; the rig has every significant correction, its covariance and
    provenance, with mast and head cameras untouched.

    Raises NoCorrection ``too_few``: the mast file has no camera on the body.
    """
    groups = body_groups(mast.rig)
    if not groups:
        raise NoCorrection("too_few", f"{mast.path} has no camera on the rover's body to correct")
    every: dict[tuple[Any, ...], MatchedHandoff] = {}
    for log in logs:
        for one in log.handoffs:
            every[(one.time, one.mast_digest, one.pair, *one.clicks_px.ravel().tolist())] = one
    handoffs = tuple(one for one in every.values() if one.mast_digest == mast.digest)
    poses: dict[str, BodyPose] = {}
    refusals: dict[str, NoCorrection] = {}
    for group, cameras in groups.items():
        try:
            poses[group] = fit_body_pose(mast.rig, cameras, handoffs)
        except NoCorrection as refusal:
            refusals[group] = refusal
    other_mast = len(every) - len(handoffs)
    record = {
        "mast_file": None,
        "former": {"path": str(mast.path), "digest": mast.digest},
        "corrections": {group: _pose_as_json(pose) for group, pose in poses.items()},
        "refusals": {group: {"code": one.code, "message": str(one)} for group, one in refusals.items()},
        "bias": [_bias_as_json(one) for one in handoff_bias(handoffs)],
        "handoffs": len(handoffs),
        "other_mast": other_mast,
    }
    significant = {group: pose for group, pose in poses.items() if pose.significant}
    if significant:
        return record, _corrected(mast, significant, logs)
    sentences = [f"{group}: {one}" for group, one in refusals.items()]
    sentences += [
        f"{group}: {len(pose.used.handoffs)} hand-offs show no correction: {pose.sigmas:.1f} sigma where 3 "
        "are needed"
        for group, pose in poses.items()
    ]
    if other_mast:
        sentences.append(f"{other_mast} hand-offs were made with another mast file")
    codes = [*(one.code for one in refusals.values()), "not_significant"]
    return record, NoCorrection(codes[0], "; ".join(sentences))


def _corrected(mast: StoredRig, significant: dict[str, BodyPose], logs: Sequence[ReadLog]) -> Rig:
    rig, known = mast.rig, stored_covariance(mast.rig)
    for pose in significant.values():
        known = None if known is None else corrected_covariance(rig, known, pose)
        rig = corrected_rig(rig, pose)
    corrections = {group: _pose_as_json(pose) for group, pose in significant.items()}
    by = {
        "cameras": [name for pose in significant.values() for name in pose.cameras],
        "records": [{"file": log.path.name, "digest": log.digest} for log in logs],
        "handoffs": {group: len(pose.used.handoffs) for group, pose in significant.items()},
    }
    fit = {**mast.rig.fit, "refined": corrections}  # the rest stays as its survey left it
    if known is not None:
        fit["covariance"] = rounded_matrix(known.covariance).tolist()
        fit["sigma"] = plain(sigma_by_key(rig, known.names, known.covariance))
    before = mast.rig.provenance.get("refined", [])
    former = {"former_file": mast.path.name, "former_digest": mast.digest}
    refined = [*(before if isinstance(before, list) else [before]), {**former, **by, **made()}]
    return replace(rig, fit=fit, provenance={**mast.rig.provenance, "refined": refined})


def _bias_as_json(bias: HandoffBias) -> dict[str, Any]:
    """A camera's mean offset as JSON."""
    return {
        **picked(bias, "source", "camera", "handoffs", "left_out", "sigmas", "sentence"),
        "offset_px": bias.offset_px.tolist(),
        "sigma_px": np.sqrt(np.diag(bias.covariance_px2)).tolist(),
    }


def _pose_as_json(pose: BodyPose) -> dict[str, Any]:
    """A correction as JSON or YAML; the shift is of the origin, the turn about it, rover axes."""
    return {
        **picked(pose, "cameras", "origin_m", "chance", "chi2_before", "chi2_after", "degrees_of_freedom"),
        "shift_m": pose.step[3:].tolist(),
        "turn_rad": pose.step[:3].tolist(),
        "covariance": rounded_matrix(pose.covariance[np.ix_(SHIFT_FIRST, SHIFT_FIRST)]).tolist(),
        "prior_sigma": {"shift_m": PRIOR_SHIFT_M, "turn_rad": PRIOR_TURN_RAD},
        "significant": pose.significant,
        "significance_sigmas": pose.sigmas,
        "handoffs": len(pose.used.handoffs),
        "outliers": [one.sentence for one in pose.outliers],
        "rms_px": {
            name: {"before": list(before), "after": list(after)}
            for name, (before, after) in pose.rms_px.items()
        },
        "directions_seen": pose.seen,
        "unseen": list(pose.unseen),
    }
