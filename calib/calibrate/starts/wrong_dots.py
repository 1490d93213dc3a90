"""Finds dots that are not where the rest of their image says, without a camera.

Over one board, pixels are a smooth function of the place on it, whatever the lens and the board's pose: a
polynomial of the fourth degree is good to some hundredths of a pixel. What is left of a dot is its own
noise, and its square in sigmas chi-square with two degrees of freedom. This is the test for fits that
take boards as exact: there the station's error moves all dots of an image, and would hide a wrong one. Every
start does it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from calib.adjust.gross import MANY, at_least_stated
from calib.adjust.outliers import Outlier
from calib.adjust.scatter import off_smooth
from calib.adjust.terms import ImageTerm

DEGREES = ((60, 4, 6.0), (30, 3, 6.0), (16, 2, 10.0))
"""Fewest dots for a polynomial of that degree, and how many times farther off than the typical one a dot is
gross then; of fewer nothing is tested."""

POLYNOMIAL_PX = 0.08
"""What a polynomial of the fourth degree may miss, at the corners of a near board in a wide lens."""


def wrong_dots(images: Sequence[ImageTerm]) -> tuple[dict[str, np.ndarray], tuple[Outlier, ...]]:
    """Return by image which dots (n,) disagree with the rest of it (where any do), and these by name.

    Where an image's typical dot is farther off than its sigma, its limit is wider by as much. Where too many
    are beyond it, it is not the dots that are wrong.
    """
    wrong, outliers = dict[str, np.ndarray](), list[Outlier]()
    for image in images:
        found = next((rest for fewest, *rest in DEGREES if len(image.keep) >= fewest), None)
        if found is None:
            continue
        degree, gross = found
        sigma_px = np.hypot(image.sigma_px, POLYNOMIAL_PX)
        statistic, off_px = off_smooth(image.in_board_m[:, :2], image.pixels_px, sigma_px, int(degree))
        limit = gross**2 * at_least_stated(statistic)
        bad = np.asarray(statistic > limit)
        if bad.any() and bad.mean() <= MANY:
            wrong[image.name] = bad
            for i in np.flatnonzero(bad):
                name = f"image {image.name} {image.part(int(i))}"
                outliers.append(Outlier("dot", name, float(statistic[i]), limit, float(off_px[i])))
    return wrong, tuple(outliers)


def without_wrong(image: ImageTerm, wrong: dict[str, np.ndarray]) -> ImageTerm:
    """Return an image of which wrong dots do not count."""
    return replace(image, keep=image.keep & ~wrong[image.name]) if image.name in wrong else image
