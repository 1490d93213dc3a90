"""A bench as a least-squares problem: its terms, where it starts, and where its rover frame is."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from calib.adjust.adjustment import HUBER, Adjustment
from calib.adjust.model_terms import ModelTerm, candidate_terms, term_numbers
from calib.adjust.terms import ImageTerm, with_kept
from calib.adjust.unknowns import Estimate
from calib.calibrate.starts.bench import BenchNotFitted, SomethingChanged, bench_start
from calib.calibrate.starts.views import ViewPoses, ViewsTooFew, view_poses
from calib.calibrate.starts.wrong_dots import wrong_dots
from calib.geometry.cahvor import Kind
from calib.geometry.rigid import Rigid
from calib.survey.records import Survey

SUREST = 0.1
"""Part of ``corner_px`` below which no corner's own sigma counts: what neighbours share is not in it."""

FEWEST_CORNERS = 6
"""An image with fewer takes no part: with four, a pose goes through them whatever they are."""


def bench_terms(survey: Survey, notes: list[str]) -> tuple[list[ImageTerm], list[ImageTerm], int]:
    """Return terms of the fitted and of the check images of a bench, in the order in which these were taken,
    and the number of the head's standstills among the former.

    Images of several cameras that follow each other at one placement and reading belong to one standstill:
    what a reading is off is the same for all of them.
    """
    fitted: list[ImageTerm] = []
    checks: list[ImageTerm] = []
    standstill, shown, count = None, set[tuple[str, str]](), 0
    for image in survey.images:
        corners = survey.corners.get(image.name)
        if corners is None or not len(corners.ids):
            continue
        if len(corners.ids) < FEWEST_CORNERS:
            notes.append(
                f"image {image.name} is not used: it shows {len(corners.ids)} corners of board "
                f"{image.board}, {FEWEST_CORNERS} at least are expected"
            )
            continue
        on_head = survey.cameras[image.camera].on == "head"
        check = image.purpose == "check"
        attitude = None if not on_head else -1
        if on_head and not check:
            key = (image.placement, image.pan_rad, image.tilt_rad, image.pan_approach, image.tilt_approach)
            if key != standstill or (image.camera, image.board) in shown:
                standstill, shown, count = key, set(), count + 1
            shown.add((image.camera, image.board))
            attitude = count - 1
        board = survey.boards[image.board]
        bend = np.stack(
            [board.in_board_m(corners.ids, bow)[:, 2] for bow in ((1.0, 0.0), (0.0, 1.0))], axis=1
        )
        term = ImageTerm(
            image.name,
            image.camera,
            (image.board, image.placement),
            attitude,
            float(image.pan_rad or 0.0) if on_head else 0.0,
            float(image.tilt_rad or 0.0) if on_head else 0.0,
            np.zeros(0, dtype=np.int64),
            np.zeros(0, dtype=np.int64),
            board.in_board_m(corners.ids),
            corners.pixels_px,
            np.maximum(corners.sigma_px, SUREST * survey.sigma.corner_px),
            np.ones(len(corners.ids), dtype=bool),
            (image.pan_approach, image.tilt_approach) if on_head else (0, 0),
            bend,
            corners.ids,
        )
        (checks if check else fitted).append(term)
    return fitted, checks, count


MOVES = 4
"""Boards that moved are searched for so many times."""

TURNABOUTS = 0.34
"""A board stood at two places in turn if no cut divides its pictures but for this part of the fewer ones."""


@dataclass(frozen=True)
class BenchOptions:
    """The choices that are not measured.

    Attributes
    ----------
    kind
        Camera model of all cameras; None: as the survey says for each.
    rover_from_mast, rover_from_board
        Where the rover frame is: the mast's frame at zero angles in it, as a level and a tape give it (by
        default it is the mast's), or the board and placement whose pose is known, and that pose.
    """

    kind: Kind | None = None
    rover_from_mast: Rigid | None = None
    rover_from_board: tuple[tuple[str, str], Rigid] | None = None


