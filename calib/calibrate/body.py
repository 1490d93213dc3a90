"""Correct the pose of a body pair from hand-offs: the paper's bias from two set-ups of the prisms.

The mast cameras define the rover frame here; the body's cameras move as one rigid body by a *step*: a turn
(3, radians, a rotation vector) about the middle of their centres and a shift (3, metres), rover axes. Clicks
and joint readings err once per hand-off, so the cameras of one hand-off share that part of the noise.

Weighted least squares gives the step. Targets at one range cannot separate a turn from a shift; a prior says
how far two prism set-ups can disagree, and directions in which the hand-offs add little to it are named. The
significance is that of the directions that the hand-offs do see, against no motion at all.

The corrected rig's covariance: with e what the rig's parameters are wrong by, the hand-offs' residuals are G
e + noise, and the step is K times them. The remainder e - LK (G e + noise) has the covariance (1 - LKG) P (1
- LKG)ᵀ + LK R (LK)ᵀ (Joseph's form, right for any K). It ties the corrected cameras to mast and mast cameras,
which they were corrected by.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from scipy.special import chdtri

from calib.adjust.gross import Outlier, bounded
from calib.errors import NoCorrection, NoStereoPoint
from calib.geometry.covariance import (
    MOST_SIGMAS,
    RayGap,
    RigCovariance,
    click_covariance,
    click_rates,
    pixel_rates,
    ray_gap,
    stored_covariance,
)
from calib.geometry.parameters import carried_errors, parameter_names, twist_rates
from calib.geometry.rig import Rig, gimbal, gimbal_rates, numbers_of
from calib.geometry.rigid import FloatArray, Rigid, moved_rigid, rigid_rates, rigid_twists
from calib.geometry.significance import Level, chance, sigmas
from calib.geometry.stereo import triangulate
from calib.matching.handoff import MODEL_PX, MatchedHandoff

PRIOR_SHIFT_M, PRIOR_TURN_RAD = 0.005, 0.005
"""Sigma an axis of how far two prism set-ups disagree: the paper's 5 mrad (2 mm at prisms 40 to 60 cm apart),
and what that and the 2 mm themselves do at a camera some 0.7 m from the prisms."""

STEP_NAMES = ("roll", "pitch", "yaw", "shift forward", "shift right", "shift down")
"""A step's six numbers: about and along the rover's x (forward), y (right), z (down)."""

SEEN = 4.0
"""A direction is seen if the hand-offs say four times as much of it as the prior."""

FEWEST = 8
"""Hand-offs: among fewer, a blunder does not stand out."""

SPREAD = 0.2
"""Of the picture's width, that found pixels must span at least."""

MOST_OUTLIERS = 1 / 3

_JOINTS = np.array([8, 9])
"""Pan and tilt among a gimbal's ten numbers."""

_PRIOR_SIGMA = np.array([PRIOR_TURN_RAD] * 3 + [PRIOR_SHIFT_M] * 3)
_PRIOR = np.diag(1.0 / _PRIOR_SIGMA**2)
_STEPS, _ROBUST_STEPS = 20, 10
"""Of Gauss and Newton at most. Weights by residuals need not settle: they only find what to leave out."""
_ENOUGH = 1e-3
"""A step shorter than this, in sigmas, is none."""


class Equations(NamedTuple):
    """Of n hand-offs and k cameras: found less predicted (n, 2k), its rates to a step (n, 2k, 6) and to the
    target's position (n, 2k, 3), and covariance (n, 2k, 2k).

    Rates are of the predicted pixels. A camera that found nothing has residual and rates 0 and covariance 1.
    """

    residual_px: FloatArray
    rates: FloatArray
    point_rates: FloatArray
    covariance_px2: FloatArray

    def normal(self, weights: FloatArray | None = None) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return information (6, 6), gradient (6,), and chi-square by hand-off (n,), these with weights
        (n,)."""
        inverse = np.linalg.inv(self.covariance_px2)
        weighed = np.einsum("nij,nik->njk", self.rates, inverse)  # (n, 6, 2k)
        counts = np.ones(len(weighed)) if weights is None else weights
        information = np.einsum("n,nij,njk->ik", counts, weighed, self.rates)
        gradient = np.einsum("n,nij,nj->i", counts, weighed, self.residual_px)
        return information, gradient, np.einsum("ni,nij,nj->n", self.residual_px, inverse, self.residual_px)


@dataclass(frozen=True, eq=False)
class BodySights:
    """The sights of a body pair's cameras (k,) by hand-offs (n,).

    ``origin_m`` (3,) is the middle of the cameras' centres, rover frame. The targets by the source pairs,
    from clicks and joint readings, are ``positions_m`` (n, 3), ``covariances_m2`` (n, 3, 3) and
    ``rates_m_per_px`` (n, 3, 4). ``found_px`` (n, k, 2) are found pixels, ``noise_px2`` (n, k, 2, 2) their
    noise, and ``seen`` (n, k) says which there are. ``apart`` are hand-offs whose clicks do not mean one
    point, and their gaps.
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


