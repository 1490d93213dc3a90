"""Cameras, axes and joints of a rig corrected by features of a still scene: what counts, and how sure it is.

Terms enter one after another, the most significant first, as long as one is beyond three sigma, counted by
how many were tried and by how far the rests of the head scatter (`calib.calibrate.scene.halfway`). What
pictures cannot tell (where the rover is, where pan is zero) is held by a prior and comes out as not seen.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from calib.adjust.significance import THREE_SIGMAS, sigmas
from calib.calibrate.scene.features import Feature
from calib.calibrate.scene.halfway import Quadratic, SceneMinimum, change_halfway, errs_by_reading
from calib.calibrate.scene.problem import SceneProblem, SceneState
from calib.calibrate.scene.terms import (
    LEAST_RESTS_TWICE,
    LEAST_SPAN_TWICE_RAD,
    SceneView,
    Term,
    corrected,
    terms_of,
)
from calib.errors import NoCorrection
from calib.geometry.rig import Rig
from calib.geometry.rigid import FloatArray

FOLDS = 4
LEAST_FEATURES = 12


def predicted_px(
    problem: SceneProblem, state: SceneState, taken: Sequence[Term], joint_sigma_rad: float
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


JOINT_SIGMA_RAD = 2e-4
"""What a rest of the head is off by chance, if nothing else is told."""

LOOSE_RAD = 0.005
"""What rests may be off by while features are looked for that contradict the others."""

OUTLIER_SIGMAS = 4.0
SEEN = 0.5
"""A number is seen by the pictures if they leave less than this part of its prior's sigma."""


@dataclass(frozen=True, eq=False)
class SceneFit:
    """The result of a scene about a rig.

    Attributes
    ----------
    rig
        Corrected by the terms that are significant; ``fit`` and ``provenance`` as they were.
    names, values, covariance
        The numbers that were corrected (p,), in radians, and their covariance (p, p), widened by ``scale``.
    unseen
        Names of those that the pictures hardly determine.
    gains
        By term in the order they were taken, the rejected last: significance in sigmas.
    rest_rad
        By rest of the head (k, 2): what its pan and tilt were off by beyond the terms.
    joint_sigma_rad
        What rests scatter by: as told, or more if they do.
    rms_px, median_px
        Of what no place of the features explains: as the rig is believed, corrected, and with each rest's own
        angles beside, which no correction foresees.
    features, outliers
        Those used, and sentences of those left out.
    scale
        Chi-square over degrees of freedom of the features; the sigmas are widened by its root.
    predicted_px
        Rms, before and after, of features that had no part in the correction: each part of the pictures in
        turn predicted by the others.
    """

    rig: Rig
    names: tuple[str, ...]
    values: FloatArray
    covariance: FloatArray
    unseen: tuple[str, ...]
    gains: Mapping[str, float]
    taken: tuple[str, ...]
    rest_rad: FloatArray
    joint_sigma_rad: float
    rms_px: tuple[float, float, float]
    median_px: tuple[float, float, float]
    features: tuple[Feature, ...]
    outliers: tuple[str, ...]
    scale: float
    predicted_px: tuple[float, float]


def fit_scene(
    rig: Rig,
    views: Sequence[SceneView],
    features: Sequence[Feature],
    joint_sigma_rad: float = JOINT_SIGMA_RAD,
) -> SceneFit:
    """Fit a rig's corrections to features of a still scene.

    Parameters
    ----------
    rig
        What is believed.
    views, features
        The pictures, and what they show together (`calib.calibrate.scene.features.find_features`).
    joint_sigma_rad
        What a rest of the head is off by chance at least, one sigma.

    Raises
    ------
    NoCorrection
        ``too_few``: fewer than twelve features; ``not_significant``: nothing is beyond three sigma;
        ``changed_halfway``: the rover moved or a joint slipped between two rests; ``errs_by_reading``: a
        joint errs by its angle otherwise than the terms have it.
    """
    _enough(features)
    terms = terms_of(rig, views)
    problem, state, outliers = _without_outliers(rig, views, features, terms, joint_sigma_rad)
    changed = change_halfway(problem, state)
    if changed is not None:
        at = [next(v for v in views if v.pose == pose) for pose in _on_either_side(problem, changed.after)]
        rests = " and that at ".join(f"pan {v.pan_rad:.3f}, tilt {v.tilt_rad:.3f} rad" for v in at)
        raise NoCorrection(
            "changed_halfway",
            f"between the rest at {rests} {changed.what} by {1e3 * changed.size_rad:.1f} mrad "
            f"({changed.sigmas:.0f} sigma): pictures of one side alone are expected",
        )
    taken, gains, fitted, state = _chosen(problem, state, terms)
    if not taken:
        most = max(gains.values(), default=0.0)
        raise NoCorrection(
            "not_significant",
            f"{len(problem.features)} features show no correction: {most:.1f} sigma where 3 are asked for",
        )
    errs = errs_by_reading(problem, state)
    if errs is not None:
        raise NoCorrection(
            "errs_by_reading",
            f"at its {errs.readings} readings {errs.joint} is off by {1e3 * errs.size_rad:.1f} mrad rms "
            f"({errs.sigmas:.0f} sigma beyond what rests scatter by), which no term explains: a correction "
            f"would look surer than it is. Take pictures at {LEAST_RESTS_TWICE} or more {errs.joint} angles "
            f"over {LEAST_SPAN_TWICE_RAD:g} rad; if the joint repeats no better, give --joint-sigma-rad",
        )
    predicted = predicted_px(problem, state, taken, fitted.joint_sigma_rad)
    return _told(problem, state, taken, gains, fitted, outliers, predicted)


