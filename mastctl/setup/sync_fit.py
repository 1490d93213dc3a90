"""The time offset between pictures and joint readings, from how patches moved while the head went to and fro.

A patch's place u along its way is a smooth function g of the joint angle that the picture was really taken
at, whatever the camera's model, the range or a scale error of the joint: a cubic of its own for every patch.
With the frame stamped t, the joint read at P(t), and s the sign of the motion, that angle is

    q = P(t + o + c y) - h s

o is the offset that is wanted, the same for all patches; c the time that a rolling shutter takes from the top
of the picture to its bottom (y the patch's row in picture heights from the middle); h half the play of the
gears, of which the readings see nothing. Going to and fro separates o and h from g, since they shift it
oppositely on either way; several speeds separate o from h, since only o grows with the speed.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import make_smoothing_spline

from calib.geometry.rigid import FloatArray
from mastctl.errors import MastctlError

LEAST_FRAMES = 30  # and readings
LEAST_REVERSAL_RAD = 5e-4
LEAST_WAY_RAD = 0.010  # after a turn back: until then the gears of a plain servo are not all on one side
LARGEST_GAP_S = 0.1  # between the readings around a frame; beyond it the angle is a guess
LEAST_SPEED_RAD_PER_S = 0.06

REACH_S = 0.6
"""How far off a camera's stamps are searched, seconds either way."""

SEARCH_STEP_S = 0.01
LEAST_LEGS = 8
ROBUST_SIGMAS = 2.5
WILD_SIGMAS = 6.0
MOST_STEPS = 40
WEIGHTED_STEPS = 8
SETTLED_S = 1e-6
LARGEST_CONDITION = 1e4
LEAST_ROWS = 0.2  # image heights between patches, from which a rolling shutter shows
UNEXPLAINED = 0.15  # of the patches' own motion, rms: then pictures did not move with the joint


class CannotTell(MastctlError):
    """The images do not determine the offset; the message says why."""

    code = "cannot_tell"


class JointMotion:
    """The joint angle over time by its readings (m,), cut into legs between turns back.

    ``span`` is the middle of the angles and half their range, radians.
    """

    def __init__(self, times_s: FloatArray, angles_rad: FloatArray) -> None:
        self.times_s, first = np.unique(times_s, return_index=True)
        self.angles_rad = angles_rad[first]
        if len(self.times_s) < LEAST_FRAMES:
            raise CannotTell(f"the head was read {len(self.times_s)} times, {LEAST_FRAMES} are needed")
        self._turns, self._signs = _legs(self.angles_rad)
        low, high = float(self.angles_rad.min()), float(self.angles_rad.max())
        self.span = (low + high) / 2, max((high - low) / 2, 1e-9)
        self._curve = make_smoothing_spline(self.times_s, self.angles_rad)
        self._speed = self._curve.derivative()

    def at(self, times_s: FloatArray) -> FloatArray:
        """Return the angle, radians, on a curve through the readings that evens their counts out."""
        return np.asarray(self._curve(np.clip(times_s, self.times_s[0], self.times_s[-1])))

    def slope(self, times_s: FloatArray) -> FloatArray:
        """Return the speed, rad/s."""
        return np.asarray(self._speed(np.clip(times_s, self.times_s[0], self.times_s[-1])))

    def leg(self, times_s: FloatArray) -> tuple[NDArray[np.int64], FloatArray]:
        """Return which leg a moment is of (-1: of none) and the sign of that leg's motion."""
        turns_s = self.times_s[self._turns]
        leg = np.searchsorted(turns_s, times_s, side="right") - 1
        after = np.clip(np.searchsorted(self.times_s, times_s), 1, len(self.times_s) - 1)
        sure = (leg >= 0) & (times_s < self.times_s[-1])
        sure &= self.times_s[after] - self.times_s[after - 1] <= LARGEST_GAP_S
        known = np.clip(leg, 0, len(self._turns) - 1)
        sure &= np.abs(self.slope(times_s)) >= LEAST_SPEED_RAD_PER_S  # one at rest does not depend on time
        sure &= np.abs(self.at(times_s) - self.angles_rad[self._turns[known]]) >= LEAST_WAY_RAD
        return np.where(sure, leg, -1), self._signs[known]


def _legs(angles_rad: FloatArray) -> tuple[NDArray[np.int64], FloatArray]:
    """Where the motion turns back (indices), and its sign from there on; dither of a count is no turn."""
    steps = np.abs(np.diff(np.unique(angles_rad)))
    count_rad = float(steps.min()) if len(steps) else 0.0
    threshold_rad = max(LEAST_REVERSAL_RAD, 2.5 * count_rad if count_rad < LEAST_WAY_RAD / 3 else 0.0)
    turns, signs = [0], [0.0]
    extreme = 0
    for index, angle_rad in enumerate(angles_rad):
        way_rad = angle_rad - angles_rad[extreme]
        if signs[-1] == 0.0:
            if abs(way_rad) > threshold_rad:
                signs[-1] = np.sign(way_rad)
                extreme = index
        elif way_rad * signs[-1] >= 0:
            extreme = index
        elif abs(way_rad) > threshold_rad:
            turns.append(extreme)
            signs.append(-signs[-1])
            extreme = index
    return np.array(turns), np.array(signs)


