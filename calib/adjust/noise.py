"""How large errors are against their stated sigmas: of each kind of measurement, and of each image's dots.

Kinds of measurements are compared with one another by the fit itself: each has its part of the redundancy,
n - tr(JᵀJ C), which is what its squared residuals (in sigmas) should sum up to. Their quotient is the
variance component (Foerstner 1979); iterated by fitting again with the sigmas that it gives, it is Helmert's
estimate and that of restricted maximum likelihood. Its covariance is 2 H⁻¹ with Helmert's matrix

    h_ii = n_i - 2 tr(C N_i) + tr(C N_i C N_i),    h_ij = tr(C N_i C N_j),    N_i = J_iᵀJ_i.

So a few hundred points of a station are judged by themselves, and not drowned by ten thousand dots.

Over one board, what a fit leaves of an image's dots is a smooth function of the place on the board if
anything moved the image as a whole: a polynomial takes it up. What is left is the dots' own noise. So every
image says for itself how noisy it is, before it is tested against the others; and a whole image that is
tested with that sigma is tested for coherent shifts alone. Images of a camera that agree with each other have
one scale, their camera's; luck changes none. Nothing is taken for more exact than stated here. Scales end at
`GROSS`, or `ORDER` times what the survey states of all dots: gross blunders are no noise.

Pixels themselves are a smooth function of the place as well, whatever the lens and the board's pose: so wrong
dots are found without a camera, for fits that take boards as exact. There the station's error moves all dots
of an image, and would hide a wrong one.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from scipy.special import chdtr, chdtrc, fdtrc

from calib.adjust.adjustment import Adjustment
from calib.adjust.gross import GROSS, MANY, Outlier, at_least_stated, bounded
from calib.adjust.terms import PRISMS, TAPES, ImageTerm, StationTerm, scaled_images
from calib.adjust.unknowns import Estimate, ResidualBlock, Unknown
from calib.geometry.rigid import FloatArray
from calib.geometry.significance import Level, typical_scale

FEWEST = 3.0
"""With less redundancy than this, nothing is said of a kind of measurement."""

LEAST = 0.1
"""A sigma is narrowed to this part of the stated one at most: what is smaller still is no noise."""

STAYS = 20.0
"""A kind that was called wrong stays so up to a chance so many times larger."""

ORDER = 2.0
"""Noise is at most `GROSS` times what is stated: five times is what a careless focus makes of it. Or until a
dot's sigma is so many times what the survey states of all dots: dots come with sigmas of their
own that may be much less, and a near board shows its print's errors most."""

DEGREES = ((60, 3), (24, 2), (10, 1))
"""Fewest dots for a polynomial of that degree; an image with fewer has its camera's scale."""

BEYOND = 4.0
"""A dot so many times farther off than the typical one is no noise."""

BLUNDER_DEGREES = ((60, 4, 6.0), (30, 3, 6.0), (16, 2, 10.0))
"""Fewest dots for a polynomial of that degree, and how many times farther off than the typical one a dot is
gross then; of fewer nothing is tested."""

POLYNOMIAL_PX = 0.08
"""What a polynomial of the fourth degree may miss, at the corners of a near board in a wide lens."""

STEPS = 10
PULL = 2.5
"""Beyond so many times the typical residual a dot pulls no harder."""


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


class Scatter(NamedTuple):
    """Mean square of an image's dots about their smooth map, in stated sigmas, and its degrees of freedom."""

    square: float
    freedom: float


def scatter(image: ImageTerm, residual: FloatArray, judged: np.ndarray | None = None) -> Scatter | None:
    """Return how much an image's dots scatter, their residuals (2n,) being in its sigmas; None of too few.

    The farthest are left out as blunders, unless these were ``judged``: then all that passed (n,) count.
    """
    off = residual.reshape(-1, 2)
    seen = np.isfinite(off).all(axis=1) & (True if judged is None else judged)
    degree = next((degree for fewest, degree in DEGREES if seen.sum() >= fewest), 0)
    if not degree:
        return None
    statistic, _ = off_smooth(image.in_board_m[seen, :2], off[seen], np.ones(int(seen.sum())), degree)
    kept = statistic if judged is not None else statistic[statistic <= BEYOND**2 * typical_scale(statistic)]
    taken = (degree + 1) * (degree + 2)
    return Scatter(float(kept.mean()) / 2.0, float(2 * len(kept) - taken)) if 2 * len(kept) > taken else None