def left_px(rig: Rig, views: Sequence[SceneView], features: Sequence[Feature]) -> FloatArray:
    """Return what no place of the features explains as the rig stands, its size in pixels (q,)."""
    problem = SceneProblem(rig, views, features, (), JOINT_SIGMA_RAD)
    start = problem.start()
    return np.abs(problem.rest(start.numbers, start.places)[0]) * white_px(features)


def white_px(features: Sequence[Feature]) -> float:
    """Return how many pixels one sigma of the features is, per axis."""
    return float(np.mean([np.sqrt(np.trace(feature.covariances_px2[-1]) / 2) for feature in features]))


def _chosen(
    problem: SceneProblem, state: SceneState, terms: Sequence[Term]
) -> tuple[list[Term], dict[str, float], SceneMinimum, SceneState]:
    """The terms that are significant, what each gains in sigmas, and the fit with them."""
    taken: list[Term] = []
    gains: dict[str, float] = {}
    left = list(terms)
    problem.free[: problem.terms] = False
    state = problem.solved(SceneState(np.where(problem.free, state.numbers, 0.0), state.places))
    fitted = None
    while True:
        quadratic = _quadratic(problem, state)
        free = problem.free[: problem.terms].copy()
        tried = [
            (by_chance, term, with_it)
            for term in left
            if not term.after or term.after in {one.words for one in taken}
            for by_chance, with_it in [quadratic.chance(free, _where(problem, term))]
            if _possible(problem, term, with_it, free)
        ]
        by_chance, term, with_it = min(tried, key=lambda one: one[0], default=(1.0, None, None))
        gains |= {one.words: abs(sigmas(min(len(tried) * p, 1.0))) for p, one, _ in tried}
        if term is None or with_it is None or len(tried) * by_chance > THREE_SIGMAS:
            return taken, gains, fitted or quadratic.fitted(free), state
        taken.append(term)
        left.remove(term)
        problem.free[: problem.terms] |= _where(problem, term)
        problem.joint_sigma_rad = with_it.joint_sigma_rad
        state = problem.solved(state)
        problem.joint_sigma_rad = quadratic.told_rad
        fitted = _quadratic(problem, state).fitted(problem.free[: problem.terms])


def _quadratic(problem: SceneProblem, state: SceneState) -> Quadratic:
    """The problem's cost about a state."""
    linear = problem.linear(state)
    return Quadratic(
        linear.matrix,
        linear.gradient - linear.matrix @ state.numbers,
        problem.prior[: problem.terms],
        problem.joint_sigma_rad,
    )


def _possible(problem: SceneProblem, term: Term, fitted: SceneMinimum, free: np.ndarray) -> bool:
    """Whether a term's numbers may be: a play of less than nothing is none."""
    if not term.play_of:
        return True
    joints = problem.rig.joints
    held = {"pan": joints.pan, "tilt": joints.tilt}[term.play_of].backlash_rad
    at = int((free | _where(problem, term))[: problem.names.index(term.names[0])].sum())
    return bool(held + fitted.numbers[at] >= 0.0)


def _where(problem: SceneProblem, term: Term) -> np.ndarray:
    """Which of a problem's terms' numbers (p,) are this one's."""
    return np.array([name in term.names for name in problem.names])


def _on_either_side(problem: SceneProblem, after: int) -> list[int]:
    """A rest's number, and the next that has features."""
    seen = np.unique([problem.views[number].pose for number in np.unique(problem.sights.view_of)])
    return [after, int(seen[np.searchsorted(seen, after) + 1])]


