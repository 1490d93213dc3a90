"""Accepted hand-offs as equations for the pose of a body pair: what is off, by which rates, how surely.

The mast cameras define the rover frame here; the body's cameras move as one rigid body by a *step*: a shift
(3, metres) and a turn (3, radians, a rotation vector) about the middle of their centres, rover axes.
Clicks and joint readings err once per hand-off, so the eyes of one hand-off share that part of the noise.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from calib.camera.stereo import Triangulation, triangulate
from calib.errors import NoStereoPoint
from calib.handoff.matched import MODEL_PX, MatchedHandoff
from calib.mast.covariance import RigCovariance, stored_covariance
from calib.mast.gimbal import gimbal, gimbal_rates, numbers_of
from calib.mast.ray_gap import MOST_SIGMAS, RIG_PX, RayGap, ray_gap, silent_cameras
from calib.mast.rig import Rig
from calib.mast.rig_rates import click_covariance
from calib.rigid import FloatArray, Rigid, moved_rigid, rigid_rates

_JOINTS = np.array([8, 9])
"""Pan and tilt among a gimbal's ten numbers."""


class Equations(NamedTuple):
    """Of n hand-offs and k eyes: found less predicted (n, 2k), its rates to a step (n, 2k, 6) and to the
    target's position (n, 2k, 3), and covariance (n, 2k, 2k).

    Rates are of the predicted pixels. What an eye did not find has residual and rates 0 and covariance 1.
    """

    residual_px: FloatArray
    rates: FloatArray
    point_rates: FloatArray
    covariance_px2: FloatArray


@dataclass(frozen=True, eq=False)
class BodySights:
    """What the cameras of a body pair found.

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
