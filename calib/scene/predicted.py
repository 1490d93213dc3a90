"""A correction held against pictures that had no part in it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from calib.rigid import FloatArray
from calib.scene.problem import SceneProblem, State
from calib.scene.terms import Term

FOLDS = 4
LEAST_FEATURES = 12


def predicted_px(
    problem: SceneProblem, state: State, taken: Sequence[Term], joint_sigma_rad: float
) -> tuple[float, float]:
    """Return the rms, before and after, of features of rests that a correction was made without.

    Features are parted by the rests that they join; where all join the same ones nothing can be predicted,
    and both are not-a-number. What is predicted are corrected cameras at what the joints read: a rest's own
    errors are not foreseen.

    Parameters
    ----------
    problem, state
        All features, and where they fit best.
    taken
        The terms of the correction.
    joint_sigma_rad
        How far rests scatter.
    """
    views, features = problem.views, problem.features
    joined = [tuple(sorted({views[number].pose for number in feature.views})) for feature in features]
    parts = sorted(set(joined))
    fold_of = {part: at % FOLDS for at, part in enumerate(parts)}
    folds = np.array([fold_of[part] for part in joined])
    before: list[FloatArray] = []
    after: list[FloatArray] = []
    for fold in range(min(FOLDS, len(parts))):
        tested, others = np.flatnonzero(folds == fold), np.flatnonzero(folds != fold)
        if not len(tested) or len(others) < LEAST_FEATURES:
            continue
        fitted = _of(problem, others, taken, joint_sigma_rad)
        fitted.free[:] = True
        numbers = fitted.solved(fitted.start(state.places[others])).numbers.copy()
        numbers[fitted.terms :] = 0.0
        test = _of(problem, tested, taken, joint_sigma_rad)
        for rests, wanted in ((before, test.nothing), (after, numbers)):
            rests.append(test.rest(wanted, state.places[tested])[0])
    if not before:
        return np.nan, np.nan
    px = float(np.mean([np.sqrt(np.trace(feature.covariances_px2[-1]) / 2) for feature in features]))
    rms = [px * float(np.sqrt(np.mean(np.concatenate(rests) ** 2))) for rests in (before, after)]
    return rms[0], rms[1]


def _of(
    problem: SceneProblem, which: np.ndarray, taken: Sequence[Term], joint_sigma_rad: float
) -> SceneProblem:
    """The problem of some of the features with some of the terms."""
    names = tuple(name for term in taken for name in term.names)
    features = [problem.features[at] for at in which]
    return SceneProblem(problem.rig, problem.views, features, names, joint_sigma_rad, problem.scale)
