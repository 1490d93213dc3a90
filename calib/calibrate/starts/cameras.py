"""Where fits of cameras to surveyed boards start, and then that of the mast (paper section III.C, eq. (9)).

A camera starts from a rough focal length alone: each image by itself says where a pinhole of it (equidistant
for a fish-eye) stood before its board. Of these places that which most points of all images agree with is
taken: images of another board lose. Least squares of all that is free about the camera follows, the boards
taken as exact.

The mast is fitted to images at many joint angles. Each head camera is known in the rover frame at its own
reference angles, and hangs on the very mast that is fitted: the mast carries it there. Pan and tilt offsets
are gauges (see the errata to the paper) and never fitted.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace

import numpy as np

from calib.adjust.adjustment import Adjustment
from calib.adjust.gross import GROSS
from calib.adjust.robust import SurveyNotFitted
from calib.adjust.solver import Normal
from calib.adjust.terms import ImageTerm
from calib.adjust.unknowns import MAST, Estimate
from calib.calibrate.starts.agreeing import Agreed, best_agreeing, thinned
from calib.calibrate.starts.views import centred_camera, poses_of
from calib.geometry.cahvor import CameraModel, Kind
from calib.geometry.parameters import carried_errors, twist_rates
from calib.geometry.rig import gimbal, mast_of
from calib.geometry.rigid import FloatArray, Rigid, crossed

FOCAL_FACTORS = (1.0, 0.85, 1.18)
"""Times the rough focal length: starts tried in turn until one fits."""

POINTS_OF_IMAGE = 16
"""Points of each image that a start is made of."""

LEAN_STARTS_RAD = ((0.0, 0.0), (0.3, 0.0), (-0.3, 0.0), (0.0, 0.3), (0.0, -0.3))
"""θx and θy of the starts tried in turn, until one fits."""

HEIGHT_STARTS_M = (0.0, 0.2, -0.2)
"""Where the head's origin may be below the mean of its cameras, metres."""


def fit_camera(
    images: Sequence[ImageTerm],
    boards: Mapping[tuple[str, str], Rigid],
    *,
    kind: Kind,
    size_px: tuple[int, int],
    focal_px: float,
    expected_px: float,
) -> Agreed:
    """Fit a camera that stood still to images of boards whose poses are known, in the boards' frame.

    The focal length may be some 20 % off. A CAHVORE is fitted as a fish-eye (type 2), and as type 1 if that
    does not fit. A fit that leaves more than six times ``expected_px``, of a coordinate, is refused.

    Raises SurveyNotFitted if the images do not fix a camera, or none fits.
    """
    name, points = images[0].camera, sum(int(t.keep.sum()) for t in images)
    if points < 8 or len({t.board for t in images}) < 2:
        raise SurveyNotFitted(
            f"camera {name} sees {points} points of {len({t.board for t in images})} boards where at least 8 "
            "points of 2 boards, better 8 boards, are expected: take more images of boards at two distances "
            "without moving the head"
        )
    still = [replace(t, attitude=None) for t in images]

    def start(model: CameraModel) -> tuple[Adjustment, Estimate]:
        state = Estimate({name: model}, rover_from_board=boards)
        return Adjustment(still, (), state, mast_parameters=0, fixed=tuple(boards)), state

    best = best_agreeing(map(start, _camera_starts(still, boards, kind, size_px, focal_px)), expected_px)
    if best is None or best.typical_px > GROSS * expected_px:
        how = (
            "no start led to a camera at which the fit settled"
            if best is None
            else f"the best one leaves {best.typical_px:.1f} px"
        )
        raise SurveyNotFitted(
            f"camera {name}: no {kind} camera explains the points: {how} where some {expected_px:.2g} px are "
            "expected; check the focal length and which placement each image belongs to"
        )
    return best


def _camera_starts(
    images: Sequence[ImageTerm],
    boards: Mapping[tuple[str, str], Rigid],
    kind: Kind,
    size_px: tuple[int, int],
    focal_px: float,
) -> Iterator[CameraModel]:
    """Cameras to start from: for each type of lens and focal length the pose that most points agree with."""
    few = [thinned(t, POINTS_OF_IMAGE) for t in images]
    points_m = np.concatenate([boards[t.board].points(t.in_board_m[t.keep]) for t in few])
    pixels_px = np.concatenate([t.pixels_px[t.keep] for t in few])

    def typical_px(model: CameraModel) -> float:
        off_px = np.linalg.norm(model.project(points_m)[0] - pixels_px, axis=1)
        return float(np.median(np.nan_to_num(off_px, nan=np.inf)))

    for number in (2, 1) if kind == "CAHVORE" else (0,):
        for factor in FOCAL_FACTORS:
            rough = centred_camera(kind, size_px, factor * focal_px, number)
            placed = [
                rough.moved(boards[t.board] @ pose.inverse) for t in few for _, pose in poses_of(rough, t)
            ]
            if placed:
                yield min(placed, key=typical_px)


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

    Raises SurveyNotFitted if no start leads to a mast at which the fit settles and that explains most images.
    """
    if not images:
        raise SurveyNotFitted(
            "mast: no image was taken away from the angles at which its camera is calibrated"
        )

    def start(mast: FloatArray) -> tuple[Adjustment, Estimate]:
        state = Estimate(references.in_head(mast), mast, rover_from_board=boards)
        problem = MastAlone(images, (), state, mast_parameters=mast_parameters, fixed=tuple(boards))
        problem.references, problem.weak = references, np.full(len(problem.mast_free), 1e-4)
        return problem, state

    upright = mast_parameters == 4
    best = best_agreeing(map(start, _mast_starts(images, references, upright)), expected_px, keep_all=upright)
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


def _mast_starts(images: Sequence[ImageTerm], references: References, upright: bool) -> list[FloatArray]:
    """Upright and leaning masts with the head's origin near the cameras."""
    x, y, z = np.mean([references.in_rover[t.camera].C for t in images], axis=0)
    return [
        np.array([x, y, z + height, *lean, 0.0, 0.0, 0.0])
        for lean in (LEAN_STARTS_RAD[:1] if upright else LEAN_STARTS_RAD)
        for height in HEIGHT_STARTS_M
    ]
