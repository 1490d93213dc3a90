"""Accepted hand-offs as equations for the pose of a body pair: what is off, by which rates, how surely.

The mast cameras define the rover frame here; the body's cameras move as one rigid body by a *step*: a shift
(3, metres) and a turn (3, radians, a rotation vector) about the middle of their centres, rover axes.
Clicks and joint readings err once per hand-off, so the cameras of one hand-off share that part of the noise.

`calib.calibrate.body` makes a correction of them, with what was left out.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from calib.adjust.significance import THREE_SIGMAS
from calib.errors import NoStereoPoint
from calib.geometry.covariance import (
    MOST_SIGMAS,
    RIG_PX,
    RayGap,
    RigCovariance,
    click_covariance,
    ray_gap,
    silent_cameras,
    stored_covariance,
)
from calib.geometry.rig import Rig, gimbal, gimbal_rates, numbers_of
from calib.geometry.rigid import FloatArray, Rigid, moved_rigid, rigid_rates
from calib.geometry.stereo import Triangulation, triangulate
from calib.matching.handed_over import MODEL_PX, MatchedHandoff

_JOINTS = np.array([8, 9])
"""Pan and tilt among a gimbal's ten numbers."""


class Equations(NamedTuple):
    """Of n hand-offs and k cameras: found less predicted (n, 2k), its rates to a step (n, 2k, 6) and to the
    target's position (n, 2k, 3), and covariance (n, 2k, 2k).

    Rates are of the predicted pixels. A camera that found nothing has residual and rates 0 and covariance 1.
    """

    residual_px: FloatArray
    rates: FloatArray
    point_rates: FloatArray
    covariance_px2: FloatArray


@dataclass(frozen=True, eq=False)
class BodySights:
    """The sights of a body pair's cameras.

    Attributes
    ----------
    cameras
        (k,) names.
    origin_m
        (3,) middle of their centres, rover frame.
    handoffs
        (n,) those with at least one accepted match and a source on the head.
    positions_m, covariances_m2, rates_m_per_px
        (n, 3), (n, 3, 3) and (n, 3, 4): the targets by the source pairs, from clicks and joint readings.
    found_px, noise_px2, seen
        (n, k, 2), (n, k, 2, 2) and (n, k): found pixels and their noise; which there are.
    apart
        Hand-offs that are not among them since their clicks do not mean one point, and their gaps.
    """

    rig: Rig
    cameras: tuple[str, ...]
    origin_m: FloatArray
    handoffs: tuple[MatchedHandoff, ...]
    positions_m: FloatArray
    covariances_m2: FloatArray
    rates_m_per_px: FloatArray
    found_px: FloatArray
    noise_px2: FloatArray
    seen: np.ndarray
    apart: tuple[tuple[MatchedHandoff, RayGap], ...] = ()

    def pose(self, step: FloatArray) -> Rigid:
        """Return the rigid motion that a step is, in the rover frame."""
        return moved_rigid(Rigid(np.eye(3), self.origin_m), step) @ Rigid(np.eye(3), -self.origin_m)

    def equations(self, step: FloatArray) -> Equations:
        """Return the equations with the body's cameras moved by a step (6,)."""
        moved = self.pose(step)
        count, eyes = self.seen.shape
        residual = np.zeros((count, eyes, 2))
        rates, point_rates = np.zeros((count, eyes, 2, 6)), np.zeros((count, eyes, 2, 3))
        covariance = np.zeros((count, eyes, 2, eyes, 2))
        for eye, name in enumerate(self.cameras):
            on = self.seen[:, eye]
            model = self.rig.cameras[name].model.moved(moved)
            pixels, per_point, _ = model.project_jacobian(self.positions_m[on])
            residual[on, eye] = self.found_px[on, eye] - pixels
            point_rates[on, eye] = per_point
            # A camera that moves one way sees its targets go the other.
            rates[on, eye] = -rigid_rates(per_point, self.positions_m[on], self.origin_m + step[3:])
            covariance[on, eye, :, eye] = self.noise_px2[on, eye]
            covariance[~on, eye, :, eye] = np.eye(2)
        flat = point_rates.reshape(count, 2 * eyes, 3)
        total = covariance.reshape(count, 2 * eyes, 2 * eyes)
        total += np.einsum("nij,njk,nlk->nil", flat, self.covariances_m2, flat)
        return Equations(residual.reshape(count, 2 * eyes), rates.reshape(count, 2 * eyes, 6), flat, total)


