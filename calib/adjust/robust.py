"""A fit without its blunders, every kind of measurement weighed by what its residuals show.

Pulls are bounded first (Huber). Every image then says how noisy its dots are (`calib.adjust.noise`), so
that blunders can be found by the tests of `calib.adjust.outliers`; then plain least squares without them.
Where residuals show that a kind of measurement is worse than stated, the fit is done again with the sigma
that they show (`calib.adjust.noise`), and so is its covariance.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from scipy.special import chdtrc

from calib.adjust.adjustment import HUBER, Adjustment
from calib.adjust.hypotheses import ScoredFit, find_contradictions
from calib.adjust.noise import (
    Component,
    found_sigmas,
    goodness,
    own_scales,
    scattering,
    variance_components,
    with_scales,
)
from calib.adjust.outliers import judge, name_outliers
from calib.adjust.solver import Minimum, minimise
from calib.adjust.terms import ImageTerm, StationTerm, scaled_images
from calib.adjust.uncertainty import fitted_fields, image_residuals, open_directions
from calib.adjust.unknowns import Estimate
from calib.errors import CalibError
from calib.geometry.significance import Level, typical_scale
from calib.survey.records import Survey


class SurveyNotFitted(CalibError):
    """The survey does not determine what is to be fitted, or no start leads to its noise."""


ROUNDS = 40
"""Times that measurements are judged and the fit done again, at most."""

WEIGHINGS = 6
"""Times that sigmas are changed and the fit done again, at most; three mostly do."""

FAR_SCATTER = 1.5
"""Dots that scatter in their images by so many times what is noise are what a far fit is far by."""

WEIGHED = 0.02
"""Sigmas are good enough when the next ones differ by less than this part."""


@dataclass(frozen=True, eq=False)
class Cleaned:
    """A fit without blunders, by sigmas as large as each image's scatter shows them.

    ``images`` are all that were to be fitted, with every dot and these sigmas; ``cameras`` is by what the
    stated sigmas of each kind were multiplied, without what single images have besides.
    """

    problem: Adjustment
    fit: Minimum[Estimate]
    images: tuple[ImageTerm, ...]
    cameras: Mapping[str, float]

    def as_stated(self) -> tuple[Adjustment, Minimum[Estimate]]:
        """Return the same with the sigmas that were stated, and its fit."""
        back = {kind: 1.0 / factor for kind, factor in self.cameras.items()}
        if all(factor == 1.0 for factor in back.values()) and all(t.scatter == 1.0 for t in self.images):
            return self.problem, self.fit
        images = scaled_images(self.problem.images, {}, {t.name: 1.0 / t.scatter for t in self.images})
        problem = self.problem.with_terms(images, self.problem.station).with_sigmas(back)
        return problem, minimise(problem, self.fit.state, weak=problem.weak, gain=1e-11)


@dataclass(frozen=True, eq=False)
class Weighed:
    """A fit with sigmas as large as residuals show them.

    ``images`` are all that were fitted, with every dot and these sigmas. ``excess`` is how far the squared
    residuals of the widened kinds, in the first fit, exceeded what their scatter allows.
    """

    problem: Adjustment
    fit: Minimum[Estimate]
    images: tuple[ImageTerm, ...]
    components: tuple[Component, ...]
    excess: float

    @property
    def factors(self) -> dict[str, float]:
        """By kind what stated sigmas count times."""
        return {c.kind: c.weighed for c in self.components}

    @cached_property
    def scored(self) -> ScoredFit:
        """What hypotheses are tested by."""
        return ScoredFit(self.problem, self.fit.state)


def weighed_fields(
    survey: Survey,
    cleaned: Cleaned,
    weighed: Weighed,
    images: Sequence[ImageTerm],
    checks: Sequence[ImageTerm],
    kinds: Sequence[str],
    level: Level,
    notes: Sequence[str],
    widened: float = 1.0,
) -> dict[str, Any]:
    """Return the fields of a `FittedRig` that follow from a weighed fit.

    Chi-square is that of the fit by the stated sigmas. ``images`` are all with every dot, and ``checks``
    the check images, with stated sigmas; the rest is as of `calib.adjust.uncertainty.fitted_fields`.
    """
    problem, state, covariance = weighed.problem, weighed.fit.state, weighed.fit.covariance
    order_px = survey.sigma.corner_px if survey.boards else survey.sigma.dot_px
    own = own_scales(problem, state, checks, weighed.factors, order_px)
    sized = scaled_images(checks, weighed.factors, own)
    scatter = {t.name: t.scatter for t in (*weighed.images, *sized)}
    residuals = image_residuals(survey, problem, state, images, checks, scatter)
    stated, fit = cleaned.as_stated()
    chi2, freedom = goodness(stated, fit.state, fit.covariance)
    return {
        **fitted_fields(survey, problem, state, covariance, residuals, sized, kinds, level, notes, widened),
        "chi2": chi2,
        "degrees_of_freedom": freedom,
        "chi2_probability": float(chdtrc(freedom, chi2)) if freedom > 0 else float("nan"),
        "components": weighed.components,
        "outliers": name_outliers(problem, state, weighed.images),
        "degenerate": open_directions(problem, covariance),
        "contradictions": find_contradictions(weighed.scored),
    }


def weigh(cleaned: Cleaned, *, narrows: bool = True) -> Weighed:
    """Return the fit with the sigma of each kind of measurement that is worse, or better, than stated.

    ``narrows`` says whether a sigma may become smaller than stated. Raises SurveyNotFitted if the last fit
    did not settle.
    """
    problem, fit, images = cleaned.problem, cleaned.fit, cleaned.images
    weighed = dict(cleaned.cameras)
    first: tuple[Component, ...] = ()
    for count in range(WEIGHINGS + 1):
        components = variance_components(problem.blocks(fit.state), fit.covariance, weighed)
        first = first or components
        wanted = found_sigmas(components, narrows=narrows)
        change = {kind: factor / weighed.get(kind, 1.0) for kind, factor in wanted.items()}
        if count == WEIGHINGS or all(abs(ratio - 1.0) < WEIGHED for ratio in change.values()):
            break
        weighed |= wanted
        images = scaled_images(images, change)
        problem, fit = judged(problem.with_sigmas(change), fit.state, images)
    if not fit.settled:
        raise SurveyNotFitted(
            f"the fit did not settle: after {fit.steps} steps it was still finding better values, so that "
            "neither they nor their sigmas are good. Take more images, at more joint angles and distances"
        )
    wrong = {c.kind for c in components if c.wrong}
    excess = sum(((c.factor / c.weighed) ** 2 - 1) * c.redundancy for c in first if c.kind in wrong)
    return Weighed(problem, fit, tuple(images), components, excess)


def without_blunders(
    problem: Adjustment, start: Estimate, all_images: Sequence[ImageTerm], order_px: float
) -> Cleaned:
    """Fit with pulls bounded, find each image's sigma, judge, and fit again until nothing fails.

    ``problem`` has stated sigmas, ``all_images`` are its images with every dot, ``start`` is a state that
    blunders may have moved, ``order_px`` as of `calib.adjust.noise.with_scales`.
    """
    fit = minimise(problem, start, weak=problem.weak, gain=1e-7)
    _refuse_lost(fit)
    problem, images, cameras = with_scales(problem, fit.state, all_images, order_px)
    for huber in (HUBER, None):
        problem, fit = judged(problem.with_huber(huber), fit.state, images)
    return Cleaned(problem, fit, images, cameras)


def judged(
    problem: Adjustment, start: Estimate, images: Sequence[ImageTerm]
) -> tuple[Adjustment, Minimum[Estimate]]:
    """Fit, judge every measurement by the rest (`calib.adjust.outliers`), and fit again until nothing fails.

    ``images`` are those of the problem with every dot.
    """
    gain = 1e-7 if problem.huber else 1e-11
    fit = minimise(problem, start, weak=problem.weak, gain=gain)
    _refuse_lost(fit)
    kept = {_kept(problem.images, problem.station)}
    for _ in range(ROUNDS):
        seen, station = judge(problem, fit.state, fit.covariance, images)
        pattern = _kept(seen, station)
        if pattern in kept:  # nothing new, or a measurement on its limit that comes and goes
            break
        kept.add(pattern)
        problem = problem.with_terms(seen, station)
        fit = minimise(problem, fit.state, weak=problem.weak, gain=gain)
        _refuse_lost(fit)
    return problem, fit


def _kept(images: Sequence[ImageTerm], station: Sequence[StationTerm]) -> bytes:
    """Which measurements count, as something to compare."""
    return b"".join(t.keep.tobytes() for t in images) + bytes(p.keep for p in station)


def _refuse_lost(fit: Minimum[Estimate]) -> None:
    if not np.isfinite(fit.normal.cost):
        raise SurveyNotFitted(
            "the fit starts where a camera does not see a dot that it saw: no start was found"
        )


def refuse_far(
    problem: Adjustment,
    state: Estimate,
    stated_px: float,
    *,
    most: float,
    dot: str,
    disagree: str,
    scatter: str,
    coherent: str,
) -> None:
    """Raise SurveyNotFitted if a camera's typical dot is far above its noise, or too many of its images were
    left out.

    No dot's own sigma counts as less than ``stated_px``: what neighbours share, as a print's errors, is not
    in it. The typical dot may be off ``most`` times the noise: stated sigmas are wrong by two or three, wrong
    minima by a hundred. ``disagree``, ``scatter`` and ``coherent`` say what to check where images disagree,
    where dots are off one by one, and where they are off together.
    """
    for name in state.cameras:
        mine = [t for t in problem.images if t.camera == name]
        kept = [t for t in mine if t.keep.any()]
        if len(kept) < max(2, len(mine) // 2):
            raise SurveyNotFitted(
                f"camera {name}: {len(mine) - len(kept)} of its {len(mine)} images do not agree with the rest"
                f"{disagree}"
            )
        own_px = np.concatenate([t.sigma_px[t.keep] for t in kept])
        counted_px = np.maximum(own_px, stated_px)
        off = np.concatenate([r.reshape(-1, 2) for r in problem.residuals(state, kept)])
        lengths = np.linalg.norm(off, axis=1) * own_px / counted_px
        typical, noise_px = float(np.sqrt(typical_scale(lengths**2))), float(np.median(counted_px))
        squares = [one.square for _, one in scattering(problem, state, kept).values()]
        excess = float(np.sqrt(np.median(squares))) if squares else 1.0
        if excess > FAR_SCATTER:
            raise SurveyNotFitted(
                f"camera {name}: its {dot}s are off one by one, by {excess * noise_px:.2g} px beside a "
                f"smooth map of each image, where {noise_px:.2g} px at most may count for noise "
                f"({stated_px:g} px are stated): {scatter}"
            )
        if typical > most:
            raise SurveyNotFitted(
                f"camera {name}: the fit leaves {typical:.1f} times the noise of a {dot} ({noise_px:.2g} "
                f"px), and {dot}s of an image are off together, not one by one: it ended in a wrong minimum, "
                f"the lens is not of this model, or {coherent}"
            )
