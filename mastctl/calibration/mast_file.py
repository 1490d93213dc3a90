"""The mast file that a calibration leaves: the rig, how well it fits, how sure it is, where it comes from."""

from __future__ import annotations

import platform
from collections.abc import Mapping
from dataclasses import replace
from datetime import UTC, datetime
from importlib.metadata import version
from types import MappingProxyType
from typing import Any

import numpy as np

from calib.adjust.result import BenchCalibration, Calibration
from calib.adjust.uncertainty import sigma_by_key
from calib.files.mast_file import StoredRig
from calib.files.yaml_text import plain
from calib.geometry.covariance import RigCovariance
from calib.geometry.rig import Rig
from calib.survey.records import Survey
from mastctl.calibration.tested import components_told, finite

DIGITS = 9
"""Significant digits of the covariance: enough that it stays positive definite."""


def with_fit(
    calibration: Calibration | BenchCalibration,
    survey: Survey,
    method: Mapping[str, Any],
    own: Mapping[str, Any],
    versions: Mapping[str, Any],
) -> Rig:
    """Return the calibrated rig with ``fit`` and ``provenance`` filled in.

    ``fit.covariance`` is square, its rows and columns in the order of ``fit.parameters``: ``mast.KEY.x`` and
    ``cameras.NAME.C.x``; A and O have two each (``A.1``, ``A.2``), radians along
    `calib.geometry.parameters.tangents`.

    Parameters
    ----------
    calibration, survey
        What came of what.
    method, own
        What stands first under ``fit``, and what a method has of its own there.
    versions
        What else the provenance says of the program.
    """
    fit = {
        **method,
        "rms_px": as_lists(calibration.rms_px),
        "check_rms_px": as_lists(calibration.check_rms_px),
        "sigma": plain(calibration.sigma),
        "chi2": finite(calibration.chi2),
        "degrees_of_freedom": finite(calibration.degrees_of_freedom),
        "sigmas_found": components_told(survey, calibration),
        **own,
        "parameters": list(calibration.parameter_names),
        "covariance": rounded_matrix(calibration.covariance).tolist(),
    }
    provenance = {
        "survey": survey.folder.resolve().name,
        "survey_digest": survey.digest,
        **_made(versions),
    }
    return replace(calibration.rig, fit=fit, provenance=provenance)


def with_survey_fit(calibration: Calibration, survey: Survey, verdict: Mapping[str, Any]) -> Rig:
    """Return `with_fit` of a survey's calibration."""
    libraries = ("numpy", "scipy", "opencv-python-headless")
    return with_fit(
        calibration,
        survey,
        {"method": calibration.method, "mast_parameters": calibration.mast_parameters},
        {
            "asked_for": [model.sentence for model in calibration.wider if model.significant],
            "outliers": [outlier.name for outlier in calibration.outliers],
            "degenerate": [direction.sentence for direction in calibration.degenerate],
            "verdict": dict(verdict),
        },
        {"versions": {"python": platform.python_version(), **{name: version(name) for name in libraries}}},
    )


def with_correction(
    mast: StoredRig,
    rig: Rig,
    known: RigCovariance | None,
    corrected: Mapping[str, Any],
    by: Mapping[str, Any],
) -> Rig:
    """Return a corrected rig with ``fit`` and ``provenance`` that say by what it was corrected.

    What else the former file has under ``fit`` stays as its survey left it.

    Parameters
    ----------
    mast, rig
        The file that was corrected, and the corrected rig.
    known
        The corrected rig's covariance; None where the former file has none.
    corrected, by
        What stands under ``fit`` besides, and in the provenance's list of corrections.
    """
    fit = {**mast.rig.fit, **corrected}
    if known is not None:
        fit["covariance"] = rounded_matrix(known.covariance).tolist()
        fit["sigma"] = plain(sigma_by_key(rig, known.names, known.covariance))
    before = mast.rig.provenance.get("refined", [])
    former = {"former_file": mast.path.name, "former_digest": mast.digest}
    refined = [*(before if isinstance(before, list) else [before]), {**former, **by, **_made()}]
    return replace(rig, fit=fit, provenance={**mast.rig.provenance, "refined": refined})


def _made(versions: Mapping[str, Any] = MappingProxyType({})) -> dict[str, Any]:
    """By which program, and when."""
    date = datetime.now(UTC).isoformat(timespec="seconds")
    return {"program": f"mastctl {version('mastctl')}", **versions, "date": date}


def mast_keys(rig: Rig) -> dict[str, Any]:
    """Return the mast's parameters under the mast file's keys."""
    mast = rig.mast
    return {
        "translation_m": mast.translation_m.tolist(),
        "rotation_rad": mast.rotation_rad.tolist(),
        "axis_offset_m": float(mast.axis_offset_m),
        "axis_twist_rad": float(mast.axis_twist_rad),
    }


def as_lists(pairs: Mapping[str, tuple[float, float]]) -> dict[str, list[float]]:
    """Return (x, y) by camera as lists of numbers."""
    return {name: [float(x), float(y)] for name, (x, y) in pairs.items()}


def rounded_matrix(matrix: np.ndarray) -> np.ndarray:
    """Return a symmetric matrix with ``DIGITS`` significant digits in each number."""
    half = np.vectorize(lambda number: float(f"{number:.{DIGITS - 1}e}"))(matrix)
    return np.asarray(np.tril(half) + np.tril(half, -1).T)
