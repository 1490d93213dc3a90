"""What a fit was tested for, in words, as tables and for programs: stated sigmas beside those that residuals
show, and what further numbers would gain.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from calib.adjust.goodness import Component
from calib.adjust.hypotheses import Finding
from calib.adjust.result import BenchCalibration, Calibration, ImageResiduals
from calib.adjust.terms import DOTS_OF, DRAWING, JOINTS, PRISMS, TAPES
from calib.survey.records import Survey
from mastctl.report.tables import Table

Images = Sequence[ImageResiduals]

OWN = "their own sigmas"
"""What says a sigma that dots or corners came with, each its own; told is the median."""


def stated(survey: Survey, images: Images, kind: str) -> tuple[float, str, str]:
    """Return the stated sigma of a kind of measurement, its unit, and its key under sigma in survey.yaml, or
    `OWN`."""
    sigma = survey.sigma
    if kind.startswith(DOTS_OF):
        own_px = _own_px(images, kind.removeprefix(DOTS_OF))
        told = (sigma.corner_px, "px", "corner_px") if survey.boards else (sigma.dot_px, "px", "dot_px")
        return told if own_px in (None, told[0]) else (own_px, "px", OWN)
    if kind == JOINTS:
        return 1e3 * sigma.joint_rad, "mrad", "joint_rad"
    if kind == DRAWING:
        return 1e3 * sigma.prism_cad_m, "mm", "prism_cad_m"
    return 1e3 * sigma.station_m, "mm", "station_m"


def _own_px(images: Images, camera: str) -> float | None:
    """The median sigma that a camera's dots or corners were fitted with, before any was found."""
    own = [image.sigma_px for image in images if image.camera == camera and image.purpose != "check"]
    return float(np.median(np.concatenate(own))) if own else None


def allowed(survey: Survey, images: Images, kind: str) -> float:
    """Return by how much a kind may exceed its stated sigma before that of survey.yaml is exceeded: dots and
    corners come with what noise leaves of them, prints and lenses are in ``dot_px`` and ``corner_px``."""
    told, _, key = stated(survey, images, kind)
    whole_px = survey.sigma.corner_px if survey.boards else survey.sigma.dot_px
    return max(1.0, whole_px / told) if key == OWN else 1.0


def wrong_sentence(survey: Survey, images: Images, component: Component, wrong: Sequence[Component]) -> str:
    """Return in words that a stated sigma is none; ``wrong`` are all kinds for which it is too small."""
    told, unit, key = stated(survey, images, component.kind)
    says = "say" if key == OWN else "says"
    words = (
        f"{component.kind} scatter by {component.factor:.2f} ± {component.factor_sigma:.2f} times their "
        f"stated sigma: {component.factor * told:.2g} {unit} where {key} {says} {told:.3g} {unit}; the fit "
        f"and its uncertainties take {component.weighed * told:.2g} {unit}"
    )
    if component.wrong and component.kind == PRISMS and all(other.kind != TAPES for other in wrong):
        words += "; tapes do not, so it may be the drawing of the prisms that is off (prism_cad_m)"
    return words


def component_table(survey: Survey, calibration: Calibration) -> Table | None:
    """Return stated and found sigma of each kind, or None where the method does not weigh by them."""
    if not calibration.components:
        return None
    rows = []
    for c in calibration.components:
        told, unit, _ = stated(survey, calibration.images, c.kind)
        known = np.isfinite(c.factor)
        rows.append(
            [
                c.kind,
                f"{told:.3g} {unit}",
                f"{c.factor * told:.3g} ± {c.factor_sigma * told:.1g} {unit}" if known else "cannot be told",
                f"{c.redundancy:.0f} of {c.count}",
                f"{c.weighed:.2f}",
            ]
        )
    return Table(("measurements", "stated sigma", "found", "redundant numbers", "taken times"), rows)


def components_told(survey: Survey, calibration: Calibration | BenchCalibration) -> list[dict[str, Any]]:
    """Return the variance components as JSON or YAML."""
    found = []
    for c in calibration.components:
        told, unit, key = stated(survey, calibration.images, c.kind)
        found.append(
            {
                "kind": c.kind,
                "stated": told,
                "unit": unit,
                "key": "sigma_px" if key == OWN else f"sigma.{key}",
                "count": c.count,
                "redundancy": c.redundancy,
                "factor": c.factor if np.isfinite(c.factor) else None,
                "factor_sigma": c.factor_sigma if np.isfinite(c.factor) else None,
                "taken_times": c.weighed,
                "chance": c.chance,
                "small_chance": c.small_chance,
            }
        )
    return found


def finding_table(heading: str, findings: Sequence[Finding], most: int | None = None) -> Table | None:
    """Return what hypotheses would gain, or None where none was tested."""
    if not findings:
        return None
    rows = [
        [
            one.name,
            f"{one.numbers}",
            f"{one.gain:.1f}",
            f"{one.chance:.2g}",
            one.sentence if one.significant else "no more than chance",
        ]
        for one in findings[:most]
    ]
    return Table((heading, "numbers", "gain in chi-square", "chance", ""), rows)


def findings_as_json(findings: Sequence[Finding]) -> list[dict[str, Any]]:
    """Return what hypotheses would gain as JSON or YAML."""
    return [
        {
            "name": one.name,
            "sentence": one.sentence,
            "numbers": one.numbers,
            "gain": one.gain,
            "chance": one.chance,
            "significant": one.significant,
            "size_px": finite(one.size_px),
        }
        for one in findings
    ]


def finite(number: float) -> float | None:
    """Return a number as JSON and YAML hold it; None for one that is not finite."""
    return float(number) if np.isfinite(number) else None
