"""Fit a head on a bench: cameras, their place in the head, axes, joints' errors and boards, from pictures
alone.

The estimator is that of surveys (``calib.adjust.adjustment``), with boards of unknown pose and no station.
Start (``calib.calibrate.starts.bench``), pulls bounded, what changed half-way found
(``calib.adjust.hypotheses``), blunders left out by the tests of ``calib.adjust.outliers``, terms chosen
(``calib.adjust.model_terms``), least squares.
"""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from calib.adjust.adjustment import HUBER, SCAN_HUBER, Adjustment
from calib.adjust.gross import gross_limit
from calib.adjust.hypotheses import ScoredFit, find_change, find_drifts
from calib.adjust.model_terms import ModelTerm, candidate_terms, choose_terms, term_numbers
from calib.adjust.noise import print_error_m, with_scales, without_wrong
from calib.adjust.result import BenchCalibration
from calib.adjust.robust import (
    SurveyNotFitted,
    judged,
    refuse_far,
    weigh,
    weighed_fields,
    without_blunders,
)
from calib.adjust.solver import minimise
from calib.adjust.terms import ImageTerm
from calib.adjust.unknowns import Estimate
from calib.calibrate.starts.bench import BenchNotFitted, BoardMoved, SomethingChanged, bench_start, best_cut
from calib.calibrate.starts.views import ViewPoses, ViewsTooFew, view_poses
from calib.geometry.rigid import Rigid
from calib.geometry.significance import Level
from calib.survey.records import Survey

WRONG_MINIMUM = 3.0
"""A fit is refused if the typical corner is this many times farther off than its sigma."""

PART = 4
"""As many pictures on one side of another are no blunders."""

SUREST = 0.1
"""Part of ``corner_px`` below which no corner's own sigma counts: what neighbours share is not in it."""

FEWEST_CORNERS = 6
"""An image with fewer takes no part: with four, a pose goes through them whatever they are."""


def fit_bench(survey: Survey, *, rover_from_mast: Rigid | None = None) -> BenchCalibration:
    """Fit a rig to a bench's pictures, every measurement weighted by its sigma; check images take no part.

    The rover frame is where the mast's frame at zero angles was stated to be, as by a level and a tape; by
    default it is the mast's.

    Raises
    ------
    BenchNotFitted
        If the pictures do not determine a rig, something changed while they were taken, or the fit ends far
        from the noise: it is never reported as done.
    """
    began = time.perf_counter()
    try:
        bench = BenchProblem(survey, rover_from_mast)
        candidates = bench.candidates()
        problem, start = _without_changes(bench, candidates)
        bench.refuse_far(problem, start)  # where nothing fits, before blunders are searched for one by one
        cleaned = without_blunders(problem, start, bench.images, survey.sigma.corner_px)
        chosen, tests = choose_terms(cleaned.problem, cleaned.fit, candidates)
        dropped = {name: term for name, term in candidates.items() if name not in chosen}
        start = _without_terms(cleaned.fit.state, dropped)
        last = bench.problem(chosen, start).with_terms(cleaned.problem.images, ())
        last, fit = judged(last.with_huber(None), start, cleaned.images)
        cleaned = replace(cleaned, problem=last, fit=fit)
        _refuse_part(cleaned.problem)
        bench.refuse_far(cleaned.problem, cleaned.fit.state)
        # counts and the least of corners are known; what a simulated or lucky bench has less is no knowledge
        weighed = weigh(cleaned, narrows=False)
    except SurveyNotFitted as error:
        raise BenchNotFitted(str(error)) from None
    bench.notes += [
        f"{one.kind} scatter by {one.factor:.2f} ± {one.factor_sigma:.2f} times the stated sigma; they count "
        "with that"
        for one in weighed.components
        if one.wrong or one.generous
    ]
    # A parameter that is not seen keeps what is weakly known of it, and is reported as open.
    kinds = ("mast", "joints", "camera")
    fields = weighed_fields(
        survey, cleaned, weighed, bench.images, bench.checks, kinds, Level.PREDICTED, bench.notes
    )
    beside = choose_terms(weighed.problem, weighed.fit, chosen)[1]  # those of the model beside one another
    beside = {name: replace(gain, entered=True) for name, gain in beside.items()}
    return BenchCalibration(
        **fields,
        terms=tuple({**tests, **beside}.values()),
        gauges=_gauges(bench, chosen),
        drifts=find_drifts(weighed.scored),
        joint_rad=weighed.problem.joint_rad,
        inexact_m=print_error_m(weighed.problem, weighed.fit.state),
        bows_m=weighed.fit.state.bows_m,
        seconds=time.perf_counter() - began,
    )