@dataclass(frozen=True)
class OffsetFit:
    """The offset, to be added to the frames' stamps, with one sigma, and what was fitted beside it.

    ``rolling_s``: from the top of the image to its bottom, by a rolling shutter; None if all patches are in
    few rows. ``play_rad``: of the gears, both sides together. ``frames``, ``patches`` and ``legs`` are those
    that were used; ``rms_px`` is what the model leaves, one axis.
    """

    offset_s: float
    sigma_s: float
    rolling_s: float | None
    rolling_sigma_s: float | None
    play_rad: float
    play_sigma_rad: float
    frames: int
    patches: int
    legs: int
    rms_px: float


def fit_offset(
    motion: JointMotion, stamps_s: FloatArray, places_px: FloatArray, rows: FloatArray
) -> OffsetFit:
    """Fit the offset.

    ``stamps_s`` (n,) are mid-exposures by the camera's stamps, ``places_px`` (n, p) the place of each patch
    along its way, not-a-number where it was not found, ``rows`` (p,) the patches' rows, image heights from
    the middle. Raises CannotTell if too little was seen, if the images did not move with the joint, or more
    than `REACH_S` off.
    """
    patches = np.isfinite(places_px).sum(axis=0) >= LEAST_FRAMES
    if not patches.any():
        raise CannotTell(
            f"no patch was found in {LEAST_FRAMES} of {len(stamps_s)} frames: "
            "the scene is too plain, too dark or too near, or it moves"
        )
    places_px, rows = places_px[:, patches], rows[patches]
    state = np.array([*np.zeros(4 * len(rows)), _search(motion, stamps_s, places_px), 0.0, 0.0])
    for step in range(MOST_STEPS):
        seen, legs, residuals_px, jacobian = _linearised(motion, stamps_s, places_px, rows, state)
        if step < WEIGHTED_STEPS:  # afterwards they stay, so that it comes to rest
            weights = _robust_weights(seen, residuals_px)
        root = np.sqrt(weights[seen])
        weighted, left = jacobian * root[:, None], residuals_px * root
        change = np.linalg.lstsq(weighted, left, rcond=1e-12)[0]
        state = state + change
        state[-3] = np.clip(state[-3], -1.5 * REACH_S, 1.5 * REACH_S)
        if step >= WEIGHTED_STEPS and abs(change[-3]) < SETTLED_S:
            break
    else:
        raise CannotTell("the fit of the time offset does not settle; a longer or wider sweep is needed")
    offset_s, rolling_s, half_play_rad = (float(value) for value in state[-3:])
    if abs(offset_s) > REACH_S:
        raise CannotTell(f"the stamps are further than {REACH_S:g} s off the joint readings")
    rolls = bool(jacobian[:, -2].any())
    beside = np.linalg.qr(weighted)[1][-3:, -3:]  # the columns of o, c, h without the cubics' part
    beside = beside if rolls else beside[np.ix_((0, 2), (0, 2))]
    if np.linalg.cond(beside / np.linalg.norm(beside, axis=0)) > LARGEST_CONDITION:
        raise CannotTell("the head's motion cannot separate a time offset from the play of its gears")
    # One sigma by leaving out each way of the head in turn (the jackknife): errors within one way go together
    # (a reading's stamp, the phase of its counts, the play's side).
    rests = [legs != leg for leg in np.unique(legs)]
    changes = np.array([np.linalg.lstsq(weighted[rest], left[rest], rcond=1e-12)[0][-3:] for rest in rests])
    sigmas = np.sqrt((len(rests) - 1) / len(rests) * np.sum((changes - changes.mean(axis=0)) ** 2, axis=0))
    return OffsetFit(
        offset_s=offset_s,
        sigma_s=float(sigmas[0]),
        rolling_s=rolling_s if rolls else None,
        rolling_sigma_s=float(sigmas[1]) if rolls else None,
        play_rad=2 * half_play_rad,
        play_sigma_rad=float(2 * sigmas[2]),
        frames=int(seen.any(axis=1).sum()),
        patches=int(seen.any(axis=0).sum()),
        legs=len(rests),
        rms_px=float(np.sqrt(np.average(residuals_px**2, weights=weights[seen]))),
    )


