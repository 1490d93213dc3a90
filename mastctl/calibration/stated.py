"""Stated sigmas beside those that residuals show, kind by kind: in words, as a table and for programs."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from calib.fit.calibration import Calibration
from calib.fit.components import Component
from calib.fit.terms import DOTS_OF, DRAWING, JOINTS, PRISMS, TAPES
from calib.survey import Sigma, Survey
from mastctl.report.tables import Table


def stated(sigma: Sigma, kind: str) -> tuple[float, str, str]:
    """Return the stated sigma of a kind of measurement, its unit, and its key under sigma in survey.yaml."""
    if kind.startswith(DOTS_OF):
        return (sigma.dot_px, "px", "dot_px") if sigma.dot_px else (sigma.corner_px, "px", "corner_px")
    if kind == JOINTS:
        return 1e3 * sigma.joint_rad, "mrad", "joint_rad"
    if kind == DRAWING:
        return 1e3 * sigma.prism_cad_m, "mm", "prism_cad_m"
    return 1e3 * sigma.station_m, "mm", "station_m"


def wrong_sentence(sigma: Sigma, component: Component, wrong: Sequence[Component]) -> str:
    """Return in words that a stated sigma is none; ``wrong`` are all kinds for which it is too small."""
    told, unit, key = stated(sigma, component.kind)
    words = (
        f"{component.kind} scatter by {component.factor:.2f} ± {component.factor_sigma:.2f} times their "
        f"stated sigma: {component.factor * told:.2g} {unit} where {key} says {told:g} {unit}; the fit and "
        f"its uncertainties take {component.weighed * told:.2g} {unit}"
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
        told, unit, _ = stated(survey.sigma, c.kind)
        known = np.isfinite(c.factor)
        rows.append(
            [
                c.kind,
                f"{told:g} {unit}",
                f"{c.factor * told:.3g} ± {c.factor_sigma * told:.1g} {unit}" if known else "cannot be told",
                f"{c.redundancy:.0f} of {c.count}",
                f"{c.weighed:.2f}",
            ]
        )
    return Table(("measurements", "stated sigma", "found", "redundant numbers", "taken times"), rows)


def components_told(sigma: Sigma, components: Sequence[Component]) -> list[dict[str, Any]]:
    """Return the variance components as JSON or YAML."""
    found = []
    for c in components:
        told, unit, key = stated(sigma, c.kind)
        found.append(
            {
                "kind": c.kind,
                "stated": told,
                "unit": unit,
                "key": f"sigma.{key}",
                "count": c.count,
                "redundancy": c.redundancy,
                "factor": c.factor if np.isfinite(c.factor) else None,
                "factor_sigma": c.factor_sigma if np.isfinite(c.factor) else None,
                "widened_by": c.weighed,
                "chance": c.chance,
                "small_chance": c.small_chance,
            }
        )
    return found
