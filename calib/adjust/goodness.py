"""Variance components: how large the errors of each kind of measurement are, against its stated sigma.

Kinds of measurements are compared with one another by the fit itself: each has its part of the redundancy,
n - tr(JᵀJ C), which is what its squared residuals (in sigmas) should sum up to. Their quotient is the
variance component (Foerstner 1979); iterated by fitting again with the sigmas that it gives, it is Helmert's
estimate and that of restricted maximum likelihood. Its covariance is 2 H⁻¹ with Helmert's matrix

    h_ii = n_i - 2 tr(C N_i) + tr(C N_i C N_i),    h_ij = tr(C N_i C N_j),    N_i = J_iᵀJ_i.

So a few hundred points of a station are judged by themselves, and not drowned by ten thousand dots.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import chdtr, chdtrc, fdtrc

from calib.adjust.adjustment import Adjustment
from calib.adjust.terms import PRISMS, TAPES, ImageTerm, StationTerm
from calib.adjust.unknowns import Estimate, ResidualBlock, Unknown
from calib.geometry.rigid import FloatArray
from calib.geometry.significance import Level

FEWEST = 3.0
"""With less redundancy than this, nothing is said of a kind of measurement."""

LEAST = 0.1
"""A sigma is narrowed to this part of the stated one at most: what is smaller still is no noise."""

STAYS = 20.0
"""A kind that was called wrong stays so up to a chance so many times larger."""


@dataclass(frozen=True)
class Component:
    """How large the errors of one kind of measurement are.

    ``kind`` is ``dots of CAMERA``, ``tapes``, ``prisms``, ``joint readings`` or ``drawing`` (of the prisms),
    ``redundancy`` how many of the ``count`` numbers check the others, ``factor`` sigma found over sigma
    stated, ``weighed`` the factor on the stated sigma for the fit: 1 where it is no more than luck. The
    chances are of residuals as large, and as small, were the stated sigma right.
    """

    kind: str
    count: int
    redundancy: float
    factor: float
    factor_sigma: float
    weighed: float
    chance: float
    small_chance: float = 1.0

    @property
    def wrong(self) -> bool:
        """Whether the stated sigma is too small."""
        return self.weighed > 1.0

    @property
    def generous(self) -> bool:
        """Whether the stated sigma is too large."""
        return self.weighed < 1.0


def variance_components(
    blocks: Iterable[tuple[ImageTerm | StationTerm | Unknown, ResidualBlock]],
    covariance: FloatArray,
    weighed: Mapping[str, float] | None = None,
) -> tuple[Component, ...]:
    """Return the variance components of a fit at its minimum.

    ``blocks`` are of all that was measured, ``covariance`` (p, p) is of the unknowns, the inverse of all the
    blocks' normal equations. ``weighed`` is by what the stated sigma of a kind was multiplied before:
    residuals are in sigmas of that size.
    """
    before, sums = weighed or {}, _by_kind(blocks, len(covariance))
    taken = [covariance @ normal for _, _, normal in sums.values()]
    helmert = np.array([[float(np.sum(one * other.T)) for other in taken] for one in taken])
    paid = np.array([np.trace(one) for one in taken])
    counts = np.array([count for _, count, _ in sums.values()], dtype=np.float64)
    helmert[np.diag_indices(len(sums))] += counts - 2 * paid
    spread = 2 * np.diag(np.linalg.pinv(helmert)) if sums else np.zeros(0)
    found = []
    for (kind, (squares, count, _)), r, variance in zip(sums.items(), counts - paid, spread, strict=True):
        times = before.get(kind, 1.0)
        if r < FEWEST:
            found.append(Component(kind, count, float(r), float("nan"), float("nan"), times, 1.0))
            continue
        factor = float(np.sqrt(squares / r)) * times
        sigma = factor * float(np.sqrt(variance)) / 2
        large, small = (float(of(r, squares * times**2)) for of in (chdtrc, chdtr))
        found.append(Component(kind, count, float(r), factor, sigma, times, large, small))
    return tuple(found)


def _by_kind(
    blocks: Iterable[tuple[ImageTerm | StationTerm | Unknown, ResidualBlock]], size: int
) -> dict[str, tuple[float, int, FloatArray]]:
    """By kind of measurement the sum of squares, how many numbers there are, and JᵀJ of all unknowns."""
    sums: dict[str, tuple[float, int, FloatArray]] = {}
    for what, block in blocks:
        if what.kind is not None:
            squares, count, normal = sums.get(what.kind, (0.0, 0, np.zeros((size, size))))
            normal[np.ix_(block.columns, block.columns)] += block.jacobian.T @ block.jacobian
            squares += float(block.residual @ block.residual)
            sums[what.kind] = squares, count + len(block.residual), normal
    return sums


def found_sigmas(components: Sequence[Component], *, narrows: bool = True) -> dict[str, float]:
    """Return by kind what a stated sigma should be multiplied by.

    Luck changes none: a kind is widened, or narrowed, where chance does not explain its residuals; one that
    was before stays so a little longer, so that none comes and goes. Tapes and prisms are taken together
    where they agree. Without ``narrows`` no sigma becomes smaller than stated.
    """
    known = [c for c in components if np.isfinite(c.factor)]
    found = {c.kind: c.factor for c in known}
    limit = {c.kind: (STAYS if c.weighed != 1.0 else 1.0) * Level.STATED / len(known) for c in known}
    odd = {c.kind: 2 * min(c.chance, c.small_chance) if narrows else c.chance for c in known}
    wrong = {kind for kind, chance in odd.items() if chance < limit[kind]}
    station = {c.kind: c for c in known if c.kind in (TAPES, PRISMS)}
    if len(station) == 2 and wrong & set(station) and as_one(station[TAPES], station[PRISMS]):
        square = sum(c.redundancy * c.factor**2 for c in station.values())
        together = float(np.sqrt(square / sum(c.redundancy for c in station.values())))
        found |= dict.fromkeys(station, together)
        wrong |= set(station)
    return {kind: max(LEAST, factor) if kind in wrong else 1.0 for kind, factor in found.items()}


def as_one(one: Component, other: Component) -> bool:
    """Return whether two kinds may have one sigma."""
    ratio = (one.factor / other.factor) ** 2
    above = float(fdtrc(one.redundancy, other.redundancy, ratio))
    return 2 * min(above, 1 - above) > Level.STATED


def goodness(problem: Adjustment, state: Estimate, covariance: FloatArray) -> tuple[float, float]:
    """Return the weighted sum of squares of all measurements and its degrees of freedom.

    What is known of lenses beforehand counts as information but not as a measurement: the unknowns cost
    only as many degrees of freedom as the measurements have paid for, tr(JᵀJ C).
    """
    sums = _by_kind(problem.blocks(state), len(covariance)).values()
    freedom = sum(count - float(np.sum(covariance * normal)) for _, count, normal in sums)
    return float(sum(squares for squares, _, _ in sums)), float(freedom)
