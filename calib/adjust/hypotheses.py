"""What a fit's residuals would gain by: one table of hypotheses, for surveys and for benches.

Each hypothesis has numbers beside the fitted ones, all 0 in the fit: of the mast's axes, of a joint's errors
around the turn, of a joint that slips, of a lens, of a camera that changes between two pictures, of joints
and cameras that drift from the first picture to the last, of a board's shape, of a board that moved, of a
placement whose pictures say something else of cameras and axes than the others. Surveys and benches differ
only in what is tested. Where one defect shows in several hypotheses, the one that gains most for its numbers
is the likeliest. A pan that slips between two placements of a bench's board is seen by nothing and does no
harm.

Rao's score test: with the Jacobian E of the further numbers beside J of those that were fitted, the residual
r at the minimum and C = (JᵀJ)⁻¹, the sum of squares would fall by gᵀ S⁻¹ g to first order, where

    g = Eᵀr,    S = EᵀE - EᵀJ C JᵀE.

Without such an effect that is chi-square with as many degrees of freedom as there are numbers that J cannot
make up for. Nothing is fitted again, so that hundreds of wider models cost as much as one step of the fit.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Literal, NamedTuple

import numpy as np
from scipy.linalg import block_diag, null_space

from calib.adjust.adjustment import PAN_TILT, Adjustment, Motions
from calib.adjust.noise import goodness
from calib.adjust.solver import covariance_of
from calib.adjust.terms import DRAWING, ImageTerm
from calib.adjust.unknowns import Estimate, ResidualBlock
from calib.geometry.rig import AXIS_NAMES, MAST_FREE, MAST_NAMES
from calib.geometry.rigid import FloatArray, rigid_rates
from calib.geometry.significance import Level, chance

EXPLAINS = 0.5
"""A hypothesis explains what a fit leaves if it takes away this part."""

BEND_DEGREE = 4
"""Of the polynomials of the place in the picture by which a lens may be bent otherwise than modelled."""

AS_GOOD = 0.98
"""A change with fewer numbers is preferred if it gains this part of the best one's."""

LEAST_PART = 0.01
"""A board or camera that moved explains at least this part of the weighted sum of squares: less is the
model's."""

STILL_FAR = 9.0
"""Chi-square over its degrees of freedom that a cause leaves at most, or it explains half of it at least."""

UNSEEN = 1e-3
"""A direction is not tested if the other unknowns take up all but this part of it, unless a station ties
boards to the rover: tapes show a slip that sharp images alone leave to their boards."""

LARGEST = 0.5
"""Radians, or part of the focal length: what is larger is no slip, knock or other focus."""

SURE, LITTLE_FOCAL = 3.0, 0.05
"""A camera turned alone if its focal length changed by fewer sigmas, or by less of this part of the turn."""

MADE_UP = 1e-7
"""A further number is made up for by those that were fitted if so little of its information is left."""

Course = Literal["always", "once", "each", "from"]
Rates = Callable[[ImageTerm, Motions], FloatArray]


class Gain(NamedTuple):
    """By how much the sum of squares would fall, how many of the further numbers count, their values (k,) and
    sigmas (k,), not-a-number where one cannot be determined by itself."""

    chi2: float
    freedom: int
    values: FloatArray
    sigma: FloatArray


