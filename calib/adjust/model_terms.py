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

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np

from calib.adjust.adjustment import Adjustment
from calib.adjust.noise import goodness
from calib.adjust.solver import Minimum
from calib.adjust.terms import ImageTerm
from calib.adjust.unknowns import Estimate
from calib.geometry.rig import AXIS_NAMES, JOINTS_NAMES, MAST_NAMES
from calib.geometry.rigid import FloatArray
from calib.geometry.significance import Level, chance

Kind = Literal["harmonic 1", "harmonic 2", "backlash", "offset", "twist", "bow"]


@dataclass(frozen=True)
class ModelTerm:
    """A part of the model: its kind, what it is of (``pan``, ``tilt``, ``axis`` or a board), and the places
    of its numbers among ``JOINTS_NAMES`` (a joint's), ``MAST_NAMES`` (the axes') or a bow's two."""

    kind: Kind
    of: str
    numbers: tuple[int, ...]

    @property
    def name(self) -> str:
        """Its name for people; no two terms of a model have the same."""
        return f"bow of {self.of}" if self.kind == "bow" else f"{self.of} {self.kind}"

    @property
    def unknown(self) -> str:
        """The kind of unknowns (``calib.adjust.unknowns``) that its numbers belong to."""
        return {"bow": "bow", "offset": "mast", "twist": "mast"}.get(self.kind, "joints")

    @property
    def parameters(self) -> tuple[str, ...]:
        """Its numbers' names."""
        if self.kind == "bow":
            return tuple(f"board {self.of}.bow_m.{axis}" for axis in "xy")
        joint = self.unknown == "joints"
        return tuple(JOINTS_NAMES[i] if joint else f"mast.{MAST_NAMES[i]}" for i in self.numbers)

    @property
    def group(self) -> tuple[str, str]:
        """Terms of one group enter together or not at all."""
        return "harmonic" if self.kind in ("harmonic 1", "harmonic 2") else self.kind, self.of


HIDDEN_PX = 0.1
"""The error that a term left out may hide, one sigma, rms: half that of a person's click."""


def candidate_terms(boards: Sequence[str]) -> dict[str, ModelTerm]:
    """Return the terms that a model of some boards may have, by name."""
    terms = []
    for first, joint in ((0, "pan"), (len(AXIS_NAMES), "tilt")):
        terms += [
            ModelTerm("harmonic 1", joint, (first, first + 1)),
            ModelTerm("harmonic 2", joint, (first + 2, first + 3)),
            ModelTerm("backlash", joint, (first + 4,)),
        ]
    terms += [ModelTerm("offset", "axis", (6,)), ModelTerm("twist", "axis", (7,))]
    return {term.name: term for term in (*terms, *(ModelTerm("bow", board, (0, 1)) for board in boards))}


def term_numbers(terms: Mapping[str, ModelTerm], unknown: str) -> list[int]:
    """Return the places of all numbers that some terms have of a kind of unknowns."""
    return sorted(number for term in terms.values() if term.unknown == unknown for number in term.numbers)


def entering_together(terms: Iterable[ModelTerm]) -> list[tuple[str, ...]]:
    """Return the terms' names in groups of which all enter or none."""
    groups: dict[tuple[str, str], list[str]] = {}
    for term in terms:
        groups.setdefault(term.group, []).append(term.name)
    return [tuple(group) for group in groups.values()]


@dataclass(frozen=True, eq=False)
class TermGain:
    """A part of the model that enters if the pictures ask for it, or cannot exclude one that would matter.

    ``values`` and ``sigma`` (k,) are of its parameters beside the other terms, in the units of their names;
    ``chi2`` is by how much the weighted sum of squares is lower with it, ``chance`` that of so much were it
    nothing: of a first harmonic before the second one, of a second one beyond the first. Its sigma moves
    pixels by ``hidden_px``, the term itself by ``moves_px``, rms over all corners.
    """

    term: ModelTerm
    values: FloatArray
    sigma: FloatArray
    chi2: float
    chance: float
    hidden_px: float
    moves_px: float
    entered: bool = True

    @property
    def name(self) -> str:
        """The term's name for people."""
        return self.term.name

    def as_json(self) -> dict[str, Any]:
        """Return the term as JSON or YAML."""
        names = self.term.parameters
        return {
            "name": self.name,
            "entered": self.entered,
            "values": dict(zip(names, self.values.tolist(), strict=True)),
            "sigma": dict(zip(names, self.sigma.tolist(), strict=True)),
            "chi2": self.chi2,
            "chance": self.chance,
            "moves_px": self.moves_px if self.entered else None,
            "sentence": self.sentence,
        }

    @property
    def sentence(self) -> str:
        """The term for a person."""
        size, spread = float(np.linalg.norm(self.values)), float(np.sqrt(np.mean(self.sigma**2)))
        unit = "mm" if self.term.kind in ("offset", "bow") else "mrad"
        value = f"{self.name}: {1e3 * size:.2f} ± {1e3 * spread:.2f} {unit}"
        if not self.entered:
            return f"{value}, not significant (chi-square {self.chi2:.1f}): left out"
        if self.chance > Level.THREE_SIGMAS and self.term.kind != "harmonic 2":
            return f"{value}, chi-square {self.chi2:.1f}: not significant, but the pictures cannot exclude it"
        return f"{value}, moves pixels by {self.moves_px:.2f} px rms, lowers chi-square by {self.chi2:.0f}"


