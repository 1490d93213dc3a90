"""Where the station says that set-ups and boards stand, gross blunders left out and named.

"If the CAD model of the prism positions is inaccurate, it needs to be refined iteratively at different total
station locations" (paper section III.B): here all set-ups and the drawing are one least-squares problem, a
generalised Procrustes alignment with the drawing as prior. The drawing also defines the rover frame, by the
mean of its prisms.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from calib.adjust.adjustment import Adjustment
from calib.adjust.gross import chance_limit
from calib.adjust.outliers import Outlier, name_outliers
from calib.adjust.robust import judged
from calib.adjust.terms import station_terms
from calib.adjust.unknowns import Estimate
from calib.geometry.rigid import FloatArray, Rigid
from calib.geometry.significance import Level
from calib.survey.alignment import Alignment, NotAligned, rover_from_station, station_from_board
from calib.survey.records import Survey


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

    Set-ups are taken each alone where the drawing of the prisms is exact, else together, as the paper does.

    Raises
    ------
    NotAligned
        Naming the set-up or placement whose points are too few or on one line, or if the set-ups stand too
        differently from the drawing.
    """
    alone = rover_from_station(survey, false_alarm=Level.GROSS)
    notes = [
        f"the prisms of set-up {setup} do not agree with their CAD positions: {pose.doubt}"
        for setup, pose in alone.items()
        if pose.doubt
    ]
    if survey.sigma.prism_cad_m > 0:
        setups, prisms, blunders = _together(survey, alone)
    else:
        setups = {setup: pose.b_from_a for setup, pose in alone.items()}
        prisms = {name: np.array(place) for name, place in survey.prisms_in_rover_m.items()}
        blunders = [
            blunder
            for setup, pose in alone.items()
            for blunder in _left_out("prism", pose, survey.sigma.station_m, f"of set-up {setup}")
        ]
    boards, bent = {}, set()
    for (setup, placement), pose in station_from_board(survey, false_alarm=Level.GROSS).items():
        where = f"of placement {placement} (set-up {setup})"
        boards[setup, placement] = setups[setup] @ pose.b_from_a
        blunders += _left_out("tape", pose, survey.sigma.station_m, where)
        if pose.doubt:
            bent.add((setup, placement))
            notes.append(f"the tapes {where} do not agree with the board's: {pose.doubt}")
    return StationPoses(setups, boards, prisms, frozenset(bent), tuple(blunders), tuple(notes))


def _together(
    survey: Survey, alone: Mapping[str, Alignment]
) -> tuple[dict[str, Rigid], dict[str, FloatArray], list[Outlier]]:
    """Set-ups and prisms by all set-ups and the drawing together: an adjustment without images.

    A prism that no set-up has where it is drawn is wrong in the drawing.
    """
    off = {(setup, name) for setup, pose in alone.items() for name in pose.rejected}
    measured = Counter(name for pose in alone.values() for name in pose.names)
    rejected = Counter(name for _, name in off)
    misdrawn = {name for name, count in rejected.items() if 1 < count == measured[name]}
    station = [
        replace(term, keep=(term.setup, term.point) not in off or term.point in misdrawn)
        for term in station_terms(survey, {})
    ]
    start = Estimate(
        rover_from_station={setup: pose.b_from_a for setup, pose in alone.items()},
        prisms_in_rover_m=survey.prisms_in_rover_m,
    )
    problem = Adjustment(
        (),
        station,
        start,
        mast_parameters=0,
        prisms_cad_m={n: at for n, at in survey.prisms_in_rover_m.items() if n not in misdrawn},
        prism_cad_m=survey.sigma.prism_cad_m,
    )
    problem, fit = judged(problem, start, ())
    if not fit.settled:
        raise NotAligned(
            f"the prisms' places did not settle in {fit.steps} steps: the set-ups stand too differently from "
            "the drawing; check the prisms' names and places"
        )
    prisms = dict(fit.state.prisms_in_rover_m)
    blunders = list(name_outliers(problem, fit.state, fit.covariance, ()))
    for name in sorted(misdrawn):
        off_m = prisms[name] - survey.prisms_in_rover_m[name]
        blunders.append(_outlier("prism", name, "in the drawing", off_m, survey.sigma.prism_cad_m))
    return dict(fit.state.rover_from_station), prisms, blunders


def _left_out(kind: Literal["prism", "tape"], pose: Alignment, sigma_m: float, where: str) -> list[Outlier]:
    """The points that an alignment left out."""
    rows = [pose.names.index(name) for name in pose.rejected]
    return [_outlier(kind, pose.names[row], where, pose.residuals_m[row], sigma_m) for row in rows]


def _outlier(
    kind: Literal["prism", "tape"], name: str, where: str, off_m: FloatArray, sigma_m: float
) -> Outlier:
    off = float(np.linalg.norm(off_m))
    return Outlier(kind, f"{kind} {name} {where}", (off / sigma_m) ** 2, chance_limit(Level.GROSS, 1, 3), off)
