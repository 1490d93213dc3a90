"""Where a ray that is fixed to the head can be brought: its meetings with a target, as points of the arm.

Letters: p target in the mast frame (x, y, z), rho its distance from the pan axis; a, k axis offset and twist
of the mast; u the target in the *arm* frame, which is the mast frame turned with the pan axis; w = c + s d
the target in the head frame, s > 0 the range along the ray. The kinematics of calib.geometry.rig say

    u = a x̂ + Rot(x,k) Rot(y,tilt) w     and     p = Rot(z,pan) u

and three lengths that no joint changes fix everything else:

    u_z = z,    u_x² + u_y² = rho²,    w_y = u_y cos k + z sin k,    |w|² = rho² + z² + a² - 2 a u_x.

For a = 0 the last is a quadratic in s, the paper's eq. (25). For a ≠ 0 they make a quartic.
docs/explanation/pointing.md has the derivation.

Roots of the quartic are bracketed by the turning points of its derivatives, so that none is lost: between
neighbouring ones a polynomial is monotonic. The leading coefficients may be as small as they like: nothing is
divided by them, unlike with companion matrices or Ferrari's formula.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise

from calib.errors import Unreachable

EDGE = 1e-12
"""A miss up to this part of the target's distance is rounding: the target is then on the edge of reach."""


@dataclass(frozen=True)
class Arm:
    """A mast's axis offset a, sin k and cos k, and a ray c + s d in its head frame, as plain floats."""

    a: float
    sin_k: float
    cos_k: float
    c: tuple[float, float, float]
    d: tuple[float, float, float]

    @cached_property
    def along(self) -> float:
        """c·d."""
        return sum(c * d for c, d in zip(self.c, self.d, strict=True))

    @cached_property
    def miss2(self) -> float:
        """The squared distance at which the ray's line passes the head's origin."""
        (cx, cy, cz), (dx, dy, dz) = self.c, self.d
        x, y, z = cy * dz - cz * dy, cz * dx - cx * dz, cx * dy - cy * dx
        return x * x + y * y + z * z

    def points(self, rho: float, z: float) -> Iterator[tuple[float, float, float]]:
        """Yield (u_x, u_y, s) of every solution, s > 0; duplicates may come."""
        # sigma = s + c·d runs along the ray from its point nearest the head's origin: |w|² = miss2 + sigma².
        # Offsets below this are nothing (2e-13 rad at half a metre) and would underflow in the quartic.
        a = self.a if abs(self.a) >= 1e-13 else 0.0
        reach2 = rho * rho + z * z + a * a - self.miss2
        slack = EDGE * math.hypot(rho, z)
        # u_y = y_0 + y_1 sigma, from w_y = u_y cos k + z sin k
        y_1 = self.d[1] / self.cos_k
        y_0 = (self.c[1] - self.along * self.d[1] - z * self.sin_k) / self.cos_k
        # sigma² = reach2 - 2 a u_x, so u_x within ±rho bounds sigma. With sigma = b + a t and b² = reach2
        # the quartic u_x² + u_y² = rho² stays well scaled however small a is, and is a quadratic for a = 0:
        #     u_x = excess/2 - b t - a t²/2,     excess = 0 (or reach2/a with b = 0 where reach2 < 0).
        widest = rho * (1.0 + 1e-9) + slack
        if reach2 + 2.0 * abs(a) * widest <= 0.0:
            return
        for sign in (1.0, -1.0):
            least2 = max(0.0, reach2 - 2.0 * abs(a) * widest)
            farthest = math.sqrt(reach2 + 2.0 * abs(a) * widest) if sign > 0.0 else -math.sqrt(least2)
            if farthest <= self.along:
                continue
            b = sign * math.sqrt(reach2) if reach2 > 0.0 else 0.0
            excess = 0.0 if reach2 > 0.0 else reach2 / a
            ends = []
            for u_x in (widest, -widest):
                sigma2 = reach2 - 2.0 * a * u_x
                if sigma2 <= 0.0:
                    ends.append(-b / a)
                elif b != 0.0:
                    ends.append(-2.0 * u_x / (sign * math.sqrt(sigma2) + b))
                else:
                    ends.append(sign * math.sqrt(sigma2) / a)
            u_y0 = y_0 + y_1 * b
            u_y1 = y_1 * a
            quartic = (
                0.25 * a * a,
                a * b,
                b * b - 0.5 * a * excess + u_y1 * u_y1,
                2.0 * u_y0 * u_y1 - b * excess,
                0.25 * excess * excess + (u_y0 - rho) * (u_y0 + rho),
            )
            for t in roots_between(quartic, min(ends), max(ends), touching=slack * (2.0 * rho + slack)):
                s = b + a * t - self.along
                if s > 0.0:
                    yield 0.5 * excess - t * (b + 0.5 * a * t), u_y0 + u_y1 * t, s

    def why_not(self, rho: float, z: float) -> Unreachable:
        """Return the refusal for a target that no pan and tilt bring onto the ray."""
        # The tilt axis turns about (a, 0, 0) of the arm frame; |w| is the target's distance from there.
        farthest = math.hypot(rho + abs(self.a), z)
        nearest = math.sqrt(self.miss2) if self.along < 0.0 else math.hypot(*self.c)
        if farthest <= nearest:
            return Unreachable(
                "too_near",
                f"target is at most {farthest:.6g} m from the tilt axis centre, {nearest - farthest:.3g} m "
                f"nearer than this pixel's ray comes ({nearest:.6g} m)",
            )
        edge = self._edge_m(rho, z)
        side = "up" if z < 0.0 else "down"
        angle = math.atan2(rho, abs(z))
        place = f"target is {rho:.6g} m from the pan axis ({angle:.3g} rad from straight {side})"
        if edge is None:
            return Unreachable("blind_cone", f"{place}; at its height this pixel reaches no target at all")
        return Unreachable(
            "blind_cone",
            f"{place}, inside the blind cone by {edge - rho:.3g} m: at its height this pixel reaches targets "
            f"from {edge:.6g} m on",
        )

    def _edge_m(self, rho: float, z: float) -> float | None:
        """Return the distance from the pan axis, beyond rho, from which targets at height z are reached."""

        def reached(distance: float) -> bool:
            return any(True for _ in self.points(distance, z))

        size = math.hypot(rho, z, self.a)
        inside, outside = rho, max(2.0 * rho, 1e-3 * size)
        while not reached(outside):
            inside, outside = outside, 2.0 * outside
            # So far from the target's distance there is no edge of reach.
            if outside > 1e4 * size:
                return None
        while outside - inside > 1e-12 * outside:
            middle = 0.5 * (inside + outside)
            if middle in (inside, outside):
                break
            inside, outside = (inside, middle) if reached(middle) else (middle, outside)
        return outside