def choose_terms(
    problem: Adjustment, fit: Minimum[Estimate], terms: Mapping[str, ModelTerm]
) -> tuple[dict[str, ModelTerm], dict[str, TermGain]]:
    """Return which of the terms that were fitted are needed, and how each one does beside these."""
    total, freedom = goodness(problem, fit.state, fit.covariance)
    freedom = max(freedom, 1.0)
    scale = total / freedom
    known = problem.values(fit.state, "joints", "mast", "bow")
    numbers = [number for term in terms.values() for number in term.parameters]
    ends = np.cumsum([len(term.parameters) for term in terms.values()], dtype=int).tolist()
    places = {n: list(range(e - len(t.parameters), e)) for (n, t), e in zip(terms.items(), ends, strict=True)}
    at = [problem.names.index(number) for number in numbers]
    x, c = np.array([known[number] for number in numbers]), fit.covariance[np.ix_(at, at)]
    motion = _motion(problem, fit.state, terms, places, at)

    def tested(group: Sequence[str], beside: Collection[str]) -> TermGain:
        """The test of a group in the model of itself and some other terms."""
        mine = [i for term in group for i in places[term]]
        gone = [i for term, own in places.items() if term not in group and term not in beside for i in own]
        value, spread, moves = x[mine], c[np.ix_(mine, mine)], motion[np.ix_(mine, mine)]
        if gone:
            pull = c[np.ix_(mine, gone)] @ np.linalg.inv(c[np.ix_(gone, gone)])
            value, spread = value - pull @ x[gone], spread - pull @ c[np.ix_(gone, mine)]
        gain = float(value @ np.linalg.solve(spread, value))
        # Play is a width: what comes out negative is none.
        negative = is_play(group) and value[0] <= 0.0
        likely = 1.0 if negative else chance(gain, len(mine), scale, freedom)
        squares = np.array([np.sum(moves * spread) * max(scale, 1.0), value @ moves @ value])
        hidden, moved = np.sqrt(np.maximum(squares, 0.0)).tolist()
        sigma = np.sqrt(np.maximum(np.diag(spread), 0.0))
        return TermGain(terms[group[0]], value, sigma, gain, likely, hidden, moved)

    def is_play(group: Sequence[str]) -> bool:
        return terms[group[0]].kind == "backlash"

    kept = entering_together(terms.values())
    while kept:
        beside = [term for group in kept for term in group]
        tests = {group: tested(group, beside) for group in kept}
        doubtful = [group for group, test in tests.items() if test.chance > Level.THREE_SIGMAS]
        needless = [group for group in doubtful if tests[group].hidden_px < HIDDEN_PX or is_play(group)]
        if not needless:
            break
        kept.remove(max(needless, key=lambda group: (tests[group].chance, -tests[group].chi2)))
    chosen = {name: term for name, term in terms.items() if any(name in group for group in kept)}
    found = {}
    for name, term in terms.items():
        found[name] = tested((name,), chosen)
        if term.kind == "harmonic 1":  # what it gains alone, before the second one
            alone = tested((name,), [other for other in chosen if terms[other].group != term.group])
            found[name] = replace(found[name], chi2=alone.chi2, chance=alone.chance)
        found[name] = replace(found[name], entered=name in chosen)
    return chosen, found


def _motion(
    problem: Adjustment,
    state: Estimate,
    terms: Mapping[str, ModelTerm],
    places: Mapping[str, Sequence[int]],
    at: Sequence[int],
) -> FloatArray:
    """The matrix (k, k), px², of how the terms' numbers, ``at`` these among all, move pixels.

    With numbers x of a group of terms, xᵀ M x is the mean square of the motion. What a joint's harmonics do
    to all pictures alike is no motion: another zero of the joint, which pictures leave open, does the same.
    """
    found, count = np.zeros((len(at), len(at))), 0
    for image, block in problem.blocks(state):
        if isinstance(image, ImageTerm):
            rates = np.zeros((len(block.residual), len(problem.names)))
            rates[:, block.columns] = np.repeat(image.sigma_px[image.keep], 2)[:, None] * block.jacobian
            found += rates[:, at].T @ rates[:, at]
            count += len(rates)
    found /= max(count, 1)
    for group in entering_together(terms.values()):
        if terms[group[0]].unknown == "joints":
            mine = [i for term in group for i in places[term]]
            found[np.ix_(mine, mine)] = _by_joint(problem, state, [terms[term] for term in group])
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
