"""Gross measurements: which are too far off beside the others.

Sizes are compared with the typical one, since stated sigmas may be too small: the median of many is not moved
by a few blunders.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from calib.geometry.rigid import FloatArray
from calib.geometry.significance import typical_scale

GROSS = 6.0
"""What is so many times farther off than the typical one, or than expected, is a blunder, and no noise."""

MANY = 0.25
"""With more than this part of an image's dots beyond their limit, it is not the dots that are wrong."""


@dataclass(frozen=True, eq=False)
class Outlier:
    """A measurement that was not used, and how far off it is.

    ``size`` is in pixels (rms over an image, in the worst camera of a hand-off, across the epipolar line of
    its clicks) or metres; not-a-number for an image whose board, as it is named, the camera cannot see.
    """

    kind: Literal["dot", "image", "tape", "prism", "hand-off", "clicks"]
    name: str
    size: float

    @property
    def sentence(self) -> str:
        """The outlier for a person."""
        if not np.isfinite(self.size):
            return f"{self.name} cannot show the board that it names and was not used"
        if self.kind == "clicks":
            return (
                f"{self.name} was not used: its two clicks do not mean one point, they are {self.size:.1f} "
                "px apart across the epipolar line"
            )
        if self.kind == "hand-off":
            return f"{self.name} is off by {self.size:.1f} px after the correction and was not used"
        off = f"{self.size:.2f} px" if self.kind in ("dot", "image") else f"{1000 * self.size:.1f} mm"
        return f"{self.name} is off by {off} and was not used"


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
