"""Stated sigmas of a survey or bench beside those that residuals show: reasons, tables and JSON."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from calib.adjust.goodness import Component, as_one
from calib.adjust.hypotheses import Finding
from calib.adjust.result import FittedRig, ImageResiduals
from calib.adjust.terms import DOTS_OF, DRAWING, JOINTS, PRISMS, TAPES
from calib.geometry.significance import Level
from calib.survey.records import Survey
from mastctl.calibration.reasons import Grade, Reason
from mastctl.report.tables import Table

Images = Sequence[ImageResiduals]

OWN = "their own sigmas"
"""What states a sigma that dots or corners came with, each its own; shown is the median."""

MANY_UNEVEN = 0.25
"""Share of images noisier than stated above which the cause should be looked for."""

UNEXPLAINED, HOPELESS = 2.0, 5.0
"""Residuals so many times their stated sigmas that no kind of measurement explains are a model's; kinds that
scatter so many times more or less than stated are not what they are treated as."""


def stated(survey: Survey, images: Images, kind: str) -> tuple[float, str, str]:
    """Return the stated sigma of a kind of measurement, its unit, and its key under sigma in survey.yaml, or
    `OWN`."""
    sigma = survey.sigma
    if kind.startswith(DOTS_OF):
        camera, key = kind.removeprefix(DOTS_OF), "corner_px" if survey.boards else "dot_px"
        own = [image.sigma_px for image in images if image.camera == camera and image.purpose != "check"]
        own_px = float(np.median(np.concatenate(own))) if own else _order_px(survey)
        same = own_px == _order_px(survey)
        return own_px, "px", key if same else OWN
    if kind == JOINTS:
        return 1e3 * sigma.joint_rad, "mrad", "joint_rad"
    if kind == DRAWING:
        return 1e3 * sigma.prism_cad_m, "mm", "prism_cad_m"
    return 1e3 * sigma.station_m, "mm", "station_m"


def chi_square_reason(fit: FittedRig) -> Reason:
    """Return whether the residuals as a whole are what the stated sigmas make them.

    They are no reason for doubt by themselves where single kinds of measurements, or images, explain them;
    these have reasons of their own.
    """
    freedom = max(fit.degrees_of_freedom, 1.0)
    factor = float(np.sqrt(fit.chi2 / freedom))
    explained = any(c.wrong for c in fit.components) or any(i.scatter > 1.0 for i in fit.images)
    grade: Grade = "good"
    if fit.chi2_probability < Level.STATED and not explained:
        grade = "bad" if factor > UNEXPLAINED else "care"
    return Reason(
        grade,
        f"chi-square is {fit.chi2:.0f} for {freedom:.0f} degrees of freedom: the residuals are "
        f"{factor:.2f} times what the stated sigmas make them",
    )


def sigma_reasons(survey: Survey, fit: FittedRig) -> list[Reason]:
    """Return a reason for each kind of measurement whose stated sigma is not what its residuals show.

    Too small a sigma is a fault of the survey. Too large a one is none, once the fit takes what was found;
    unless it is so far off that the measurements may be smoothed, or copies.
    """
    wrong = [c for c in fit.components if c.wrong]
    reasons = []
    for c in (*wrong, *(c for c in fit.components if c.generous)):
        sigma, unit, key = stated(survey, fit.images, c.kind)
        # Dots and corners come with what noise leaves of them; prints and lenses are in survey.yaml's sigma.
        most = max(1.0, _order_px(survey) / sigma) if key == OWN else 1.0
        grade: Grade = "good" if c.generous or 1.0 < c.factor <= most else "care"
        if c.factor > HOPELESS * most:
            grade = "bad"
        elif c.factor < 1.0 / HOPELESS and not survey.boards:  # a bench's are counts, which have no choice
            grade = "care"
        sentence = (
            f"{c.kind} scatter by {c.factor:.2f} ± {c.factor_sigma:.2f} times their stated sigma: "
            f"{c.factor * sigma:.2g} {unit} where {key} {'say' if key == OWN else 'says'} {sigma:.3g} "
            f"{unit}; the fit and its uncertainties take {c.weighed * sigma:.2g} {unit}"
        )
        if c.wrong and c.kind == PRISMS and all(other.kind != TAPES for other in wrong):
            sentence += "; tapes do not, so it may be the drawing of the prisms that is off (prism_cad_m)"
        reasons.append(Reason(grade, sentence))
    return [*reasons, *_uneven(survey, fit.images), *_one_station(survey, fit.components)]


def _uneven(survey: Survey, images: Images) -> list[Reason]:
    """Images that are noisier than others of their camera: each counts with what it scatters."""
    noisy = [image for image in images if image.scatter > 1.0]
    if not noisy:
        return []
    worst = max(noisy, key=lambda image: image.scatter)
    beyond = [i for i in noisy if i.scatter * float(np.median(i.sigma_px)) > _order_px(survey)]
    sentence = (
        f"{len(noisy)} of {len(images)} images scatter more than others of their camera, {worst.name} most, "
        f"by {worst.scatter:.1f} times; each counts with its own sigma"
    )
    if len(beyond) <= MANY_UNEVEN * len(images):
        return [Reason("good", sentence)]
    return [Reason("care", f"{sentence}. That is many: look for motion, focus or light")]


def _one_station(survey: Survey, components: Sequence[Component]) -> list[Reason]:
    """Whether prisms scatter as the tapes of the same station do: by tapes alone its sigma is found smaller
    than stated, and a wrong prism hides under the stated one."""
    by_kind = {c.kind: c for c in components if np.isfinite(c.factor)}
    tapes, prisms = by_kind.get(TAPES), by_kind.get(PRISMS)
    if tapes is None or prisms is None or not tapes.generous or prisms.factor < tapes.factor:
        return []
    if as_one(tapes, prisms):
        return []
    sigma_mm = 1e3 * survey.sigma.station_m
    sentence = (
        f"prisms scatter by {prisms.factor * sigma_mm:.1f} mm where the tapes of the same station do by "
        f"{tapes.factor * sigma_mm:.1f} mm: one of them, or their drawing, is wrong; measure them again"
    )
    return [Reason("care", sentence)]


def _order_px(survey: Survey) -> float:
    """The sigma of a dot or corner in survey.yaml."""
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