class BenchProblem:
    """The problem of a bench's pictures; a board that turns out to have moved changes it.

    Raises
    ------
    BenchNotFitted
        If the pictures allow no start, or a board stood at two places in turn.
    """

    def __init__(self, survey: Survey, options: BenchOptions) -> None:
        self.survey, self.options = survey, options
        self.notes = list[str]()
        self.images, checks, self.attitudes = bench_terms(survey, self.notes)
        wrong, _ = wrong_dots(checks)
        self.checks = [t.only(~wrong[t.name]) if t.name in wrong else t for t in checks]
        self.joint_rad = survey.sigma.joint_rad
        if not any(t.attitude is not None for t in self.images):
            raise BenchNotFitted(
                "no picture of a head camera shows a board: the head cannot be calibrated; at least 20 "
                "pictures are expected, with pan and tilt both moved between them"
            )
        self.cameras = {t.camera: survey.cameras[t.camera] for t in self.images}
        self.boards = tuple(dict.fromkeys(t.board[0] for t in self.images))
        self.split: list[tuple[tuple[str, str], tuple[str, str], str]] = []
        self.views = self._views()
        self.begin()

    def begin(self) -> None:
        """Find where to start, and leave out placements that no head camera shows.

        A board that stood elsewhere in all pictures from some one on counts as two placements.
        """
        attitudes = self.attitudes if self.joint_rad > 0 else 0
        for left in range(MOVES, -1, -1):
            start = bench_start(self.images, self.views, attitudes)
            if not start.elsewhere or not left:
                break
            self._moved_far(*next(iter(start.elsewhere.items())))
        self.notes += start.notes
        self.images = [t for t in self.images if t.board in start.estimate.rover_from_board]
        self.checks = [t for t in self.checks if t.board in start.estimate.rover_from_board]
        self.start, self.doubtful = self._in_rover(start.estimate), start.doubtful
        self.boards = tuple(dict.fromkeys(t.board[0] for t in self.images))

    def _moved_far(self, board: tuple[str, str], elsewhere: frozenset[str]) -> None:
        """Split the placement of a board that moved; refuse one that stood at two places in turn."""
        shown = [t for t in self.images if t.board == board]
        there = np.array([t.name in elsewhere for t in shown])
        changes = np.flatnonzero(there[1:] != there[:-1])
        # A picture that says nothing clear may lie on either side: the change is where it divides best.
        cut, wrong = best_cut(there)
        if wrong > TURNABOUTS * there.sum():
            first = [shown[i + 1].name for i in changes[:3]]
            raise SomethingChanged(
                f"board {board[0]} of placement {board[1]} stands at two places, now at one and now at the "
                f"other (pictures {', '.join(first)} and others). Two boards have the same ids, or it was "
                "moved and put back. Leave one board only, or print the other with other ids (first_id)"
            )
        before, after = shown[cut - 1].name, shown[cut].name
        moved = f"board {board[0]} moved during placement {board[1]}, between pictures {before} and {after}"
        self.split_placement(board, after, moved)

    def split_placement(self, board: tuple[str, str], after: str, why: str) -> None:
        """Give the images of a board from one on a placement of their own."""
        self.notes.append(f"{why}; from there on it counts as another placement")
        moved = (board[0], f"{board[1]} from {after} on")
        self.split.append((board, moved, after))
        names = [i.name for i in self.survey.images]
        later = set(names[names.index(after) :])
        self.images, self.checks = (
            [replace(t, board=moved) if t.board == board and t.name in later else t for t in terms]
            for terms in (self.images, self.checks)
        )

    def _views(self) -> dict[str, ViewPoses]:
        """What each camera says by itself."""
        views = {}
        for name, camera in self.cameras.items():
            mine = [t for t in self.images if t.camera == name]
            try:
                views[name] = view_poses(
                    mine, self.options.kind or camera.kind, camera.size_px, camera.focal_px or None
                )
            except ViewsTooFew as error:
                raise BenchNotFitted(f"camera {name}: {error}") from None
        return views

    def _in_rover(self, state: Estimate) -> Estimate:
        """The start, which is in the mast's frame, carried to where the rover frame was chosen to be."""
        options, known = self.options, self.options.rover_from_board
        state = replace(state, bows_m={b: np.zeros(2) for b, _ in state.rover_from_board})
        if known is not None and known[0] not in state.rover_from_board:
            there = ", ".join("/".join(board) for board in state.rover_from_board)
            raise BenchNotFitted(
                f"no picture shows the board {'/'.join(known[0])} that is known; there are {there}"
            )
        rover_from_mast = options.rover_from_mast
        if known is not None:
            rover_from_mast = known[1] @ state.rover_from_board[known[0]].inverse
        if rover_from_mast is None:
            return state
        angles = Rotation.from_matrix(rover_from_mast.rotation).as_euler("XYZ")
        mast = np.array([*rover_from_mast.translation_m, *angles, *state.mast[6:]])
        boards = {b: rover_from_mast @ pose for b, pose in state.rover_from_board.items()}
        cameras = {
            n: m.moved(rover_from_mast) if self.cameras[n].on == "rover" else m
            for n, m in state.cameras.items()
        }
        if known is not None:
            boards[known[0]] = known[1]
        return replace(state, cameras=cameras, mast=mast, rover_from_board=boards)

    def problem(self, chosen: Mapping[str, ModelTerm], state: Estimate) -> Adjustment:
        """The least-squares problem with some terms."""
        known = self.options.rover_from_board
        return Adjustment(
            with_kept(self.images, self.doubtful),
            (),
            state,
            mast_parameters=[*(() if known is None else range(6)), *term_numbers(chosen, "mast")],
            joint_rad=self.joint_rad,
            joint_errors=term_numbers(chosen, "joints"),
            bowed=[term.of for term in chosen.values() if term.kind == "bow"],
            fixed=() if known is None else (known[0],),
            huber=HUBER,
        )

    def candidates(self) -> dict[str, ModelTerm]:
        """Terms that pictures could determine: backlash only where the axis came from both sides."""
        found = {}
        approaches = np.array([t.approach for t in self.images if t.attitude is not None])
        for name, term in candidate_terms(self.boards).items():
            if term.kind == "backlash":
                sides = set(approaches[:, ("pan", "tilt").index(term.of)].tolist())
                if not {-1, 1} <= sides:
                    self.notes.append(_one_sided(name, term.of, sides))
                    continue
            found[name] = term
        return found


