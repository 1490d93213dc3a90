"""Which terms a bench's model needs: joints' harmonics and backlash, skew axes, boards' bows.

All of them are fitted together once. Near that fit the problem is linear, so that what dropping some of them
costs, and what it does to the others, follows from the covariance (a Wald test of nested models): no further
fit is needed until the choice is made. The least significant goes first, until all that are left are.

A term that is not significant is left out only if the pictures show that it is small: what could hide in it
moves pixels by less than ``HIDDEN_PX``. Else it stays with its sigma, so that the fit is not sure of unseen
effects; but play, which is none or more, needs to be seen.

The two harmonics of a joint enter together: over the part of a turn that a head sees boards in, one can do
most of the other's work, and a fit with the wrong one alone would be sure of numbers that are not so.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from calib.adjust.adjustment import Adjustment
from calib.adjust.terms import ImageTerm
from calib.adjust.unknowns import Estimate
from calib.geometry.rig import AXIS_NAMES, JOINTS_NAMES, MAST_NAMES
from calib.geometry.rigid import FloatArray
from calib.geometry.significance import Level, chance

Kind = Literal["harmonic 1", "harmonic 2", "backlash", "offset", "twist", "bow"]


@dataclass(frozen=True)
class ModelTerm:
    """A part of the model: its kind, and what it is of (a joint, ``axis``, a board).

    ``numbers`` are its places among ``JOINTS_NAMES`` (a joint's), ``MAST_NAMES`` (the axes') or a bow's two,
    ``parameters`` their names.
    """

    kind: Kind
    of: str
    numbers: tuple[int, ...]
    parameters: tuple[str, ...]

    @property
    def name(self) -> str:
        """Its name for people; no two terms of a model have the same."""
        return f"bow of {self.of}" if self.kind == "bow" else f"{self.of} {self.kind}"

    @property
    def group(self) -> tuple[str, str]:
        """Terms of one group enter together or not at all."""
        return "harmonic" if self.kind in ("harmonic 1", "harmonic 2") else self.kind, self.of


def _by_name(terms: Iterable[ModelTerm]) -> dict[str, ModelTerm]:
    return {term.name: term for term in terms}


def _joint_term(kind: Kind, joint: int, numbers: tuple[int, ...]) -> ModelTerm:
    """A term of one joint by which of its numbers (``AXIS_NAMES``) it has."""
    places = tuple(joint * len(AXIS_NAMES) + number for number in numbers)
    return ModelTerm(kind, ("pan", "tilt")[joint], places, tuple(JOINTS_NAMES[i] for i in places))


def _axis_term(kind: Kind, place: int) -> ModelTerm:
    """A term of the axes."""
    return ModelTerm(kind, "axis", (place,), (f"mast.{MAST_NAMES[place]}",))


_JOINT_KINDS: tuple[tuple[Kind, tuple[int, ...]], ...] = (
    ("harmonic 1", (0, 1)), ("harmonic 2", (2, 3)), ("backlash", (4,)),
)  # fmt: skip
JOINT_TERMS = _by_name(
    _joint_term(kind, joint, numbers) for joint in (0, 1) for kind, numbers in _JOINT_KINDS
)
AXIS_TERMS = _by_name((_axis_term("offset", 6), _axis_term("twist", 7)))
TERM_KINDS = ("joints", "mast", "bow")
"""The kinds of unknowns (``calib.adjust.unknowns``) that terms are numbers of."""

HIDDEN_PX = 0.1
"""The error that a term left out may hide, one sigma, rms: half that of a person's click."""


def bow_of(board: str) -> ModelTerm:
    """Return the term of a board that is not flat."""
    return ModelTerm("bow", board, (0, 1), tuple(f"board {board}.bow_m.{a}" for a in "xy"))


def candidate_terms(boards: Sequence[str]) -> dict[str, ModelTerm]:
    """Return the terms that a model of some boards may have, by name."""
    return {**JOINT_TERMS, **AXIS_TERMS, **_by_name(bow_of(board) for board in boards)}