def body_groups(rig: Rig) -> dict[str, tuple[str, ...]]:
    """Return the cameras on the body that move as one: each stereo pair, and each camera without one."""
    groups: dict[str, tuple[str, ...]] = {
        pair: names
        for pair, names in rig.stereo.items()
        if all(rig.cameras[name].on == "rover" for name in names)
    }
    paired = {name for names in groups.values() for name in names}
    alone = [name for name, camera in rig.cameras.items() if camera.on == "rover" and name not in paired]
    return groups | {name: (name,) for name in alone}


def body_sights(
    rig: Rig, cameras: Sequence[str], handoffs: Sequence[MatchedHandoff], model_px: float = MODEL_PX
) -> BodySights:
    """Return what the named body cameras found of the targets that pairs on the head handed over.

    Hand-offs from other pairs, without an accepted match, or whose clicks mean no point by this rig are
    left out. Clicks may be matches, so ``model_px`` counts for them too.

    Raises
    ------
    CalibError
        If the rig's stored covariance is none of it.
    """
    known = stored_covariance(rig)
    origin = np.mean([rig.cameras[name].model.C for name in cameras], axis=0)
    used, rows, apart = [], [], []
    for one in handoffs:
        if not all(name in rig.cameras and rig.cameras[name].on == "head" for name in one.pair):
            continue
        seen = _seen(rig, one)
        row = None if seen is None else _row(rig, cameras, one, seen, model_px)
        if seen is None or row is None:
            continue
        gap = ray_gap(seen, _allowed_px2(rig, one, seen, known, model_px))
        if gap.sigmas > MOST_SIGMAS:
            apart.append((one, gap))
        else:
            used.append(one)
            rows.append(row)
    k = len(cameras)
    shapes = ((3,), (3, 3), (3, 4), (k, 2), (k, 2, 2), (k,))
    position, covariance, rates, found, noise, there = (
        np.array([row[i] for row in rows]).reshape(len(rows), *shape) for i, shape in enumerate(shapes)
    )
    return BodySights(
        rig, tuple(cameras), origin, tuple(used), position, covariance, rates, found, noise,
        there.astype(bool), tuple(apart),
    )  # fmt: skip


def _seen(rig: Rig, one: MatchedHandoff) -> Triangulation | None:
    """The point of a hand-off's clicks by this rig; None if there is none."""
    left, right = (rig.camera_in_rover(n, one.joints.pan_rad, one.joints.tilt_rad) for n in one.pair)
    try:
        return triangulate(left, right, one.clicks_px[0], one.clicks_px[1], one.sigma_px)
    except NoStereoPoint:
        return None


def _allowed_px2(
    rig: Rig, one: MatchedHandoff, seen: Triangulation, known: RigCovariance | None, model_px: float
) -> FloatArray:
    """Covariance (4, 4) of a hand-off's clicks that a gap of its rays is judged by."""
    allowed = click_covariance(
        rig, one.pair, one.joints.pan_rad, one.joints.tilt_rad, seen.position_m,
        sigma_px=one.sigma_px, sigma_rad=one.joints.sigma_rad, calibration=known,
    )  # fmt: skip
    unknown = silent_cameras(one.pair, known)
    model_px2 = [RIG_PX**2 if name in unknown else model_px**2 for name in one.pair]
    return np.asarray(allowed + np.diag(np.repeat(model_px2, 2)))


