"""Accepted hand-offs as equations for the pose of a body pair: what is off, by which rates, how surely.

The mast cameras define the rover frame here; the body's cameras move as one rigid body by a *step*: a turn
(3, radians, a rotation vector) about the middle of their centres and a shift (3, metres), rover axes.
Clicks and joint readings err once per hand-off, so the cameras of one hand-off share that part of the noise.

`calib.calibrate.body` makes a correction of them, with what was left out.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from calib.errors import NoStereoPoint
from calib.geometry.covariance import (
    MOST_SIGMAS,
    RayGap,
    click_covariance,
    ray_gap,
    stored_covariance,
)
from calib.geometry.rig import Rig, gimbal, gimbal_rates, numbers_of
from calib.geometry.rigid import FloatArray, Rigid, moved_rigid, rigid_rates
from calib.geometry.stereo import triangulate
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
    """The sights of a body pair's cameras (k,) by hand-offs (n,).

    Attributes
    ----------
    origin_m
        (3,) middle of the cameras' centres, rover frame.
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

    def part(self, keep: np.ndarray) -> BodySights:
        """Return the same with some (n,) of the hand-offs."""
        arrays = ("positions_m", "covariances_m2", "rates_m_per_px", "found_px", "noise_px2", "seen")
        handoffs = tuple(one for one, good in zip(self.handoffs, keep, strict=True) if good)
        return replace(self, handoffs=handoffs, **{name: getattr(self, name)[keep] for name in arrays})

    def pose(self, step: FloatArray) -> Rigid:
        """Return the rigid motion that a step is, in the rover frame."""
        return moved_rigid(Rigid(np.eye(3), self.origin_m), step) @ Rigid(np.eye(3), -self.origin_m)

    def equations(self, step: FloatArray) -> Equations:
        """Return the equations with the body's cameras moved by a step (6,)."""
        moved = self.pose(step)
        count, cameras = self.seen.shape
        residual = np.zeros((count, cameras, 2))
        rates, point_rates = np.zeros((count, cameras, 2, 6)), np.zeros((count, cameras, 2, 3))
        covariance = np.zeros((count, cameras, 2, cameras, 2))
        for k, name in enumerate(self.cameras):
            on = self.seen[:, k]
            model = self.rig.cameras[name].model.moved(moved)
            pixels, per_point, _ = model.project_jacobian(self.positions_m[on])
            residual[on, k] = self.found_px[on, k] - pixels
            point_rates[on, k] = per_point
            # A camera that moves one way sees its targets go the other.
            rates[on, k] = -rigid_rates(per_point, self.positions_m[on], self.origin_m + step[3:])
            covariance[on, k, :, k] = self.noise_px2[on, k]
            covariance[~on, k, :, k] = np.eye(2)
        flat = point_rates.reshape(count, 2 * cameras, 3)
        total = covariance.reshape(count, 2 * cameras, 2 * cameras)
        total += np.einsum("nij,njk,nlk->nil", flat, self.covariances_m2, flat)
        return Equations(
            residual.reshape(count, 2 * cameras), rates.reshape(count, 2 * cameras, 6), flat, total
        )


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
    used, rows, apart = (
        list[MatchedHandoff](),
        list[tuple[FloatArray, ...]](),
        list[tuple[MatchedHandoff, RayGap]](),
    )
    for one in handoffs:
        if not all(name in rig.cameras and rig.cameras[name].on == "head" for name in one.pair):
            continue
        pan_rad, tilt_rad, sigma_rad = one.joints.pan_rad, one.joints.tilt_rad, one.joints.sigma_rad
        left, right = (rig.camera_in_rover(name, pan_rad, tilt_rad) for name in one.pair)
        try:
            target = triangulate(left, right, one.clicks_px[0], one.clicks_px[1], one.sigma_px)
        except NoStereoPoint:
            continue
        found, noise = np.zeros((len(cameras), 2)), np.zeros((len(cameras), 2, 2))
        seen = np.zeros(len(cameras), dtype=bool)
        for k, name in enumerate(cameras):
            match = one.found.get(name)
            if match is None or not rig.cameras[name].model.project(target.position_m)[1]:
                continue
            assert match.found_px is not None and match.found_covariance_px2 is not None
            found[k], seen[k] = match.found_px, True
            noise[k] = match.found_covariance_px2 + model_px**2 * np.eye(2)
        if not seen.any():
            continue
        allowed_px2 = click_covariance(
            rig, one.pair, pan_rad, tilt_rad, target.position_m,
            sigma_px=one.sigma_px, sigma_rad=sigma_rad, calibration=known, model_px=model_px,
        )  # fmt: skip
        gap = ray_gap(target, allowed_px2)
        if gap.sigmas > MOST_SIGMAS:
            apart.append((one, gap))
            continue
        head = gimbal(numbers_of(rig.mast), pan_rad, tilt_rad)
        turned = gimbal_rates(np.eye(3)[None], target.position_m[None], head, _JOINTS)[0]
        covariance = target.covariance_m2 + sigma_rad**2 * turned @ turned.T
        used.append(one)
        rows.append((target.position_m, covariance, target.rates_m_per_px, found, noise, seen))
    k = len(cameras)
    shapes = ((3,), (3, 3), (3, 4), (k, 2), (k, 2, 2), (k,))
    position, covariance, rates, found, noise, seen = (
        np.array([row[i] for row in rows]).reshape(len(rows), *shape) for i, shape in enumerate(shapes)
    )
    return BodySights(
        rig, tuple(cameras), np.mean([rig.cameras[name].model.C for name in cameras], axis=0), tuple(used),
        position, covariance, rates, found, noise, seen.astype(bool), tuple(apart),
    )  # fmt: skip
