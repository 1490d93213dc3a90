"""Correct the pose of a body pair from hand-offs: the paper's bias from two set-ups of the prisms.

Weighted least squares for one rigid motion of the pair against the mast cameras, which define the rover
frame. Targets at one range cannot separate a turn from a shift; a prior says how far two prism set-ups can
disagree, and directions in which the hand-offs add little to it are named. The significance is that of the
directions that the hand-offs do see, against no motion at all.

The corrected rig's covariance: with e what the rig's parameters are wrong by, the hand-offs' residuals are G
e + noise, and the step is K times them. The remainder e - LK (G e + noise) has the covariance (1 - LKG) P (1
- LKG)ᵀ + LK R (LK)ᵀ (Joseph's form, right for any K). It ties the corrected cameras to mast and mast cameras,
which they were corrected by.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import chdtri

from calib.adjust.gross import bounded, worst_first
from calib.adjust.outliers import Outlier
from calib.calibrate.body_sights import BodySights, Equations, body_sights
from calib.errors import NoCorrection
from calib.geometry.covariance import MOST_SIGMAS, RigCovariance, click_rates, pixel_rates
from calib.geometry.parameters import carried_errors, parameter_names, twist_rates
from calib.geometry.rig import Rig
from calib.geometry.rigid import FloatArray, Rigid, rigid_twists
from calib.geometry.significance import Level, chance, sigmas
from calib.matching.handed_over import MatchedHandoff

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


@dataclass(frozen=True, eq=False)
class CamerasApart:
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
    origin_m
        (3,) the middle of the moved cameras' centres before, rover frame: the turn is about it.
    step, covariance
        (6,) rotation vector, radians, and shift, metres, rover axes; (6, 6) with the prior.
    gain
        (6, n, 2k): by the residuals of the used hand-offs the step is gain times these.
    motion
        The same motion of the cameras as a transform in the rover frame.
    rms_px
        Camera to ((x, y) before, (x, y) after), over the used hand-offs.
    chi2_before, chi2_after, degrees_of_freedom
        Weighted sum of squares of what is found less what is predicted, and what it is expected to be after.
    scale
        ``chi2_after`` over its degrees of freedom where that is above 1: the covariance is widened by it.
    chance, sigmas
        Of hand-offs without any motion that seem as moved as these, and the same in sigmas.
    seen, unseen
        How many of the six directions the hand-offs see, and a sentence for each that they do not.
    """

    cameras: tuple[str, ...]
    origin_m: FloatArray
    step: FloatArray
    covariance: FloatArray
    gain: FloatArray
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
    cameras_apart: CamerasApart | None

    @property
    def significant(self) -> bool:
        """Whether chance alone does so less often than three sigma."""
        return self.chance < Level.THREE_SIGMAS


def fit_body_pose(rig: Rig, cameras: Sequence[str], handoffs: Sequence[MatchedHandoff]) -> BodyPose:
    """Fit the rigid motion of body cameras that brings geometric hand-offs to where pictures show targets.

    The rig's mast and head cameras stay; the body ``cameras`` move as one, see
    `calib.calibrate.body_sights.body_groups`. Hand-offs without accepted matches in those cameras, or not
    from a pair on the head, are passed over.

    Raises
    ------
    NoCorrection
        ``too_few``: fewer than eight hand-offs. ``one_sided``: the found pixels span less than a fifth of
        the picture. ``inconsistent``: more than a third of the hand-offs contradict the rest.
        ``not_settled``: the fit did not.
    """
    every = body_sights(rig, cameras, handoffs)
    _enough(every)
    keep, statistics, limits = _keep(every)
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
    left_out = [
        Outlier("clicks", one.name, gap.sigmas**2, MOST_SIGMAS**2, gap.across_px) for one, gap in every.apart
    ]
    at = every.equations(fit.step)
    for i in np.flatnonzero(~keep):
        off = float(np.linalg.norm(at.residual_px[i].reshape(-1, 2), axis=1).max())
        left_out.append(
            Outlier("hand-off", every.handoffs[i].name, float(statistics[i]), float(limits[i]), off)
        )
    return _correction(used, fit, tuple(left_out))


