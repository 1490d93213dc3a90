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
from functools import lru_cache

from calib.errors import Unreachable
from calib.geometry.rig import Mast

EDGE = 1e-12
"""A miss up to this part of the target's distance is rounding: the target counts as on the edge of reach."""

_NO_OFFSET_M = 1e-13
"""Axis offsets below this are nothing (2e-13 rad at half a metre) and would underflow in the quartic."""

_FAR_OUT = 1e4
"""The search for the edge of reach ends at this many times the target's distance: there is none."""

Triple = tuple[float, float, float]


@dataclass(frozen=True, slots=True)
class Axes:
    """A mast as plain floats: rows of the rotation rover_from_mast, its translation, a, sin k and cos k."""

    rows: tuple[Triple, Triple, Triple]
    translation: Triple
    a: float
    sin_k: float
    cos_k: float


@dataclass(frozen=True, slots=True)
class Ray:
    """A ray in the head frame with c·d and the squared distance at which its line passes the origin."""

    c: Triple
    d: Triple
    along: float
    miss2: float


@lru_cache(maxsize=64)
def axes_of(mast: Mast) -> Axes:
    rotation = mast.rover_from_mast.rotation.tolist()
    k = mast.axis_twist_rad
    a = mast.axis_offset_m if abs(mast.axis_offset_m) >= _NO_OFFSET_M else 0.0
    return Axes(
        (tuple(rotation[0]), tuple(rotation[1]), tuple(rotation[2])),
        tuple(mast.translation_m.tolist()),
        float(a),
        math.sin(k),
        math.cos(k),
    )


def ray_of(origin_m: Sequence[float], direction: Sequence[float]) -> Ray:
    cx, cy, cz = origin_m
    dx, dy, dz = direction
    miss = (cy * dz - cz * dy, cz * dx - cx * dz, cx * dy - cy * dx)
    return Ray(
        (cx, cy, cz),
        (dx, dy, dz),
        cx * dx + cy * dy + cz * dz,
        miss[0] * miss[0] + miss[1] * miss[1] + miss[2] * miss[2],
    )


def arm_points(axes: Axes, ray: Ray, rho: float, z: float) -> Iterator[tuple[float, float, float]]:
    """Yield (u_x, u_y, s) of every solution, s > 0; duplicates may come."""
    # sigma = s + c·d runs along the ray from its point nearest the head's origin: |w|² = miss2 + sigma².
    a = axes.a
    reach2 = rho * rho + z * z + a * a - ray.miss2
    slack = EDGE * math.hypot(rho, z)
    # u_y = y_0 + y_1 sigma, from w_y = u_y cos k + z sin k
    y_1 = ray.d[1] / axes.cos_k
    y_0 = (ray.c[1] - ray.along * ray.d[1] - z * axes.sin_k) / axes.cos_k
    if a == 0.0:
        if reach2 < 0.0:
            return
        root = math.sqrt(reach2)
        for sigma in (root, -root):
            s = sigma - ray.along
            u_y = y_0 + y_1 * sigma
            if s > 0.0 and abs(u_y) <= rho + slack:
                u_x = math.sqrt(max(0.0, (rho - u_y) * (rho + u_y)))
                yield u_x, u_y, s
                yield -u_x, u_y, s
        return

    # a ≠ 0: sigma² = reach2 - 2 a u_x, so u_x within ±rho bounds sigma. With sigma = b + a t, b² = reach2,
    # the quartic u_x² + u_y² = rho² stays well scaled however small a is:
    #     u_x = excess/2 - b t - a t²/2,     excess = 0 (or reach2/a with b = 0 where reach2 < 0).
    widest = rho * (1.0 + 1e-9) + slack
    if reach2 + 2.0 * abs(a) * widest <= 0.0:
        return
    for sign in (1.0, -1.0):
        least2 = max(0.0, reach2 - 2.0 * abs(a) * widest)
        farthest = math.sqrt(reach2 + 2.0 * abs(a) * widest) if sign > 0.0 else -math.sqrt(least2)
        if farthest <= ray.along:
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
            s = b + a * t - ray.along
            if s > 0.0:
                yield 0.5 * excess - t * (b + 0.5 * a * t), u_y0 + u_y1 * t, s


def why_not(axes: Axes, ray: Ray, rho: float, z: float, explain: bool) -> Unreachable:
    """Return the refusal for a target that no pan and tilt bring onto the ray."""
    # The tilt axis turns about its point (a, 0, 0) of the arm frame; |w| is the target's distance from there.
    farthest = math.hypot(rho + abs(axes.a), z)
    nearest = math.sqrt(ray.miss2) if ray.along < 0.0 else math.hypot(*ray.c)
    if farthest <= nearest:
        return Unreachable(
            "too_near",
            f"target is at most {farthest:.6g} m from the tilt axis centre, {nearest - farthest:.3g} m "
            f"nearer than this pixel's ray comes ({nearest:.6g} m)",
        )
    if not explain:
        return Unreachable("blind_cone", "target is too near the pan axis")
    edge = _reach_edge_m(axes, ray, rho, z)
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


def _reach_edge_m(axes: Axes, ray: Ray, rho: float, z: float) -> float | None:
    """Return the distance from the pan axis, beyond rho, from which targets at height z are reached."""

    def reached(distance: float) -> bool:
        return any(True for _ in arm_points(axes, ray, distance, z))

    inside, outside = rho, max(2.0 * rho, 1e-3 * math.hypot(rho, z))
    while not reached(outside):
        inside, outside = outside, 2.0 * outside
        if outside > _FAR_OUT * math.hypot(rho, z):
            return None
    while outside - inside > 1e-12 * outside:
        middle = 0.5 * (inside + outside)
        if middle in (inside, outside):
            break
        inside, outside = (inside, middle) if reached(middle) else (middle, outside)
    return outside


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
