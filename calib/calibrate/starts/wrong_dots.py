"""Finds dots that are not where the rest of their image says, without a camera.

Over one board, pixels are a smooth function of the place on it, whatever the lens and the board's pose: a
polynomial of the fourth degree is good to some hundredths of a pixel. What is left of a dot is its own
noise, and its square in sigmas chi-square with two degrees of freedom. This is the test for fits that
take boards as exact: there the station's error moves all dots of an image, and would hide a wrong one. Every
start does (``calib.calibrate.starts.survey``).
"""

from __future__ import annotations

import numpy as np

from calib.adjust.gross import MANY, at_least_stated, chance_limit
from calib.adjust.outliers import Outlier
from calib.adjust.scatter import off_smooth
from calib.geometry.rigid import FloatArray
from calib.geometry.significance import Level
from calib.survey.records import Survey
from calib.targets.boards import Dots

DEGREES = ((60, 4), (30, 3))
"""Fewest dots for a polynomial of that degree."""

FEWER = ((16, 2),)
"""The same for a small or partly seen board, where only gross errors are looked for; with still fewer dots
nothing is tested."""

FAR = 100.0
"""A square beyond so many times the typical one is gross where nothing finer is tested: ten sigma."""

POLYNOMIAL_PX = 0.08
"""What a polynomial of the fourth degree may miss, at the corners of a near board in a wide lens."""


def wrong_dots(survey: Survey) -> tuple[dict[str, np.ndarray], tuple[Outlier, ...]]:
    """Return by image which dots (n,) disagree with the rest of it (where any do), and these by name.

    Check images are tested as well: nothing is fitted here but a polynomial. Where the typical dot is farther
    off than its stated sigma, the limit is wider by as much.
    """
    tested = {}
    for image in survey.images:
        dots = survey.dots.get(image.name)
        degree = 0 if dots is None else _degree(len(dots.rows))
        if dots is not None and degree:
            tested[image.name] = _test(survey, dots, degree)
    every = [statistic for statistic, _ in tested.values() if len(statistic) >= DEGREES[-1][0]]
    fine = 0.0
    if every:
        squares = np.concatenate(every)
        fine = chance_limit(Level.MEASUREMENT, len(squares)) * at_least_stated(squares)
    wrong, outliers = dict[str, np.ndarray](), list[Outlier]()
    for name, (statistic, off_px) in tested.items():
        limit = fine if len(statistic) >= DEGREES[-1][0] else FAR * at_least_stated(statistic)
        bad = statistic > limit
        if not bad.any() or bad.mean() > MANY:
            continue
        dots, wrong[name] = survey.dots[name], bad
        for i in np.flatnonzero(bad):
            where = f"image {name} dot (row {dots.rows[i]}, column {dots.columns[i]})"
            outliers.append(Outlier("dot", where, float(statistic[i]), limit, float(off_px[i])))
    return wrong, tuple(outliers)


def _test(survey: Survey, dots: Dots, degree: int) -> tuple[FloatArray, FloatArray]:
    """The statistic of each dot (n,), and how far it is (n,), pixels, from where the others say."""
    sigma = np.full(len(dots.rows), survey.sigma.dot_px) if dots.sigma_px is None else dots.sigma_px
    places = survey.board.dots_in_board_m(dots.rows, dots.columns)[:, :2] / survey.board.spacing_m / 5
    return off_smooth(places, dots.pixels_px, np.hypot(sigma, POLYNOMIAL_PX), degree)


def wrong_points(places_m: FloatArray, pixels_px: FloatArray, sigma_px: FloatArray) -> np.ndarray:
    """Return which points (n,) of one image are grossly off where the rest of a flat board says.

    None where there are too few. ``places_m`` (n, 2) on the board; it may be partly seen.
    """
    degree = _degree(len(places_m))
    if not degree:
        return np.zeros(len(places_m), dtype=bool)
    middle = places_m.mean(axis=0)
    scale = max(float(np.abs(places_m - middle).max()), 1e-9)
    sigma = np.hypot(sigma_px, POLYNOMIAL_PX)
    statistic, _ = off_smooth((places_m - middle) / scale, pixels_px, sigma, degree)
    return np.asarray(statistic > FAR * at_least_stated(statistic))


def _degree(dots: int) -> int:
    """Of the polynomial for so many dots; 0 if they are too few."""
    return next((degree for fewest, degree in (*DEGREES, *FEWER) if dots >= fewest), 0)
