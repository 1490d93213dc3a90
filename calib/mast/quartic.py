"""Real roots of a quartic within an interval, none lost, by the turning points of its derivatives.

Between neighbouring turning points a polynomial is monotonic, so a change of sign there brackets exactly one
root, which Newton's steps kept inside the bracket then find to rounding. The leading coefficients may be as
small as they like: nothing is divided by them, unlike with companion matrices or Ferrari's formula.
"""

from __future__ import annotations

import math

Quartic = tuple[float, float, float, float, float]


def roots_between(quartic: Quartic, low: float, high: float, touching: float = 0.0) -> list[float]:
    """Return the real roots of a quartic in [low, high], in rising order.

    Parameters
    ----------
    quartic
        Coefficients, the highest power first; leading ones may be zero.
    low, high
        The interval, low <= high.
    touching
        A minimum inside the interval with a value in (0, touching] counts as a (double) root: the two roots
        there are lost to rounding alone.

    Examples
    --------
    >>> roots_between((0.0, 0.0, 1.0, 0.0, -4.0), -3.0, 3.0)
    [-2.0, 2.0]
    """
    c4, c3, c2, c1, _ = quartic
    slope = (0.0, 4.0 * c4, 3.0 * c3, 2.0 * c2, c1)
    bends = [t for t in _quadratic_roots(12.0 * c4, 6.0 * c3, 2.0 * c2) if low < t < high]
    turns = _between_knots(slope, [low, *bends, high])
    roots = _between_knots(quartic, [low, *turns, high])
    for turn in turns:
        if 0.0 < _value(quartic, turn)[0] <= touching:
            roots.append(turn)
            roots.sort()
    return roots


def _between_knots(coefficients: Quartic, knots: list[float]) -> list[float]:
    """Return one root for each pair of neighbouring knots between which the sign changes."""
    found: list[float] = []
    low = knots[0]
    at_low, slope_low = _value(coefficients, low)
    for high in knots[1:]:
        at_high, slope_high = _value(coefficients, high)
        if (at_low <= 0.0) != (at_high <= 0.0):
            start = low if abs(slope_low) > abs(slope_high) else high
            found.append(_bracketed(coefficients, low, high, at_low <= 0.0, start))
        low, at_low, slope_low = high, at_high, slope_high
    return found


def _bracketed(coefficients: Quartic, low: float, high: float, rising: bool, t: float) -> float:
    """Return the root in [low, high] by Newton's steps from t, halving where a step would leave it."""
    c4, c3, c2, c1, c0 = coefficients
    last = high - low
    enough = 1e-16 * max(abs(low), abs(high))
    for _ in range(200):
        value = (((c4 * t + c3) * t + c2) * t + c1) * t + c0
        if value == 0.0:
            return t
        if (value < 0.0) == rising:
            low = t
        else:
            high = t
        slope = ((4.0 * c4 * t + 3.0 * c3) * t + 2.0 * c2) * t + c1
        step = -value / slope if slope != 0.0 else math.inf
        # A step that leaves the bracket, or shrinks too slowly for Newton, is replaced by halving.
        steps_well = low <= t + step <= high and abs(step) <= 0.75 * last
        after = t + step if steps_well else 0.5 * (low + high)
        last = abs(after - t)
        if last <= enough:
            return after
        t = after
    return t


def _value(coefficients: Quartic, t: float) -> tuple[float, float]:
    c4, c3, c2, c1, c0 = coefficients
    return (
        (((c4 * t + c3) * t + c2) * t + c1) * t + c0,
        ((4.0 * c4 * t + 3.0 * c3) * t + 2.0 * c2) * t + c1,
    )


def _quadratic_roots(a: float, b: float, c: float) -> list[float]:
    """Return the real roots of a t² + b t + c in rising order, without cancellation; a may be zero."""
    square = b * b - 4.0 * a * c
    if square < 0.0:
        return []
    half = -0.5 * (b + math.copysign(math.sqrt(square), b))
    return sorted(top / bottom for top, bottom in ((half, a), (c, half)) if bottom != 0.0)
