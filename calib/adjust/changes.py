"""Finds changes while a bench's pictures were taken: a board, a joint, a camera, from some picture on.

For every picture after which something may have changed, the fit is asked what it would gain if it had: the
board of the placement stood elsewhere from there on (six numbers), pan or tilt read otherwise (one), a camera
had another focal length (one) or looked elsewhere in the head (three). Near the fit the problem is linear, so
that the gains follow from sums over pictures and no further fit is made (score tests). Of changes that
explain the same, that with the fewest numbers is reported. A pan that slips between two placements is seen by
nothing and does no harm.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from calib.adjust.adjustment import Adjustment, bounded_weights
from calib.adjust.goodness import goodness
from calib.adjust.score import MADE_UP, Score
from calib.adjust.significance import chance
from calib.adjust.solver import covariance_of
from calib.adjust.terms import ImageTerm
from calib.adjust.unknowns import Estimate, ResidualBlock
from calib.geometry.cahvor import CameraModel
from calib.geometry.rigid import FloatArray

UNLIKELY = 1e-7
"""A change is reported if so large a gain, were it none, had less than this chance over all tries."""

AS_GOOD = 0.98
"""A change with fewer numbers is preferred if it gains this part of the best one's."""

LEAST_PART = 0.01
"""A board or camera that moved explains at least this part of the weighted sum of squares: less is the
model's."""

STILL_FAR = 9.0
"""Chi-square over its degrees of freedom that a cause leaves at most, or it explains half of it at least."""

SIDE = 2
"""Pictures at least on either side of a change, at different standstills: one is a blunder."""

UNSEEN = 1e-3
"""A direction of a change is not looked at if the other unknowns take up all but this part of it, unless a
station ties boards to the rover: tapes show a slip that sharp images alone leave to their boards."""

LARGEST = 0.5
"""Radians, or part of the focal length: what is larger is no slip, knock or other focus."""

STEP = 1e-6


@dataclass(frozen=True, eq=False)
class BenchChange:
    """Something that changed between two pictures.

    Attributes
    ----------
    what
        ``board``, ``pan``, ``tilt``, ``focus`` or ``knock``.
    board, camera
        Whose, where it is one's.
    before, after
        Names of the pictures between which it changed.
    step
        The approximate change: turn and shift of the board (6), radians (1) of a joint, a part of the focal
        length (1), turn of the camera (3).
    chi2
        The part of the weighted sum of squares that it explains.
    sure
        Whether little would be left then; else only another fit shows it, for far from it nothing is linear.
    chance
        Of so large a gain without any change, all that were tried counted.
    """

    what: str
    board: tuple[str, str] | None
    camera: str
    before: str
    after: str
    step: FloatArray
    chi2: float
    sure: bool = True
    chance: float = 0.0

    @property
    def sentence(self) -> str:
        """The change in words, and what to do."""
        between = f"between pictures {self.before} and {self.after}"
        if self.board is not None:
            turn, shift = np.linalg.norm(self.step[:3]), np.linalg.norm(self.step[3:])
            return (
                f"board {self.board[0]} moved during placement {self.board[1]}, {between}, by about "
                f"{_milli(shift)} mm and {_milli(turn)} mrad"
            )
        size = float(np.linalg.norm(self.step))
        if self.what in ("pan", "tilt"):
            return (
                f"{self.what} slipped by about {_milli(size)} mrad {between}: the head no longer points "
                "where it read before; tighten what holds it on its axis and take the pictures again"
            )
        if self.what == "focus":
            return (
                f"camera {self.camera} was refocused {between}: its focal length changed by about "
                f"{100 * size:.2f} %; fix the lens and take the pictures again"
            )
        return (
            f"camera {self.camera} was knocked {between}: it turned by about {_milli(size)} mrad in its "
            "mount; fasten it and take the pictures again"
        )


def _milli(size: float | np.floating) -> str:
    """A size in thousandths, with two digits at least."""
    return f"{1e3 * size:.1f}" if 1e3 * size >= 1.0 else f"{1e3 * size:.2g}"