@dataclass(frozen=True, eq=False)
class Score:
    """Sums over the residuals that depend on further numbers: EᵀE (k, k), EᵀJ (k, p) and Eᵀr (k,)."""

    own: FloatArray
    cross: FloatArray
    pull: FloatArray

    @classmethod
    def of(cls, measured: Iterable[tuple[ResidualBlock, FloatArray]], fitted: int) -> Score:
        """Return the sums over blocks (m,) with their rates E (m, k), beside ``fitted`` numbers."""
        every = list(measured)
        count = every[0][1].shape[1]
        own, cross, pull = np.zeros((count, count)), np.zeros((count, fitted)), np.zeros(count)
        for block, rates in every:
            own += rates.T @ rates
            cross[:, block.columns] += rates.T @ block.jacobian
            pull += rates.T @ block.residual
        return cls(own, cross, pull)

    @classmethod
    def side_by_side(cls, scores: Sequence[Score]) -> Score:
        """Return the sums of numbers that each of several groups of residuals has for itself."""
        return cls(
            block_diag(*[one.own for one in scores]),
            np.concatenate([one.cross for one in scores]),
            np.concatenate([one.pull for one in scores]),
        )

    def __add__(self, other: Score) -> Score:
        return Score(self.own + other.own, self.cross + other.cross, self.pull + other.pull)

    def gain(self, covariance: FloatArray, gradient: FloatArray, least: float = MADE_UP) -> Gain:
        """Return what the numbers would gain with the fitted ones giving way: C (p, p), and Jᵀr (p,).

        A direction of which the fitted numbers leave less than the part ``least`` is not tested. Where
        something is not finite, nothing is gained.
        """
        by_cross = self.cross @ covariance
        left, pull = self.own - by_cross @ self.cross.T, self.pull - by_cross @ gradient
        scale = np.sqrt(np.maximum(np.diag(self.own), 1e-300))
        if not (np.isfinite(left).all() and np.isfinite(pull).all()):
            return Gain(0.0, 0, np.zeros(len(pull)), np.full(len(pull), np.nan))
        values, vectors = np.linalg.eigh(left / np.outer(scale, scale))
        count = values > least
        along = vectors[:, count].T @ (pull / scale)
        found = -vectors[:, count] @ (along / values[count]) / scale
        spread = np.sqrt(np.sum(vectors[:, count] ** 2 / values[count], axis=1)) / scale
        free = np.sum(vectors[:, ~count] ** 2, axis=1) < 1e-3
        return Gain(
            float(np.sum(along**2 / values[count])), int(count.sum()), found, np.where(free, spread, np.nan)
        )


@dataclass(frozen=True, eq=False)
class Effect:
    """A measurement that a hypothesis concerns: of a picture, or of the station.

    ``group`` is what changes only as a whole: a standstill, a placement. ``rates`` (m, k) are how residuals
    follow the numbers, ``moves_px`` (n, k) how dots do, ``elapsed`` which part of the pictures had been taken
    before, 0 to 1.
    """

    name: str
    group: Hashable
    block: ResidualBlock
    rates: FloatArray
    moves_px: FloatArray
    elapsed: float = 0.0

    def part(self, numbers: Sequence[int]) -> Effect:
        """Return the same for some of its numbers."""
        return replace(self, rates=self.rates[:, numbers], moves_px=self.moves_px[:, numbers])

    def drifting(self) -> Effect:
        """Return the same for numbers that grow from nothing with every picture."""
        return replace(self, rates=self.elapsed * self.rates, moves_px=self.elapsed * self.moves_px)


@dataclass(frozen=True, eq=False)
class Hypothesis:
    """Something that may be otherwise than a fit has it: what it concerns, and the sentence of a finding.

    ``name`` is ``mast``, ``harmonics of pan``, ``slip of tilt``, ``drift of tilt``, ``joint readings``,
    ``lens of CAMERA``, ``change of CAMERA``, ``drift of CAMERA``, ``bow of the board``, ``spacing of the
    board``, ``board moved``, ``placement P of BOARD`` or ``drawing`` (of the prisms); ``subject`` is
    ``("joint", NAME)``, ``("camera", NAME)`` or ``("board", NAME, PLACEMENT)``, where it is one's. ``rows``
    are in the order in which they were measured, and it is so ``always``, in one of their groups (``once``),
    in ``each`` by numbers of its own, or ``from`` some group on.
    """

    name: str
    subject: tuple[str, ...]
    rows: Sequence[Effect]
    sentence: Callable[[Finding], str] | str
    course: Course = "always"

    @cached_property
    def groups(self) -> list[list[Effect]]:
        """The rows that change only together, in the order of their first."""
        found: dict[Hashable, list[Effect]] = {}
        for row in self.rows:
            found.setdefault(row.group, []).append(row)
        return list(found.values())


