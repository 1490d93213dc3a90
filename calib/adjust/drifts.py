"""Tests of a bench's fit: joints and cameras that drift, and each placement against the rest.

Near the fit the problem is linear: what a drift would gain is a score test, as a change from one picture on
is (``calib.adjust.changes``); what the pictures of a placement say of cameras, axes and joints is held
against what the others say of these (``calib.adjust.left_out``).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from calib.adjust.adjustment import Adjustment
from calib.adjust.changes import UNSEEN, BenchChange, Rows, reading_rows, rows_of, scatter
from calib.adjust.goodness import goodness
from calib.adjust.left_out import left_out
from calib.adjust.score import scored
from calib.adjust.significance import chance
from calib.adjust.solver import covariance_of
from calib.adjust.unknowns import Estimate, ResidualBlock
from calib.geometry.rigid import FloatArray


@dataclass(frozen=True, eq=False)
class BenchDrift:
    """Something that went on changing, from the first picture to the last.

    Attributes
    ----------
    what
        ``pan``, ``tilt``, or a camera's name.
    step
        By how much in all: radians (1) of a joint; of a camera a part of the focal length and its turn (4).
    chi2
        The part of the weighted sum of squares that it explains.
    chance
        Of so large a gain without any, all that were asked counted.
    moves_px
        Rms over the corners concerned of what it moves them by.
    """

    what: str
    step: FloatArray
    chi2: float
    chance: float
    moves_px: float

    def tells_more(self, change: BenchChange) -> bool:
        """Whether the drift is less likely by chance than a sudden change.

        It may have more numbers to explain with. Where no float is as small as both chances, chi-squares of
        hundreds are compared, beside which few numbers more count nothing.
        """
        return (self.chance, -self.chi2) < (change.chance, -change.chi2)

    @property
    def sentence(self) -> str:
        """The drift in words, and what to do."""
        if self.what in ("pan", "tilt"):
            return (
                f"{self.what} drifts off its reading, by {1e3 * self.step[0]:+.2f} mrad from the first "
                "picture to the last: a mount or an encoder creeps; fasten it and take the pictures again"
            )
        return (
            f"camera {self.what} drifts from the first picture to the last. Its focal length changes by "
            f"{100 * self.step[0]:+.3f} %, and it turns by {1e3 * np.linalg.norm(self.step[1:]):.2f} mrad; "
            "let it warm up, fasten it, and take the pictures again"
        )


def find_drifts(problem: Adjustment, state: Estimate) -> tuple[BenchDrift, ...]:
    """Return how far each joint and each camera drifts, the least likely first.

    Parameters
    ----------
    problem, state
        A fit at its minimum.
    """
    rows = rows_of(problem, state)
    passed = {row.image.name: k / max(len(rows) - 1, 1) for k, row in enumerate(rows)}
    chi2, matrix, gradient = problem.normal(state)
    covariance = covariance_of(matrix, problem.weak)
    _, freedom = goodness(problem, state, covariance)
    on_head = [row for row in rows if row.image.attitude is not None]
    readings = reading_rows(problem, state, rows)
    asked: list[tuple[str, tuple[str, ...], list[Rows], list[Rows]]] = []
    if on_head:
        asked += [("pan", ("pan",), on_head, readings), ("tilt", ("tilt",), on_head, readings)]
    for camera in dict.fromkeys(row.image.camera for row in rows):  # one may have no picture left
        mine = [row for row in rows if row.image.camera == camera]
        asked.append((camera, ("focus", "knock"), mine, mine))
    found = []
    for what, names, moving, measured in asked:

        def drifting(row: Rows, names: tuple[str, ...] = names) -> FloatArray:
            return np.asarray(passed[row.image.name] * np.hstack([row.rates[name] for name in names]))

        gain = scored(((row.block, drifting(row)) for row in measured), covariance, gradient).gain(
            least=UNSEEN
        )
        scale = max((chi2 - gain.chi2) / max(freedom, 1.0), 0.1)
        if what in ("pan", "tilt"):
            scale = max(scale, scatter(readings, what, covariance, gain.chi2))
        likely = chance(gain.chi2, len(gain.values), scale, max(freedom, 1.0))
        off_px = [
            drifting(row) @ gain.values * np.repeat(row.image.sigma_px[row.image.keep], 2) for row in moving
        ]
        moves_px = float(np.sqrt(np.mean(np.concatenate(off_px) ** 2)))
        found.append(BenchDrift(what, gain.values, gain.chi2, min(1.0, len(asked) * likely), moves_px))
    return tuple(sorted(found, key=lambda drift: drift.chance))


@dataclass(frozen=True)
class OtherPlacements:
    """A placement held against the others: chi-square of what its pictures and theirs say of ``freedom``
    numbers that they share, and its chance if all is right, all placements counted."""

    board: tuple[str, str]
    chi2: float
    freedom: int
    chance: float

    @property
    def sentence(self) -> str:
        """The contradiction to the others, and the remedy."""
        return (
            f"placement {self.board[1]} of board {self.board[0]} contradicts the others: its pictures say "
            f"something else of cameras, axes and joints (chi-square {self.chi2:.0f} for {self.freedom} "
            "numbers). Check that it is the same board and that nothing changed in between, and put it up "
            "there once more"
        )


def by_other_placements(problem: Adjustment, state: Estimate) -> tuple[OtherPlacements, ...]:
    """Return each placement held against the others, the least likely first; none if there is but one.

    Parameters
    ----------
    problem, state
        A fit at its minimum.
    """
    chi2, matrix, _ = problem.normal(state)
    covariance = covariance_of(matrix, problem.weak)
    _, freedom = goodness(problem, state, covariance)
    images = [image for image in problem.images if image.keep.any()]
    boards = list(dict.fromkeys(image.board for image in images))
    found = []
    for board in boards if len(boards) > 1 else ():
        blocks = problem.image_blocks(state, [image for image in images if image.board == board])
        columns = np.unique(np.concatenate([block.columns for block in blocks]))
        residual = np.concatenate([block.residual for block in blocks])
        jacobian = np.zeros((len(residual), len(columns)))
        first = 0
        for block in blocks:
            last = first + len(block.residual)
            jacobian[first:last, np.searchsorted(columns, block.columns)] = block.jacobian
            first = last
        every = ResidualBlock(residual, jacobian, columns, 2)
        keep = np.ones(len(jacobian) // 2, dtype=bool)
        pull, numbers = left_out(every, covariance[np.ix_(columns, columns)], keep, problem.huber).pull()
        likely = chance(pull, numbers, chi2 / max(freedom, 1.0), max(freedom, 1.0))
        found.append(OtherPlacements(board, pull, numbers, min(1.0, len(boards) * likely)))
    return tuple(sorted(found, key=lambda one: one.chance))