def _one_sided(term: str, joint: str, sides: set[int]) -> str:
    """Why a joint's backlash is not fitted."""
    if not sides & {-1, 1}:
        return f"{term} is not fitted: it is not known from which side {joint} came to rest"
    side = "smaller" if 1 in sides else "larger"
    return (
        f"{term} is not fitted: {joint} came to rest from {side} angles only, as in a head that "
        "approaches every goal from one side. Its play is then part of its zero, and no error"
    )


def best_cut(there: np.ndarray) -> tuple[int, int]:
    """Return before which of a row (n,) it changes sides, and for how many of them that is wrong."""
    cuts = range(len(there) + 1)
    wrong = [min((~there[:k]).sum() + there[k:].sum(), there[:k].sum() + (~there[k:]).sum()) for k in cuts]
    return int(np.argmin(wrong)), int(min(wrong))


def without_terms(state: Estimate, terms: Mapping[str, ModelTerm]) -> Estimate:
    """Return the state with some terms' numbers at nothing."""
    mast, errors = state.mast.copy(), state.joint_errors.copy()
    mast[term_numbers(terms, "mast")] = 0.0
    errors[term_numbers(terms, "joints")] = 0.0
    bows = {**state.bows_m, **{term.of: np.zeros(2) for term in terms.values() if term.kind == "bow"}}
    return replace(state, mast=mast, joint_errors=errors, bows_m=bows)