class BenchProblem:
    """A bench's pictures as a least-squares problem, and where it starts.

    Raises BenchNotFitted if the pictures allow no start, or a board stood at two places.
    """

    def __init__(self, survey: Survey, rover_from_mast: Rigid | None = None) -> None:
        self.survey, self.rover_from_mast = survey, rover_from_mast
        self.notes = list[str]()
        images, checks, attitudes = bench_terms(survey, self.notes)
        if not any(t.attitude is not None for t in images):
            raise BenchNotFitted(
                "no picture of a head camera shows a board: the head cannot be calibrated; at least 20 "
                "pictures are expected, with pan and tilt both moved between them"
            )
        views = _views(survey, images)
        start = bench_start(images, views, attitudes if survey.sigma.joint_rad > 0 else 0)
        self.notes += start.notes
        shown = start.estimate.rover_from_board
        self.images = [t for t in images if t.board in shown]
        self.checks = [t.only(t.keep) for t in without_wrong(checks)[0] if t.board in shown]
        self.boards = tuple(dict.fromkeys(t.board[0] for t in self.images))
        self.start, self.doubtful = self._in_rover(start.estimate), start.doubtful

    def _in_rover(self, state: Estimate) -> Estimate:
        """The start, which is in the mast's frame, carried to where the rover frame was chosen to be."""
        state = replace(state, bows_m={b: np.zeros(2) for b, _ in state.rover_from_board})
        carried = self.rover_from_mast
        if carried is None:
            return state
        angles = Rotation.from_matrix(carried.rotation).as_euler("XYZ")
        cameras = {
            n: m.moved(carried) if self.survey.cameras[n].on == "rover" else m
            for n, m in state.cameras.items()
        }
        mast = np.array([*carried.translation_m, *angles, *state.mast[6:]])
        boards = {b: carried @ pose for b, pose in state.rover_from_board.items()}
        return replace(state, cameras=cameras, mast=mast, rover_from_board=boards)

    def problem(self, chosen: Mapping[str, ModelTerm], state: Estimate) -> Adjustment:
        """Return the least-squares problem with some terms."""
        return Adjustment(
            [replace(t, keep=t.keep & (t.name not in self.doubtful)) for t in self.images],
            (),
            state,
            mast_parameters=term_numbers(chosen, "mast"),
            joint_rad=self.survey.sigma.joint_rad,
            joint_errors=term_numbers(chosen, "joints"),
            bowed=[term.of for term in chosen.values() if term.kind == "bow"],
            huber=HUBER,
        )

    def candidates(self) -> dict[str, ModelTerm]:
        """Return the terms that pictures could determine: backlash only where the axis came from both
        sides."""
        found = candidate_terms(self.boards)
        for axis, joint in enumerate(("pan", "tilt")):
            sides = {t.approach[axis] for t in self.images if t.attitude is not None}
            if {-1, 1} <= sides:
                continue
            name = next(n for n, one in found.items() if (one.kind, one.of) == ("backlash", joint))
            del found[name]
            why = f"it is not known from which side {joint} came to rest"
            if sides & {-1, 1}:
                side = "smaller" if 1 in sides else "larger"
                why = (
                    f"{joint} came to rest from {side} angles only, as in a head that approaches every goal "
                    "from one side. Its play is then part of its zero, and no error"
                )
            self.notes.append(f"{name} is not fitted: {why}")
        return found

    def refuse_far(self, problem: Adjustment, state: Estimate) -> None:
        """Raise SurveyNotFitted if a fit ends far from the noise."""
        refuse_far(
            problem,
            state,
            self.survey.sigma.corner_px,
            most=WRONG_MINIMUM,
            dot="corner",
            disagree=", and no slip, knock, other focus or moved board between two of them explains it. "
            "Check that pan counts right and tilt up, that each picture's placement is the right one, and "
            "that nothing but the head moved",
            scatter="they are found badly, the board is printed inexactly, or corner_px is far too small",
            coherent="the board's measures are wrong",
        )


GAUGES = (
    "its origin is where the pan axis is nearest to the tilt axis: pictures show no other height along it",
    "pan is zero where the tilt axis points to y, tilt where the head's x lies square to pan. An offset of "
    "either would turn the frame or all head cameras, and is none",
    "every length is as long as the boards were measured: 0.1 % there is 0.1 % of every range",
)


