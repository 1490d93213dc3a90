"""The paper's calibration (section III): each camera at one joint setting, then the mast, each step exact.

Cameras are fitted to images of purpose ``camera``, set-ups and boards taken from the station as they are. The
mast is fitted to images of purpose ``mast`` with those cameras (eq. (9)), which it then carries to the head.
Both steps are those of every start (``calib.calibrate.starts.survey``). All dots weigh the same; errors of
the station show as residuals. Dots that disagree with the rest of their image are left out beforehand.

The covariance is that of this estimator. With normal equations (k cameras, m mast, s station: boards,
set-ups, prisms and joints), the station's noise moves boards and set-ups, the cameras follow, and the mast
follows both:

    dk = -Nkk⁻¹ (Nks ds + dots),    dm = -Nmm⁻¹ (Nms ds + Nmk dk + dots),

k from the camera images, m from the mast images, ds with the covariance that prisms and tapes give.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.linalg import block_diag

from calib.adjust.adjustment import Adjustment
from calib.adjust.gross import Outlier
from calib.adjust.result import Calibration, ImageResiduals
from calib.adjust.solver import covariance_of
from calib.adjust.terms import ImageTerm, StationTerm
from calib.adjust.uncertainty import fitted_fields, image_residuals, open_directions, station_fields
from calib.adjust.unknowns import MAST, Estimate
from calib.calibrate.starts.cameras import References
from calib.calibrate.starts.survey import Start, start_values
from calib.geometry.rigid import FloatArray
from calib.geometry.significance import Level
from calib.survey.records import Survey


def fit_paper(survey: Survey, mast_parameters: int = 6) -> Calibration:
    """Fit cameras, then the mast, as the paper does.

    Head cameras need images of purpose ``camera`` at one joint setting each. ``mast_parameters`` are 4 for a
    mast that is taken as upright (the paper's Table V), 6 for the paper's, 8 for two skew axes. Raises
    SurveyNotFitted if the survey does not determine a camera or the mast, or no start leads near the noise.
    """
    began = time.perf_counter()
    start = start_values(survey, mast_parameters, by_purpose=True)
    state = start.estimate
    blunders = {o.name for o in start.poses.blunders}
    problem = start.problem(survey, mast_parameters)
    station = [replace(p, keep=p.name not in blunders) for p in problem.station]
    problem = problem.with_terms(problem.images, station)
    whole, mast_alone = two_step_covariance(problem, state, start.references, start.camera_images)
    images = image_residuals(survey, problem, state, start.images, start.checks)
    in_sigmas = [
        np.sum((i.residuals_px[i.used] / i.sigma_px[i.used, None]) ** 2) for i in images if i.used.any()
    ]
    count = sum(2 * int(i.used.sum()) for i in images)
    kinds = ("mast", "camera")
    return Calibration(
        **fitted_fields(
            survey, problem, state, whole, images, start.checks, kinds, Level.STATED, start.notes
        ),
        **station_fields(survey, problem, state),
        method="paper",
        mast_parameters=mast_parameters,
        outliers=(*start.poses.blunders, *_left_out(images, start), *start.wrong),
        degenerate=open_directions(problem, mast_alone),
        chi2=float(sum(in_sigmas)),
        degrees_of_freedom=float(count - len(problem.of_kinds(*kinds))),
        chi2_probability=float("nan"),
        seconds=time.perf_counter() - began,
    )


def two_step_covariance(
    problem: Adjustment, state: Estimate, references: References, camera_images: frozenset[str]
) -> tuple[FloatArray, FloatArray]:
    """Return the covariance of all unknowns, and the same of cameras and mast for noise of dots alone."""
    total = len(problem.names)
    first, second, station = np.zeros((total, total)), np.zeros((total, total)), np.diag(problem.weak)
    for what, block in problem.blocks(state):
        if isinstance(what, ImageTerm):
            matrix = first if what.name in camera_images else second
        else:
            matrix = station if isinstance(what, StationTerm) or what.kind is not None else first
        matrix[np.ix_(block.columns, block.columns)] += block.jacobian.T @ block.jacobian
    # The steps know cameras in the rover frame at their references, the problem those in the head.
    rates = references.rates(problem, state)
    first, second = rates.T @ first @ rates, rates.T @ second @ rates
    k, m = problem.of_kinds("camera"), problem.at(MAST)
    rig, size = np.concatenate([k, m]), len(k)
    s = np.setdiff1d(np.arange(total), rig)
    steps = np.zeros((len(rig), len(rig)))
    steps[:size, :size], steps[size:] = first[np.ix_(k, k)], second[np.ix_(m, rig)]
    steps += np.diag(problem.weak[rig])
    scale = 1.0 / np.sqrt(np.diag(steps))
    inverse = np.linalg.inv(steps * np.outer(scale, scale)) * np.outer(scale, scale)
    dots = inverse @ block_diag(steps[:size, :size], steps[size:, size:]) @ inverse.T
    by_s = -inverse @ np.concatenate([first[np.ix_(k, s)], second[np.ix_(m, s)]])
    of_station = covariance_of(station[np.ix_(s, s)])
    errors, alone = np.zeros((total, total)), np.zeros((total, total))
    errors[np.ix_(rig, rig)] = dots + by_s @ of_station @ by_s.T
    errors[np.ix_(rig, s)] = by_s @ of_station
    errors[np.ix_(s, rig)] = errors[np.ix_(rig, s)].T
    errors[np.ix_(s, s)] = of_station
    alone[np.ix_(rig, rig)] = dots
    return rates @ errors @ rates.T, rates @ alone @ rates.T


def _left_out(images: Sequence[ImageResiduals], start: Start) -> list[Outlier]:
    """The images left out, with how far they are off."""
    out = start.doubtful | {t.name for t in start.images if t.board in start.poses.bent}
    return [
        Outlier(
            "image",
            f"image {image.name}",
            float(np.sqrt(np.mean(np.sum(image.residuals_px**2, axis=1)))),
        )
        for image in images
        if image.name in out
    ]
