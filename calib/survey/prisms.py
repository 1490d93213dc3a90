"""Better places of the prisms than the drawing's, from several set-ups (paper section III.B).

"If the CAD model of the prism positions is inaccurate, it needs to be refined iteratively at different total
station locations": here all set-ups and the drawing are one least-squares problem, a generalised Procrustes
alignment with the drawing as prior. The drawing also defines the rover frame, by the mean of its prisms.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from scipy.stats import chi2 as chi_square

from calib.rigid import FloatArray, Rigid, moved_rigid, rigid_rates
from calib.survey import Survey
from calib.survey.alignment import FALSE_ALARM, NotAligned, align

STEPS = 50
"""Gauss-Newton steps at most; three or four do from the aligned start, more where a prism is off."""

ENOUGH = 1e-7
"""A step of less, metres and radians, is none."""


@dataclass(frozen=True, eq=False)
class AdjustedPrisms:
    """Where the prisms are on the rover.

    Attributes
    ----------
    names, places_in_rover_m
        The prisms and (n, 3) their places, metres.
    covariance
        (3n, 3n) of the places, metres squared. Where the whole set stands is known no better than the
        drawing says, however many set-ups there are.
    rover_from_station
        The pose of every set-up.
    rejected
        Measurements left out: set-up and prism, or None and prism where the set-ups agree with each other
        on another place than the drawing's.
    doubt
        '' if what was used agrees; else a sentence.
    chi2, degrees_of_freedom
        Of what was used.
    """

    names: tuple[str, ...]
    places_in_rover_m: FloatArray
    covariance: FloatArray
    rover_from_station: Mapping[str, Rigid]
    rejected: tuple[tuple[str | None, str], ...]
    doubt: str
    chi2: float
    degrees_of_freedom: int


@dataclass(frozen=True, eq=False)
class _PrismFit:
    places_m: FloatArray
    covariance: FloatArray
    poses: dict[str, Rigid]
    chi2: float
    freedom: int
    settled: bool


Seen = dict[str, dict[int, FloatArray]]
"""Set-up to prism's index to its place in the station frame."""


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
    names = tuple(survey.prisms_in_rover_m)
    drawing = np.array([survey.prisms_in_rover_m[name] for name in names])
    seen: Seen = {point.setup: {} for point in survey.station}
    for point in survey.station:
        if point.kind == "prism" and point.point in names:
            seen[point.setup][names.index(point.point)] = point.position_m
    for setup, points in seen.items():
        if len(points) < 3:
            raise NotAligned(f"set-up {setup}: {len(points)} prisms where at least three are expected")
    drawn = np.ones(len(names), dtype=bool)
    sigmas = survey.sigma.station_m, survey.sigma.prism_cad_m
    fit = _fit(drawing, drawn, seen, *sigmas)
    rejected: list[tuple[str | None, str]] = []
    while fit.chi2 > _limit(fit.freedom, false_alarm):
        found = _culprit(drawing, drawn, seen, sigmas, fit.chi2, false_alarm)
        if found is None:
            break
        rejected.append((found[0], names[found[1]]))
        drawn, seen = _without(drawn, seen, *found)
        fit = _fit(drawing, drawn, seen, *sigmas)
    if not fit.settled:
        raise NotAligned(
            f"the prisms' places did not settle in {STEPS} steps: the set-ups stand too differently from the "
            "drawing; check the prisms' names and places"
        )
    doubt = ""
    if fit.chi2 > _limit(fit.freedom, false_alarm):
        rms = np.sqrt(fit.chi2 / fit.freedom)
        doubt = f"the set-ups and the drawing of the prisms disagree by {rms:.1f} times their sigmas"
    return AdjustedPrisms(
        names, fit.places_m, fit.covariance, fit.poses, tuple(rejected), doubt, fit.chi2, fit.freedom
    )


def _limit(freedom: int, false_alarm: float) -> float:
    return float(chi_square.isf(false_alarm, freedom))


def _without(drawn: np.ndarray, seen: Seen, setup: str | None, index: int) -> tuple[np.ndarray, Seen]:
    """The measurements without one of them: a prism in a set-up, or in the drawing (None)."""
    if setup is None:
        drawn = drawn.copy()
        drawn[index] = False
        return drawn, seen
    points = {i: place for i, place in seen[setup].items() if i != index}
    return drawn, {**seen, setup: points}


def _culprit(
    drawing: FloatArray,
    drawn: np.ndarray,
    seen: Seen,
    sigmas: tuple[float, float],
    now: float,
    false_alarm: float,
) -> tuple[str | None, int] | None:
    """The measurement whose leaving helps by far the most; None if two would do about as well."""
    left: list[tuple[float, str | None, int]] = []
    candidates: list[tuple[str | None, int]] = [
        (setup, i) for setup, points in seen.items() if len(points) > 3 for i in points
    ]
    if drawn.sum() > 3:
        candidates += [(None, int(i)) for i in np.flatnonzero(drawn) if any(i in p for p in seen.values())]
    for setup, index in candidates:
        fit = _fit(drawing, *_without(drawn, seen, setup, index), *sigmas)
        left.append((fit.chi2, setup, index))
    left.sort(key=lambda entry: entry[0])
    clear = _limit(3, false_alarm)
    if len(left) < 2 or now - left[0][0] < clear or left[1][0] - left[0][0] < _limit(1, false_alarm):
        return None
    return left[0][1], left[0][2]


def _fit(drawing: FloatArray, drawn: np.ndarray, seen: Seen, station_m: float, cad_m: float) -> _PrismFit:
    """Gauss-Newton on places and poses together; residuals are taken in the rover frame."""
    places: FloatArray = drawing.copy()
    poses = {
        setup: align(
            list(points.values()),
            drawing[list(points)],
            float(np.hypot(station_m, cad_m)),
            [str(i) for i in points],
        ).b_from_a
        for setup, points in seen.items()
    }
    size = places.size + 6 * len(poses)
    settled = False
    for _ in range(STEPS):
        normal, gradient, total, count = np.zeros((size, size)), np.zeros(size), 0.0, 0
        for index in map(int, np.flatnonzero(drawn)):
            part = slice(3 * index, 3 * index + 3)
            residual = (places[index] - drawing[index]) / cad_m
            normal[part, part] += np.eye(3) / cad_m**2
            gradient[part] += residual / cad_m
            total, count = total + float(residual @ residual), count + 3
        for number, (setup, points) in enumerate(seen.items()):
            at = places.size + 6 * number
            for index, position in points.items():
                at_rover = poses[setup].points(position)
                residual = (at_rover - places[index]) / station_m
                rates = np.zeros((3, size))
                follows = rigid_rates(np.eye(3)[None], at_rover[None], poses[setup].translation_m)[0]
                rates[:, at : at + 6] = follows / station_m
                rates[:, 3 * index : 3 * index + 3] = -np.eye(3) / station_m
                normal += rates.T @ rates
                gradient += rates.T @ residual
                total, count = total + float(residual @ residual), count + 3
        step = -np.asarray(np.linalg.solve(normal, gradient), dtype=np.float64)
        places = places + step[: places.size].reshape(-1, 3)
        for number, setup in enumerate(seen):
            at = places.size + 6 * number
            poses[setup] = moved_rigid(poses[setup], step[at : at + 6])
        settled = float(np.abs(step).max()) < ENOUGH
        if settled:
            break
    covariance = np.asarray(np.linalg.inv(normal), dtype=np.float64)[: places.size, : places.size]
    return _PrismFit(places, covariance, poses, total, count - size, settled)