@dataclass(frozen=True, eq=False)
class Finding:
    """What a hypothesis would gain, at that of its pictures at which it gains most, and what to do.

    ``values`` and ``sigma`` (k,) are of its numbers: radians (1) of a joint; a part of the focal length and a
    turn (4) of a camera; turn and shift (6) of a board; ``numbers`` is how many of them count. The sum of
    squares would fall by ``gain``; ``chance`` is that of such a gain without any such effect, all tries
    counted, and ``significant`` says whether it does not explain it, all hypotheses counted. The numbers move
    the dots that depend on them by ``size_px``, rms; not-a-number for what moves points of the station. It
    changed between the pictures ``before`` and ``after``, the latter alone where it is one's.
    """

    name: str
    subject: tuple[str, ...]
    sentence: str
    values: FloatArray
    sigma: FloatArray
    numbers: int
    gain: float
    chance: float
    size_px: float
    before: str = ""
    after: str = ""
    significant: bool = False

    def likelier(self, other: Finding) -> bool:
        """Whether chance explains this finding less than another one.

        It may have more numbers to explain with. Where no float is as small as both chances, chi-squares of
        hundreds are compared, beside which few numbers more count nothing.
        """
        return (self.chance, -self.gain) < (other.chance, -other.gain)


def survey_findings(fit: ScoredFit) -> tuple[Finding, ...]:
    """Return what every hypothesis that can be tested on a survey would gain, the likeliest first."""
    found = fit.findings(_of_surveys(fit)) if fit.images else []
    # Few prisms check one another, and the rover frame hangs on their drawing.
    limits, each = {DRAWING: float(Level.MEASUREMENT)}, Level.HYPOTHESIS / max(len(found), 1)
    found = [replace(f, significant=f.chance < limits.get(f.name, each)) for f in found]
    return tuple(sorted(found, key=lambda f: (not f.significant, 2 * f.numbers - f.gain)))


def explaining(findings: Sequence[Finding], excess: float) -> tuple[Finding, ...]:
    """Return the findings that make up for most of an excess of chi-square: not the sigmas were wrong then.

    ``findings`` are those of a fit with the stated sigmas, ``excess`` by how much its sum of squares is
    larger than they allow. A fit with sigmas widened for that excess no longer asks for them.
    """
    return tuple(f for f in findings if f.significant and f.gain - f.numbers > EXPLAINS * excess)


def find_drifts(fit: ScoredFit) -> tuple[Finding, ...]:
    """Return how far each joint and each camera drifts, the least likely by chance first."""
    return _each_tested(fit, _drifts(fit))


def find_contradictions(fit: ScoredFit) -> tuple[Finding, ...]:
    """Return what each placement would gain by cameras, axes and joints of its own, the least likely by
    chance first."""
    return _each_tested(fit, _placements(fit))


def _each_tested(fit: ScoredFit, hypotheses: Iterator[Hypothesis]) -> tuple[Finding, ...]:
    """What some hypotheses gain, their chances with all of them counted."""
    found = fit.findings(hypotheses)
    found = [replace(f, chance=min(1.0, len(found) * f.chance)) for f in found]
    found = [replace(f, significant=f.chance < Level.STATED) for f in found]
    return tuple(sorted(found, key=lambda f: (f.chance, -f.gain)))


def find_change(fit: ScoredFit) -> Finding | None:
    """Return the change between two pictures that explains most, or None if none is significant.

    The fit is one with pulls bounded. A board may have stood elsewhere, a joint read otherwise, or a camera
    had another focal length and direction from any picture on. Of changes that explain the same, that with
    the fewest numbers is reported; none where axes of the mast that do not meet squarely explain more.
    """
    tried = [(what, at, gain) for what in _changes(fit) for at, gain in fit.gains(what)]
    possible = [one for one in tried if one[2].chi2 < fit.chi2]
    if not possible:
        return None
    most = max(gain.chi2 for _, _, gain in possible)
    as_good = [one for one in possible if one[2].chi2 >= AS_GOOD * most]
    what, at, gain = min(as_good, key=lambda one: (len(one[2].values), -one[2].chi2))
    explained = fit.left(gain) <= STILL_FAR or gain.chi2 >= EXPLAINS * fit.chi2
    if what.subject[:1] != ("board",) and not (what.subject and explained):  # it is the model that is wrong
        return None
    found = fit.finding(what, at, gain, len(tried))
    little = len(gain.values) > 1 and gain.chi2 < LEAST_PART * fit.chi2
    return None if found.chance > Level.CHANGED or little else found