def _row(
    rig: Rig, cameras: Sequence[str], one: MatchedHandoff, seen: Triangulation, model_px: float
) -> tuple[FloatArray, ...] | None:
    """One hand-off's position, covariance, rates, found pixels, their noise, and which are there."""
    at = (one.joints.pan_rad, one.joints.tilt_rad)
    turned = gimbal_rates(np.eye(3)[None], seen.position_m[None], gimbal(numbers_of(rig.mast), *at), _JOINTS)[
        0
    ]
    covariance = seen.covariance_m2 + one.joints.sigma_rad**2 * turned @ turned.T
    found, noise = np.zeros((len(cameras), 2)), np.zeros((len(cameras), 2, 2))
    there = np.zeros(len(cameras), dtype=bool)
    accepted = one.found
    for eye, name in enumerate(cameras):
        match = accepted.get(name)
        if match is None or not rig.cameras[name].model.project(seen.position_m)[1]:
            continue
        assert match.found_px is not None and match.found_covariance_px2 is not None
        found[eye], there[eye] = match.found_px, True
        noise[eye] = match.found_covariance_px2 + model_px**2 * np.eye(2)
    if not there.any():
        return None
    return seen.position_m, covariance, seen.rates_m_per_px, found, noise, there


PRIOR_SHIFT_M, PRIOR_TURN_RAD = 0.005, 0.005
"""Sigma an axis of how far two prism set-ups disagree: the paper's 5 mrad (2 mm at prisms 40 to 60 cm apart),
and what that and the 2 mm themselves do at a camera some 0.7 m from the prisms."""

WORDS = ("roll", "pitch", "yaw", "shift forward", "shift right", "shift down")
"""A step's six numbers: about and along the rover's x (forward), y (right), z (down)."""


@dataclass(frozen=True, eq=False)
class LeftOutHandoff:
    """A hand-off that was not used: which, by how much (px), and the failed test.

    It contradicts the rest, by ``off_px`` in the worst camera; or, if it is not ``one_point``, its clicks
    contradict each other, by ``off_px`` across the epipolar line.
    """

    name: str
    off_px: float
    statistic: float
    limit: float
    one_point: bool = True

    @property
    def sentence(self) -> str:
        """The outlier in words."""
        if not self.one_point:
            return (
                f"{self.name} was not used: its two clicks do not mean one point, they are "
                f"{self.off_px:.1f} px apart across the epipolar line, {math.sqrt(self.statistic):.1f} sigma"
            )
        return f"{self.name} is off by {self.off_px:.1f} px after the correction and was not used"


@dataclass(frozen=True, eq=False)
class EyesApart:
    """The remainder between the two cameras of a pair: mean of right less left, px, covariance, sigmas.

    One rigid motion cannot explain it: one camera moved by itself, or its model is off.
    """

    offset_px: FloatArray
    covariance_px2: FloatArray
    sigmas: float


@dataclass(frozen=True, eq=False)
class BodyPose:
    """A proposed correction of a body pair, and how sure it is.

    Attributes
    ----------
    cameras
        Which move.
    origin_m
        (3,) the middle of their centres before, rover frame: the turn is about it.
    step
        (6,) rotation vector, radians, and shift, metres, rover axes.
    covariance
        (6, 6) of the step, with the prior.
    gain
        (6, n, 2k): the step is the sum of gain times residual over the used hand-offs' pixels.
    motion
        The same motion of the cameras as a transform in the rover frame.
    used, outliers
        Names of the hand-offs that were, and those that were not.
    rms_px
        Camera to ((x, y) before, (x, y) after), over the used hand-offs.
    chi2_before, chi2_after, degrees_of_freedom
        Weighted sum of squares of what is found less what is predicted, and what it is expected to be after.
    scale
        ``chi2_after`` over its degrees of freedom where that is above 1: the covariance is widened by it.
    chance, sigmas
        Of hand-offs without any motion that look as moved as these, and the same in sigmas.
    seen
        How many of the six directions the hand-offs see.
    unseen
        A sentence for each that they do not see.
    eyes_apart
        For a pair that both found a target of.
    """

    cameras: tuple[str, ...]
    origin_m: FloatArray
    step: FloatArray
    covariance: FloatArray
    gain: FloatArray
    motion: Rigid
    used: BodySights
    outliers: tuple[LeftOutHandoff, ...]
    rms_px: dict[str, tuple[tuple[float, float], tuple[float, float]]]
    chi2_before: float
    chi2_after: float
    degrees_of_freedom: float
    scale: float
    chance: float
    sigmas: float
    seen: int
    unseen: tuple[str, ...]
    eyes_apart: EyesApart | None

    @property
    def significant(self) -> bool:
        """Whether chance alone does so less often than three sigma."""
        return self.chance < THREE_SIGMAS
