"""Fit a head on a bench: cameras, their place in the head, axes, joints' errors and boards, from pictures
alone.

The estimator is that of surveys (``calib.adjust.adjustment``), with boards of unknown pose and no station.
Start (``calib.calibrate.starts.bench``), pulls bounded, what changed half-way found
(``calib.adjust.hypotheses``), blunders left out by the tests of ``calib.adjust.outliers``, terms chosen
(``calib.adjust.model_terms``), least squares.
"""

from __future__ import annotations

import time
from collections.abc import Collection, Mapping
from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from calib.adjust.adjustment import HUBER, SCAN_HUBER, Adjustment
from calib.adjust.gross import gross_limit
from calib.adjust.hypotheses import ScoredFit, find_change, find_drifts
from calib.adjust.model_terms import ModelTerm, TermGain, choose_terms
from calib.adjust.result import BenchCalibration
from calib.adjust.robust import (
    Cleaned,
    SurveyNotFitted,
    Weighed,
    judged_again,
    weigh,
    weighed_fields,
    without_blunders,
)
from calib.adjust.scatter import print_error_m, with_scales
from calib.adjust.solver import minimise
from calib.adjust.terms import ImageTerm
from calib.adjust.unknowns import Estimate
from calib.calibrate.bench.problem import MOVES, BenchOptions, BenchProblem, best_cut, without_terms
from calib.calibrate.refusals import refuse_far
from calib.calibrate.starts.bench import BenchNotFitted, SomethingChanged
from calib.calibrate.starts.wrong_dots import without_wrong
from calib.geometry.significance import Level
from calib.survey.records import Survey

WRONG_MINIMUM = 3.0
"""A fit is refused if the typical corner is this many times farther off than its sigma."""

SLIP_RAD, SLIP_ASIDE = 0.003, 0.1
"""A board that moved by more than this about the pan axis, and by less than this part of it otherwise
(radians and metres), did not move: pan slipped."""

PART = 4
"""As many pictures on one side of another are no blunders."""


def fit_bench(survey: Survey, options: BenchOptions | None = None) -> BenchCalibration:
    """Fit a rig to a bench's pictures, every measurement weighted by its sigma; check images take no part.

    Raises
    ------
    BenchNotFitted
        If the pictures do not determine a rig, something changed while they were taken, or the fit ends far
        from the noise: it is never reported as done.
    """
    began = time.perf_counter()
    options = options or BenchOptions()
    try:
        return _fitted(BenchProblem(survey, options), began)
    except SurveyNotFitted as error:
        raise BenchNotFitted(str(error)) from None


def _fitted(bench: BenchProblem, began: float) -> BenchCalibration:
    """Fit everything, choose, fit again, and put together what it says."""
    candidates = bench.candidates()
    bench, problem, start = _look_for_changes(bench, candidates)
    _refuse_far(bench, problem, start)  # where nothing fits, before blunders are searched for one by one
    cleaned = without_blunders(problem, start, bench.images, bench.survey.sigma.corner_px)
    chosen, tests = choose_terms(cleaned.problem, cleaned.fit, candidates)
    dropped = {name: term for name, term in candidates.items() if name not in chosen}
    start = without_terms(cleaned.fit.state, dropped)
    last = bench.problem(chosen, start).with_terms(cleaned.problem.images, ())
    cleaned = judged_again(cleaned, last, start)
    _refuse_part(cleaned.problem)
    _refuse_far(bench, cleaned.problem, cleaned.fit.state)
    # counts and the least of corners are known; what a simulated or lucky bench has less is no knowledge
    weighed = weigh(cleaned, narrows=False)
    return _calibration(bench, cleaned, weighed, chosen, tests, began)


def _look_for_changes(
    bench: BenchProblem, chosen: Mapping[str, ModelTerm]
) -> tuple[BenchProblem, Adjustment, Estimate]:
    """Return the bench, its problem with some terms, lone wrong corners left out, and its fit.

    A board that moved counts as two placements.

    Raises
    ------
    BenchNotFitted
        If a joint slipped, or a camera changed: nothing says which of its two states is the one to come.
    """
    wrong = {n: s for view in bench.views.values() for n, s in view.wrong.items()}
    for left in range(MOVES, -1, -1):
        problem = bench.problem(chosen, bench.start).without_unseen(bench.start)
        problem = problem.with_terms([without_wrong(t, wrong) for t in problem.images], ())
        fit = minimise(problem, bench.start, weak=problem.weak, gain=1e-4)
        if np.isfinite(fit.normal.cost):
            order_px = bench.survey.sigma.corner_px
            problem, _, _ = with_scales(problem, fit.state, bench.images, order_px)
            fit = minimise(problem, fit.state, weak=problem.weak, gain=1e-4)
        problem = _without_lone_corners(problem, fit.state).with_huber(SCAN_HUBER)
        fit = minimise(problem, fit.state, weak=problem.weak, gain=1e-6)
        if not np.isfinite(fit.normal.cost) or not left:
            break
        scored = ScoredFit(problem, fit.state)
        change = find_change(scored)
        _refuse_slip(bench, fit.state)
        if change is None or any(drift.likelier(change) for drift in find_drifts(scored)):
            break  # the verdict names what drifts, with its size
        if change.subject[0] != "board":
            raise SomethingChanged(change.sentence)
        bench.split_placement((change.subject[1], change.subject[2]), change.after, change.sentence)
        bench.begin()
    return bench, problem.with_huber(HUBER), fit.state


