"""Gross measurements: which are too far off beside the others, and which goes first where one hides another.

Sizes are compared with the typical one, since stated sigmas may be too small: the median of many is not moved
by a few blunders. Where a fit is moved by them, the worst is left out alone and the fit is done again.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike

from calib.geometry.rigid import FloatArray
from calib.geometry.significance import typical_scale

GROSS = 6.0
"""What is so many times farther off than the typical one, or than expected, is a blunder, and no noise."""

MANY = 0.25
"""With more than this part of an image's dots beyond their limit, it is not the dots that are wrong."""


def gross_limit(sizes: ArrayLike, expected: float = 0.0) -> float:
    """Return beyond what sizes (n,) are gross; no typical one counts as less than ``expected``."""
    return GROSS * max(float(np.median(np.asarray(sizes, dtype=np.float64))), expected)


def chance_limit(level: float, count: int, freedom: int = 2) -> float:
    """Return what one of ``count`` chi-squares exceeds with the chance ``level``."""
    from scipy.special import chdtri  # slow to load, and a daemon that starts does not need it

    return float(chdtri(freedom, level / max(count, 1)))


def at_least_stated(squares: FloatArray, freedom: int = 2) -> float:
    """Return by how much typical chi-squares (n,) are larger than chance makes them, at least 1."""
    return max(1.0, typical_scale(squares, freedom))


def bounded(lengths: FloatArray, limit: ArrayLike) -> FloatArray:
    """Return the weights (n,) of squares whose pull no longer grows from a length of ``limit`` on (Huber)."""
    return np.asarray(np.minimum(1.0, limit / np.maximum(lengths, 1e-300)))


def worst_first(keep: np.ndarray, ratios: Callable[[np.ndarray], FloatArray], most_out: float) -> np.ndarray:
    """Return which measurements (n,) agree.

    Parameters
    ----------
    keep
        (n,) those to begin with.
    ratios
        Of statistics to their limits (n,) when some are kept, by a fit to these. The worst beyond 1 goes
        alone, and what passes comes back.
    most_out
        Part of them that may be left out; with more, it ends.
    """
    for _ in range(len(keep)):
        if np.mean(~keep) > most_out:
            break
        found = ratios(keep)
        failing = keep & (found > 1.0)
        new = keep | (found <= 1.0)
        if failing.any():
            new[np.argmax(np.where(failing, found, 0.0))] = False
        if (new == keep).all():
            break
        keep = new
    return keep
