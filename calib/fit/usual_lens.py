"""What lenses are usually like: weak knowledge that holds a lens where a survey hardly sees it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from calib.camera.cahvor import CameraModel
from calib.camera.parameters import parameter_names, parameter_part
from calib.mast.rig import Rig
from calib.rigid import FloatArray, tangents

O_SIGMA_RAD = 0.02
R_SIGMA = (0.5, 1.0)
E_SIGMA_M = 0.01
"""What lenses are like, one sigma: O beside A, R1 and R2, E0 to E2. Flight cameras stay within some 2.5 of
these; a survey that sees a lens well does not feel them, and one that does not cannot run away with it."""

LIMITS = {"O": (O_SIGMA_RAD,) * 3, "R": R_SIGMA, "E": (E_SIGMA_M,) * 3}
"""The same by a camera's letters."""

HARDLY = 0.7
"""A lens whose sigma stays above this part of what was known beforehand is hardly seen."""


def lens_knowledge(model: CameraModel) -> tuple[FloatArray, FloatArray]:
    """Return how far a lens is from usual, in sigmas, and the Jacobian to the camera's step."""
    kind = model.kind
    size = len(parameter_names(kind))
    aside = np.zeros((3, size))
    aside[:, parameter_part(kind, "O")] = tangents(model.O).T / O_SIGMA_RAD
    aside[:, parameter_part(kind, "A")] = -tangents(model.A).T / O_SIGMA_RAD
    residuals, rows = [(model.O - model.A) / O_SIGMA_RAD, model.R[1:] / np.array(R_SIGMA)], [aside]
    bends = np.zeros((2, size))
    bends[:, parameter_part(kind, "R")] = np.diag(1 / np.array(R_SIGMA))
    rows.append(bends)
    if "E" in kind:
        enters = np.zeros((3, size))
        enters[:, parameter_part(kind, "E")] = np.eye(3) / E_SIGMA_M
        rows.append(enters)
        residuals.append(model.E / E_SIGMA_M)
    return np.concatenate(residuals), np.concatenate(rows)


def lens_notes(rig: Rig, sigma: Mapping[str, Any]) -> tuple[str, ...]:
    """Return a sentence for what the survey hardly sees of lenses, so that usual lenses decide.

    ``sigma`` is that of ``calib.fit.calibration.Calibration``.
    """
    by_words: dict[str, list[str]] = {}
    for name, camera in rig.cameras.items():
        held = []
        for letter, word in (("O", "lens axis"), ("R", "distortion"), ("E", "entrance point")):
            if letter not in camera.model.kind or name not in sigma["cameras"]:
                continue
            found = np.array(sigma["cameras"][name][letter])
            found = found[1:] if letter == "R" else found[:1] if letter == "E" else found
            if (found > HARDLY * np.array(LIMITS[letter])[: len(found)]).any():
                held.append(word)
        if held:
            by_words.setdefault(" and ".join(held), []).append(name)
    return tuple(
        f"the survey hardly shows {words} of {', '.join(names)}, so what lenses are usually like decides; "
        "pixels beyond the dots suffer"
        for words, names in by_words.items()
    )
