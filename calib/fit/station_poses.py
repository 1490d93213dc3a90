"""Where the station says that set-ups and boards stand, gross blunders left out and named."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

import numpy as np
from scipy.special import chdtri

from calib.fit.calibration import Outlier
from calib.fit.prisms import adjust_prisms
from calib.rigid import FloatArray, Rigid
from calib.survey import Survey
from calib.survey.alignment import Alignment, rover_from_station, station_from_board

GROSS = 1e-9
"""Tapes or prisms whose shape chance alone makes so seldom are not trusted for a start: only gross errors,
since the stated sigmas may be too small. The finer ones are the fit's to judge."""


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
    (``calib.fit.prisms``), as the paper does.

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
    for (setup, placement), pose in station_from_board(survey, false_alarm=GROSS).items():
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
    for setup, pose in rover_from_station(survey, false_alarm=GROSS).items():
        found[setup] = pose.b_from_a
        blunders += _left_out("prism", pose, survey.sigma.station_m, f"of set-up {setup}")
        if pose.doubt:
            notes.append(f"the prisms of set-up {setup} do not agree with their CAD positions: {pose.doubt}")
    return found, {name: np.array(place) for name, place in survey.prisms_in_rover_m.items()}


def _refined(
    survey: Survey, blunders: list[Outlier], notes: list[str]
) -> tuple[dict[str, Rigid], dict[str, FloatArray]]:
    """Set-ups and prisms by all set-ups and the drawing together."""
    refined = adjust_prisms(survey, false_alarm=GROSS)
    prisms = dict(zip(refined.names, refined.places_in_rover_m, strict=True))
    measured = {(p.setup, p.point): p.position_m for p in survey.station if p.kind == "prism"}
    for setup, name in refined.rejected:
        if setup is None:
            off = prisms[name] - survey.prisms_in_rover_m[name]
            sigma_m, where = survey.sigma.prism_cad_m, "in the drawing"
        else:
            off = refined.rover_from_station[setup].points(measured[setup, name]) - prisms[name]
            sigma_m, where = survey.sigma.station_m, f"of set-up {setup}"
        blunders.append(_outlier("prism", name, where, off, sigma_m))
    if refined.doubt:
        notes.append(refined.doubt)
    return dict(refined.rover_from_station), prisms


def _left_out(kind: Literal["prism", "tape"], pose: Alignment, sigma_m: float, where: str) -> list[Outlier]:
    """The points that an alignment left out."""
    rows = [pose.names.index(name) for name in pose.rejected]
    return [_outlier(kind, pose.names[row], where, pose.residuals_m[row], sigma_m) for row in rows]


def _outlier(
    kind: Literal["prism", "tape"], name: str, where: str, off_m: FloatArray, sigma_m: float
) -> Outlier:
    off = float(np.linalg.norm(off_m))
    return Outlier(kind, f"{kind} {name} {where}", (off / sigma_m) ** 2, float(chdtri(3, GROSS)), off)
