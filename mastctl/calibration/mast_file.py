"""The mast file that a calibration leaves: the rig, how well it fits, how sure it is, where it comes from."""

from __future__ import annotations

import platform
from collections.abc import Mapping
from dataclasses import replace
from datetime import UTC, datetime
from importlib.metadata import version
from typing import Any

import numpy as np

from calib.adjust.result import Calibration
from calib.files.yaml_text import plain
from calib.geometry.rig import Rig
from calib.survey.records import Survey
from mastctl.calibration.stated import components_told

DIGITS = 9
"""Significant digits of the covariance: enough that it stays positive definite."""


def with_fit(calibration: Calibration, survey: Survey, verdict: Mapping[str, Any]) -> Rig:
    """Return the calibrated rig with ``fit`` and ``provenance`` filled in.

    ``fit.covariance`` is square, its rows and columns in the order of ``fit.parameters``: ``mast.KEY.x`` and
    ``cameras.NAME.C.x``; A and O have two each (``A.1``, ``A.2``), radians along
    `calib.geometry.parameters.tangents`.
    """
    fit = {
        "method": calibration.method,
        "mast_parameters": calibration.mast_parameters,
        "rms_px": as_lists(calibration.rms_px),
        "check_rms_px": as_lists(calibration.check_rms_px),
        "sigma": plain(calibration.sigma),
        "chi2": _finite(calibration.chi2),
        "degrees_of_freedom": _finite(calibration.degrees_of_freedom),
        "sigmas_found": components_told(survey, calibration),
        "asked_for": [model.sentence for model in calibration.wider if model.significant],
        "outliers": [outlier.name for outlier in calibration.outliers],
        "degenerate": [direction.sentence for direction in calibration.degenerate],
        "verdict": dict(verdict),
        "parameters": list(calibration.parameter_names),
        "covariance": rounded_matrix(calibration.covariance).tolist(),
    }
    provenance = {
        "survey": survey.folder.resolve().name,
        "survey_digest": survey.digest,
        "program": f"mastctl {version('mastctl')}",
        "versions": {
            "python": platform.python_version(),
            **{name: version(name) for name in ("numpy", "scipy", "opencv-python-headless")},
        },
        "date": datetime.now(UTC).isoformat(timespec="seconds"),
    }
    return replace(calibration.rig, fit=fit, provenance=provenance)


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


def _finite(number: float) -> float | None:
    return float(number) if np.isfinite(number) else None
