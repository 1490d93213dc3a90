"""What no correction of a rig holds: a change between two rests, a joint that reads wrong by its angle.

The rover moved, or a joint slipped: pictures of both sides contradict. Or a joint errs alike wherever it
reads the same, otherwise than the terms have it.

How far rests of the head scatter decides which misfit is common to all pictures and which is each rest's own.
It is estimated with the numbers (a variance component: squares of the rests' errors over how many of them the
pictures tell). What was told counts like `TOLD_COUNTS` such errors, and is the least.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from calib.adjust.significance import THREE_SIGMAS, chance, sigmas
from calib.adjust.solver import covariance_of
from calib.calibrate.scene.problem import Linear, SceneProblem, SceneState
from calib.calibrate.scene.terms import PRIOR, alike
from calib.geometry.rigid import FloatArray

_ROUNDS, _SETTLED = 60, 3e-3

TOLD_COUNTS = 10
"""Few rests tell little of how they scatter: what was told then stands."""


@dataclass(frozen=True, eq=False)
class SceneMinimum:
    """The least of a quadratic cost.

    ``numbers`` (f,) and ``covariance`` (f, f) of the free ones; ``joint_sigma_rad`` as it was found, from
    ``freedom`` numbers of the rests' errors, infinite where it is as it was told.
    """

    numbers: FloatArray
    covariance: FloatArray
    cost: float
    joint_sigma_rad: float
    freedom: float


@dataclass(frozen=True, eq=False)
class Quadratic:
    """Cost x' M x + 2 b' x of numbers that are terms first, the rests' errors last.

    Attributes
    ----------
    matrix, linear
        M (p + 2k, p + 2k) and b (p + 2k,) of the pictures alone.
    held
        (p,) sigma beforehand of each term's number.
    told_rad
        What a rest of the head is off by at least, one sigma.
    """

    matrix: FloatArray
    linear: FloatArray
    held: FloatArray
    told_rad: float

    def fitted(self, free: np.ndarray) -> SceneMinimum:
        """Return the least with those terms (p,) that are free, and how far rests then scatter."""
        sigma, freedom = self.told_rad, math.inf
        for _ in range(_ROUNDS):
            found = self.at(free, sigma)
            count = int(free.sum())
            rests = found.numbers[count:]
            told = len(rests) - float(np.diag(found.covariance)[count:].sum()) / sigma**2
            freedom = TOLD_COUNTS + told
            square = (TOLD_COUNTS * self.told_rad**2 + float(rests @ rests)) / freedom
            wider = math.sqrt(square)
            if wider <= self.told_rad:
                wider, freedom = self.told_rad, math.inf
            if abs(wider - sigma) <= _SETTLED * sigma:
                break
            sigma = wider
        return SceneMinimum(found.numbers, found.covariance, found.cost, sigma, freedom)

    def at(self, free: np.ndarray, joint_sigma_rad: float) -> SceneMinimum:
        """Return the least with those terms (p,) that are free, for rests of this scatter."""
        rests = len(self.linear) - len(self.held)
        which = np.concatenate([np.flatnonzero(free), np.arange(len(self.held), len(self.linear))])
        prior = np.concatenate([self.held[free], np.full(rests, joint_sigma_rad)])
        covariance = covariance_of(self.matrix[np.ix_(which, which)] + np.diag(prior**-2))
        numbers = -covariance @ self.linear[which]
        return SceneMinimum(
            numbers, covariance, float(self.linear[which] @ numbers), joint_sigma_rad, math.inf
        )

    def chance(self, free: np.ndarray, further: np.ndarray) -> tuple[float, SceneMinimum]:
        """Return the chance of what further terms (p,) gain, were they nothing; and the fit with them.

        The gain is by the scatter that is left with them, which is known as well as its freedom says.
        """
        with_them = self.fitted(free | further)
        gain = self.at(free, with_them.joint_sigma_rad).cost - with_them.cost
        scale = 1.0 + 1e-9 if math.isfinite(with_them.freedom) else 1.0
        by_chance = chance(max(gain, 0.0), int(further.sum()), scale, with_them.freedom)
        return by_chance, with_them


ALARM_SIGMAS = 6.0
LEAST_RESTS = 2
"""Rests on either side of a change: one alone that errs is only that."""

LEAST_JOINED = 3
"""Pairs of rests across it that features join: one pair alone that contradicts may err by itself."""

PRIOR_TURN_RAD, PRIOR_SHIFT_M = 0.05, 0.2


class ChangeHalfway(NamedTuple):
    """What changed, by how much, after which rest's number, and how unlikely the pictures are without."""

    what: str
    size_rad: float
    after: int
    sigmas: float


class ByReading(NamedTuple):
    """A joint that errs by its angle: which, by how much (rms about the mean), at how many readings."""

    joint: str
    size_rad: float
    readings: int
    sigmas: float