@dataclass(frozen=True, eq=False)
class Rows:
    """One image's residuals (m,) as the fit weighs them, and their rates (m, e) by what may change."""

    image: ImageTerm
    block: ResidualBlock
    rates: dict[str, FloatArray]


def find_change(problem: Adjustment, state: Estimate) -> BenchChange | None:
    """Return the change that explains most, or None if none is significant.

    Parameters
    ----------
    problem, state
        A fit with pulls bounded.
    """
    rows = rows_of(problem, state)
    # Of this very state: what is left of a change that others nearly take up is a small difference.
    chi2, matrix, gradient = problem.normal(state)
    covariance = covariance_of(matrix, problem.weak)
    found: list[BenchChange] = []
    count = 0
    for what, board, camera, mine in _subjects(problem, state, rows):
        least = MADE_UP if problem.station else UNSEEN
        changes = _tried(what, board, camera, mine, covariance, gradient, least)
        count += len(changes)
        found += [change for change in changes if change.chi2 < chi2]
    if not found:
        return None
    most = max(change.chi2 for change in found)
    as_good = [c for c in found if c.chi2 >= AS_GOOD * most]
    best = min(as_good, key=lambda c: (len(c.step), -c.chi2))
    _, freedom = goodness(problem, state, covariance)
    scale = max((chi2 - best.chi2) / max(freedom, 1.0), 0.1)
    sure = scale <= STILL_FAR or best.chi2 >= 0.5 * chi2
    if not sure and best.what in ("focus", "knock"):  # it is the model that is wrong
        return None
    if best.what in ("pan", "tilt"):
        scale = max(scale, scatter(reading_rows(problem, state, rows), best.what, covariance, best.chi2))
    by_chance = chance(best.chi2, len(best.step), scale, max(freedom, 1.0)) * count
    if by_chance > UNLIKELY:
        return None
    if len(best.step) > 1 and best.chi2 < LEAST_PART * chi2:
        return None
    return replace(best, sure=sure, chance=by_chance)


def _subjects(
    problem: Adjustment, state: Estimate, rows: Sequence[Rows]
) -> Iterator[tuple[str, tuple[str, str] | None, str, list[Rows]]]:
    """What may have changed: its name, board, camera, and the images that would show it."""
    for board in dict.fromkeys(r.image.board for r in rows):
        if board not in problem.held:
            yield "board", board, "", [r for r in rows if r.image.board == board]
    readings = reading_rows(problem, state, rows)
    for axis in ("pan", "tilt"):
        yield axis, None, "", readings
    for camera in dict.fromkeys(r.image.camera for r in rows):
        mine = [r for r in rows if r.image.camera == camera]
        for what in ("focus", "knock"):
            yield what, None, camera, mine


def _tried(
    what: str,
    board: tuple[str, str] | None,
    camera: str,
    rows: Sequence[Rows],
    covariance: FloatArray,
    gradient: FloatArray,
    least: float,
) -> list[BenchChange]:
    """The gain of every picture from which something may have changed."""
    score = Score(rows[0].rates[what].shape[1], len(gradient))
    found = []
    for index in range(len(rows) - 1, 0, -1):
        row, before = rows[index], rows[index - 1]
        score.add(row.block, row.rates[what])
        if _same_standstill(before.image, row.image):
            continue
        if min(_standstills(rows[:index]), _standstills(rows[index:])) < SIDE:
            continue
        gain = score.beside(covariance, gradient).gain(least=least)
        if what != "board" and np.linalg.norm(gain.values) > LARGEST:
            continue
        names = before.image.name, row.image.name
        found.append(BenchChange(what, board, camera, *names, gain.values, gain.chi2))
    return found


def _same_standstill(one: ImageTerm, other: ImageTerm) -> bool:
    if one.attitude is None or other.attitude is None:
        return False
    return one.attitude == other.attitude


def _standstills(rows: Sequence[Rows]) -> int:
    return len({r.image.name if r.image.attitude is None else r.image.attitude for r in rows})


