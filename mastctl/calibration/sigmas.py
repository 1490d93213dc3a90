"""Stated sigmas of a survey or bench beside those that residuals show: tables and JSON."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from calib.adjust.hypotheses import Finding
from calib.adjust.result import FittedRig, ImageResiduals
from calib.adjust.terms import DOTS_OF, DRAWING, JOINTS
from calib.survey.records import Survey
from mastctl.report.pages import Table

OWN = "their own sigmas"
"""What states a sigma that dots or corners came with, each its own; shown is the median."""


def stated(survey: Survey, images: Sequence[ImageResiduals], kind: str) -> tuple[float, str, str]:
    """Return the stated sigma of a kind of measurement, its unit, and its key under sigma in survey.yaml, or
    `OWN`."""
    sigma = survey.sigma
    if kind.startswith(DOTS_OF):
        camera, key = kind.removeprefix(DOTS_OF), "corner_px" if survey.boards else "dot_px"
        own = [image.sigma_px for image in images if image.camera == camera and image.purpose != "check"]
        own_px = float(np.median(np.concatenate(own))) if own else order_px(survey)
        same = own_px == order_px(survey)
        return own_px, "px", key if same else OWN
    if kind == JOINTS:
        return 1e3 * sigma.joint_rad, "mrad", "joint_rad"
    if kind == DRAWING:
        return 1e3 * sigma.prism_cad_m, "mm", "prism_cad_m"
    return 1e3 * sigma.station_m, "mm", "station_m"


def order_px(survey: Survey) -> float:
    """Return the sigma of a dot or corner in survey.yaml, px."""
    return survey.sigma.corner_px if survey.boards else survey.sigma.dot_px


def sigma_table(survey: Survey, fit: FittedRig) -> Table | None:
    """Return stated and found sigma of each kind, or None where the method does not weigh by them."""
    if not fit.components:
        return None
    rows = []
    for c in fit.components:
        sigma, unit, _ = stated(survey, fit.images, c.kind)
        found = f"{c.factor * sigma:.3g} ± {c.factor_sigma * sigma:.1g} {unit}"
        rows.append(
            [
                c.kind,
                f"{sigma:.3g} {unit}",
                found if np.isfinite(c.factor) else "not determined",
                f"{c.redundancy:.0f} of {c.count}",
                f"{c.weighed:.2f}",
            ]
        )
    return Table(("measurements", "stated sigma", "found", "redundant numbers", "taken times"), rows)


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