def change_halfway(problem: SceneProblem, state: SceneState) -> ChangeHalfway | None:
    """Return the change between two rests, in the order of their numbers, that is certain; None if none is.

    ``state`` is where all of the problem's numbers fit best.
    """
    linear = problem.linear(state)
    pose = np.array([view.pose for view in problem.views])[problem.sights.view_of]
    by_what = _rates(problem, state)
    seen = np.unique(pose)
    rests = [{problem.views[number].pose for number in feature.views} for feature in problem.features]
    joined = {(min(one, other), max(one, other)) for these in rests for one in these for other in these}
    tries = max(len(by_what) * (len(seen) - 2 * LEAST_RESTS + 1), 1)
    best: ChangeHalfway | None = None
    least = 1.0
    for first in seen[LEAST_RESTS : len(seen) - LEAST_RESTS + 1]:
        across = [pair for pair in joined if pair[0] < first <= pair[1]]
        if len(across) < LEAST_JOINED:
            continue
        after = (pose >= first)[:, None, None]
        for what, (rates, held) in by_what.items():
            every = np.ones(problem.terms, dtype=bool)
            by_chance, found = _chance(problem, state, linear, np.where(after, rates, 0.0), held, every)
            if by_chance < least:
                least = by_chance
                size_rad = float(np.linalg.norm(found.numbers[: min(len(held), 3)]))
                before = int(seen[np.searchsorted(seen, first) - 1])
                best = ChangeHalfway(what, size_rad, before, sigmas(by_chance * tries))
    return best if best is not None and best.sigmas >= ALARM_SIGMAS else None


def errs_by_reading(problem: SceneProblem, state: SceneState) -> ByReading | None:
    """Return which joint errs by what it reads, beyond what the free terms explain; None if none does.

    ``state`` is where the free terms and the rests fit best.
    """
    linear, by_joint = problem.linear(state), _joint_rates(problem, state)
    seen = [problem.views[number] for number in problem.sights.view_of]
    rests = len({view.pose for view in seen})
    found: list[ByReading] = []
    for axis, joint in enumerate(("pan", "tilt")):
        read = alike(np.array([(view.pan_rad, view.tilt_rad)[axis] for view in seen]))
        readings = np.unique(read)
        if not 1 < len(readings) < rests:  # an angle that no two rests share: that is their scatter
            continue
        there = read[:, None] == readings[1:]
        rates = by_joint[:, :, axis, None] * there[:, None, :]
        held = np.full(there.shape[1], PRIOR["joints"])
        by_chance, fitted = _chance(problem, state, linear, rates, held, problem.free[: problem.terms])
        by_chance *= 2
        if by_chance < THREE_SIGMAS:
            size_rad = float(np.std([0.0, *fitted.numbers[: len(held)]]))
            found.append(ByReading(joint, size_rad, len(held) + 1, sigmas(by_chance)))
    return max(found, key=lambda one: one.sigmas, default=None)


def _chance(
    problem: SceneProblem,
    state: SceneState,
    linear: Linear,
    rates: FloatArray,
    held: FloatArray,
    free: np.ndarray,
) -> tuple[float, SceneMinimum]:
    """The chance of what further numbers of given rates (o, 2, s) gain, and the fit with them, they first."""
    mixed, own, gradient = linear.beside(rates)
    more = len(held)
    quadratic = Quadratic(
        np.block([[own, mixed.T], [mixed, linear.matrix]]),
        np.concatenate([gradient - mixed.T @ state.numbers, linear.gradient - linear.matrix @ state.numbers]),
        np.concatenate([held, problem.prior[: problem.terms]]),
        problem.joint_sigma_rad,
    )
    further = np.arange(more + problem.terms) < more
    return quadratic.chance(np.concatenate([np.zeros(more, dtype=bool), free]), further)


def _joint_rates(problem: SceneProblem, state: SceneState) -> FloatArray:
    """Whitened rates (o, 2, 2) of each sight by its rest's pan and tilt."""
    _, _, by_number = problem.rates(state)
    joints = np.zeros((len(by_number), 2, 2))
    for number, view in enumerate(problem.views):
        rows, rest = problem.sights.rows[number], problem.terms + 2 * view.pose
        joints[rows] = by_number[rows][:, :, rest : rest + 2]
    return joints


def _rates(problem: SceneProblem, state: SceneState) -> dict[str, tuple[FloatArray, FloatArray]]:
    """By what may change: whitened rates (o, 2, s), and sigmas beforehand (s,)."""
    sights, joints = problem.sights, _joint_rates(problem, state)
    models = problem.models(state.numbers)
    _, _, (by_point, arm) = sights.off(models, state.places)
    back = arm + np.array([model.C for model in models])[sights.view_of] - sights.origin
    turns = by_point @ np.stack([np.cross(back, axis) for axis in np.eye(3)], axis=2)
    rover = np.concatenate([turns, -by_point], axis=2)
    return {
        "pan slipped, or the rover turned": (joints[:, :, :1], np.array([PRIOR_TURN_RAD])),
        "tilt slipped": (joints[:, :, 1:], np.array([PRIOR_TURN_RAD])),
        "the rover moved": (rover, np.array([PRIOR_TURN_RAD] * 3 + [PRIOR_SHIFT_M] * 3)),
    }
