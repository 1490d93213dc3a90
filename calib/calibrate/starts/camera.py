"""Fit one camera to surveyed points: a start from a rough focal length alone, then least squares.

The points are taken as exact and everything else about the camera is free (``calib.geometry.parameters``).
Start: with a pinhole of the rough focal length (equidistant for a fish-eye), the pose that a sample of
images agrees with best (SQPnP, closed form; Terzakis and Lourakis 2020). Samples that hold an image of
another board fit badly and lose. Then least squares whose pulls shrink with the size of a residual (Cauchy),
then without that on the images that agree.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from math import comb

import cv2
import numpy as np

from calib.adjust.significance import typical_px
from calib.adjust.solver import Normal, covariance_of, minimise
from calib.adjust.terms import lens_knowledge
from calib.errors import CalibError
from calib.geometry.cahvor import CameraModel, Kind
from calib.geometry.parameters import parameter_names, parameter_part, predict, stepped
from calib.geometry.rigid import FloatArray

SAMPLES = 30
"""Samples of images tried for a start."""

IMAGES_IN_SAMPLE = 3

FOCAL_FACTORS = (1.0, 0.85, 1.18)
"""Times the rough focal length: starts tried in turn until one fits."""

POINTS_OF_IMAGE = 9
"""Points of each image that a start is made of."""

WIDEST_RAD = np.radians(80.0)
"""A fish-eye's points beyond this angle from its axis do not take part in a start."""

LAST_STEPS = 500
"""Steps at most of the last fit, which must settle: a narrow field hardly tells the lens, and took 170."""

GROSS = 6.0
"""An image is another board's if its typical residual is this many times the typical image's (and above its
noise)."""

STRAY = 3.0
"""A point so many times farther off than an image may be is left out by itself."""


class CameraNotFitted(CalibError):
    """No camera explains the points: too few of them, or every start ended far from the noise."""


@dataclass(frozen=True, eq=False)
class CameraFit:
    """A camera fitted to fixed points.

    Attributes
    ----------
    model
        The camera, in the points' frame.
    covariance
        (p, p) of its step (``calib.geometry.parameters.parameter_names``), scaled by the residuals where
        these are larger than ``sigma_px``; the points count as exact.
    residuals_px
        (n, 2) predicted less measured pixels of every point, also of those not used.
    used
        (n,) which points took part.
    rms_px
        (2,) of those, along x and y.
    limit_px
        An image whose dots are farther off than this, rms of their distances, did not take part.
    """

    model: CameraModel
    covariance: FloatArray
    residuals_px: FloatArray
    used: np.ndarray
    rms_px: FloatArray
    limit_px: float


def fit_camera(
    points_m: FloatArray,
    pixels_px: FloatArray,
    images: np.ndarray,
    *,
    kind: Kind,
    size_px: tuple[int, int],
    focal_px: float,
    sigma_px: float = 0.1,
    expected_px: float | None = None,
    seed: int = 0,
) -> CameraFit:
    """Fit a camera to fixed points.

    Parameters
    ----------
    points_m, pixels_px
        (n, 3) points in one frame and (n, 2) where they were seen.
    images
        (n,) which image (or board) each point belongs to: blunders come by whole images.
    kind, size_px, focal_px
        What camera to fit; the focal length may be some 20 % off. A CAHVORE is fitted as a fish-eye
        (type 2), and as type 1 if that does not fit.
    sigma_px
        Noise of a pixel coordinate.
    expected_px
        Residual rms to expect, where the points are not as exact as they are taken; ``sigma_px`` if None.
        A fit more than some 6 times above it is refused.
    seed
        Of the choice of samples.

    Raises
    ------
    CameraNotFitted
        If the points do not fix a camera, or none fits.
    """
    labels, images = np.unique(images, return_inverse=True)
    if len(points_m) < 8 or len(labels) < 2:
        raise CameraNotFitted(
            f"{len(points_m)} points on {len(labels)} boards do not fix a camera; "
            "at least 8 points on 2 boards at different distances are expected"
        )
    expected = max(sigma_px, expected_px or 0.0)
    best: CameraFit | None = None
    for start in _starts(points_m, pixels_px, images, kind, size_px, focal_px, seed):
        fit = _fit_from(start, points_m, pixels_px, images, sigma_px, expected)
        if fit is not None and (best is None or _typical(fit, images) < _typical(best, images)):
            best = fit
        if best is not None and _typical(best, images) < 3 * expected:
            break
    if best is None or _typical(best, images) > GROSS * expected:
        how = (
            "no start led to a camera at which the fit settled"
            if best is None
            else f"the best one leaves {_typical(best, images):.1f} px"
        )
        raise CameraNotFitted(
            f"no {kind} camera explains the points: {how} where some {expected:.2g} px are expected; "
            "check the focal length and which placement each image belongs to"
        )
    return best


