"""The mast file that a calibration leaves: the rig, how well it fits, how sure it is, where it comes from."""

from __future__ import annotations

import platform
from collections.abc import Sequence
from dataclasses import replace
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

from calib.adjust.hypotheses import Finding
from calib.adjust.result import BenchCalibration, Calibration
from calib.files import keep_previous, previous_path
from calib.files.mast_file import StoredRig, save_rig
from calib.files.yaml_text import plain
from calib.geometry.rig import Rig
from calib.survey.records import Survey
from mastctl.as_json import as_json
from mastctl.calibration.sigmas import sigmas_as_json
from mastctl.calibration.verdict import CalibrationVerdict

DIGITS = 9
"""Significant digits of the covariance: enough that it stays positive definite."""

LIBRARIES = ("numpy", "scipy", "opencv-python-headless")


def fit_summary(
    survey: Survey, fit: Calibration | BenchCalibration, verdict: CalibrationVerdict
) -> dict[str, Any]:
    """Return what mast files and commands report of a fit, as JSON or YAML."""
    return {
        **as_json(picked(fit, "rms_px", "check_rms_px", "chi2", "degrees_of_freedom")),
        "sigma": plain(fit.sigma),
        "sigmas_found": sigmas_as_json(survey, fit),
        "verdict": verdict.as_json(),
    }


def fit_document(
    survey: Survey, fit: Calibration | BenchCalibration, verdict: CalibrationVerdict, saved: StoredRig
) -> dict[str, Any]:
    """Return what a command prints of a calibration with ``--json``."""
    summary = fit_summary(survey, fit, verdict)
    mast = fit.rig.mast
    return {
        **summary,
        "mast": as_json(picked(mast, "translation_m", "rotation_rad", "axis_offset_m", "axis_twist_rad")),
        # The mast's own keys stand at the top beside the file's two sections.
        "sigma": {**summary["sigma"]["mast"], **summary["sigma"]},
        "seconds": fit.seconds,
        "chi2_probability": as_json(fit.chi2_probability),
        "degenerate": [picked(one, "parameters", "sentence") for one in fit.degenerate],
        "notes": list(fit.notes),
        "mast_file": {"path": str(saved.path), "digest": saved.digest},
    }


def picked(record: object, *names: str) -> dict[str, Any]:
    """Return some attributes of a record as JSON."""
    return {name: as_json(getattr(record, name)) for name in names}


def findings_as_json(findings: Sequence[Finding]) -> list[dict[str, Any]]:
    """Return what hypotheses would gain."""
    keys = ("name", "sentence", "numbers", "gain", "chance", "significant", "size_px")
    return [picked(one, *keys) for one in findings]


def with_fit(fit: Calibration | BenchCalibration, survey: Survey, verdict: CalibrationVerdict) -> Rig:
    """Return the calibrated rig with ``fit`` and ``provenance`` filled in.

    ``fit.covariance`` is square, its rows and columns in the order of ``fit.parameters``: ``mast.KEY.x`` and
    ``cameras.NAME.C.x``; A and O have two each (``A.1``, ``A.2``), radians along
    `calib.geometry.parameters.tangents`.
    """
    if isinstance(fit, Calibration):
        method = picked(fit, "method", "mast_parameters")
        own: dict[str, Any] = {"needed": [model.sentence for model in fit.wider if model.significant]}
    else:
        method = {"method": "bench"}
        own = {
            "terms": [term.as_json() for term in fit.terms],
            "bows_m": as_json(fit.bows_m),
            "gauges": list(fit.gauges),
        }
    whole = {
        **method,
        **fit_summary(survey, fit, verdict),
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
