"""Fit the mast to images at many joint angles, with cameras known at one (paper section III.C, eq. (9)).

Each head camera is known in the rover frame at its own reference angles. For other angles the same mast that
is being fitted carries it there: a point is turned back into the head and forward to the reference, and the
known camera projects it. Pan and tilt offsets are gauges (see the errata to the paper) and never fitted.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from calib.adjust.significance import typical_px
from calib.adjust.solver import Normal, minimise
from calib.errors import CalibError
from calib.geometry.cahvor import CameraModel
from calib.geometry.rig import MAST_FREE, gimbal
from calib.geometry.rigid import FloatArray, crossed, rigid_rates

LEAN_STARTS_RAD = ((0.0, 0.0), (0.3, 0.0), (-0.3, 0.0), (0.0, 0.3), (0.0, -0.3))
"""θx and θy of the starts tried in turn, until one fits."""

HEIGHT_STARTS_M = (0.0, 0.2, -0.2)
"""Where the head's origin may be below the mean of its cameras, metres."""

LAST_STEPS = 100
"""Steps at most of the last fit, which must settle."""

GROSS = 6.0
"""An image is left out if its typical residual is this many times that of most images and the expectation."""


class MastNotFitted(CalibError):
    """No mast explains the images: too few of them, or every start ended far from the noise."""


@dataclass(frozen=True, eq=False)
class MastView:
    """One image for the mast: the camera in the rover frame at its reference angles, the joint readings,
    and points (n, 3) of the rover frame, metres, with their pixels (n, 2)."""

    name: str
    camera: CameraModel
    reference_rad: tuple[float, float]
    joints_rad: tuple[float, float]
    points_m: FloatArray
    pixels_px: FloatArray


@dataclass(frozen=True, eq=False)
class MastFit:
    """A mast fitted to images.

    Attributes
    ----------
    mast
        (8,) numbers in the order of ``calib.geometry.rig.MAST_NAMES``.
    left_out
        Names of images that another board or other angles must belong to.
    rms_px
        (2,) of the images that took part.
    limit_px
        An image with a larger rms, per coordinate, was left out.
    """

    mast: FloatArray
    left_out: tuple[str, ...]
    rms_px: FloatArray
    limit_px: float


def fit_mast(
    views: Sequence[MastView],
    mast_parameters: int = 6,
    *,
    expected_px: float = 1.0,
    rough: FloatArray | None = None,
    keep_all: bool = False,
) -> MastFit:
    """Fit 4, 6 or 8 numbers of the mast to images at many joint angles, the cameras taken as known.

    Parameters
    ----------
    views
        The images; those at their camera's reference angles say nothing.
    mast_parameters
        4 for a mast that stands upright (θx = θy = 0), 6 for the paper's, 8 for two skew axes.
    expected_px
        Residual rms to expect.
    rough
        (8,) where to start; else an upright mast under the cameras.
    keep_all
        Leave no image out and refuse no fit: for a mast of four parameters, which need not explain anything.

    Raises
    ------
    MastNotFitted
        If no start leads to a mast at which the fit settles and that explains most images.
    """
    if not views:
        raise MastNotFitted("no image was taken away from the angles at which its camera is calibrated")
    best: tuple[float, MastFit] | None = None
    for start in [rough] if rough is not None else _starts(views):
        if mast_parameters == 4 and start[3:5].any() and rough is None:
            continue
        found = _fit_from(start, views, mast_parameters, expected_px, keep_all)
        if best is None or found[0] < best[0]:
            best = found
        if best[0] < 3 * expected_px:
            break
    if best is None or not np.isfinite(best[0]):
        raise MastNotFitted(
            f"no start led to a mast at which the fit settled in {LAST_STEPS} steps; check pan and tilt "
            "(radians, right and up positive), and take images at more joint angles"
        )
    if best[0] > GROSS * expected_px and not keep_all:
        raise MastNotFitted(
            f"no mast explains the images: the best one leaves {best[0]:.1f} px where some "
            f"{expected_px:.2g} px are expected. Check pan and tilt (radians, right and up positive) and "
            "each image's placement; "
            "axes that do not meet at a right angle need eight parameters"
        )
    return best[1]


def _starts(views: Sequence[MastView]) -> list[FloatArray]:
    """Upright and leaning masts with the head's origin near the cameras."""
    centre = np.mean([view.camera.C for view in views], axis=0)
    starts = []
    for lean in LEAN_STARTS_RAD:
        for height in HEIGHT_STARTS_M:
            starts.append(np.array([*centre[:2], centre[2] + height, *lean, 0.0, 0.0, 0.0]))
    return starts


class _Images:
    """The problem of the mast's numbers, with a weight for every point."""

    def __init__(self, views: Sequence[MastView], free: np.ndarray, sigmas: Sequence[FloatArray]) -> None:
        self.views, self.free, self.sigmas = views, free, sigmas

    def normal(self, state: FloatArray) -> Normal:
        cost, matrix, gradient = 0.0, np.zeros((len(self.free),) * 2), np.zeros(len(self.free))
        carried, twists = _carried(self.views, state)
        for mine in _by_camera(self.views):
            points, sigma = (np.concatenate([parts[i] for i in mine]) for parts in (carried, self.sigmas))
            pixels, d_points, _ = self.views[mine[0]].camera.project_jacobian(points)
            off = pixels - np.concatenate([self.views[i].pixels_px for i in mine])
            by_twist = rigid_rates(d_points, points, np.zeros(3)) / sigma[:, None, None]
            moving = twists[np.repeat(mine, [len(carried[i]) for i in mine])][:, self.free]
            residual = (off / sigma[:, None]).ravel()
            jacobian = (by_twist @ moving.transpose(0, 2, 1)).reshape(len(residual), -1)
            cost += float(residual @ residual)
            matrix += jacobian.T @ jacobian
            gradient += jacobian.T @ residual
        return Normal(cost if np.isfinite(cost) else float("inf"), matrix, gradient)

    def cost(self, state: FloatArray) -> float:
        residuals = _residuals(self.views, state)
        cost = sum(
            float(np.sum((off / sigma[:, None]) ** 2))
            for off, sigma in zip(residuals, self.sigmas, strict=True)
        )
        return cost if np.isfinite(cost) else float("inf")

    def stepped(self, state: FloatArray, step: FloatArray) -> FloatArray:
        moved = state.copy()
        moved[self.free] += step
        return moved