def _typical(fit: CameraFit, images: np.ndarray) -> float:
    """Median over images of the typical residual, pixels."""
    return float(np.median(_image_sizes(fit.residuals_px, images)))


def _image_sizes(residuals_px: FloatArray, images: np.ndarray) -> FloatArray:
    """Residual of each image's typical point, per coordinate; infinite where most have no pixel.

    By the median: an image in which some points are found elsewhere is judged by the others.
    """
    return typical_px(residuals_px, images, int(images.max()) + 1)


def _starts(
    points_m: FloatArray,
    pixels_px: FloatArray,
    images: np.ndarray,
    kind: Kind,
    size_px: tuple[int, int],
    focal_px: float,
    seed: int,
) -> Iterator[CameraModel]:
    """Cameras to start from: for each type of lens and focal length the pose that most images agree with."""
    rng = np.random.default_rng(seed)
    count = int(images.max()) + 1
    some = [np.flatnonzero(images == i) for i in range(count)]
    some = [rows[np.linspace(0, len(rows) - 1, min(POINTS_OF_IMAGE, len(rows))).astype(int)] for rows in some]
    size = min(IMAGES_IN_SAMPLE, count)
    choices = comb(count, size)
    drawn = range(choices) if choices <= SAMPLES else rng.choice(choices, SAMPLES, replace=False)
    every = [_combination(count, size, int(number)) for number in drawn]
    probe = np.concatenate(some)
    for number in (2, 1) if kind == "CAHVORE" else (0,):
        for factor in FOCAL_FACTORS:
            focal = factor * focal_px
            best, best_score = None, np.inf
            for sample in [tuple(range(count)), *every]:
                rows = np.concatenate([some[i] for i in sample])
                model = pinhole(points_m[rows], pixels_px[rows], kind, size_px, focal, number)
                if model is None:
                    continue
                seen, _ = model.project(points_m[probe])
                score = float(np.median(_image_sizes(seen - pixels_px[probe], images[probe])))
                if score < best_score:
                    best, best_score = model, score
            if best is not None:
                yield best


def _combination(count: int, size: int, number: int) -> tuple[int, ...]:
    """The combination of so many of ``range(count)`` that comes at ``number`` in rising order, from 0."""
    chosen: list[int] = []
    for at in range(count):
        if len(chosen) == size:
            break
        with_this = comb(count - at - 1, size - len(chosen) - 1)
        if number < with_this:
            chosen.append(at)
        else:
            number -= with_this
    return tuple(chosen)


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
    x, y, a = axes
    if not ((points_m - centre) @ a > 0).all():
        return None
    return CameraModel.normalised(
        kind,
        size_px,
        centre,
        a,
        focal_px * x + middle[0] * a,
        focal_px * y + middle[1] * a,
        a,
        cahvore_type=cahvore_type,
    )[0]