def own_scales(
    problem: Adjustment,
    state: Estimate,
    images: Sequence[ImageTerm],
    cameras: Mapping[str, float],
    order_px: float,
) -> dict[str, float]:
    """Return by image what its stated sigmas count times beside its camera's: of images that were not fitted.

    ``cameras`` is by kind of measurement what stated sigmas count times, ``order_px`` as of `with_scales`.
    """
    found = scattering(problem, state, images)
    return {
        name: _own(one, cameras.get(term.kind, 1.0), np.inf, _most(term, order_px))
        for name, (term, one) in found.items()
    }


def with_scales(
    problem: Adjustment, state: Estimate, images: Sequence[ImageTerm], order_px: float
) -> tuple[Adjustment, tuple[ImageTerm, ...], dict[str, float]]:
    """Return a problem and all its images, with every dot, by sigmas as large as their scatter shows; and by
    kind of measurement what the stated sigmas of all count times.

    ``images`` are the problem's in its order, with every dot and stated sigmas, ``state`` is a first fit:
    what is left of an image may be large, but has to be smooth. ``order_px`` is what the survey states of all
    its dots, one sigma.
    """
    found = scattering(problem, state, images)
    cameras, own = dict[str, float](), dict[str, float]()
    for kind in dict.fromkeys(term.kind for term, _ in found.values()):
        mine = {name: one for name, (term, one) in found.items() if term.kind == kind}
        squares, freedom = np.array(list(mine.values())).T
        typical = float(np.median(squares))
        like = np.array([not _odd(one, typical, np.inf) for one in mine.values()])
        if like.any():
            typical = float(np.sum((squares * freedom)[like]) / freedom[like].sum())
        together = float(freedom[like].sum())
        if not (typical > 1.0 and chdtrc(together, typical * together) < Level.STATED):
            typical = 1.0
        most = [_most(found[name][0], order_px) for name in mine]
        cameras[kind] = min(float(np.sqrt(typical)), *most)
        sure = np.inf if typical == 1.0 else max(together, 1.0)
        for name, limit in zip(mine, most, strict=True):
            own[name] = _own(mine[name], cameras[kind], sure, limit)
    every = scaled_images(images, cameras, own)
    kept = [replace(whole, keep=term.keep) for whole, term in zip(every, problem.images, strict=True)]
    return problem.with_terms(kept, problem.station), every, cameras


def scattering(
    problem: Adjustment, state: Estimate, images: Sequence[ImageTerm]
) -> dict[str, tuple[ImageTerm, Scatter]]:
    """Return by image its term and its scatter, of those that show it."""
    residuals = problem.residuals(state, [_whole(term) for term in images])
    measured = ((term, scatter(term, off)) for term, off in zip(images, residuals, strict=True))
    return {term.name: (term, one) for term, one in measured if one is not None}


def print_error_m(problem: Adjustment, state: Estimate) -> float:
    """Return how far the typical corner is printed beside its place on the board, metres an axis.

    It is the same in all pictures, where noise is another in each; 0 where chance makes them agree as much.
    """
    shown = [t for t in problem.images if t.keep.any() and t.ids is not None]
    sums: dict[tuple[str, int], FloatArray] = {}
    for term, block in zip(shown, problem.blocks_of(state, shown), strict=True):
        axes = state.rover_from_board[term.board].rotation[:, :2]
        by_place = block.rates(("board", term.board))[:, 3:].reshape(-1, 2, 3) @ axes
        rows = np.concatenate([by_place, block.residual.reshape(-1, 2, 1)], axis=2)
        assert term.ids is not None
        for corner, one in zip(term.ids[term.keep].tolist(), rows.transpose(0, 2, 1) @ rows, strict=True):
            sums[term.board[0], corner] = sums.get((term.board[0], corner), 0.0) + one
    known = [(one[:2, :2], one[:2, 2]) for one in sums.values() if np.linalg.det(one[:2, :2]) > 0.0]
    agree = sum(float(pull @ np.linalg.solve(matrix, pull)) for matrix, pull in known)
    if not known or chdtrc(2 * len(known), agree) >= Level.STATED:
        return 0.0
    return float(np.sqrt((agree - 2 * len(known)) / sum(float(np.trace(matrix)) for matrix, _ in known)))


