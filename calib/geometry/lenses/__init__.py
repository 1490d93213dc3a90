"""What all lenses share: from points in the lens frame to slopes, and from slopes to rays.

A lens has ``bend`` and ``unbend`` (with derivatives if wanted), ``coefficient_rates`` in the order of a
camera's step, ``curved`` (slopes follow the angle, so a ray may be at a right angle to the axis and more),
``moving`` (so does the entrance point), ``limit_rad`` (up to where it reaches in every direction) and
``limit_reason`` (where it ends, as the end of a sentence; empty if that is where its family ends).

The lens frame has its origin at C. A point (a, b, w) of it is seen at the *slopes* (u, v), those of the
straight ray that a pinhole would need to land on the same pixel. `calib.geometry.projection` makes pixels of
slopes. Callers cut their points into chunks that fit the cache and silence numpy's floating-point warnings;
rows without a result come back with ``valid`` False and any number at all.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from calib.geometry.rigid import FloatArray

TINY = 1e-150
"""Stands for zero in divisions by a distance from the axis: its square is still a number."""

SETTLED = 1e-8
"""Newton stops after a step below this; it doubles its digits, so the result is good to rounding."""


class Bent(NamedTuple):
    """Slopes (2, n) at which a lens shows points, which it reaches (n,), and d slope / d point (2, 3, n)."""

    slopes: FloatArray
    valid: np.ndarray
    rates: FloatArray | None = None


class Unbent(NamedTuple):
    """Unit directions (3, n) that land on slopes, which exist (n,), and d direction / d slope (3, 2, n).

    Where the entrance point moves, rays begin at C + ``shift_m`` (n,) along z; d shift / d slope is (2, n).
    """

    directions: FloatArray
    valid: np.ndarray
    rates: FloatArray | None = None
    shift_m: FloatArray | None = None
    shift_rates: FloatArray | None = None


def polynomial(coefficients: tuple[float, ...], y: FloatArray) -> FloatArray:
    """Return c0 + c1 y + c2 y^2 + ... in place of few temporary arrays."""
    *lower, before, last = coefficients
    value = y * last
    value += before
    for coefficient in reversed(lower):
        value *= y
        value += coefficient
    return value


def first_root(coefficients: tuple[float, ...]) -> float:
    """Return the smallest real root above zero of c0 + c1 y + ..., c0 > 0; infinite if there is none."""
    if all(coefficient >= 0.0 for coefficient in coefficients[1:]):
        return np.inf
    scaled = np.array(coefficients) / max(map(abs, coefficients))
    inverse = np.roots(scaled)  # of 1 / y, whose leading coefficient is no rounded zero
    real = inverse.real[(np.abs(inverse.imag) <= 1e-9 * np.abs(inverse)) & (inverse.real > 0.0)]
    return float(1.0 / real.max(initial=0.0)) if len(real) else np.inf