class ScoredFit:
    """A fit at its minimum, and what every hypothesis of it is tested by."""

    def __init__(self, problem: Adjustment, state: Estimate) -> None:
        self.problem, self.state = problem, state
        # Of this very state: what is left of a change that others nearly take up is a small difference.
        self.chi2, matrix, self.gradient = problem.normal(state)
        self.covariance = covariance_of(matrix, problem.weak)
        self.freedom = max(goodness(problem, state, self.covariance)[1], 1.0)
        self.images = [image for image in problem.images if image.keep.any()]
        self.cameras = tuple(dict.fromkeys(image.camera for image in self.images))
        self.motions = problem.motions(state, self.images)
        self.least = MADE_UP if problem.station else UNSEEN
        last = max(len(self.images) - 1, 1)
        self.elapsed = {image.name: k / last for k, image in enumerate(self.images)}

    def rows(
        self, rates: Rates, *, camera: str = "", board: tuple[str, str] | None = None, head: bool = False
    ) -> list[Effect]:
        """Return the images, or those of a camera, a board or the head, by the rates (m, k) of residuals."""
        found = []
        for image, motions in zip(self.images, self.motions, strict=True):
            if (
                camera in ("", image.camera)
                and board in (None, image.board)
                and not (head and image.attitude is None)
            ):
                mine = rates(image, motions)
                found.append(self._row(image, motions.block, mine, mine))
        return found

    def _row(self, image: ImageTerm, block: ResidualBlock, rates: FloatArray, moves: FloatArray) -> Effect:
        sigma_px = np.repeat(image.sigma_px[image.keep], 2)[:, None]
        group = image.name if image.attitude is None else image.attitude
        return Effect(image.name, group, block, rates, sigma_px * moves, self.elapsed[image.name])

    @cached_property
    def readings(self) -> list[Effect]:
        """The head's images by what pan and tilt read.

        Where readings have a sigma it is that measurement which changes, and images only show where the head
        was: sharp ones leave of a reading's rates in pixels next to nothing that no other unknown takes up.
        The first image of a standstill has the reading then, and the others have no residuals.
        """
        if self.problem.joint_rad <= 0.0:
            return self.rows(lambda _, motions: motions.head[:, PAN_TILT], head=True)
        known = {what.key: block for what, block in self.problem.known(self.state)}
        found = []
        for image, motions in zip(self.images, self.motions, strict=True):
            if image.attitude is not None:
                key = ("attitude", image.attitude)
                nothing = ResidualBlock(np.zeros(0), np.zeros((0, 2)), self.problem.at(key))
                block = known.pop(key, nothing)
                found.append(self._row(image, block, -block.jacobian, motions.head[:, PAN_TILT]))
        return found

    def gains(self, what: Hypothesis) -> list[tuple[int, Gain]]:
        """Return what a hypothesis gains, by the group at which it is so, or from which on."""

        def gain(score: Score) -> Gain:
            return score.gain(self.covariance, self.gradient, self.least)

        groups = [list(what.rows)] if what.course == "always" else what.groups
        measured = [[(row.block, row.rates) for row in group] for group in groups if group]
        scores = [Score.of(group, len(self.gradient)) for group in measured]
        if what.course == "each":
            return [(0, gain(Score.side_by_side(scores)))]
        if what.course != "from":
            return [(at, gain(score)) for at, score in enumerate(scores)]
        found, total = [], None
        side = 2 if self.problem.huber else 1  # where blunders were not left out, one picture may be one
        for at in range(len(scores) - 1, side - 1, -1):
            total = scores[at] if total is None else scores[at] + total
            if len(scores) - at >= side:
                mine = gain(total)
                if what.subject[:1] == ("board",) or np.linalg.norm(mine.values) <= LARGEST:
                    found.append((at, mine))
        return found

    def left(self, gain: Gain) -> float:
        """Chi-square over its degrees of freedom that a gain leaves."""
        return (self.chi2 - gain.chi2) / self.freedom

    def findings(self, hypotheses: Iterator[Hypothesis]) -> list[Finding]:
        """What hypotheses gain, each where its gain is the least likely."""
        found = []
        for what in hypotheses:
            gains = self.gains(what)
            if gains:
                at, best = min(gains, key=lambda one: (chance(one[1].chi2, one[1].freedom), -one[1].chi2))
                found.append(self.finding(what, at, best, len(gains)))
        return found

    def finding(self, what: Hypothesis, at: int, gain: Gain, tries: int) -> Finding:
        """What a hypothesis says with its gain at some of its groups, the best of so many tries."""
        scale = self.left(gain)
        if what.subject[:1] == ("joint",):
            scale = max(scale, self._scatter(what.rows, gain.chi2))
        likely = chance(gain.chi2, gain.freedom, scale, self.freedom)
        before = what.groups[at - 1][-1].name if what.course == "from" else ""
        after = what.groups[at][0].name if what.course in ("once", "from") else ""
        found = Finding(
            what.name, what.subject, "", gain.values, gain.sigma, gain.freedom, gain.chi2,
            min(1.0, tries * likely), _size_px(what, at, gain.values), before, after,
        )  # fmt: skip
        said = what.sentence
        return replace(found, sentence=said if isinstance(said, str) else said(found))

    def _scatter(self, readings: Sequence[Effect], gain: float) -> float:
        """How much larger the squares of a joint's readings are than their sigma allows, less a gain.

        A joint whose readings scatter more than stated, by an unknown play, has not slipped.
        """
        squares = redundancy = 0.0
        for row in readings:
            size, one = float(np.sum(row.rates**2)), row.block
            if size:
                mine = self.covariance[np.ix_(one.columns, one.columns)]
                squares += float((row.rates.T @ one.residual)[0] ** 2) / size
                along = row.rates.T @ one.jacobian
                redundancy += 1.0 - float((along @ mine @ along.T)[0, 0]) / size
        return (squares - gain) / max(redundancy - 1.0, 1.0)


