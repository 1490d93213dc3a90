"""Fit a survey in one piece: boards, set-ups, cameras and mast together, each measurement by its sigma.

From a start (`calib.calibrate.starts.survey`) by the estimator of `calib.adjust.adjustment`, without blunders
and with sigmas as they are found (`calib.adjust.robust`). A fit that ends far above the noise is refused.
"""

from __future__ import annotations

import time
from dataclasses import replace

import numpy as np
from scipy.special import chdtrc, chdtri

from calib.adjust.adjustment import HUBER, Adjustment
from calib.adjust.goodness import goodness
from calib.adjust.left_out import left_out_boards
from calib.adjust.outliers import name_outliers
from calib.adjust.result import Calibration, rig_of
from calib.adjust.robust import SurveyNotFitted, Weighed, typical_length, weigh, without_blunders
from calib.adjust.solver import Minimum, covariance_of
from calib.adjust.terms import lens_notes, with_kept
from calib.adjust.uncertainty import (
    check_rms,
    image_residuals,
    open_directions,
    rms_by_camera,
    sigma_by_key,
    station_residuals,
)
from calib.adjust.unknowns import Estimate
from calib.adjust.wider import WiderModel, explaining, wider_models
from calib.calibrate.starts.survey import Start, start_values
from calib.survey.records import Survey

WRONG_MINIMUM = 6.0
"""A fit is refused if the typical dot is this many times farther off than its sigma, or than ``dot_px`` of
the survey where that is more (a dot's own sigma has no print). Stated sigmas are wrong by two or three, wrong
minima by a hundred."""

MANY = 0.15
"""More than this part of the tapes left out (and more than three) are no blunders: the model fails."""


def fit_joint(survey: Survey, mast_parameters: int = 6) -> Calibration:
    """Fit cameras and mast to a survey, every measurement weighted by its sigma.

    Parameters
    ----------
    survey
        The measurements; images without dots, and check images, take no part.
    mast_parameters
        4 for a mast that stands upright, 6 for the paper's, 8 for two skew axes.

    Raises
    ------
    SurveyNotFitted
        If the survey determines no start, the fit does not settle, or it ends far from the noise: it is never
        reported as done.
    """
    began = time.perf_counter()
    from_here = start_values(survey, mast_parameters)
    problem = joint_problem(survey, from_here, mast_parameters)
    problem, fit = without_blunders(problem, from_here.estimate, from_here.images)
    _refuse_wrong_minimum(problem, fit.state, survey.sigma.dot_px)
    _refuse_unsettled(fit)
    weighed = weigh(problem, fit, from_here.images)
    _refuse_unsettled(weighed.fit)
    return _calibration(survey, mast_parameters, from_here, (problem, fit), weighed, began)


def joint_problem(survey: Survey, from_here: Start, mast_parameters: int) -> Adjustment:
    """Return the least-squares problem of a survey, without images that disagree with the start."""
    images = [replace(t, keep=from_here.kept.get(t.name, t.keep)) for t in from_here.images]
    problem = Adjustment(
        with_kept(images, from_here.doubtful),
        from_here.station,
        from_here.estimate,
        mast_parameters=mast_parameters if from_here.reference_rad else 0,
        prisms_cad_m=survey.prisms_in_rover_m,
        prism_cad_m=survey.sigma.prism_cad_m,
        joint_rad=survey.sigma.joint_rad,
        huber=HUBER,
    )
    unseen = problem.unseen(from_here.estimate)
    return problem.with_terms(with_kept(problem.images, unseen), problem.station)


def _refuse_unsettled(fit: Minimum[Estimate]) -> None:
    if not fit.settled:
        raise SurveyNotFitted(
            f"the fit did not settle: after {fit.steps} steps it was still finding better values, so that "
            "neither they nor their sigmas are good. Take more images, at more joint angles and distances"
        )