class FixedPoints:
    """The problem (``calib.adjust.solver.Problem``) of one camera and fixed points, with weights."""

    def __init__(self, points_m: FloatArray, pixels_px: FloatArray, sigma_px: FloatArray) -> None:
        self.points_m, self.pixels_px, self.sigma_px = points_m, pixels_px, sigma_px

    def normal(self, state: CameraModel) -> Normal:
        seen = predict(state, self.points_m)
        residual = ((seen.pixels_px - self.pixels_px) / self.sigma_px[:, None]).ravel()
        jacobian = (seen.d_step / self.sigma_px[:, None, None]).reshape(len(residual), -1)
        cost, matrix, gradient = float(residual @ residual), jacobian.T @ jacobian, jacobian.T @ residual
        if state.kind != "CAHV":
            known, rows = lens_knowledge(state)
            cost, matrix = cost + float(known @ known), matrix + rows.T @ rows
            gradient = gradient + rows.T @ known
        return Normal(cost if np.isfinite(cost) else float("inf"), matrix, gradient)

    def cost(self, state: CameraModel) -> float:
        seen, _ = state.project(self.points_m)
        residual = (seen - self.pixels_px) / self.sigma_px[:, None]
        cost = float(np.sum(residual**2))
        if state.kind != "CAHV":
            known, _ = lens_knowledge(state)
            cost += float(known @ known)
        return cost if np.isfinite(cost) else float("inf")

    def stepped(self, state: CameraModel, step: FloatArray) -> CameraModel:
        return stepped(state, step)


def _fit_from(
    start: CameraModel,
    points_m: FloatArray,
    pixels_px: FloatArray,
    images: np.ndarray,
    sigma_px: float,
    expected_px: float,
) -> CameraFit | None:
    """Least squares from a start, or None if it leads nowhere or does not settle."""
    weak = np.ones(len(parameter_names(start.kind)))
    for letter in "HV":
        weak[parameter_part(start.kind, letter)] = 1 / float(start.H @ start.H)
    model, used = start, np.ones(len(points_m), dtype=bool)
    for rounds in (20, 12, 8, 8):
        seen, valid = model.project(points_m)
        residual = np.linalg.norm(seen - pixels_px, axis=1)
        used = valid
        if used.sum() < 8:
            return None
        typical = max(float(np.median(residual[used])), expected_px)
        weighted = typical * np.sqrt(1 + (residual[used] / (2 * typical)) ** 2)
        problem = FixedPoints(points_m[used], pixels_px[used], np.maximum(weighted, sigma_px))
        model = minimise(problem, model, weak=weak, steps=rounds, gain=1e-6).state
    seen, valid = model.project(points_m)
    sizes = _image_sizes(seen - pixels_px, images)
    limit_px = GROSS * max(float(np.median(sizes)), expected_px)
    good = sizes < limit_px
    for _ in range(2):  # a point that only an unfinished lens puts elsewhere comes back
        used = valid & good[images] & (np.linalg.norm(seen - pixels_px, axis=1) < STRAY * limit_px)
        if used.sum() < 8 or len(np.unique(images[used])) < 2:
            return None
        problem = FixedPoints(points_m[used], pixels_px[used], np.full(int(used.sum()), sigma_px))
        found = minimise(problem, model, weak=weak, steps=LAST_STEPS)
        if not found.settled:
            return None
        model = found.state
        seen, valid = model.project(points_m)
        if used.sum() == (valid & good[images]).sum():
            break
    residuals = seen - pixels_px
    freedom = max(2 * int(used.sum()) - len(weak), 1)
    unit_weight = float(np.sum((residuals[used] / sigma_px) ** 2)) / freedom
    covariance = max(unit_weight, 1.0) * covariance_of(found.normal.matrix, weak)
    rms_px: FloatArray = np.sqrt((residuals[used] ** 2).mean(axis=0)).astype(np.float64)
    return CameraFit(model, covariance, residuals, used, rms_px, limit_px)