def _size_px(what: Hypothesis, at: int, values: FloatArray) -> float:
    """By how much numbers move the dots concerned, rms, pixels."""
    groups = what.groups
    if what.course == "each":
        own = np.split(values, len(groups))
        moved = [row.moves_px @ v for group, v in zip(groups, own, strict=True) for row in group]
    else:
        some = {"once": groups[at : at + 1], "from": groups[at:]}.get(what.course, groups)
        moved = [row.moves_px @ values for group in some for row in group]
    every = np.concatenate(moved)
    return float(np.sqrt(np.mean(every**2))) if len(every) else float("nan")


def _of_surveys(fit: ScoredFit) -> Iterator[Hypothesis]:
    """The hypotheses that a survey is tested for."""
    yield from _axes(fit)
    if fit.readings:
        yield from _harmonics(fit)
        yield from _readings(fit)
        yield from _joints(fit, "slip")
    yield from _drifts(fit)
    yield from _lenses(fit)
    yield from _cameras(fit, "change")
    yield from _board_shape(fit)
    yield from _moved_before_tapes(fit)
    yield from _drawing(fit)


def _drifts(fit: ScoredFit) -> Iterator[Hypothesis]:
    """Joints and cameras that change more with every picture."""
    for what in (*_joints(fit, "drift"), *_cameras(fit, "drift")):
        yield replace(what, rows=[row.drifting() for row in what.rows])


def _placements(fit: ScoredFit) -> Iterator[Hypothesis]:
    """Placements whose pictures see other cameras, axes and joints than those of the others."""
    compared = fit.problem.of_kinds("mast", "joints", "camera")
    boards = dict.fromkeys(image.board for image in fit.images)

    def own(_: ImageTerm, motions: Motions) -> FloatArray:
        rates = np.zeros((len(motions.block.residual), len(fit.gradient)))
        rates[:, motions.block.columns] = motions.block.jacobian
        return rates[:, compared]

    def sentence(found: Finding) -> str:
        return (
            f"{found.name} contradicts the others: its pictures say something else of cameras, axes and "
            f"joints (chi-square {found.gain:.0f} for {found.numbers} numbers). Check that it is the same "
            "board and that nothing changed in between, and put it up there once more"
        )

    for board in boards if len(boards) > 1 else ():
        name = f"placement {board[1]} of {board[0]}"
        yield Hypothesis(name, ("board", *board), fit.rows(own, board=board), sentence)