def _gauges(bench: BenchProblem, chosen: Mapping[str, ModelTerm]) -> tuple[str, ...]:
    """What pictures cannot determine, and how it was fixed, a sentence each."""
    where = (
        "the rover frame is the mast's at zero angles (z down along the pan axis): where the vehicle is, "
        "pictures cannot show"
    )
    if bench.rover_from_mast is not None:
        where = "the mast stands in the rover frame as was stated, with no uncertainty"
    sag = "the first harmonic of tilt is encoder and an arm's sag: pictures cannot separate them"
    return (where, *GAUGES, sag) if "tilt harmonic 1" in chosen else (where, *GAUGES)


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
        if on_head and not check:
            key = (image.placement, image.pan_rad, image.tilt_rad, image.pan_approach, image.tilt_approach)
            if key != standstill or (image.camera, image.board) in shown:
                standstill, shown, count = key, set(), count + 1
            shown.add((image.camera, image.board))
        board = survey.boards[image.board]
        bend = np.stack(
            [board.in_board_m(corners.ids, bow)[:, 2] for bow in ((1.0, 0.0), (0.0, 1.0))], axis=1
        )
        term = ImageTerm(
            image.name,
            image.camera,
            (image.board, image.placement),
            (-1 if check else count - 1) if on_head else None,
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


def _views(survey: Survey, images: list[ImageTerm]) -> dict[str, ViewPoses]:
    """What each camera says by itself."""
    views = {}
    for name in dict.fromkeys(t.camera for t in images):
        camera, mine = survey.cameras[name], [t for t in images if t.camera == name]
        try:
            views[name] = view_poses(mine, camera.kind, camera.size_px, camera.focal_px)
        except ViewsTooFew as error:
            raise BenchNotFitted(f"camera {name}: {error}") from None
    return views


def _without_changes(bench: BenchProblem, chosen: Mapping[str, ModelTerm]) -> tuple[Adjustment, Estimate]:
    """The problem with some terms, lone wrong corners left out, and its fit.

    Raises BoardMoved if a board moved, and SomethingChanged if a joint slipped or a camera changed:
    nothing says which of its two states is the one to come.
    """
    problem = bench.problem(chosen, bench.start).without_unseen(bench.start)
    problem = problem.with_terms(without_wrong(problem.images)[0], ())
    fit = minimise(problem, bench.start, weak=problem.weak, gain=1e-4)
    if np.isfinite(fit.normal.cost):
        problem, _, _ = with_scales(problem, fit.state, bench.images, bench.survey.sigma.corner_px)
        fit = minimise(problem, fit.state, weak=problem.weak, gain=1e-4)
    problem = _without_lone_corners(problem, fit.state).with_huber(SCAN_HUBER)
    fit = minimise(problem, fit.state, weak=problem.weak, gain=1e-6)
    if np.isfinite(fit.normal.cost):
        scored = ScoredFit(problem, fit.state)
        change = find_change(scored)
        # The verdict names what drifts, with its size.
        if change is not None and not any(drift.likelier(change) for drift in find_drifts(scored)):
            if change.subject[0] == "board":
                raise BoardMoved(change.sentence, change.subject[2])
            raise SomethingChanged(change.sentence)
    return problem.with_huber(HUBER), fit.state


def _without_lone_corners(problem: Adjustment, state: Estimate) -> Adjustment:
    """Leave out corners far off in images of which most corners are less so."""
    terms = []
    for t, off in zip(problem.images, problem.residuals(state, problem.images), strict=True):
        length = np.linalg.norm(off.reshape(-1, 2), axis=1)
        terms.append(t.kept(length < gross_limit(length, 1.0)) if len(length) else t)
    return problem.with_terms(terms, ())


def _refuse_part(problem: Adjustment) -> None:
    """Raise if all pictures of a placement or a camera from some one on, or up to it, had to be left out."""
    shown_by: dict[str, list[ImageTerm]] = {}
    for term in problem.images:
        for what in (f"placement {term.board[1]}", f"camera {term.camera}"):
            shown_by.setdefault(what, []).append(term)
    for what, shown in shown_by.items():
        out = np.array([not t.keep.any() for t in shown])
        if out.sum() < PART or out.all():
            continue
        cut, wrong = best_cut(out)
        cut = min(max(cut, 1), len(out) - 1)
        if wrong <= 0.2 * out.sum():
            raise BenchNotFitted(
                f"{int(out.sum())} of {len(out)} pictures of {what} contradict the rest, all on one side of "
                f"picture {shown[cut].name}: something changed before it. Fasten board, head and cameras, "
                "and take the pictures again, or take those out of images.csv"
            )


def _without_terms(state: Estimate, terms: Mapping[str, ModelTerm]) -> Estimate:
    """The state with some terms' numbers at nothing."""
    mast, errors = state.mast.copy(), state.joint_errors.copy()
    mast[term_numbers(terms, "mast")] = 0.0
    errors[term_numbers(terms, "joints")] = 0.0
    bows = {**state.bows_m, **{term.of: np.zeros(2) for term in terms.values() if term.kind == "bow"}}
    return replace(state, mast=mast, joint_errors=errors, bows_m=bows)