def _by_camera(views: Sequence[MastView]) -> list[list[int]]:
    """Which images each camera took."""
    found: dict[int, list[int]] = {}
    for at, view in enumerate(views):
        found.setdefault(id(view.camera), []).append(at)
    return list(found.values())


def _residuals(views: Sequence[MastView], mast: FloatArray) -> list[FloatArray]:
    """Predicted less measured pixels (n, 2) of each image, not-a-number where there is no pixel."""
    carried, found = _carried(views, mast)[0], dict[int, FloatArray]()
    for mine in _by_camera(views):
        pixels, _ = views[mine[0]].camera.project(np.concatenate([carried[i] for i in mine]))
        ends = np.cumsum([len(carried[i]) for i in mine])[:-1]
        found |= dict(zip(mine, np.split(pixels, ends), strict=True))
    return [found[at] - view.pixels_px for at, view in enumerate(views)]


def _carried(views: Sequence[MastView], mast: FloatArray) -> tuple[list[FloatArray], FloatArray]:
    """Points (n, 3) of each image as they would lie in the rover frame were the head at its reference, and
    how the mast's eight numbers move them there: twists (images, 10, 6), of which the joints' are none."""
    now = gimbal(mast, *np.array([view.joints_rad for view in views]).T)
    then = gimbal(mast, *np.array([view.reference_rad for view in views]).T)
    turn = then.rotation @ now.rotation.transpose(0, 2, 1)
    shift = then.translation_m - (turn @ now.translation_m[..., None])[..., 0]
    carried = [v.points_m @ r.T + t for v, r, t in zip(views, turn, shift, strict=True)]
    turns, shifts = (part @ turn.transpose(0, 2, 1) for part in np.split(now.twists, 2, axis=2))
    moved = np.concatenate([turns, shifts + crossed(shift[:, None], turns)], axis=2)
    return carried, then.twists - moved


def _fit_from(
    start: FloatArray, views: Sequence[MastView], mast_parameters: int, expected_px: float, keep_all: bool
) -> tuple[float, MastFit]:
    """Typical residual of an image, infinite if the fit does not settle, and the fit, from a start."""
    mast = start
    few = [_thinned(view) for view in views]
    for steps, count in ((15, min(mast_parameters, 6)), (10, mast_parameters), (8, mast_parameters)):
        free = np.array(MAST_FREE[count])
        weak = np.full(len(free), 1e-4)
        seen = _seen(few, mast)
        mast = minimise(
            _Images(seen, free, _cauchy(seen, mast, expected_px)), mast, weak=weak, steps=steps
        ).state
    rms = _typical_px(views, mast)
    typical = float(np.median(rms))
    limit_px = GROSS * max(typical, expected_px)
    good = (rms <= limit_px) | keep_all
    kept = [view for view, keep in zip(views, good, strict=True) if keep]
    if np.isfinite(typical) and kept:
        sigmas = [np.ones(len(view.points_m)) for view in kept]
        last = minimise(_Images(kept, free, sigmas), mast, weak=weak, steps=LAST_STEPS)
        mast = last.state
        typical = float(np.median(_typical_px(views, mast))) if last.settled else np.inf
    else:
        kept = list(views)
    residuals = np.concatenate(_residuals(kept, mast))
    left_out = tuple(view.name for view, keep in zip(views, good, strict=True) if not keep)
    return typical, MastFit(mast, left_out, np.sqrt((residuals**2).mean(axis=0)), limit_px)


def _seen(views: Sequence[MastView], mast: FloatArray) -> Sequence[MastView]:
    """The images whose points all have a pixel, if they are most: another board may lie behind the camera."""
    residuals = _residuals(views, mast)
    seen = [view for view, off in zip(views, residuals, strict=True) if np.isfinite(off).all()]
    return seen if 2 * len(seen) > len(views) else views


def _thinned(view: MastView) -> MastView:
    """The image with some 20 of its points."""
    rows = np.linspace(0, len(view.points_m) - 1, min(20, len(view.points_m))).astype(int)
    return MastView(
        view.name, view.camera, view.reference_rad, view.joints_rad, view.points_m[rows], view.pixels_px[rows]
    )


def _typical_px(views: Sequence[MastView], mast: FloatArray) -> FloatArray:
    """What a coordinate of each image is typically off by (n,), infinite where most have no pixel."""
    images = np.repeat(np.arange(len(views)), [len(view.points_m) for view in views])
    return typical_px(np.concatenate(_residuals(views, mast)), images, len(views))


def _cauchy(views: Sequence[MastView], mast: FloatArray, expected_px: float) -> list[FloatArray]:
    """Sigmas that take the pull from images far from the typical one."""
    rms = _typical_px(views, mast)
    typical = max(float(np.median(rms)), expected_px)
    if not np.isfinite(typical):
        return [np.ones(len(view.points_m)) for view in views]
    return [
        np.full(len(view.points_m), np.sqrt(1 + (min(r, 1e6) / (2 * typical)) ** 2))
        for view, r in zip(views, rms, strict=True)
    ]