def _changes(fit: ScoredFit) -> Iterator[Hypothesis]:
    """The changes between two pictures that are tested where a fit fails."""

    def sentence(found: Finding) -> str:
        _, board, placement = found.subject
        by = f", by about {_milli(found.values[3:])} mm and {_milli(found.values[:3])} mrad"
        return board_moved(board, placement, found.before, found.after, by)

    for board in dict.fromkeys(image.board for image in fit.images):
        rows = fit.rows(lambda image, motions: motions.block.rates(("board", image.board)), board=board)
        yield Hypothesis("board moved", ("board", *board), rows, sentence, "from")
    if not fit.problem.upright:
        yield from _axes(fit)
    yield from _joints(fit, "slip")
    yield from _cameras(fit, "change")


def _joints(fit: ScoredFit, what: Literal["slip", "drift"]) -> Iterator[Hypothesis]:
    """Of each joint that it reads otherwise."""
    course: Course = "from" if what == "slip" else "always"
    for joint, name in enumerate(("pan", "tilt") if fit.readings else ()):
        rows = [row.part([joint]) for row in fit.readings]
        yield Hypothesis(f"{what} of {name}", ("joint", name), rows, SENTENCES["joint", what], course)


def _cameras(fit: ScoredFit, what: Literal["change", "drift"]) -> Iterator[Hypothesis]:
    """Of each camera that has images left that its focal length and direction are others."""
    course: Course = "from" if what == "change" else "always"
    for name in fit.cameras:
        rows = fit.rows(lambda _, motions: motions.camera, camera=name)
        yield Hypothesis(f"{what} of {name}", ("camera", name), rows, SENTENCES["camera", what], course)


def _axes(fit: ScoredFit) -> Iterator[Hypothesis]:
    """The axes of the mast."""
    fitted = len(fit.problem.mast_free)
    further = sorted(set(MAST_FREE.get(fitted + 2, ())) - set(fit.problem.mast_free.tolist()))
    if not (fitted and further and fit.readings and fit.problem.station):
        return

    def sentence(found: Finding) -> str:
        named = []
        for index, value, sigma in zip(further, found.values, found.sigma, strict=True):
            name, unit = MAST_NAMES[index], "mm" if MAST_NAMES[index].endswith("_m") else "mrad"
            name = name.replace("_rad", "").replace("_m", "").replace("_", " ").replace(".", " ")
            named.append(f"{name} {1e3 * value:+.2f} ± {1e3 * sigma:.2f} {unit}")
        return f"{' and '.join(named)}: fit with --mast {fitted + 2}"

    yield Hypothesis("mast", (), _on_head(fit, further), sentence)


def _on_head(fit: ScoredFit, numbers: Sequence[int]) -> list[Effect]:
    """The head's images by some of the numbers that move it."""
    return fit.rows(lambda _, motions: motions.head[:, numbers], head=True)


def _harmonics(fit: ScoredFit) -> Iterator[Hypothesis]:
    """Readings that are off around the turn."""
    for joint, name in enumerate(("pan", "tilt")):
        first = len(MAST_NAMES) + joint * len(AXIS_NAMES)
        text = (
            f"{name} is read wrong around the turn (a magnet off centre, an arm that sags): its mast file "
            "needs joint terms"
        )
        rows = _on_head(fit, range(first, first + 4))
        yield Hypothesis(f"harmonics of {name}", (), rows, text)


def _readings(fit: ScoredFit) -> Iterator[Hypothesis]:
    """Readings that are all off."""

    def sentence(found: Finding) -> str:
        rms = 1e3 * float(np.sqrt(np.mean(found.values**2)))
        return f"joint readings scatter by some {rms:.2g} mrad more than joint_rad in survey.yaml says"

    yield Hypothesis("joint readings", (), fit.readings, sentence, "each")


