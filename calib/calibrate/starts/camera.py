"""Where the fit of one camera to surveyed boards starts: from a rough focal length alone.

The pose of a pinhole of the rough focal length (equidistant for a fish-eye) that a sample of images agrees
with best (SQPnP, closed form; Terzakis and Lourakis 2020). Samples that hold an image of another board fit
badly and lose. Least squares of all that is free about the camera follows, the boards taken as exact.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import combinations
from math import comb

import cv2
import numpy as np

from calib.adjust.adjustment import Adjustment
from calib.adjust.gross import GROSS
from calib.adjust.terms import ImageTerm
from calib.adjust.unknowns import Estimate
from calib.calibrate.starts.agreeing import Agreed, fit_agreeing, thinned
from calib.errors import CalibError
from calib.geometry.cahvor import CameraModel, Kind
from calib.geometry.rig import MAST_NAMES
from calib.geometry.rigid import FloatArray, Rigid

SAMPLES, IMAGES_IN_SAMPLE = 30, 3

FOCAL_FACTORS = (1.0, 0.85, 1.18)
"""Times the rough focal length: starts tried in turn until one fits."""

POINTS_OF_IMAGE = 9
"""Points of each image that a start is made of."""

WIDEST_RAD = np.radians(80.0)
"""A fish-eye's points beyond this angle from its axis do not take part in a start."""


class CameraNotFitted(CalibError):
    """No camera explains the points: too few of them, or every start ended far from the noise."""


def fit_camera(
    images: Sequence[ImageTerm],
    boards: Mapping[tuple[str, str], Rigid],
    *,
    kind: Kind,
    size_px: tuple[int, int],
    focal_px: float,
    expected_px: float,
    seed: int = 0,
) -> Agreed:
    """Fit a camera that stood still to images of boards whose poses are known, in the boards' frame.

    Parameters
    ----------
    images
        Blunders come by whole images.
    kind, size_px, focal_px
        What camera to fit; the focal length may be some 20 % off. A CAHVORE is fitted as a fish-eye
        (type 2), and as type 1 if that does not fit.
    expected_px
        Residual of a coordinate to expect. A fit more than six times above it is refused.
    seed
        Of the choice of samples.

    Raises
    ------
    CameraNotFitted
        If the images do not fix a camera, or none fits.
    """
    points = sum(int(t.keep.sum()) for t in images)
    if points < 8 or len(images) < 2:
        raise CameraNotFitted(
            f"{points} points on {len(images)} boards do not fix a camera; "
            "at least 8 points on 2 boards at different distances are expected"
        )
    still = [replace(t, attitude=None) for t in images]
    best: Agreed | None = None
    for model in _starts(still, boards, kind, size_px, focal_px, seed):
        state = Estimate(
            {still[0].camera: model}, np.zeros(len(MAST_NAMES)), {}, boards, {}, np.zeros((0, 2))
        )
        problem = Adjustment(still, (), state, mast_parameters=0, fixed=tuple(boards))
        fit = fit_agreeing(problem, state, expected_px)
        if fit is not None and (best is None or fit.typical_px < best.typical_px):
            best = fit
        if best is not None and best.typical_px < 3 * expected_px:
            break
    if best is None or best.typical_px > GROSS * expected_px:
        how = (
            "no start led to a camera at which the fit settled"
            if best is None
            else f"the best one leaves {best.typical_px:.1f} px"
        )
        raise CameraNotFitted(
            f"no {kind} camera explains the points: {how} where some {expected_px:.2g} px are expected; "
            "check the focal length and which placement each image belongs to"
        )
    return best


def _starts(
    images: Sequence[ImageTerm],
    boards: Mapping[tuple[str, str], Rigid],
    kind: Kind,
    size_px: tuple[int, int],
    focal_px: float,
    seed: int,
) -> Iterator[CameraModel]:
    """Cameras to start from: for each type of lens and focal length the pose that most points agree with."""
    rng = np.random.default_rng(seed)
    few = [thinned(t, POINTS_OF_IMAGE) for t in images]
    points = [boards[t.board].points(t.in_board_m[t.keep]) for t in few]
    pixels = [t.pixels_px[t.keep] for t in few]
    count, size = len(images), min(IMAGES_IN_SAMPLE, len(images))
    samples = (
        list(combinations(range(count), size))
        if comb(count, size) <= SAMPLES
        else [tuple(rng.choice(count, size, replace=False)) for _ in range(SAMPLES)]
    )
    probe, every = np.concatenate(points), np.concatenate(pixels)
    for number in (2, 1) if kind == "CAHVORE" else (0,):
        for factor in FOCAL_FACTORS:
            best, best_score = None, np.inf
            for sample in [tuple(range(count)), *samples]:
                model = pinhole(
                    np.concatenate([points[i] for i in sample]), np.concatenate([pixels[i] for i in sample]),
                    kind, size_px, factor * focal_px, number,
                )  # fmt: skip
                if model is None:
                    continue
                seen, _ = model.project(probe)
                off = np.linalg.norm(seen - every, axis=1)
                score = float(np.median(np.nan_to_num(off, nan=np.inf)))
                if score < best_score:
                    best, best_score = model, score
            if best is not None:
                yield best


def pinhole(
    points_m: FloatArray,
    pixels_px: FloatArray,
    kind: Kind,
    size_px: tuple[int, int],
    focal_px: float,
    cahvore_type: int = 0,
) -> CameraModel | None:
    """Return the camera of a focal length, centred and without distortion, that sees points best.

    None if no such camera has them in front of it. ``cahvore_type`` 2 is equidistant.
    """
    middle = (np.array(size_px) - 1) / 2
    slopes = (pixels_px - middle) / focal_px
    if cahvore_type == 2 or kind == "OPENCV_FISHEYE":
        theta = np.linalg.norm(slopes, axis=1)
        near = theta < WIDEST_RAD
        theta = np.maximum(theta[near], 1e-12)
        slopes = slopes[near] * (np.tan(theta) / theta)[:, None]
        points_m = points_m[near]
    if len(points_m) < 4:
        return None
    mean = points_m.mean(axis=0)
    try:
        found, turn, shift = cv2.solvePnP(
            points_m - mean, slopes[:, None, :], np.eye(3), None, flags=cv2.SOLVEPNP_SQPNP
        )
    except cv2.error:
        return None
    if not found:
        return None
    axes = np.asarray(cv2.Rodrigues(turn)[0], dtype=np.float64)
    centre = mean - axes.T @ np.asarray(shift, dtype=np.float64).ravel()
    if not ((points_m - centre) @ axes[2] > 0).all():
        return None
    return centred_camera(kind, size_px, focal_px, cahvore_type).moved(Rigid(axes.T, centre))


def centred_camera(
    kind: Kind, size_px: tuple[int, int], focal_px: float, cahvore_type: int = 0
) -> CameraModel:
    """Return a camera without distortion at the origin, its axis along z."""
    x, y, z = np.eye(3)
    cx, cy = (np.array(size_px) - 1) / 2
    return CameraModel.normalised(
        kind, size_px, np.zeros(3), z, focal_px * x + cx * z, focal_px * y + cy * z, z,
        cahvore_type=cahvore_type,
    )[0]  # fmt: skip
