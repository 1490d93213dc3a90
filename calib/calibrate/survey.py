"""Fit a survey in one piece: boards, set-ups, cameras and mast together, each measurement by its sigma.

From a start (`calib.calibrate.starts.survey`) by the estimator of `calib.adjust.adjustment`, without blunders
and with sigmas as they are found (`calib.adjust.robust`). A fit that ends far above the noise is refused.
"""

from __future__ import annotations

import time
from dataclasses import replace

import numpy as np
from scipy.special import chdtrc

from calib.adjust.adjustment import HUBER, SCAN_HUBER, Adjustment
from calib.adjust.gross import GROSS
from calib.adjust.hypotheses import (
    Finding,
    ScoredFit,
    explaining,
    find_change,
    survey_findings,
)
from calib.adjust.noise import goodness
from calib.adjust.result import Calibration
from calib.adjust.robust import (
    Cleaned,
    SurveyNotFitted,
    Weighed,
    refuse_far,
    weigh,
    weighed_fields,
    without_blunders,
)
from calib.adjust.solver import minimise
from calib.adjust.uncertainty import station_fields
from calib.adjust.unknowns import Estimate
from calib.calibrate.starts.survey import start_values
from calib.geometry.significance import Level
from calib.survey.records import Survey

FEW_LEFT_OUT = 3
"""So many images, tapes and prisms that are left out may have a common cause."""

MANY = 0.15
"""More than this part of the tapes left out (and more than three) are no blunders: the model fails."""


def fit_joint(survey: Survey, mast_parameters: int = 6) -> Calibration:
    """Fit cameras and mast to a survey, every measurement weighted by its sigma.

    Images without dots, and check images, take no part. ``mast_parameters`` are 4 for a mast that stands
    upright, 6 for the paper's, 8 for two skew axes. Raises SurveyNotFitted if the survey determines no start,
    the fit does not settle, or it ends far from the noise: it is never reported as done.
    """
    began = time.perf_counter()
    start = start_values(survey, mast_parameters)
    problem = start.problem(survey, mast_parameters).with_huber(HUBER).without_unseen(start.estimate)
    cleaned = without_blunders(problem, start.estimate, start.images, survey.sigma.dot_px)
    change = _what_changed(cleaned)
    _refuse_wrong_minimum(cleaned.problem, cleaned.fit.state, survey.sigma.dot_px, change)
    weighed = weigh(cleaned)
    problem, state = weighed.problem, weighed.fit.state
    notes, widened = list(start.notes), 1.0
    chi_square, freedom = goodness(problem, state, weighed.fit.covariance)
    if freedom > 0 and chdtrc(freedom, chi_square) < Level.STATED:
        notes.append(
            f"the residuals are {np.sqrt(chi_square / freedom):.2f} times what their sigmas allow "
            f"(chi-square {chi_square:.0f} for {freedom:.0f}); uncertainties are scaled up by as much"
        )
        widened = chi_square / freedom
    kinds, checks = ("mast", "camera"), start.checks
    fields = weighed_fields(
        survey, cleaned, weighed, start.images, checks, kinds, Level.STATED, notes, widened
    )
    of_checks = tuple(f"image {t.name} dot " for t in checks)
    fields["outliers"] += tuple(o for o in start.wrong if o.name.startswith(of_checks))
    return Calibration(
        **fields,
        **station_fields(survey, problem, state),
        method="joint",
        mast_parameters=mast_parameters,
        wider=(*_left_out_for(change), *_wider(cleaned, weighed)),
        seconds=time.perf_counter() - began,
    )


def _what_changed(cleaned: Cleaned) -> Finding | None:
    """A joint that slipped or a camera that was refocused or knocked, where images were left out for that.

    Images and tapes were left out because they contradict others; whether they do since something changed is
    another question, put to all of them: a board whose tapes all went follows its images, and hides a slip.
    """
    kept = [*(bool(t.keep.any()) for t in cleaned.problem.images), *(p.keep for p in cleaned.problem.station)]
    if len(kept) - sum(kept) < FEW_LEFT_OUT:
        return None
    station = [replace(point, keep=True) for point in cleaned.problem.station]
    every = cleaned.problem.with_terms(cleaned.images, station).with_huber(SCAN_HUBER)
    every = every.without_unseen(cleaned.fit.state)
    fit = minimise(every, cleaned.fit.state, weak=every.weak, gain=1e-6)
    change = find_change(ScoredFit(every, fit.state)) if np.isfinite(fit.normal.cost) else None
    return change if change is not None and change.subject[0] != "board" else None


def _left_out_for(change: Finding | None) -> tuple[Finding, ...]:
    """A change that images were left out for; how far it moves dots is not bounded by those that are left."""
    if change is None:
        return ()
    name = f"images left out for a change of {change.subject[1]}"
    return (replace(change, name=name, significant=True, size_px=float("inf")),)


def _refuse_wrong_minimum(
    problem: Adjustment, state: Estimate, dot_px: float, change: Finding | None
) -> None:
    """Raise if a camera's typical dot is far above its noise, or if the station contradicts the rest."""
    tapes = [p for p in problem.station if p.board is not None]
    left_out = sum(not p.keep for p in tapes)
    if left_out > max(3, MANY * len(tapes)) and not problem.upright:
        said = f"{left_out} of {len(tapes)} tapes do not agree with the images"
        if change is not None:
            raise SurveyNotFitted(f"{said}: {change.sentence}")
        raise SurveyNotFitted(
            f"{said}: too many for blunders. Check the sigmas and the joint angles, and whether the mast's "
            "axes meet at a right angle (else fit eight parameters)"
        )
    refuse_far(
        problem,
        state,
        dot_px,
        most=GROSS,
        dot="dot",
        disagree=f": {change.sentence}"
        if change is not None
        else ", and no slipped joint, knock or other focus between two images explains it. Check which "
        "placement each belongs to, and the joint angles",
        scatter="they are found badly, or dot_px in survey.yaml is far too small",
        coherent="station_m or joint_rad in survey.yaml is far too small",
    )


def _wider(cleaned: Cleaned, weighed: Weighed) -> tuple[Finding, ...]:
    """What hypotheses would gain, those first that explain why sigmas had to be widened beyond scatter."""
    found = survey_findings(weighed.scored)
    if not any(component.wrong for component in weighed.components):
        return found
    causes = explaining(survey_findings(ScoredFit(cleaned.problem, cleaned.fit.state)), weighed.excess)
    named = {finding.name for finding in causes}
    return (*causes, *(finding for finding in found if finding.name not in named))