def _refuse_wrong_minimum(problem: Adjustment, state: Estimate, dot_px: float) -> None:
    """Raise if a camera's typical dot is far above its noise, or if the station contradicts the rest."""
    tapes = [p for p in problem.station if p.board is not None]
    left_out = sum(not p.keep for p in tapes)
    if left_out > max(3, MANY * len(tapes)) and not problem.upright:
        raise SurveyNotFitted(
            f"{left_out} of {len(tapes)} tapes do not agree with the images: too many for blunders. Check "
            "the sigmas and the joint angles, and whether the mast's axes meet at a right angle (else fit "
            "eight parameters)"
        )
    for name in state.cameras:
        mine = [t for t in problem.images if t.camera == name]
        kept = [t for t in mine if t.keep.any()]
        if len(kept) < max(2, len(mine) // 2):
            raise SurveyNotFitted(
                f"camera {name}: {len(mine) - len(kept)} of its {len(mine)} images do not agree with the "
                "rest; check which placement each belongs to and the joint angles"
            )
        typical, noise_px = typical_length(problem, state, kept, dot_px)
        if typical > WRONG_MINIMUM:
            raise SurveyNotFitted(
                f"camera {name}: the fit leaves {typical:.1f} times the stated noise of a dot "
                f"({noise_px:g} px); either it ended in a wrong "
                "minimum or the sigmas in survey.yaml are too small"
            )


def _calibration(
    survey: Survey,
    mast_parameters: int,
    from_here: Start,
    as_stated: tuple[Adjustment, Minimum[Estimate]],
    weighed: Weighed,
    began: float,
) -> Calibration:
    """Put together what the fit says, with the stated sigmas and with those that were found."""
    problem, state, covariance = weighed.problem, weighed.fit.state, weighed.covariance
    rig_numbers = problem.unknowns.of_kinds("camera", "mast")
    notes = list(from_here.notes)
    order = problem.unknowns.of_kinds("mast", "camera")
    mine = covariance[np.ix_(order, order)]
    chi_square, freedom = goodness(problem, state, covariance)
    if freedom > 0 and chdtrc(freedom, chi_square) < 0.001:
        notes.append(
            f"the residuals are {np.sqrt(chi_square / freedom):.2f} times what their sigmas allow "
            f"(chi-square {chi_square:.0f} for {freedom:.0f}); uncertainties are scaled up by as much"
        )
        mine = mine * chi_square / freedom
    stated, first = as_stated
    notes += _prism_notes(stated, first.state, mast_parameters)
    chi_square, freedom = goodness(stated, first.state, covariance_of(first.normal.matrix, stated.weak))
    rig, values = rig_of(survey, state), problem.values(state, "mast", "camera")
    sigma = sigma_by_key(rig, tuple(values), mine)
    notes += lens_notes(rig, sigma)
    images = image_residuals(survey, problem, state, from_here.images, from_here.checks)
    return Calibration(
        method="joint",
        mast_parameters=mast_parameters,
        rig=rig,
        parameter_names=tuple(values),
        estimate=np.array(list(values.values())),
        covariance=mine,
        sigma=sigma,
        rms_px=rms_by_camera(images),
        check_rms_px=check_rms(survey, state, images),
        outliers=(*name_outliers(problem, state, covariance, weighed.images), *from_here.stray_checks),
        degenerate=open_directions(problem, covariance[np.ix_(rig_numbers, rig_numbers)]),
        notes=tuple(notes),
        chi2=chi_square,
        degrees_of_freedom=freedom,
        chi2_probability=float(chdtrc(freedom, chi_square)) if freedom > 0 else float("nan"),
        images=images,
        station=station_residuals(problem, state),
        components=weighed.components,
        wider=_wider(stated, first, weighed),
        left_out_boards=left_out_boards(problem, weighed.fit, covariance),
        rover_from_station=state.rover_from_station,
        rover_from_board=state.rover_from_board,
        prisms_in_rover_m=state.prisms_in_rover_m,
        seconds=time.perf_counter() - began,
    )


def _wider(stated: Adjustment, first: Minimum[Estimate], weighed: Weighed) -> tuple[WiderModel, ...]:
    """Wider models beside the fit, those first that explain why sigmas had to be widened."""
    found = wider_models(weighed.problem, weighed.fit.state, weighed.covariance, weighed.fit.normal.gradient)
    if not any(component.wrong for component in weighed.components):
        return found
    covariance = covariance_of(first.normal.matrix, stated.weak)
    tried = wider_models(stated, first.state, covariance, first.normal.gradient)
    causes = explaining(tried, weighed.excess)
    named = {model.name for model in causes}
    return (*causes, *(model for model in found if model.name not in named))


def _prism_notes(problem: Adjustment, state: Estimate, mast_parameters: int) -> list[str]:
    """Sentences on set-ups whose prisms do not fit the rover, though each may be the wrong one."""
    notes = []
    for setup in state.rover_from_station:
        prisms = [p for p in problem.station if p.setup == setup and p.board is None and p.keep]
        residuals = np.array([problem.station_residual(state, p) for p in prisms])
        if float(np.sum(residuals**2)) > chdtri(3 * len(prisms), 0.001):
            worst = 1000 * float(np.linalg.norm(residuals, axis=1).max()) * prisms[0].sigma_m
            why = "an upright mast" if mast_parameters == 4 else "their CAD positions"
            notes.append(
                f"the prisms of set-up {setup} do not agree with {why}: they are off by up to {worst:.1f} mm"
            )
    return notes
