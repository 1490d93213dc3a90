"""Something changed between two rests: the rover moved, or a joint slipped; pictures of both contradict."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from calib.fit.significance import sigmas
from calib.rigid import FloatArray
from calib.scene.problem import SceneProblem, State
from calib.scene.spread import Quadratic

ALARM_SIGMAS = 6.0
LEAST_RESTS = 2
"""Rests on either side of a change: one alone that errs is only that."""

LEAST_JOINED = 3
"""Pairs of rests across it that features join: one pair alone that contradicts may err by itself."""

PRIOR_TURN_RAD, PRIOR_SHIFT_M = 0.05, 0.2


class Change(NamedTuple):
    """What changed, by how much, after which rest's number, and how unlikely the pictures are without."""

    what: str
    size_rad: float
    after: int
    sigmas: float


def change_halfway(problem: SceneProblem, state: State) -> Change | None:
    """Return the change between two rests, in the order of their numbers, that is certain; None if none is.

    ``state`` is where all of the problem's numbers fit best.
    """
    linear = problem.linear(state)
    off = linear.gradient - linear.matrix @ state.numbers
    pose = np.array([view.pose for view in problem.views])[problem.sights.view_of]
    by_what = _rates(problem, state)
    seen = np.unique(pose)
    rests = [{problem.views[number].pose for number in feature.views} for feature in problem.features]
    joined = {(min(one, other), max(one, other)) for these in rests for one in these for other in these}
    tries = max(len(by_what) * (len(seen) - 2 * LEAST_RESTS + 1), 1)
    best: Change | None = None
    least = 1.0
    for first in seen[LEAST_RESTS : len(seen) - LEAST_RESTS + 1]:
        across = [pair for pair in joined if pair[0] < first <= pair[1]]
        if len(across) < LEAST_JOINED:
            continue
        after = (pose >= first)[:, None, None]
        for what, (rates, held) in by_what.items():
            mixed, own, gradient = linear.beside(np.where(after, rates, 0.0))
            gradient = gradient - mixed.T @ state.numbers
            terms, more = problem.terms, len(held)
            quadratic = Quadratic(
                np.block([[own, mixed.T], [mixed, linear.matrix]]),
                np.concatenate([gradient, off]),
                np.concatenate([held, problem.prior[:terms]]),
                problem.joint_sigma_rad,
            )
            old = np.arange(more + terms) >= more
            by_chance, found = quadratic.chance(old, ~old)
            if by_chance < least:
                least, size_rad = by_chance, float(np.linalg.norm(found.numbers[: min(more, 3)]))
                before = int(seen[np.searchsorted(seen, first) - 1])
                best = Change(what, size_rad, before, sigmas(by_chance * tries))
    return best if best is not None and best.sigmas >= ALARM_SIGMAS else None


def _rates(problem: SceneProblem, state: State) -> dict[str, tuple[FloatArray, FloatArray]]:
    """By what may change: whitened rates (o, 2, s), and sigmas beforehand (s,)."""
    _, _, by_number = problem.rates(state)
    sights, terms = problem.sights, problem.terms
    joints = np.zeros((len(sights.pixels), 2, 2))
    for number, view in enumerate(problem.views):
        rows = sights.rows[number]
        joints[rows] = by_number[rows][:, :, terms + 2 * view.pose : terms + 2 * view.pose + 2]
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