def _search(motion: JointMotion, stamps_s: FloatArray, places_px: FloatArray) -> float:
    """The offset at which the best patches' places are most nearly a function of the angle."""
    best = np.argsort(-np.isfinite(places_px).sum(axis=0), kind="stable")[:3]
    offsets_s = np.arange(-REACH_S, REACH_S + SEARCH_STEP_S / 2, SEARCH_STEP_S)
    left = np.full(len(offsets_s), np.inf)
    for number, offset_s in enumerate(offsets_s):
        leg, _ = motion.leg(stamps_s + offset_s)
        angles_rad = motion.at(stamps_s + offset_s)
        found = []
        for patch in best:
            seen = np.isfinite(places_px[:, patch]) & (leg >= 0)
            if seen.sum() >= LEAST_FRAMES // 2:
                found.append(_unexplained(angles_rad[seen], places_px[seen, patch]))
        if found:
            left[number] = np.median(found)
    if not np.isfinite(left).any():
        raise CannotTell("too few frames were taken while the head moved")
    least = int(np.argmin(left))
    if left[least] > UNEXPLAINED:
        raise CannotTell(
            f"the pictures did not move with the joint: {left[least]:.0%} of their motion is left "
            "at the best offset"
        )
    if least in (0, len(offsets_s) - 1):
        raise CannotTell(f"the stamps are further than {REACH_S:g} s off the joint readings")
    return float(offsets_s[least])


def _unexplained(angles_rad: FloatArray, places_px: FloatArray) -> float:
    """Which part of a patch's motion is left by the best cubic of the angle, but for wild places."""
    span = max(float(np.ptp(angles_rad)), 1e-9)
    base = np.vander((angles_rad - angles_rad.mean()) * (2 / span), 4)
    kept = np.full(len(places_px), True)
    for share in (80, 70, 70):
        cubic = np.linalg.lstsq(base[kept], places_px[kept], rcond=None)[0]
        sizes = np.abs(places_px - base @ cubic)
        kept = sizes <= np.percentile(sizes, share)
    low, high = np.percentile(places_px, [15, 85])
    return float(np.median(sizes) / max((high - low) / 2, 1e-9))


def _linearised(
    motion: JointMotion, stamps_s: FloatArray, places_px: FloatArray, rows: FloatArray, state: FloatArray
) -> tuple[NDArray[np.bool_], NDArray[np.int64], FloatArray, FloatArray]:
    """The problem at a state: each patch's cubic (4 each), then o, c and h.

    Returns which places (n, p) can be used; the leg, the residual (px) and the derivatives of each of these.
    Raises CannotTell if they are too few.
    """
    offset_s, rolling_s, half_play_rad = state[-3:]
    times_s = stamps_s[:, None] + offset_s + rolling_s * rows
    leg, sign = motion.leg(times_s)
    seen = np.isfinite(places_px) & (leg >= 0)
    seen &= seen.sum(axis=0) >= LEAST_FRAMES // 2
    legs, signs, times_s = leg[seen], sign[seen], times_s[seen]
    frames, ways = int(seen.any(axis=1).sum()), len(np.unique(legs))
    if frames < LEAST_FRAMES or ways < LEAST_LEGS:
        raise CannotTell(
            f"{frames} frames on {ways} ways of the head can be used, "
            f"{LEAST_FRAMES} on {LEAST_LEGS} are needed"
        )
    patches = np.nonzero(seen)[1]
    middle_rad, half_rad = motion.span
    scaled = (motion.at(times_s) - half_play_rad * signs - middle_rad) / half_rad
    powers, cubics = np.vander(scaled, 4), state[:-3].reshape(-1, 4)[patches]
    slope = np.sum(np.vander(scaled, 3) * cubics[:, :3] * [3, 2, 1], axis=1) / half_rad
    speed = motion.slope(times_s)
    rolls = np.ptp(rows) > LEAST_ROWS
    jacobian = np.zeros((len(patches), len(state)))
    jacobian[np.arange(len(patches))[:, None], 4 * patches[:, None] + np.arange(4)] = powers
    jacobian[:, -3:] = slope[:, None] * np.stack([speed, rolls * speed * rows[patches], -signs], axis=1)
    return seen, legs, places_px[seen] - np.sum(powers * cubics, axis=1), jacobian


def _robust_weights(seen: NDArray[np.bool_], residuals_px: FloatArray) -> FloatArray:
    """Weights (n, p) by Cauchy, each patch by its own scale; none far outside.

    What a change of the offset left out for now is not lost for good: it has the full weight of its patch.
    """
    sizes_px = np.zeros(seen.shape)
    sizes_px[seen] = np.abs(residuals_px)
    scale_px = np.array(
        [np.median(sizes_px[mine, n]) if mine.any() else 1.0 for n, mine in enumerate(seen.T)]
    )
    scale_px = np.maximum(1.4826 * scale_px, 1e-6)
    found: FloatArray = 1.0 / scale_px**2 / (1.0 + (sizes_px / (ROBUST_SIGMAS * scale_px)) ** 2)
    return found * (sizes_px <= WILD_SIGMAS * scale_px)