def body_sights(rig: Rig, cameras: Sequence[str], handoffs: Sequence[MatchedHandoff]) -> BodySights:
    """Return what the named body cameras found of the targets that pairs on the head handed over.

    Hand-offs from other pairs, without an accepted match, or whose clicks mean no point by this rig are
    left out. Clicks may be matches, so ``MODEL_PX`` counts for them too.
    """
    known = stored_covariance(rig)
    used, rows = list[MatchedHandoff](), list[tuple[FloatArray, ...]]()
    apart = list[tuple[MatchedHandoff, RayGap]]()
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
            noise[k] = match.found_covariance_px2 + MODEL_PX**2 * np.eye(2)
        if not seen.any():
            continue
        allowed_px2 = click_covariance(
            rig, one.pair, pan_rad, tilt_rad, target.position_m,
            sigma_px=one.sigma_px, sigma_rad=sigma_rad, calibration=known, model_px=MODEL_PX,
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
    positions_m, covariances_m2, rates, found, noise, seen = (
        np.array(column) for column in (zip(*rows, strict=True) if rows else [()] * 6)
    )
    origin_m = np.mean([rig.cameras[name].model.C for name in cameras], axis=0)
    return BodySights(
        rig, tuple(cameras), origin_m, tuple(used), positions_m, covariances_m2, rates, found, noise, seen,
        tuple(apart),
    )  # fmt: skip


@dataclass(frozen=True, eq=False)
class BodyPose:
    """A proposed correction of a body pair, and how sure it is.

    ``covariance`` (6, 6) is of the ``step`` (6,), with the prior; the turn is about ``origin_m`` (3,).
    ``motion`` is the same in the rover frame. ``rms_px`` is by camera ((x, y) before, (x, y) after), over the
    ``used`` hand-offs, ``chi2_before`` and ``chi2_after`` the weighted sums of squares of what is found less
    what is predicted; ``scale`` is the latter over its degrees of freedom where that is above 1: it widens
    the covariance. ``chance`` is that of hand-offs without any motion that seem as moved as these, the same
    in ``sigmas``; ``seen`` how many of the six directions they see, ``unseen`` a sentence for each that they
    do not.
    """

    cameras: tuple[str, ...]
    origin_m: FloatArray
    step: FloatArray
    covariance: FloatArray
    motion: Rigid
    used: BodySights
    outliers: tuple[Outlier, ...]
    rms_px: dict[str, tuple[tuple[float, float], tuple[float, float]]]
    chi2_before: float
    chi2_after: float
    degrees_of_freedom: float
    scale: float
    chance: float
    sigmas: float
    seen: int
    unseen: tuple[str, ...]

    @property
    def significant(self) -> bool:
        """Whether chance alone does so less often than three sigma."""
        return self.chance < Level.THREE_SIGMAS


def fit_body_pose(rig: Rig, cameras: Sequence[str], handoffs: Sequence[MatchedHandoff]) -> BodyPose:
    """Fit the rigid motion of body cameras that brings geometric hand-offs to where pictures show targets.

    The rig's mast and head cameras stay; the body ``cameras`` move as one, see `body_groups`. Hand-offs
    without accepted matches in those cameras, or not from a pair on the head, are passed over.

    Raises
    ------
    NoCorrection
        ``too_few``: fewer than eight hand-offs. ``one_sided``: the found pixels span less than a fifth of
        the picture. ``inconsistent``: more than a third of the hand-offs contradict the rest.
        ``not_settled``: the fit did not.
    """
    every = body_sights(rig, cameras, handoffs)
    _enough(every)
    keep = _keep(every)
    if np.mean(~keep) > MOST_OUTLIERS:
        raise NoCorrection(
            "inconsistent",
            f"{np.sum(~keep)} of {len(keep)} hand-offs to {' and '.join(cameras)} contradict the rest; check "
            "them before anything is corrected by them",
        )
    used = every.part(keep)
    _enough(used)
    fit = _fit(used)
    if not fit.settled:
        raise NoCorrection(
            "not_settled",
            f"the fit of {' and '.join(cameras)} did not settle in {_STEPS} steps; the hand-offs hardly "
            "fix it",
        )
    left_out = [Outlier("clicks", one.name, gap.across_px) for one, gap in every.apart]
    at = every.equations(fit.step)
    for i in np.flatnonzero(~keep):
        off = float(np.linalg.norm(at.residual_px[i].reshape(-1, 2), axis=1).max())
        left_out.append(Outlier("hand-off", every.handoffs[i].name, off))
    return _correction(used, fit, tuple(left_out))


class _BodyFit(NamedTuple):
    """A step and how it was found; the covariance has the prior, and is widened by the scale."""

    step: FloatArray
    before: Equations
    after: Equations
    scale: float
    freedom: float
    settled: bool
    covariance: FloatArray


def _enough(sights: BodySights) -> None:
    """Refuse too few hand-offs, and those from one corner of the picture."""
    named = " and ".join(sights.cameras)
    count = len(sights.handoffs)
    if count < FEWEST:
        raise NoCorrection(
            "too_few",
            f"{count} usable hand-offs to {named}; at least {FEWEST} that were accepted are needed",
        )
    spans = []
    for k, name in enumerate(sights.cameras):
        found = sights.found_px[sights.seen[:, k], k]
        if len(found) > 1:
            main = np.linalg.svd(found - found.mean(axis=0), full_matrices=False)[2][0]
            spans.append((float(np.ptp(found @ main)), sights.rig.cameras[name].model.size_px[0], name))
    span, width, name = max(spans)
    if span < SPREAD * width:
        raise NoCorrection(
            "one_sided",
            f"the targets found in {name} lie within {span:.0f} px of its {width}; hand-offs over at least "
            f"{SPREAD * width:.0f} px are needed to separate a turn from a shift",
        )


def _fit(sights: BodySights, robust: bool = False) -> _BodyFit:
    """Gauss-Newton; ``robust`` weighs hand-offs down by Huber's rule beyond the 95 % point."""
    step, scale, settled, weights = np.zeros(6), 1.0, False, None
    before = at = sights.equations(step)
    numbers = 2 * sights.seen.sum(axis=1)
    bend, middle = chdtri(numbers, 0.05), chdtri(numbers, 0.5)
    for _ in range(_ROBUST_STEPS if robust else _STEPS):
        if robust:
            weights = np.sqrt(bounded(at.normal()[2] / scale, bend))
        information, gradient, _ = at.normal(weights)
        normal = information / scale + _PRIOR
        change = np.linalg.solve(normal, gradient / scale - _PRIOR @ step)
        step = step + change
        settled = bool(change @ normal @ change < _ENOUGH**2)
        at = sights.equations(step)
        statistics = at.normal()[2]
        fitted = np.trace(np.linalg.solve(information / scale + _PRIOR, information / scale))
        freedom = max(float(numbers.sum() - fitted), 1.0)
        # of the typical statistic: blunders do not move it
        typical = np.median(statistics / middle) if robust else float(statistics.sum()) / freedom
        scale = max(1.0, float(typical))
        if settled:
            break
    covariance = np.asarray(np.linalg.inv(at.normal()[0] / scale + _PRIOR))
    return _BodyFit(step, before, at, scale, freedom, settled, covariance)


def _keep(sights: BodySights) -> np.ndarray:
    """Which hand-offs (n,) agree: the worst goes alone, the fit is done again, and what passes comes
    back."""
    limits = chdtri(2 * sights.seen.sum(axis=1), Level.MEASUREMENT / len(sights.handoffs))
    robust = _fit(sights, robust=True)
    keep = robust.after.normal()[2] / robust.scale <= limits
    for _ in range(len(keep)):
        if np.mean(~keep) > MOST_OUTLIERS:
            break
        fit = _fit(sights.part(keep))
        at = sights.equations(fit.step)
        spread = np.einsum("nij,jk,nlk->nil", at.rates, fit.covariance, at.rates)
        # A fitted residual is less sure than its noise by what the fit took; one left out, more.
        total = fit.scale * at.covariance_px2 - np.where(keep, 1.0, -1.0)[:, None, None] * spread
        statistics = np.einsum("ni,nij,nj->n", at.residual_px, np.linalg.inv(total), at.residual_px)
        failing = keep & (statistics > limits)
        new = keep | (statistics <= limits)
        if failing.any():
            new[np.argmax(np.where(failing, statistics / limits, 0.0))] = False
        if (new == keep).all():
            break
        keep = new
    return np.asarray(keep)


def _correction(used: BodySights, fit: _BodyFit, outliers: tuple[Outlier, ...]) -> BodyPose:
    """Significance, open directions, and what becomes of the residuals."""
    information, gradient, statistics = fit.before.normal()
    # In units of the prior's sigma: what the hand-offs say of each direction, against 1 that the prior says.
    unit = np.diag(_PRIOR_SIGMA)
    says, directions = np.linalg.eigh(unit @ information @ unit)
    seen = says / fit.scale >= SEEN
    explained = float(np.sum((directions.T @ unit @ gradient)[seen] ** 2 / says[seen]))
    probability = chance(explained, int(seen.sum()), fit.scale, fit.freedom)
    rms = {}
    for k, name in enumerate(used.cameras):
        on = used.seen[:, k]
        if on.any():
            before, after = (
                np.sqrt(np.mean(at.residual_px[on, 2 * k : 2 * k + 2] ** 2, axis=0)).tolist()
                for at in (fit.before, fit.after)
            )
            rms[name] = (before[0], before[1]), (after[0], after[1])
    return BodyPose(
        cameras=used.cameras,
        origin_m=used.origin_m,
        step=fit.step,
        covariance=fit.covariance,
        motion=used.pose(fit.step),
        used=used,
        outliers=outliers,
        rms_px=rms,
        chi2_before=float(statistics.sum()),
        chi2_after=float(fit.after.normal()[2].sum()),
        degrees_of_freedom=fit.freedom,
        scale=fit.scale,
        chance=probability,
        sigmas=sigmas(probability),
        seen=int(seen.sum()),
        unseen=tuple(_sentence(direction) for direction in directions.T[~seen]),
    )


def _sentence(direction: FloatArray) -> str:
    """A direction that the hand-offs leave to the prior."""
    toward = direction * np.sign(direction[np.argmax(np.abs(direction))])
    large = sorted(zip(-np.abs(toward), toward, STEP_NAMES, strict=True))
    parts = [f"{weight:+.2f} {name}" for size, weight, name in large if size < -0.3]
    return (
        f"not determined by these hand-offs: {' with '.join(parts)}, in units of {1e3 * PRIOR_SHIFT_M:g} mm "
        f"and {1e3 * PRIOR_TURN_RAD:g} mrad; only the prior holds it"
    )


def corrected_rig(rig: Rig, correction: BodyPose) -> Rig:
    """Return the rig with the correction's cameras moved; mast, head cameras and ``fit`` as they were."""
    cameras = dict(rig.cameras)
    for name in correction.cameras:
        cameras[name] = replace(cameras[name], model=cameras[name].model.moved(correction.motion))
    return replace(rig, cameras=cameras)


def corrected_covariance(rig: Rig, known: RigCovariance, correction: BodyPose) -> RigCovariance:
    """Return the covariance of the corrected rig's parameters; ``rig`` and ``known`` are those before."""
    size = len(known.names)
    per_step, carried = np.zeros((size, 6)), np.eye(size)
    places = {name: i for i, name in enumerate(known.names)}
    twists = rigid_twists(correction.origin_m + correction.step[3:]).T
    for camera in correction.cameras:
        model = rig.cameras[camera].model
        names = [f"cameras.{camera}.{part}" for part in parameter_names(model.kind)]
        mine = [i for i, name in enumerate(names) if name in places]
        rows = [places[names[i]] for i in mine]
        moved = model.moved(correction.motion)
        per_step[rows] = (twist_rates(moved) @ twists)[mine]
        errors = carried_errors(model, moved, correction.motion.rotation)
        carried[np.ix_(rows, rows)] = errors[np.ix_(mine, mine)]
    at = correction.used.equations(correction.step)
    inverse = np.linalg.inv(at.covariance_px2)
    gain = np.einsum("ij,nkj,nkl->inl", correction.covariance / correction.scale, at.rates, inverse)
    by_residual = np.einsum("pi,inl->pnl", per_step, gain)  # L K
    stays = carried - np.einsum("pnl,nlq->pq", by_residual, _parameter_rates(rig, known, correction))
    noise = correction.scale * at.covariance_px2
    total = stays @ known.covariance @ stays.T + np.einsum("pnl,nlm,qnm->pq", by_residual, noise, by_residual)
    return RigCovariance(known.names, (total + total.T) / 2)


def _parameter_rates(rig: Rig, known: RigCovariance, correction: BodyPose) -> FloatArray:
    """(n, 2k, p): predicted pixels' rates to the rig's parameters, those of the source pair included."""
    used, equations = correction.used, correction.used.equations(np.zeros(6))
    count, cameras = used.seen.shape
    rates = np.zeros((count, cameras, 2, len(known.names)))
    for k, name in enumerate(used.cameras):
        on = used.seen[:, k]
        rates[on, k] = pixel_rates(rig, known.names, name, 0.0, 0.0, used.positions_m[on]).to_rig
    flat = rates.reshape(count, 2 * cameras, -1)
    for i, one in enumerate(used.handoffs):
        joints = (one.joints.pan_rad, one.joints.tilt_rad)
        clicked = click_rates(rig, known.names, one.pair, *joints, used.positions_m[i])
        flat[i] += equations.point_rates[i] @ used.rates_m_per_px[i] @ clicked
    return flat