def entering_together(terms: Iterable[ModelTerm]) -> list[tuple[str, ...]]:
    """Return the terms' names in groups of which all enter or none."""
    groups: dict[tuple[str, str], list[str]] = {}
    for term in terms:
        groups.setdefault(term.group, []).append(term.name)
    return [tuple(group) for group in groups.values()]


@dataclass(frozen=True)
class Tested:
    """A term beside those that were chosen: what it gains, and the chance of that were it nothing; a first
    harmonic before the second one, a second one beyond the first. ``hidden_px`` is what its sigma moves
    pixels by, rms."""

    chi2: float
    chance: float
    hidden_px: float
    values: FloatArray
    sigma: FloatArray


def choose_terms(
    terms: Mapping[str, ModelTerm],
    names: Sequence[str],
    values: Mapping[str, float],
    covariance: FloatArray,
    scale: float,
    freedom: float,
    motions: Mapping[tuple[str, ...], FloatArray],
    enters: float = Level.THREE_SIGMAS,
) -> tuple[tuple[str, ...], dict[str, Tested]]:
    """Return the terms that are needed, and how each one does beside these.

    Parameters
    ----------
    terms
        By name; those that were fitted.
    names, covariance
        Of the whole fit, stated sigmas taken as they are.
    values
        Of the terms' parameters at the fit.
    scale, freedom
        The fit's chi-square over its degrees of freedom, and these.
    motions
        By group (`entering_together`) the matrix (k, k), px², that gives the mean square of what its
        numbers move pixels by.
    enters
        A group enters if so large a gain, were it nothing, had at most this chance.
    """
    at = {name: i for i, name in enumerate(names)}
    places = {name: [at[number] for number in term.parameters] for name, term in terms.items()}
    everything = [i for place in places.values() for i in place]
    of_terms = {i: k for k, i in enumerate(everything)}
    x = np.array([values[names[i]] for i in everything])
    c = covariance[np.ix_(everything, everything)]

    def is_play(group: Sequence[str]) -> bool:
        return terms[group[0]].kind == "backlash"

    def told(group: Sequence[str], beside: Sequence[str]) -> Tested:
        """The test of a group in the model of itself and some other terms."""
        mine = [of_terms[i] for term in group for i in places[term]]
        rest = [term for term in places if term not in group and term not in beside]
        gone = [of_terms[i] for term in rest for i in places[term]]
        here, spread = x[mine], c[np.ix_(mine, mine)]
        if gone:
            pull = c[np.ix_(mine, gone)] @ np.linalg.inv(c[np.ix_(gone, gone)])
            here, spread = here - pull @ x[gone], spread - pull @ c[np.ix_(gone, mine)]
        gain = float(here @ np.linalg.solve(spread, here))
        # Play is a width: what comes out negative is none.
        negative = is_play(group) and here[0] <= 0.0
        likely = 1.0 if negative else chance(gain, len(mine), scale, freedom)
        motion = motions.get(tuple(group))
        hidden = (
            0.0 if motion is None else float(np.sqrt(max(np.sum(motion * spread) * max(scale, 1.0), 0.0)))
        )
        return Tested(gain, likely, hidden, here, np.sqrt(np.maximum(np.diag(spread), 0.0)))

    kept = entering_together(terms.values())
    while kept:
        beside = [term for group in kept for term in group]
        tests = {group: told(group, beside) for group in kept}
        needless = [
            group
            for group, test in tests.items()
            if test.chance > enters and (test.hidden_px < HIDDEN_PX or is_play(group))
        ]
        if not needless:
            break
        kept.remove(max(needless, key=lambda group: (tests[group].chance, -tests[group].chi2)))
    chosen = tuple(term for term in terms if any(term in group for group in kept))
    found = {}
    for name, term in terms.items():
        found[name] = told((name,), chosen)
        if term.kind == "harmonic 1":  # what it gains alone, before the second one
            alone = told((name,), [other for other in chosen if terms[other].group != term.group])
            found[name] = replace(found[name], chi2=alone.chi2, chance=alone.chance)
    return chosen, found