def rows_of(problem: Adjustment, state: Estimate) -> list[Rows]:
    """Return every image that counts as the fit weighs it."""
    images = [image for image in problem.images if image.keep.any()]
    blocks = problem.image_blocks(state, images)
    here = [block.residual for block in blocks]

    def with_cameras(moved: Callable[[CameraModel], CameraModel]) -> list[FloatArray]:
        cameras = {name: moved(camera) for name, camera in state.cameras.items()}
        return _differences(problem, replace(state, cameras=cameras), images, here)

    zoomed = with_cameras(lambda camera: camera.zoomed(STEP))
    turned = [with_cameras(partial(CameraModel.turned, turn_rad=STEP * axis)) for axis in np.eye(3)]
    readings = reading_rates(problem, state, images, here)
    found = []
    for image, block, zoom, read, *turns in zip(images, blocks, zoomed, readings, *turned, strict=True):
        weight = np.sqrt(bounded_weights(block.residual, 2, problem.huber))
        rates = {"focus": zoom[:, None], "knock": np.stack(turns, axis=1)}
        if image.board not in problem.held:
            rates["board"] = block.rates(("board", image.board))
        if image.attitude is not None:
            rates |= {"pan": read[:, :1], "tilt": read[:, 1:]}
        weighed = replace(block, residual=weight * block.residual, jacobian=weight[:, None] * block.jacobian)
        rates = {what: weight[:, None] * rate for what, rate in rates.items()}
        found.append(Rows(image, weighed, rates))
    return found


def reading_rows(problem: Adjustment, state: Estimate, rows: Sequence[Rows]) -> list[Rows]:
    """Return the rows of head images that show what the joints read.

    Where readings have a sigma it is that measurement which changes, and images only tell where the head
    was: sharp ones leave of a reading's rates in pixels next to nothing that no other unknown takes up. The
    first image of a standstill has the reading then, and the others have no rows.
    """
    on_head = [row for row in rows if row.image.attitude is not None]
    if problem.joint_rad == 0.0:
        return on_head
    blocks = {what.key: block for what, block in problem.known(state)}
    found = []
    for row in on_head:
        attitude = ("attitude", row.image.attitude)
        block, columns = blocks.pop(attitude, None), problem.at(attitude)
        if block is None:
            block = ResidualBlock(np.zeros(0), np.zeros((0, 2)), columns, 1)
        rates = {"pan": -block.jacobian[:, :1], "tilt": -block.jacobian[:, 1:]}
        found.append(Rows(row.image, block, rates))
    return found


def scatter(readings: Sequence[Rows], axis: str, covariance: FloatArray, gain: float) -> float:
    """Return how much larger the squares of a joint's readings are than their sigma allows, less a gain.

    A joint whose readings scatter more than stated, by an unknown play, has not slipped.
    """
    squares = redundancy = 0.0
    for row in readings:
        rates = row.rates[axis]
        size = float(np.sum(rates**2))
        if size:
            one = row.block
            taken = one.jacobian @ covariance[np.ix_(one.columns, one.columns)] @ one.jacobian.T
            squares += float((rates.T @ one.residual)[0] ** 2) / size
            redundancy += 1.0 - float((rates.T @ taken @ rates)[0, 0]) / size
    return (squares - gain) / max(redundancy - 1.0, 1.0)


def reading_rates(
    problem: Adjustment, state: Estimate, images: Sequence[ImageTerm], here: Sequence[FloatArray]
) -> list[FloatArray]:
    """Return how the residuals of images, ``here``, change with what pan and tilt read, (m, 2), sigmas a
    radian."""
    by_pan, by_tilt = (
        _differences(problem, state, [replace(t, **{axis: getattr(t, axis) + STEP}) for t in images], here)
        for axis in ("pan_rad", "tilt_rad")
    )
    return [np.stack(both, axis=1) for both in zip(by_pan, by_tilt, strict=True)]


def _differences(
    problem: Adjustment, moved: Estimate, images: Sequence[ImageTerm], here: Sequence[FloatArray]
) -> list[FloatArray]:
    """How residuals change with something that was moved by a small step."""
    there = problem.image_residuals(moved, images)
    return [(after - before) / STEP for before, after in zip(here, there, strict=True)]
