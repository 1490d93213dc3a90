"""What a run wants of a fit: a rig, where the boards are, and how well it all agrees."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np

from calib.adjust.result import BenchCalibration
from calib.geometry.rig import Rig
from calib.geometry.rigid import Rigid
from calib.survey.records import Survey
from mastctl.bench.frame import Frame, fit_in_frame

LEAST_PX, LEAST_SCALE = 0.01, 0.1
"""No corner is surer than this, and none so much surer than its finder says; few pictures agree by chance."""


@dataclass(frozen=True, eq=False)
class Fitted:
    """A survey's fit.

    Attributes
    ----------
    rig
        Cameras, mast and joints.
    boards
        Placement to rover_from_board; of a board that moved meanwhile, where it stood last.
    corner_rms_px
        Rms per axis of the fitted corners.
    sigma_scale
        How large residuals are against the sigmas that corners came with.
    calibration
        All of what the fit tells; None of a stand-in.
    """

    rig: Rig
    boards: Mapping[str, Rigid]
    corner_rms_px: float
    sigma_scale: float
    calibration: BenchCalibration | None


FitSurvey = Callable[[Survey], Fitted]


def fit_in_rover(frame: Frame, former: Rig, moved: Callable[[], Mapping[str, float]]) -> FitSurvey:
    """Return the fit of a bench in a rover frame that was stated; ``moved`` as of `fit_in_frame`."""

    def fit(survey: Survey) -> Fitted:
        done = fit_in_frame(survey, frame, former, moved=moved())
        # Of a board that moved, "p1 from IMAGE on" comes after "p1": where it stands now.
        boards = {placement.split(" ")[0]: pose for (_, placement), pose in done.rover_from_board.items()}
        rms = float(np.sqrt(np.mean(np.square(list(done.rms_px.values())))))
        # Corners were fitted with what print and lens add; those that a run plans with come without it.
        fitted_px = np.median(np.concatenate([image.sigma_px for image in done.images]))
        own_px = np.median(np.concatenate([one.sigma_px for one in survey.corners.values()]))
        scale = float(np.sqrt(done.chi2 / max(done.degrees_of_freedom, 1.0)) * fitted_px / own_px)
        return Fitted(done.rig, boards, max(rms, LEAST_PX), max(scale, LEAST_SCALE), done)

    return fit
