"""Where the station says that set-ups and boards stand, gross blunders left out and named.

"If the CAD model of the prism positions is inaccurate, it needs to be refined iteratively at different total
station locations" (paper section III.B): here all set-ups and the drawing are one least-squares problem, a
generalised Procrustes alignment with the drawing as prior. The drawing also defines the rover frame, by the
mean of its prisms.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from calib.adjust.adjustment import Adjustment
from calib.adjust.gross import chance_limit
from calib.adjust.outliers import Outlier
from calib.adjust.solver import covariance_of, minimise
from calib.adjust.terms import StationTerm, station_terms
from calib.adjust.unknowns import Estimate
from calib.geometry.rig import MAST_NAMES
from calib.geometry.rigid import FloatArray, Rigid
from calib.geometry.significance import Level
from calib.survey.alignment import (
    FALSE_ALARM,
    Alignment,
    NotAligned,
    align,
    rover_from_station,
    station_from_board,
)
from calib.survey.records import Survey

STEPS = 50
"""At most; three or four do from the aligned start, more where a prism is off."""


@dataclass(frozen=True, eq=False)
class AdjustedPrisms:
    """Where the prisms are on the rover.

    Attributes
    ----------
    state
        The places of the prisms, and the pose of every set-up.
    covariance
        (3n, 3n) of the places, metres squared. Where the whole set stands is known no better than the
        drawing says, however many set-ups there are.
    chi2, degrees_of_freedom
        Of what was used.
    settled
        Whether the fit did.
    rejected
        Measurements left out: set-up and prism, or None and prism where the set-ups agree with each other
        on another place than the drawing's.
    doubt
        '' if what was used agrees; else a sentence.
    """

    state: Estimate
    covariance: FloatArray
    chi2: float
    degrees_of_freedom: int
    settled: bool
    rejected: tuple[tuple[str | None, str], ...] = ()
    doubt: str = ""


def adjust_prisms(survey: Survey, *, false_alarm: float = FALSE_ALARM) -> AdjustedPrisms:
    """Fit the places of the prisms to all set-ups of a survey and to the drawing.

    Parameters
    ----------
    survey
        With ``sigma.prism_cad_m`` above 0; at 0 the drawing is exact and there is nothing to refine.
    false_alarm
        How often measurements without a blunder may be called in doubt.

    Raises
    ------
    NotAligned
        If a set-up has fewer than three prisms, or the places do not settle.
    ValueError
        If the drawing is stated to be exact.
    """
    if survey.sigma.prism_cad_m <= 0:
        raise ValueError("sigma.prism_cad_m is 0: the drawing is taken as exact, nothing can be refined")
    station = station_terms(survey, {})
    for setup in dict.fromkeys(point.setup for point in survey.station):
        count = sum(term.setup == setup for term in station)
        if count < 3:
            raise NotAligned(f"set-up {setup}: {count} prisms where at least three are expected")
    drawing = survey.prisms_in_rover_m
    fit = _fit(survey, drawing, station)
    rejected, doubt = list[tuple[str | None, str]](), ""
    while fit.chi2 > chance_limit(false_alarm, 1, fit.degrees_of_freedom):
        found = _culprit(survey, drawing, station, fit.chi2, false_alarm)
        if found is None:
            rms = np.sqrt(fit.chi2 / fit.degrees_of_freedom)
            doubt = f"the set-ups and the drawing of the prisms disagree by {rms:.1f} times their sigmas"
            break
        rejected.append(found)
        drawing, station = _without(drawing, station, *found)
        fit = _fit(survey, drawing, station)
    if not fit.settled:
        raise NotAligned(
            f"the prisms' places did not settle in {STEPS} steps: the set-ups stand too differently from the "
            "drawing; check the prisms' names and places"
        )
    return replace(fit, rejected=tuple(rejected), doubt=doubt)


def _without(
    drawing: Mapping[str, FloatArray], station: Sequence[StationTerm], setup: str | None, prism: str
) -> tuple[dict[str, FloatArray], tuple[StationTerm, ...]]:
    """The measurements without one of them: a prism in a set-up, or in the drawing (None)."""
    drawn = {name: place for name, place in drawing.items() if (setup, name) != (None, prism)}
    return drawn, tuple(term for term in station if (term.setup, term.point) != (setup, prism))


def _culprit(
    survey: Survey,
    drawing: Mapping[str, FloatArray],
    station: Sequence[StationTerm],
    now: float,
    false_alarm: float,
) -> tuple[str | None, str] | None:
    """The measurement whose leaving helps by far the most; None if two would do about as well."""
    setups = Counter(term.setup for term in station)
    known = Counter([*drawing, *(term.point for term in station)])
    candidates: list[tuple[str | None, str]] = [
        (term.setup, term.point) for term in station if setups[term.setup] > 3 and known[term.point] > 1
    ]
    if len(drawing) > 3:
        candidates += [(None, prism) for prism in drawing if known[prism] > 1]
    left = []
    for one in candidates:
        with suppress(NotAligned):  # three on a line are no set-up
            left.append((_fit(survey, *_without(drawing, station, *one)).chi2, one))
    left.sort(key=lambda entry: entry[0])
    clear, apart = chance_limit(false_alarm, 1, 3), chance_limit(false_alarm, 1, 1)
    if len(left) < 2 or now - left[0][0] < clear or left[1][0] - left[0][0] < apart:
        return None
    return left[0][1]


def _fit(survey: Survey, drawing: Mapping[str, FloatArray], station: Sequence[StationTerm]) -> AdjustedPrisms:
    """Places and poses together: an adjustment without images, of the prisms that ``drawing`` holds."""
    places = survey.prisms_in_rover_m
    sigma_m = float(np.hypot(survey.sigma.station_m, survey.sigma.prism_cad_m))
    poses = {}
    for setup in dict.fromkeys(term.setup for term in station):
        mine = [term for term in station if term.setup == setup]
        names = [term.point for term in mine]
        measured = [term.position_m for term in mine]
        poses[setup] = align(measured, [places[name] for name in names], sigma_m, names).b_from_a
    start = Estimate({}, np.zeros(len(MAST_NAMES)), poses, {}, places, np.zeros((0, 2)))
    problem = Adjustment(
        (), station, start, mast_parameters=0, prisms_cad_m=drawing, prism_cad_m=survey.sigma.prism_cad_m
    )
    fit = minimise(problem, start, steps=STEPS, gain=1e-13)
    at = np.concatenate([problem.at(("prism", name)) for name in places])
    covariance = covariance_of(fit.normal.matrix)[np.ix_(at, at)]
    freedom = 3 * (len(drawing) + len(station)) - len(problem.names)
    return AdjustedPrisms(fit.state, covariance, fit.normal.cost, freedom, fit.settled)


@dataclass(frozen=True, eq=False)
class StationPoses:
    """Poses of set-ups and boards from prisms and tapes alone.

    ``rover_from_board`` is by set-up and placement, of placements with three tapes; ``bent`` are those whose
    tapes do not fit the board, ``blunders`` prisms and tapes that the poses were found without.
    ``prisms_in_rover_m`` is refined where the drawing has a sigma.
    """

    rover_from_station: Mapping[str, Rigid]
    rover_from_board: Mapping[tuple[str, str], Rigid]
    prisms_in_rover_m: Mapping[str, FloatArray]
    bent: frozenset[tuple[str, str]]
    blunders: tuple[Outlier, ...]
    notes: tuple[str, ...]


def station_poses(survey: Survey) -> StationPoses:
    """Return the poses that prisms and tapes give, each placement's alone.

    Set-ups are taken each alone where the drawing of the prisms is exact, else together
    (``calib.calibrate.starts.station``), as the paper does.

    Raises
    ------
    NotAligned
        Naming the set-up or placement whose points are too few or on one line.
    """
    blunders: list[Outlier] = []
    notes: list[str] = []
    if survey.sigma.prism_cad_m > 0:
        setups, prisms = _refined(survey, blunders, notes)
    else:
        setups, prisms = _as_drawn(survey, blunders, notes)
    boards, bent = {}, set()
    for (setup, placement), pose in station_from_board(survey, false_alarm=Level.GROSS).items():
        where = f"of placement {placement} (set-up {setup})"
        boards[setup, placement] = setups[setup] @ pose.b_from_a
        blunders += _left_out("tape", pose, survey.sigma.station_m, where)
        if pose.doubt:
            bent.add((setup, placement))
            notes.append(f"the tapes {where} do not agree with the board's: {pose.doubt}")
    return StationPoses(setups, boards, prisms, frozenset(bent), tuple(blunders), tuple(notes))


def _as_drawn(
    survey: Survey, blunders: list[Outlier], notes: list[str]
) -> tuple[dict[str, Rigid], dict[str, FloatArray]]:
    """Set-ups by prisms that are where the drawing says, and these."""
    found = {}
    for setup, pose in rover_from_station(survey, false_alarm=Level.GROSS).items():
        found[setup] = pose.b_from_a
        blunders += _left_out("prism", pose, survey.sigma.station_m, f"of set-up {setup}")
        if pose.doubt:
            notes.append(f"the prisms of set-up {setup} do not agree with their CAD positions: {pose.doubt}")
    return found, {name: np.array(place) for name, place in survey.prisms_in_rover_m.items()}


def _refined(
    survey: Survey, blunders: list[Outlier], notes: list[str]
) -> tuple[dict[str, Rigid], dict[str, FloatArray]]:
    """Set-ups and prisms by all set-ups and the drawing together."""
    refined = adjust_prisms(survey, false_alarm=Level.GROSS)
    setups, prisms = dict(refined.state.rover_from_station), dict(refined.state.prisms_in_rover_m)
    measured = {(p.setup, p.point): p.position_m for p in survey.station if p.kind == "prism"}
    for setup, name in refined.rejected:
        if setup is None:
            off = prisms[name] - survey.prisms_in_rover_m[name]
            sigma_m, where = survey.sigma.prism_cad_m, "in the drawing"
        else:
            off = setups[setup].points(measured[setup, name]) - prisms[name]
            sigma_m, where = survey.sigma.station_m, f"of set-up {setup}"
        blunders.append(_outlier("prism", name, where, off, sigma_m))
    if refined.doubt:
        notes.append(refined.doubt)
    return setups, prisms


def _left_out(kind: Literal["prism", "tape"], pose: Alignment, sigma_m: float, where: str) -> list[Outlier]:
    """The points that an alignment left out."""
    rows = [pose.names.index(name) for name in pose.rejected]
    return [_outlier(kind, pose.names[row], where, pose.residuals_m[row], sigma_m) for row in rows]


def _outlier(
    kind: Literal["prism", "tape"], name: str, where: str, off_m: FloatArray, sigma_m: float
) -> Outlier:
    off = float(np.linalg.norm(off_m))
    return Outlier(kind, f"{kind} {name} {where}", (off / sigma_m) ** 2, chance_limit(Level.GROSS, 1, 3), off)