def joint_numbers(chosen: Iterable[str]) -> list[int]:
    """Return which of the ten numbers of ``calib.geometry.rig.JOINTS_NAMES`` some terms have."""
    return sorted(number for term in chosen if term in JOINT_TERMS for number in JOINT_TERMS[term].numbers)


def axis_numbers(chosen: Iterable[str]) -> list[int]:
    """Return which of the mast's eight numbers some terms have."""
    return sorted(number for term in chosen if term in AXIS_TERMS for number in AXIS_TERMS[term].numbers)


def moves_px(
    problem: Adjustment,
    state: Estimate,
    terms: Mapping[str, ModelTerm],
    values: Mapping[str, float],
) -> dict[str, float]:
    """Return the rms over all corners of what each term's ``values`` move pixels by, all else held."""
    at = {name: {problem.names.index(n): values[n] for n in term.parameters} for name, term in terms.items()}
    total, count = dict.fromkeys(terms, 0.0), 0
    for image, block in problem.blocks(state):
        if not isinstance(image, ImageTerm):
            continue
        sigma = np.repeat(image.sigma_px[image.keep], 2)
        columns = block.columns.tolist()
        for term, mine in at.items():
            step = np.array([mine.get(i, 0.0) for i in columns])
            total[term] += float(np.sum((sigma * (block.jacobian @ step)) ** 2))
        count += len(sigma)
    return {term: float(np.sqrt(square / max(count, 1))) for term, square in total.items()}


def term_motions(
    problem: Adjustment, state: Estimate, terms: Mapping[str, ModelTerm]
) -> dict[tuple[str, ...], FloatArray]:
    """Return by group of terms (`entering_together`) the matrix (k, k), px², of how they move pixels.

    With numbers x of a group, xᵀ M x is the mean square of the motion. What a joint's harmonics do to all
    pictures alike is no motion: another zero of the joint, which is none's to know, does the same.
    """
    names = {
        group: [n for t in group for n in terms[t].parameters] for group in entering_together(terms.values())
    }
    found = {group: np.zeros((len(mine), len(mine))) for group, mine in names.items()}
    count = 0
    for image, block in problem.blocks(state):
        if not isinstance(image, ImageTerm):
            continue
        sigma = np.repeat(image.sigma_px[image.keep], 2)
        count += len(sigma)
        place = {problem.names[i]: k for k, i in enumerate(block.columns.tolist())}
        for group, mine in names.items():
            if group[0] not in JOINT_TERMS and set(mine) <= set(place):
                moved = sigma[:, None] * block.jacobian[:, [place[n] for n in mine]]
                found[group] += moved.T @ moved
    for group in names:
        if group[0] in JOINT_TERMS:
            found[group] = _by_joint(problem, state, [JOINT_TERMS[term] for term in group])
        else:
            found[group] /= max(count, 1)
    return found


def _by_joint(problem: Adjustment, state: Estimate, terms: Sequence[ModelTerm]) -> FloatArray:
    """How numbers of one joint move pixels, in the direction in which the joint turns."""
    which = ("pan", "tilt").index(terms[0].of)
    joint = (state.as_joints.pan, state.as_joints.tilt)[which]
    rates, focal = [], []
    for image in problem.images:
        if image.attitude is not None and image.keep.any():
            read, side = problem.readings(state, [image])
            rates.append(joint.rates(read[which, 0], side[which, 0]))
            focal.append(float(np.linalg.norm(state.cameras[image.camera].H)))
    numbers = [number % len(AXIS_NAMES) for term in terms for number in term.numbers]
    apart = np.array(rates)[:, numbers]
    apart = (apart - apart.mean(axis=0)) * float(np.median(focal))
    return np.asarray(apart.T @ apart / len(apart))
