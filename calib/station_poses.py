"""Where the station says that set-ups and boards stand, gross blunders left out and named."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

import numpy as np
from scipy.stats import chi2

from calib.align import Alignment, NotAligned, align
from calib.calibration import Outlier
from calib.rigid import FloatArray, Rigid
from calib.survey import Survey

GROSS = 1e-9
"""Tapes or prisms whose shape chance alone makes so seldom are not trusted for a start: only gross errors,
since the stated sigmas may be too small. The finer ones are the fit's to judge."""


@dataclass(frozen=True, eq=False)
class StationPoses:
    """Poses of set-ups and boards from prisms and tapes alone.

    ``rover_from_board`` is by set-up and placement, of placements with three tapes; ``bent`` are those whose
    tapes do not fit the board, ``blunders`` prisms and tapes that the poses were found without.
    """

    rover_from_station: Mapping[str, Rigid]
    rover_from_board: Mapping[tuple[str, str], Rigid]
    bent: frozenset[tuple[str, str]]
    blunders: tuple[Outlier, ...]
    notes: tuple[str, ...]


def station_poses(survey: Survey) -> StationPoses:
    """Return the poses that prisms and tapes give, each set-up's and placement's alone.

    Raises
    ------
    NotAligned
        Naming the set-up or placement whose points are too few or on one line.
    """
    blunders: list[Outlier] = []
    notes: list[str] = []
    rover_from_station = _setups(survey, blunders, notes)
    rover_from_board, bent = _boards(survey, rover_from_station, blunders, notes)
    return StationPoses(rover_from_station, rover_from_board, frozenset(bent), tuple(blunders), tuple(notes))


def _setups(survey: Survey, blunders: list[Outlier], notes: list[str]) -> dict[str, Rigid]:
    """rover_from_station of every set-up."""
    found = {}
    sigma_m = float(np.hypot(survey.sigma.station_m, survey.sigma.prism_cad_m))
    for setup in dict.fromkeys(p.setup for p in survey.station):
        prisms = [p for p in survey.station if p.setup == setup and p.kind == "prism"]
        prisms = [p for p in prisms if p.point in survey.prisms_in_rover_m]
        cad = [survey.prisms_in_rover_m[p.point] for p in prisms]
        try:
            pose = align(
                [p.position_m for p in prisms], cad, sigma_m, [p.point for p in prisms], false_alarm=GROSS
            )
        except NotAligned as error:
            raise NotAligned(f"set-up {setup}: {error}; measure at least 3 of its prisms") from None
        found[setup] = pose.b_from_a
        blunders += _blunders("prism", pose, sigma_m, f"of set-up {setup}")
        if pose.doubt:
            notes.append(f"the prisms of set-up {setup} do not agree with their CAD positions: {pose.doubt}")
    return found


def _boards(
    survey: Survey, rover_from_station: Mapping[str, Rigid], blunders: list[Outlier], notes: list[str]
) -> tuple[dict[tuple[str, str], Rigid], set[tuple[str, str]]]:
    """rover_from_board of every placement with three tapes, and those whose tapes do not fit the board."""
    found, bent = {}, set()
    tapes: dict[tuple[str, str], dict[str, FloatArray]] = {}
    for p in survey.station:
        if p.kind == "tape" and p.point in survey.board.tapes_in_board_m:
            in_rover = rover_from_station[p.setup].points(p.position_m)
            tapes.setdefault((p.setup, p.placement), {})[p.point] = in_rover
    for board, points in tapes.items():
        if len(points) < 3:
            continue
        drawn = [survey.board.tapes_in_board_m[name] for name in points]
        where = f"of placement {board[1]} (set-up {board[0]})"
        try:
            pose = align(
                drawn, list(points.values()), survey.sigma.station_m, list(points), false_alarm=GROSS
            )
        except NotAligned as error:
            raise NotAligned(f"the tapes {where}: {error}") from None
        found[board] = pose.b_from_a
        blunders += _blunders("tape", pose, survey.sigma.station_m, where)
        if pose.doubt:
            bent.add(board)
            notes.append(f"the tapes {where} do not agree with the board's: {pose.doubt}")
    return found, bent


def _blunders(kind: Literal["prism", "tape"], pose: Alignment, sigma_m: float, where: str) -> list[Outlier]:
    """The points that an alignment left out."""
    found = []
    for name in pose.rejected:
        off = float(np.linalg.norm(pose.residuals_m[pose.names.index(name)]))
        limit = float(chi2.isf(GROSS, 3))
        found.append(Outlier(kind, f"{kind} {name} {where}", (off / sigma_m) ** 2, limit, off))
    return found
