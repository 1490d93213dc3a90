"""Where the fit of one camera to surveyed boards starts: from a rough focal length alone.

Each image by itself says where a pinhole of the rough focal length (equidistant for a fish-eye) stood before
its board. Of these places that which most points of all images agree with is taken: images of another board
lose. Least squares of all that is free about the camera follows, the boards taken as exact.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace

import numpy as np

from calib.adjust.adjustment import Adjustment
from calib.adjust.gross import GROSS
from calib.adjust.robust import SurveyNotFitted
from calib.adjust.terms import ImageTerm
from calib.adjust.unknowns import Estimate
from calib.calibrate.starts.agreeing import Agreed, best_agreeing, thinned
from calib.calibrate.starts.views import centred_camera, poses_of
from calib.geometry.cahvor import CameraModel, Kind
from calib.geometry.rigid import Rigid

FOCAL_FACTORS = (1.0, 0.85, 1.18)
"""Times the rough focal length: starts tried in turn until one fits."""

POINTS_OF_IMAGE = 16
"""Points of each image that a start is made of."""


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

    Raises
    ------
    SurveyNotFitted
        If the images do not fix a camera, or none fits.
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

    best = best_agreeing(map(start, _starts(still, boards, kind, size_px, focal_px)), expected_px)
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


def _starts(
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