def _refuse_slip(bench: BenchProblem, state: Estimate) -> None:
    """Raise if a board that seems to have moved turned about the pan axis: then it was pan that
    slipped."""
    rover_from_mast = state.as_mast.rover_from_mast
    for before, moved, after in bench.split:
        poses = [rover_from_mast.inverse @ state.rover_from_board[b] for b in (before, moved)]
        motion = poses[1] @ poses[0].inverse
        turn = Rotation.from_matrix(motion.rotation).as_rotvec()
        aside = np.linalg.norm(turn[:2]) + np.linalg.norm(motion.translation_m)
        if abs(turn[2]) > SLIP_RAD and aside < SLIP_ASIDE * abs(turn[2]):
            raise SomethingChanged(
                f"pan slipped by about {1e3 * abs(turn[2]):.0f} mrad before picture {after}: the head no "
                "longer points where it read before; tighten what holds it on its axis and take the "
                "pictures again"
            )


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


def _refuse_far(bench: BenchProblem, problem: Adjustment, state: Estimate) -> None:
    refuse_far(
        problem,
        state,
        bench.survey.sigma.corner_px,
        most=WRONG_MINIMUM,
        dot="corner",
        disagree=", and no slip, knock, other focus or moved board between two of them explains it. Check "
        "that pan counts right and tilt up, that each picture's placement is the right one, and that nothing "
        "but the head moved",
        scatter="they are found badly, the board is printed inexactly, or corner_px is far too small",
        coherent="the board's measures are wrong",
    )


def _calibration(
    bench: BenchProblem,
    cleaned: Cleaned,
    weighed: Weighed,
    chosen: Mapping[str, ModelTerm],
    tests: Mapping[str, TermGain],
    began: float,
) -> BenchCalibration:
    """Put together what the fit says."""
    problem, state = weighed.problem, weighed.fit.state
    for one in weighed.components:
        if one.wrong or one.generous:
            bench.notes.append(
                f"{one.kind} scatter by {one.factor:.2f} ± {one.factor_sigma:.2f} times the stated "
                "sigma; they count with that"
            )
    # A parameter that is not seen keeps what is weakly known of it, and is reported as open.
    kinds = ("mast", "joints", "camera")
    images, checks = bench.images, bench.checks
    fields = weighed_fields(
        bench.survey, cleaned, weighed, images, checks, kinds, Level.PREDICTED, bench.notes
    )
    beside = choose_terms(problem, weighed.fit, chosen)[1]  # those of the model beside one another
    beside = {name: replace(gain, entered=True) for name, gain in beside.items()}
    return BenchCalibration(
        **fields,
        terms=tuple({**tests, **beside}.values()),
        gauges=_gauges(bench, chosen),
        drifts=find_drifts(weighed.scored),
        joint_rad=problem.joint_rad,
        inexact_m=print_error_m(problem, state),
        bows_m=state.bows_m,
        seconds=time.perf_counter() - began,
    )


def _gauges(bench: BenchProblem, chosen: Collection[str]) -> tuple[str, ...]:
    """What pictures cannot know, and how it was fixed."""
    known = bench.options.rover_from_board
    if known is not None:
        where = (
            f"the rover frame hangs on placement {known[0][1]} of board {known[0][0]}, whose pose was stated"
        )
    elif bench.options.rover_from_mast is not None:
        where = "the mast stands in the rover frame as was stated, with no uncertainty"
    else:
        where = (
            "the rover frame is the mast's at zero angles (z down along the pan axis): where the "
            "vehicle is, pictures cannot show"
        )
    gauges = [
        where,
        "its origin is where the pan axis is nearest to the tilt axis: pictures determine no other height "
        "along it",
        "pan is zero where the tilt axis points to y, tilt where the head's x lies square to pan. An "
        "offset of either would turn the frame or all head cameras, and is none",
        "every length is as long as the boards were measured: 0.1 % there is 0.1 % of every range",
    ]
    if "tilt harmonic 1" in chosen:
        gauges.append(
            "the first harmonic of tilt is encoder and an arm's sag together: pictures cannot separate them"
        )
    return tuple(gauges)