def roots_between(
    coefficients: Sequence[float], low: float, high: float, touching: float = 0.0
) -> list[float]:
    """Return the real roots of a polynomial in [low, high], in rising order.

    ``coefficients`` has the highest power first; leading ones may be zero. A minimum inside the interval with
    a value in (0, touching] is a (double) root: the two roots there are lost to rounding alone.

    Examples
    --------
    >>> roots_between((0.0, 0.0, 1.0, 0.0, -4.0), -3.0, 3.0)
    [-2.0, 2.0]
    """
    if len(coefficients) == 1:
        return []
    degree = len(coefficients) - 1
    slope = [(degree - i) * c for i, c in enumerate(coefficients[:-1])]
    turns = roots_between(slope, low, high)
    roots = [turn for turn in turns if 0.0 < _value(coefficients, turn) <= touching]
    ends = [low, *turns, high]
    for start, end in pairwise(ends):
        at_start, at_end = _value(coefficients, start), _value(coefficients, end)
        if (at_start <= 0.0) != (at_end <= 0.0):
            roots.append(_bracketed(coefficients, slope, start, end, at_start <= 0.0))
    return sorted(roots)


def _bracketed(
    coefficients: Sequence[float], slope: Sequence[float], low: float, high: float, rising: bool
) -> float:
    """Return the root in [low, high] by Newton's steps from the steeper end, or by halving."""
    t = low if abs(_value(slope, low)) > abs(_value(slope, high)) else high
    last = high - low
    enough = 1e-16 * max(abs(low), abs(high))
    for _ in range(200):
        value, rate = _value(coefficients, t), _value(slope, t)
        if value == 0.0:
            return t
        low, high = (t, high) if (value < 0.0) == rising else (low, t)
        step = -value / rate if rate != 0.0 else math.inf
        # A step that leaves the bracket, or shrinks too slowly for Newton, is replaced by halving.
        steps_well = low <= t + step <= high and abs(step) <= 0.75 * last
        after = t + step if steps_well else 0.5 * (low + high)
        last = abs(after - t)
        if last <= enough:
            return after
        t = after
    return t


def _value(coefficients: Sequence[float], t: float) -> float:
    value = 0.0
    for coefficient in coefficients:
        value = value * t + coefficient
    return value