@dataclass(frozen=True, eq=False)
class _BodyFit:
    step: FloatArray
    before: Equations
    after: Equations
    information: FloatArray
    """(6, 6) of the hand-offs alone, by stated sigmas."""
    scale: float
    freedom: float
    chi2: float
    settled: bool

    @property
    def covariance(self) -> FloatArray:
        return np.asarray(np.linalg.inv(self.information / self.scale + _PRIOR))


_PRIOR_SIGMA = np.array([PRIOR_TURN_RAD] * 3 + [PRIOR_SHIFT_M] * 3)
_PRIOR = np.diag(1.0 / _PRIOR_SIGMA**2)
_STEPS, _ROBUST_STEPS = 20, 10
"""Of Gauss and Newton at most. Weights by residuals need not settle: they only find what to leave out."""
_ENOUGH = 1e-3
"""A step shorter than this, in sigmas, is none."""


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


def _normal(at: Equations, weights: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Information (6, 6), gradient (6,), chi-square by hand-off (n,); ``weights`` (n,) of the hand-offs."""
    inverse = np.linalg.inv(at.covariance_px2)
    weighed = np.einsum("nij,nik->njk", at.rates, inverse)  # (n, 6, 2k)
    information = np.einsum("n,nij,njk->ik", weights, weighed, at.rates)
    gradient = np.einsum("n,nij,nj->i", weights, weighed, at.residual_px)
    statistics = np.einsum("ni,nij,nj->n", at.residual_px, inverse, at.residual_px)
    return information, gradient, statistics


def _fit(sights: BodySights, robust: bool = False) -> _BodyFit:
    """Gauss-Newton; ``robust`` weighs hand-offs down by Huber's rule beyond the 95 % point."""
    step, scale, settled = np.zeros(6), 1.0, False
    before = at = sights.equations(step)
    numbers = 2 * sights.seen.sum(axis=1)
    bend, middle = chdtri(numbers, 0.05), chdtri(numbers, 0.5)
    for _ in range(_ROBUST_STEPS if robust else _STEPS):
        weights = np.ones(len(numbers))
        if robust:
            statistics = _normal(at, weights)[2] / scale
            weights = np.sqrt(bounded(statistics, bend))
        information, gradient, _ = _normal(at, weights)
        normal = information / scale + _PRIOR
        change = np.linalg.solve(normal, gradient / scale - _PRIOR @ step)
        step = step + change
        settled = bool(change @ normal @ change < _ENOUGH**2)
        at = sights.equations(step)
        statistics = _normal(at, weights)[2]
        fitted = np.trace(np.linalg.solve(information / scale + _PRIOR, information / scale))
        freedom = max(float(numbers.sum() - fitted), 1.0)
        # of the typical statistic: blunders do not move it
        typical = np.median(statistics / middle) if robust else float(statistics.sum()) / freedom
        scale = max(1.0, float(typical))
        if settled:
            break
    information, _, statistics = _normal(at, np.ones(len(numbers)))
    return _BodyFit(step, before, at, information, scale, freedom, float(statistics.sum()), settled)


def _keep(sights: BodySights) -> tuple[np.ndarray, FloatArray, FloatArray]:
    """Which hand-offs agree; the worst goes first and the fit is done again, and what passes comes back."""
    count = len(sights.handoffs)
    numbers = 2 * sights.seen.sum(axis=1)
    limits = chdtri(numbers, Level.MEASUREMENT / count)
    robust = _fit(sights, robust=True)
    statistics = _normal(robust.after, np.ones(count))[2] / robust.scale
    keep = statistics <= limits

    def ratios(keep: np.ndarray) -> FloatArray:
        nonlocal statistics
        fit = _fit(sights.part(keep))
        at = sights.equations(fit.step)
        spread = np.einsum("nij,jk,nlk->nil", at.rates, fit.covariance, at.rates)
        # A fitted residual is less sure than its noise by what the fit took; one left out, more.
        total = fit.scale * at.covariance_px2 - np.where(keep, 1.0, -1.0)[:, None, None] * spread
        statistics = np.einsum("ni,nij,nj->n", at.residual_px, np.linalg.inv(total), at.residual_px)
        return np.asarray(statistics / limits)

    return worst_first(keep, ratios, MOST_OUTLIERS), statistics, limits


def _correction(used: BodySights, fit: _BodyFit, outliers: tuple[Outlier, ...]) -> BodyPose:
    """Significance, open directions, and what becomes of the residuals."""
    information, gradient, statistics = _normal(fit.before, np.ones(len(used.handoffs)))
    # In units of the prior's sigma: what the hand-offs say of each direction, against 1 that the prior says.
    unit = np.diag(_PRIOR_SIGMA)
    says, directions = np.linalg.eigh(unit @ information @ unit)
    seen = says / fit.scale >= SEEN
    explained = float(np.sum((directions.T @ unit @ gradient)[seen] ** 2 / says[seen]))
    probability = chance(explained, int(seen.sum()), fit.scale, fit.freedom)
    inverse = np.linalg.inv(fit.after.covariance_px2)
    gain = np.einsum("ij,nkj,nkl->inl", fit.covariance / fit.scale, fit.after.rates, inverse)
    rms = {}
    for k, name in enumerate(used.cameras):
        on = used.seen[:, k]
        if on.any():
            sizes = [
                np.sqrt(np.mean(at.residual_px[on, 2 * k : 2 * k + 2] ** 2, axis=0)).tolist()
                for at in (fit.before, fit.after)
            ]
            rms[name] = ((sizes[0][0], sizes[0][1]), (sizes[1][0], sizes[1][1]))
    return BodyPose(
        cameras=used.cameras,
        origin_m=used.origin_m,
        step=fit.step,
        covariance=fit.covariance,
        gain=gain,
        motion=used.pose(fit.step),
        used=used,
        outliers=outliers,
        rms_px=rms,
        chi2_before=float(statistics.sum()),
        chi2_after=fit.chi2,
        degrees_of_freedom=fit.freedom,
        scale=fit.scale,
        chance=probability,
        sigmas=sigmas(probability),
        seen=int(seen.sum()),
        unseen=tuple(_sentence(direction) for direction in directions.T[~seen]),
        cameras_apart=_cameras_apart(used, fit),
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


def _cameras_apart(used: BodySights, fit: _BodyFit) -> CamerasApart | None:
    """What is left between left and right, over hand-offs that both found."""
    if len(used.cameras) != 2:
        return None
    both = used.seen.all(axis=1)
    count = int(both.sum())
    if count < 2:
        return None
    pick = np.hstack([-np.eye(2), np.eye(2)]) / count
    offset = pick @ fit.after.residual_px[both].sum(axis=0)
    rates = pick @ fit.after.rates[both].sum(axis=0)
    noise = fit.scale * pick @ fit.after.covariance_px2[both].sum(axis=0) @ pick.T
    covariance = noise - rates @ fit.covariance @ rates.T
    # What the fit explains whole has no noise left; half a thousandth of the noise is none.
    covariance += 5e-4 * noise
    probability = chance(float(offset @ np.linalg.solve(covariance, offset)), 2)
    return CamerasApart(offset, covariance, sigmas(probability))


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
    at = {name: i for i, name in enumerate(known.names)}
    twists = rigid_twists(correction.origin_m + correction.step[3:]).T
    for camera in correction.cameras:
        model = rig.cameras[camera].model
        names = [f"cameras.{camera}.{part}" for part in parameter_names(model.kind)]
        mine = [i for i, name in enumerate(names) if name in at]
        rows = [at[names[i]] for i in mine]
        moved = model.moved(correction.motion)
        per_step[rows] = (twist_rates(moved) @ twists)[mine]
        errors = carried_errors(model, moved, correction.motion.rotation)
        carried[np.ix_(rows, rows)] = errors[np.ix_(mine, mine)]
    by_residual = np.einsum("pi,inl->pnl", per_step, correction.gain)  # L K
    stays = carried - np.einsum("pnl,nlq->pq", by_residual, _parameter_rates(rig, known, correction))
    noise = correction.scale * correction.used.equations(correction.step).covariance_px2
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