def _lenses(fit: ScoredFit) -> Iterator[Hypothesis]:
    """Lenses that bend otherwise than their models."""
    powers = [(i, j) for i in range(BEND_DEGREE + 1) for j in range(BEND_DEGREE + 1 - i)]

    def bends(image: ImageTerm, motions: Motions) -> FloatArray:
        middle = (np.array(fit.state.cameras[image.camera].size_px) - 1) / 2
        sigma = image.sigma_px[image.keep, None]
        # Where the fit sees them: places as measured hold the very noise that is left over.
        seen_px = image.pixels_px[image.keep] + motions.block.residual.reshape(-1, 2) * sigma
        u, v = ((seen_px - middle) / middle[0]).T
        terms = np.stack([u**i * v**j for i, j in powers], axis=1) / sigma
        return np.asarray(np.einsum("nk,ij->nijk", terms, np.eye(2)).reshape(2 * len(u), -1))

    for name in fit.cameras:
        text = (
            f"the rest over {name}'s image is not noise: its lens is bent otherwise than "
            f"{fit.state.cameras[name].kind} can be, or its dots are off in a pattern"
        )
        yield Hypothesis(f"lens of {name}", (), fit.rows(bends, camera=name), text)


def _board_shape(fit: ScoredFit) -> Iterator[Hypothesis]:
    """The board's shape."""
    half_m = float(max(np.abs(image.in_board_m[image.keep]).max() for image in fit.images))

    def moved(moves_m: Callable[[FloatArray, FloatArray], FloatArray]) -> list[Effect]:
        """Images by how numbers move the board's points (3, k, n), metres in the board."""

        def rates(image: ImageTerm, motions: Motions) -> FloatArray:
            turn = fit.state.rover_from_board[image.board].rotation
            per_point = motions.block.rates(("board", image.board))[:, 3:].reshape(-1, 2, 3) @ turn
            x, y, _ = image.in_board_m[image.keep].T
            found = np.einsum("nij,jkn->nik", per_point, moves_m(x, y))
            return np.asarray(found.reshape(-1, found.shape[2]))

        return fit.rows(rates)

    def bent(found: Finding) -> str:
        bend_mm = 1e3 * float(np.abs(found.values).max())
        return f"the board is not flat: bent by some {bend_mm:.2g} mm at its edges"

    def spaced(found: Finding) -> str:
        wide, high, aslant = 1e3 * found.values
        return (
            f"the board's dots are not spaced as stated: {wide:+.2f} per mille along rows, {high:+.2f} along "
            f"columns, {aslant:+.2f} aslant"
        )

    def bow(x: FloatArray, y: FloatArray) -> FloatArray:
        nothing = np.zeros((3, len(x)))
        return np.stack([nothing, nothing, np.stack([x * x, x * y, y * y]) / half_m**2])

    def spacing(x: FloatArray, y: FloatArray) -> FloatArray:
        no = np.zeros(len(x))
        return np.stack([np.stack([x, no, y]), np.stack([no, y, no]), np.zeros((3, len(x)))])

    yield Hypothesis("bow of the board", (), moved(bow), bent)
    yield Hypothesis("spacing of the board", (), moved(spacing), spaced)


def _moved_before_tapes(fit: ScoredFit) -> Iterator[Hypothesis]:
    """Boards that moved between their tapes and their pictures."""
    shown = {image.board for image in fit.images}
    rows, eye = [], np.eye(3)[None]
    for board, pose in fit.state.rover_from_board.items():
        mine = [p for p in fit.problem.station if p.board == board and p.keep]
        if len(mine) < 2 or board not in shown:
            continue
        for point, block in zip(mine, fit.problem.blocks_of(fit.state, mine), strict=True):
            rates = rigid_rates(eye, pose.points(point.in_board_m)[None], pose.translation_m)[0]
            name = f"placement {board[1]} (set-up {board[0]})"
            rows.append(Effect(name, board, block, -rates / point.sigma_m, np.zeros((0, 6))))

    def sentence(found: Finding) -> str:
        turn, shift = (1e3 * float(np.linalg.norm(part)) for part in np.split(found.values, 2))
        return (
            f"the tapes of {found.after} stand {shift:.1f} mm and {turn:.1f} mrad from where its pictures "
            "show the board: it moved between them"
        )

    yield Hypothesis("board moved", (), rows, sentence, "once")


