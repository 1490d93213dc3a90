"""Fit the mast to images at many joint angles, with cameras known at one (paper section III.C, eq. (9)).

Each head camera is known in the rover frame at its own reference angles, and hangs on the very mast that is
fitted: the mast carries it there. Pan and tilt offsets are gauges (see the errata to the paper) and never
fitted.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from calib.adjust.adjustment import Adjustment
from calib.adjust.gross import GROSS
from calib.adjust.robust import SurveyNotFitted
from calib.adjust.solver import Normal
from calib.adjust.terms import ImageTerm
from calib.adjust.unknowns import MAST, Estimate
from calib.calibrate.starts.agreeing import Agreed, best_agreeing
from calib.geometry.cahvor import CameraModel
from calib.geometry.parameters import carried_errors, twist_rates
from calib.geometry.rig import gimbal, mast_of
from calib.geometry.rigid import FloatArray, Rigid, crossed

LEAN_STARTS_RAD = ((0.0, 0.0), (0.3, 0.0), (-0.3, 0.0), (0.0, 0.3), (0.0, -0.3))
"""θx and θy of the starts tried in turn, until one fits."""

HEIGHT_STARTS_M = (0.0, 0.2, -0.2)
"""Where the head's origin may be below the mean of its cameras, metres."""


class References:
    """Head cameras known in the rover frame (``in_rover``) at joint angles of their own (``joints_rad``)."""

    def __init__(
        self, in_rover: Mapping[str, CameraModel], joints_rad: Mapping[str, tuple[float, float]]
    ) -> None:
        self.in_rover, self.joints_rad = in_rover, joints_rad

    def in_head(self, mast: FloatArray) -> dict[str, CameraModel]:
        """Return the cameras as a mast's eight numbers carry them to the head; body cameras as they are."""
        carrying = mast_of(mast)
        return {
            name: model.moved(carrying.rover_from_head(*self.joints_rad[name]).inverse)
            if name in self.joints_rad
            else model
            for name, model in self.in_rover.items()
        }

    def rates(self, problem: Adjustment, state: Estimate) -> FloatArray:
        """Return what errors (p,) of cameras in the rover, the mast and all else are in a problem's numbers.

        (p, p): the cameras' numbers stand where those of the cameras in the head do.
        """
        rates = np.eye(len(problem.names))
        for name, joints in self.joints_rad.items():
            at, model = problem.at(("camera", name)), state.cameras[name]
            head = gimbal(state.mast, *joints)
            rates[np.ix_(at, at)] = carried_errors(self.in_rover[name], model, head.rotation.T)
            turns, shifts = np.split(head.twists[problem.mast_free], 2, axis=1)
            shifts = shifts + crossed(turns, head.translation_m)
            twists = np.concatenate([turns @ head.rotation, shifts @ head.rotation], axis=1)
            rates[np.ix_(at, problem.at(MAST))] = -twist_rates(model) @ twists.T
        return rates


class MastAlone(Adjustment):
    """The mast's numbers alone move, and with them the cameras in the head; boards stay."""

    references: References

    def stepped(self, state: Estimate, step: FloatArray) -> Estimate:
        mast = state.mast.copy()
        mast[self.mast_free] += step
        return replace(state, mast=mast, cameras=self.references.in_head(mast))

    def normal(self, state: Estimate) -> Normal:
        whole = super().normal(state)
        rates = self.references.rates(self, state)[:, self.at(MAST)]
        return Normal(whole.cost, rates.T @ whole.matrix @ rates, rates.T @ whole.gradient)

    @property
    def weak(self) -> FloatArray:
        return np.full(len(self.mast_free), 1e-4)


def fit_mast(
    images: Sequence[ImageTerm],
    boards: Mapping[tuple[str, str], Rigid],
    references: References,
    mast_parameters: int = 6,
    *,
    expected_px: float = 1.0,
) -> Agreed:
    """Fit 4, 6 or 8 numbers of the mast to images at many joint angles, the cameras taken as known.

    Images at their camera's reference angles say nothing. With 4 parameters the mast stands upright
    (θx = θy = 0) and need not explain anything: no image is left out and no fit refused. ``expected_px`` is
    the residual of a coordinate to expect.

    Raises
    ------
    SurveyNotFitted
        If no start leads to a mast at which the fit settles and that explains most images.
    """
    if not images:
        raise SurveyNotFitted(
            "mast: no image was taken away from the angles at which its camera is calibrated"
        )

    def start(mast: FloatArray) -> tuple[Adjustment, Estimate]:
        state = Estimate(references.in_head(mast), mast, rover_from_board=boards)
        problem = MastAlone(images, (), state, mast_parameters=mast_parameters, fixed=tuple(boards))
        problem.references = references
        return problem, state

    upright = mast_parameters == 4
    best = best_agreeing(map(start, _starts(images, references, upright)), expected_px, keep_all=upright)
    if best is None:
        raise SurveyNotFitted(
            "mast: no start led to a mast at which the fit settled; check pan and tilt "
            "(radians, right and up positive), and take images at more joint angles"
        )
    if best.typical_px > GROSS * expected_px and not upright:
        raise SurveyNotFitted(
            f"no mast explains the images: the best one leaves {best.typical_px:.1f} px where some "
            f"{expected_px:.2g} px are expected. Check pan and tilt (radians, right and up positive) and "
            "each image's placement; axes that do not meet at a right angle need eight parameters"
        )
    return best


def _starts(images: Sequence[ImageTerm], references: References, upright: bool) -> list[FloatArray]:
    """Upright and leaning masts with the head's origin near the cameras."""
    x, y, z = np.mean([references.in_rover[t.camera].C for t in images], axis=0)
    return [
        np.array([x, y, z + height, *lean, 0.0, 0.0, 0.0])
        for lean in (LEAN_STARTS_RAD[:1] if upright else LEAN_STARTS_RAD)
        for height in HEIGHT_STARTS_M
    ]