def _enough(features: Sequence[Feature]) -> None:
    if len(features) < LEAST_FEATURES:
        raise NoCorrection(
            "too_few",
            f"{len(features)} features are in two pictures or more where {LEAST_FEATURES} are expected: "
            "pictures that overlap by a fifth, of something with texture, have them",
        )


def _without_outliers(
    rig: Rig,
    views: Sequence[SceneView],
    features: Sequence[Feature],
    terms: Sequence[Term],
    joint_sigma_rad: float,
) -> tuple[SceneProblem, SceneState, list[str]]:
    """Features that fit together when every number is free, that fit, and a sentence for each other one."""
    names = tuple(name for term in terms for name in term.names)
    kept = list(features)
    sentences: list[str] = []
    state = SceneProblem(rig, views, kept, names, LOOSE_RAD).start()
    for _ in range(8):
        problem = SceneProblem(rig, views, kept, names, LOOSE_RAD)
        problem.free[:] = True
        state = problem.solved(state)
        rest, owners = problem.rest(state.numbers, state.places)
        spread = max(1.0, float(np.median(np.abs(rest)) / 0.6745))
        worst = np.zeros(len(kept))
        np.maximum.at(worst, owners, np.abs(rest) / spread)
        lost = ~np.isfinite(worst)
        good = ~lost if lost.any() else worst <= OUTLIER_SIGMAS  # with any lost, nothing was fitted yet
        if good.all():
            break
        for at in np.flatnonzero(~good).tolist():
            feature = kept[at]
            x, y = feature.pixels_px[0]
            names_of = ", ".join(views[number].name for number in feature.views)
            why = "no place is before all of these cameras" if lost[at] else f"{worst[at]:.1f} sigma off"
            sentences.append(f"the feature at ({x:.0f}, {y:.0f}) of {names_of}: {why}")
        kept = [feature for feature, stays in zip(kept, good, strict=True) if stays]
        _enough(kept)
        state = SceneState(state.numbers, state.places[good])
    problem = SceneProblem(rig, views, kept, names, joint_sigma_rad)
    rest, _ = problem.rest(state.numbers, state.places)
    problem.scale = max(1.0, float(rest @ rest) / max(len(rest) - _told_by(problem, state), 1.0))
    problem.free[:] = True
    return problem, problem.solved(state), sentences


def _told_by(problem: SceneProblem, state: SceneState) -> float:
    """How many numbers the features themselves tell, where rests are loose."""
    prior = problem.prior
    prior[problem.terms :] = LOOSE_RAD
    matrix = problem.linear(state).matrix
    return float(np.trace(np.linalg.solve(matrix + np.diag(prior**-2), matrix)))


def _told(
    problem: SceneProblem,
    state: SceneState,
    taken: Sequence[Term],
    gains: Mapping[str, float],
    fitted: SceneMinimum,
    outliers: Sequence[str],
    predicted: tuple[float, float],
) -> SceneFit:
    """The correction as it is told."""
    free = problem.free[: problem.terms]
    names = tuple(name for name, taken_in in zip(problem.names, free, strict=True) if taken_in)
    values, covariance = fitted.numbers[: len(names)], fitted.covariance[: len(names), : len(names)]
    spread, prior = np.sqrt(np.diag(covariance)), problem.prior[: problem.terms][free]
    whole = problem.nothing
    whole[: problem.terms][free] = values
    alone = whole.copy()
    whole[problem.terms :] = fitted.numbers[len(names) :]
    px = white_px(problem.features)
    rests = [problem.rest(numbers, state.places)[0] for numbers in (problem.nothing, alone, whole)]
    rms = [px * float(np.sqrt(np.mean(one**2))) for one in rests]
    median = [px * float(np.median(np.abs(one))) for one in rests]
    return SceneFit(
        rig=corrected(problem.rig, names, values),
        names=names,
        values=values,
        covariance=covariance,
        unseen=tuple(name for name, one, held in zip(names, spread, prior, strict=True) if one > SEEN * held),
        gains=gains,
        taken=tuple(term.words for term in taken),
        rest_rad=fitted.numbers[len(names) :].reshape(-1, 2),
        joint_sigma_rad=fitted.joint_sigma_rad,
        rms_px=(rms[0], rms[1], rms[2]),
        median_px=(median[0], median[1], median[2]),
        features=tuple(problem.features),
        outliers=tuple(outliers),
        scale=problem.scale,
        predicted_px=predicted,
    )