def _drawing(fit: ScoredFit) -> Iterator[Hypothesis]:
    """Prisms that stand elsewhere on the rover than drawn, the same in every set-up."""
    mine = [p for p in fit.problem.station if p.board is None and p.keep]
    if fit.problem.prism_cad_m > 0 or not mine:
        return
    names = list(dict.fromkeys(point.point for point in mine))
    # All prisms moved as one body are another rover frame, which no survey determines.
    places = np.array([fit.state.prisms_in_rover_m[name] for name in names])
    as_one = rigid_rates(np.eye(3)[None], places, places.mean(axis=0)).reshape(-1, 6)
    apart = null_space(as_one.T).reshape(len(names), 3, -1)
    rows = [
        Effect(
            p.point, p.setup, block, -apart[names.index(p.point)] / p.sigma_m, np.zeros((0, apart.shape[2]))
        )
        for p, block in zip(mine, fit.problem.blocks_of(fit.state, mine), strict=True)
    ]

    def sentence(found: Finding) -> str:
        off_mm = 1e3 * float(np.sqrt(np.sum(found.values**2) / len(names)))
        return (
            f"the prisms stand elsewhere than drawn, by some {off_mm:.1f} mm: measure them on the rover "
            "again, or state prism_cad_m and measure them from several set-ups"
        )

    yield Hypothesis(DRAWING, (), rows, sentence)


def board_moved(board: str, placement: str, before: str, after: str, by: str = "") -> str:
    """Return the sentence on a board that moved during a placement, and what to do."""
    return (
        f"board {board} moved during placement {placement}, between pictures {before} and {after}{by}, or "
        f"pan slipped: give the pictures from {after} on a placement of their own in images.csv, or take "
        "them again"
    )


def _milli(size: FloatArray) -> str:
    """The length of something in thousandths, with two digits at least."""
    length = 1e3 * float(np.linalg.norm(size))
    return f"{length:.1f}" if length >= 1.0 else f"{length:.2g}"


def _only_turned(change: Finding) -> bool:
    """Whether a camera that changed has the focal length that it had, as far as pictures show it."""
    focal, turn = abs(float(change.values[0])), float(np.linalg.norm(change.values[1:]))
    return focal < max(SURE * float(change.sigma[0]), LITTLE_FOCAL * turn)


SENTENCES: Mapping[tuple[str, str], Callable[[Finding], str]] = {
    ("joint", "slip"): lambda found: (
        f"{found.subject[1]} slipped by about {_milli(found.values)} mrad between pictures "
        f"{found.before} and {found.after}: the head no longer points where it read before; tighten what "
        "holds it on its axis and take the pictures again"
    ),
    ("joint", "drift"): lambda found: (
        f"{found.subject[1]} drifts off its reading, by {1e3 * found.values[0]:+.2f} mrad from the first "
        "picture to the last: a mount or an encoder creeps; fasten it and take the pictures again"
    ),
    ("camera", "change"): lambda found: (
        f"{found.subject[1]} was knocked between pictures {found.before} and {found.after}, and turned by "
        f"about {_milli(found.values[1:])} mrad: fasten it and take the pictures again"
        if _only_turned(found)
        else f"from picture {found.after} on {found.subject[1]} is another camera (focal length "
        f"{100 * found.values[0]:+.2f} %, turned by {_milli(found.values[1:])} mrad): it was refocused or "
        "knocked there; fasten it and take the pictures again"
    ),
    ("camera", "drift"): lambda found: (
        f"camera {found.subject[1]} drifts from the first picture to the last. Its focal length changes by "
        f"{100 * found.values[0]:+.3f} %, and it turns by {_milli(found.values[1:])} mrad; let it warm up, "
        "fasten it, and take the pictures again"
    ),
}
"""The sentences on what changes with time, of a joint or a camera."""