def without_wrong(images: Sequence[ImageTerm]) -> tuple[list[ImageTerm], tuple[Outlier, ...]]:
    """Return images of which dots that disagree with the rest of theirs do not count, and these by name.

    Where an image's typical dot is farther off than its sigma, its limit is wider by as much. Where too many
    are beyond it, it is not the dots that are wrong.
    """
    clean, outliers = list(images), list[Outlier]()
    for at, image in enumerate(images):
        found = next((rest for fewest, *rest in BLUNDER_DEGREES if len(image.keep) >= fewest), None)
        if found is None:
            continue
        degree, gross = found
        sigma_px = np.hypot(image.sigma_px, POLYNOMIAL_PX)
        statistic, off_px = off_smooth(image.in_board_m[:, :2], image.pixels_px, sigma_px, int(degree))
        limit = gross**2 * at_least_stated(statistic)
        bad = np.asarray(statistic > limit)
        if bad.any() and bad.mean() <= MANY:
            clean[at] = replace(image, keep=image.keep & ~bad)
            for i in np.flatnonzero(bad):
                name = f"image {image.name} {image.part(int(i))}"
                outliers.append(Outlier("dot", name, float(off_px[i])))
    return clean, tuple(outliers)


def off_smooth(
    places: FloatArray, values: FloatArray, sigma: FloatArray, degree: int
) -> tuple[FloatArray, FloatArray]:
    """Return how far points are from a polynomial of the others: chi-square of two degrees of freedom (n,),
    and the distance (n,).

    ``places`` (n, 2) are where each point is, ``values`` (n, 2) what is smooth over these, ``sigma`` (n,)
    that of a value's coordinate.
    """
    aside = places - places.mean(axis=0)
    x, y = (aside / max(float(np.abs(aside).max()), 1e-9)).T
    terms = np.stack([x**i * y**j for i in range(degree + 1) for j in range(degree + 1 - i)], axis=1)
    weight = 1 / sigma**2
    for _ in range(STEPS):
        root = np.sqrt(weight)[:, None]
        numbers = np.linalg.lstsq(root * terms, root * values, rcond=None)[0]
        off = np.linalg.norm(terms @ numbers - values, axis=1)
        size = off / sigma
        size = size / max(1.0, float(np.median(size)))
        weight = bounded(size, PULL) ** 2 / sigma**2
        if not (size > PULL).any():
            break
    root = np.sqrt(weight)[:, None]
    share = np.linalg.norm(np.linalg.qr(root * terms)[0], axis=1) ** 2
    # A point alone in its corner bends the polynomial to itself: judge it by what that leaves.
    return (off / sigma) ** 2 / np.maximum(1 - share, 0.1), off


def _whole(term: ImageTerm) -> ImageTerm:
    return term if term.keep.all() else replace(term, keep=np.ones_like(term.keep))


def _most(term: ImageTerm, order_px: float) -> float:
    """The largest scale that is noise."""
    return max(GROSS, ORDER * order_px / float(np.median(term.sigma_px)))


def _own(one: Scatter, camera: float, freedom: float, most: float) -> float:
    """What an image's sigmas count times beside its camera's; nothing becomes smaller than stated."""
    if not _odd(one, camera**2, freedom):
        return 1.0
    least = min(camera, 1.0)
    return min(max(float(np.sqrt(one.square)), least), max(most, camera)) / camera


def _odd(one: Scatter, typical: float, freedom: float) -> bool:
    """Whether an image's scatter is not that of others, larger or smaller, of which so much is known."""
    ratio = one.square / max(typical, 1e-300)
    if np.isinf(freedom):
        above = float(chdtrc(one.freedom, one.freedom * ratio))
    else:
        above = float(fdtrc(one.freedom, freedom, ratio))
    return 2 * min(above, 1.0 - above) < Level.STATED
