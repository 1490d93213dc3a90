"""What goes wrong in surveys, on demand: each function returns the survey with one mistake in it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike

from calib.survey import Dots, StationPoint, Survey
from calib.survey.records import StationKind


def with_moved_tape(survey: Survey, setup: str, placement: str, tape: str, shift_m: ArrayLike) -> Survey:
    """Return the survey with a tape measured ``shift_m`` (3,) aside, station frame.

    Raises
    ------
    KeyError
        If the survey has no such point.
    """
    return _moved(survey, (setup, "tape", placement, tape), shift_m)


def with_wrong_prism(survey: Survey, setup: str, prism: str, shift_m: ArrayLike) -> Survey:
    """Return the survey with a prism measured ``shift_m`` (3,) aside. Raises KeyError as above."""
    return _moved(survey, (setup, "prism", "", prism), shift_m)


def with_swapped_boards(survey: Survey, setup: str, placement: str, other: str) -> Survey:
    """Return the survey with the tapes of two placements written down under each other's names.

    Raises
    ------
    KeyError
        If the set-up has no such placements.
    """
    names = {placement: other, other: placement}
    for name in names:
        if not any(p.kind == "tape" and (p.setup, p.placement) == (setup, name) for p in survey.station):
            raise KeyError(f"no tapes of placement {name} in set-up {setup}")
    station = tuple(
        replace(p, placement=names.get(p.placement, p.placement)) if p.setup == setup else p
        for p in survey.station
    )
    return replace(survey, station=station)


def with_outlier_dots(
    survey: Survey, image: str, count: int, distance_px: float, rng: np.random.Generator
) -> tuple[Survey, tuple[tuple[int, int], ...]]:
    """Return the survey with dots of an image found ``distance_px`` aside in any direction, and which.

    Parameters
    ----------
    count
        How many different dots; the returned pairs are their (row, column).

    Raises
    ------
    KeyError
        If the image has no dots.
    ValueError
        If it has fewer.
    """
    dots = survey.dots[image]
    chosen = rng.choice(len(dots.rows), count, replace=False)
    angle = rng.uniform(-np.pi, np.pi, count)
    pixels = dots.pixels_px.copy()
    pixels[chosen] += distance_px * np.column_stack([np.cos(angle), np.sin(angle)])
    changed: Mapping[str, Dots] = {**survey.dots, image: replace(dots, pixels_px=pixels)}
    places = tuple((int(dots.rows[i]), int(dots.columns[i])) for i in chosen)
    return replace(survey, dots=changed), places


def _moved(survey: Survey, key: tuple[str, StationKind, str, str], shift_m: ArrayLike) -> Survey:
    """The survey with one point of the station moved."""
    found = [p for p in survey.station if (p.setup, p.kind, p.placement, p.point) == key]
    if not found:
        raise KeyError(f"no {key[1]} {key[3]} in set-up {key[0]} {key[2]}".rstrip())

    def place(point: StationPoint) -> StationPoint:
        moved = point.position_m + np.asarray(shift_m, dtype=np.float64)
        return replace(point, position_m=moved) if point is found[0] else point

    return replace(survey, station=tuple(map(place, survey.station)))
