"""Exact pointing: the joint angles that bring a target onto a chosen pixel of a head camera.

The pixel's ray (origin c, unit direction d, both in the head frame) comes from the camera model itself, so
lens distortion, a moving entrance point, oblique H and V and a principal point off centre are all exact, for
any pixel. The paper (section IV) turns the camera by a small rotation vector instead, eqs. (19)-(22).

Letters: p target in the mast frame (x, y, z), rho its distance from the pan axis; a, k axis offset and twist
of the mast; u the target in the *arm* frame, which is the mast frame turned with the pan axis; w = c + s d
the target in the head frame, s > 0 the range along the ray. The kinematics of calib.mast.rig say

    u = a x̂ + Rot(x,k) Rot(y,tilt) w     and     p = Rot(z,pan) u

and three lengths that no joint changes fix everything else:

    u_z = z,    u_x² + u_y² = rho²,    w_y = u_y cos k + z sin k,    |w|² = rho² + z² + a² - 2 a u_x.

For a = 0 the last is a quadratic in s, the paper's eq. (25). For a ≠ 0 they make a quartic. docs/pointing.md
has the derivation.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike, NDArray

from calib.camera.cahvor import CameraModel
from calib.errors import Unreachable
from calib.mast.quartic import roots_between
from calib.mast.rig import Mast
from calib.rigid import FloatArray, ReadOnlyArrays

_EDGE = 1e-12
"""A miss up to this part of the target's distance is rounding: the target counts as on the edge of reach."""

_SAME_RAD = 1e-7
"""Solutions closer than this are one: at the edge of reach two meet, good to the root of rounding."""

_PARALLEL = 1e-3
"""|cos k| below this: the axes are parallel to a milliradian, and the mast is not a pan/tilt head."""

_NO_OFFSET_M = 1e-13
"""Axis offsets below this are nothing (2e-13 rad at half a metre) and would underflow in the quartic."""

_FAR_OUT = 1e4
"""The search for the edge of reach ends at this many times the target's distance: there is none."""

_FARTHEST_M = 1e9
"""Coordinates from here on are taken for a mistake; their squares would overflow in the end."""

_MOST = 4
"""Pairs of joint angles that a target can have: as many as the quartic has roots."""

Triple = tuple[float, float, float]


@dataclass(frozen=True, slots=True)
class Solution:
    """Joint angles that put the target on the pixel.

    Attributes
    ----------
    pan_rad, tilt_rad
        In (-π, π] from ``solve``; ``choose`` may return them a whole turn away.
    range_m
        From the ray's origin (the camera's C, or its moved entrance point) to the target.
    """

    pan_rad: float
    tilt_rad: float
    range_m: float


@dataclass(frozen=True, eq=False)
class Solutions(ReadOnlyArrays):
    """Joint angles of many targets, by `solve` on arrays; read-only.

    Attributes
    ----------
    pan_rad, tilt_rad, range_m
        (..., 4) as those of `Solution`, the best first; a target that has fewer solutions, or none, is filled
        up with not-a-number. So ``pan_rad[..., 0]`` is the best pan of every target.
    refused
        (...) of text: empty where there is a solution, else the code of `calib.errors.Unreachable`
        (``blind_cone``, ``too_near``, ``bad_target``, ``bad_pixel``). The target by itself says by how much.
    """

    pan_rad: FloatArray
    tilt_rad: FloatArray
    range_m: FloatArray
    refused: NDArray[np.str_]

    def at(self, *index: int) -> list[Solution]:
        """Return the solutions of one target as `choose` takes them; none if it was refused."""
        if len(index) != self.refused.ndim:
            raise IndexError(f"{len(index)} indices where {self.refused.ndim} are expected")
        rows = (self.pan_rad[index].tolist(), self.tilt_rad[index].tolist(), self.range_m[index].tolist())
        return [Solution(*one) for one in zip(*rows, strict=True) if math.isfinite(one[2])]


@dataclass(frozen=True, slots=True)
class _Axes:
    """A mast as plain floats: rows of the rotation rover_from_mast, its translation, a, sin k and cos k."""

    rows: tuple[Triple, Triple, Triple]
    translation: Triple
    a: float
    sin_k: float
    cos_k: float


@dataclass(frozen=True, slots=True)
class _Ray:
    """A ray in the head frame with c·d and the squared distance at which its line passes the origin."""

    c: Triple
    d: Triple
    along: float
    miss2: float


@lru_cache(maxsize=64)
def _axes(mast: Mast) -> _Axes:
    rotation = mast.rover_from_mast.rotation.tolist()
    k = mast.axis_twist_rad
    a = mast.axis_offset_m if abs(mast.axis_offset_m) >= _NO_OFFSET_M else 0.0
    return _Axes(
        (tuple(rotation[0]), tuple(rotation[1]), tuple(rotation[2])),
        tuple(mast.translation_m.tolist()),
        float(a),
        math.sin(k),
        math.cos(k),
    )


def _ray(origin_m: Sequence[float], direction: Sequence[float]) -> _Ray:
    cx, cy, cz = origin_m
    dx, dy, dz = direction
    miss = (cy * dz - cz * dy, cz * dx - cx * dz, cx * dy - cy * dx)
    return _Ray(
        (cx, cy, cz),
        (dx, dy, dz),
        cx * dx + cy * dy + cz * dz,
        miss[0] * miss[0] + miss[1] * miss[1] + miss[2] * miss[2],
    )


@lru_cache(maxsize=256)
def _camera_ray(camera_in_head: CameraModel, x_px: float, y_px: float) -> _Ray:
    rays = camera_in_head.ray(np.array([x_px, y_px]))
    if not rays.valid:
        raise Unreachable(
            "bad_pixel", f"pixel ({x_px:g}, {y_px:g}) has no ray in this {camera_in_head.kind} camera"
        )
    return _ray(rays.origins_m.tolist(), rays.directions.tolist())


def solve(
    mast: Mast,
    camera_in_head: CameraModel,
    target_in_rover_m: ArrayLike,
    pixel_px: ArrayLike | None = None,
    *,
    from_pan_rad: float = 0.0,
    from_tilt_rad: float = 0.0,
) -> list[Solution]:
    """Return every pair of joint angles that puts the target on the pixel, the best first.

    Parameters
    ----------
    mast
        Any two revolute axes.
    camera_in_head
        Camera model in the head frame (a rig camera that is ``on: head``).
    target_in_rover_m
        (3,) target in the rover frame, metres; or (..., 3) many of them.
    pixel_px
        (x, y) of the wanted pixel; the image centre if left out; or (..., 2), broadcast against the targets.
    from_pan_rad, from_tilt_rad
        Where the head is now, for the order.

    Returns
    -------
    list of Solution
        For arrays of more than one axis what ``solve_many`` returns, which says so to a type checker too.
        For one target never empty. Upright solutions (tilt within ±π/2) first, then by the larger of |Δpan|
        and |Δtilt|. The differences are plain ones, not taken round the circle: a head with a cable cannot
        pass ±π.
        Each has the target in front of the camera (range_m > 0). Limits are left to ``choose``. For a target
        on the pan axis every pan does; from_pan_rad is returned.

    Raises
    ------
    Unreachable
        ``blind_cone``: too near the pan axis, with the distance from the axis that could be reached.
        ``too_near``: nearer than the ray can be brought, with both distances. ``bad_pixel``, ``bad_target``:
        the pixel has no ray, or the target is not three finite numbers below 1e9 m. ``parallel_axes``:
        |cos k| < 0.001. ``bad_joints``: where the head is now is not finite.

    Notes
    -----
    Extends section IV of the paper, eqs. (11)-(25); see docs/pointing.md.

    Examples
    --------
    >>> import numpy as np
    >>> from calib.camera.cahvor import CameraModel
    >>> from calib.mast.rig import Mast
    >>> mast = Mast(np.array([0.0, 0.0, -1.5]), np.zeros(3))
    >>> forward, right, down = np.eye(3)
    >>> H, V = 100 * right + 50 * forward, 100 * down + 50 * forward
    >>> camera = CameraModel("CAHV", (101, 101), np.zeros(3), forward, H, V)
    >>> [best, over_the_shoulder] = solve(mast, camera, [0.0, 3.0, -1.5])
    >>> round(best.pan_rad, 6), abs(round(best.tilt_rad, 6)), round(best.range_m, 6)
    (1.570796, 0.0, 3.0)
    """
    _check_here(from_pan_rad, from_tilt_rad)
    target = np.asarray(target_in_rover_m, dtype=np.float64)
    pixel = None if pixel_px is None else np.asarray(pixel_px, dtype=np.float64)
    if target.ndim > 1 or (pixel is not None and pixel.ndim > 1):
        return solve_many(  # type: ignore[return-value]  # a type checker cannot tell the shapes apart
            mast, camera_in_head, target, pixel, from_pan_rad=from_pan_rad, from_tilt_rad=from_tilt_rad
        )
    x_px, y_px = camera_in_head.image_center_px if pixel is None else _two_numbers(pixel)
    ray = _camera_ray(camera_in_head, x_px, y_px)
    return _solve(_axes(mast), ray, target, from_pan_rad, from_tilt_rad)


def solve_many(
    mast: Mast,
    camera_in_head: CameraModel,
    targets_in_rover_m: ArrayLike,
    pixels_px: ArrayLike | None = None,
    *,
    from_pan_rad: float = 0.0,
    from_tilt_rad: float = 0.0,
) -> Solutions:
    """Return the joint angles of many targets, each as ``solve`` gives them for that target alone.

    A target that cannot be reached, or is no target, does not stop the others: ``refused`` has its code.

    Parameters
    ----------
    mast, camera_in_head, from_pan_rad, from_tilt_rad
        As ``solve``; the head stands there before each target.
    targets_in_rover_m
        (..., 3) targets in the rover frame, metres.
    pixels_px
        (..., 2) wanted pixels (x, y), broadcast against the targets; the image centre if left out.

    Raises
    ------
    Unreachable
        ``bad_target``, ``bad_pixel``: arrays of another shape, or that do not go together.
        ``parallel_axes``, ``bad_joints``: as ``solve``.
    """
    _check_here(from_pan_rad, from_tilt_rad)
    axes = _axes(mast)
    targets = np.asarray(targets_in_rover_m, dtype=np.float64)
    pixels = np.asarray(camera_in_head.image_center_px if pixels_px is None else pixels_px, dtype=np.float64)
    for array, width, code, what in (
        (targets, 3, "bad_target", "targets"),
        (pixels, 2, "bad_pixel", "pixels"),
    ):
        if array.ndim == 0 or array.shape[-1] != width:
            raise Unreachable(code, f"{what} of shape {array.shape} where (..., {width}) is expected")
    try:
        shape = np.broadcast_shapes(targets.shape[:-1], pixels.shape[:-1])
    except ValueError:
        raise Unreachable(
            "bad_target",
            f"targets of shape {targets.shape} and pixels of shape {pixels.shape} do not go together",
        ) from None
    each = zip(
        np.broadcast_to(targets, (*shape, 3)).reshape(-1, 3),
        np.broadcast_to(pixels, (*shape, 2)).reshape(-1, 2).tolist(),
        strict=True,
    )
    found, refused = np.full((3, math.prod(shape), _MOST), np.nan), [""] * math.prod(shape)
    for row, (target, (x_px, y_px)) in enumerate(each):
        try:
            ray = _camera_ray(camera_in_head, x_px, y_px)
            some = _solve(axes, ray, target, from_pan_rad, from_tilt_rad, told=False)
        except Unreachable as refusal:
            if refusal.code == "parallel_axes":  # the mast's fault, not the target's
                raise
            refused[row] = refusal.code
            continue
        for column, one in enumerate(some[:_MOST]):
            found[:, row, column] = one.pan_rad, one.tilt_rad, one.range_m
    pan_rad, tilt_rad, range_m = found.reshape(3, *shape, _MOST)
    codes = np.array(refused, dtype=np.str_).reshape(shape)
    for rows in (pan_rad, tilt_rad, range_m, codes):
        rows.setflags(write=False)
    return Solutions(pan_rad, tilt_rad, range_m, codes)


def solve_ray(
    mast: Mast,
    origin_in_head_m: ArrayLike,
    direction_in_head: ArrayLike,
    target_in_rover_m: ArrayLike,
    *,
    from_pan_rad: float = 0.0,
    from_tilt_rad: float = 0.0,
) -> list[Solution]:
    """Return every pair of joint angles that puts the target on a ray fixed to the head; see ``solve``.

    Parameters
    ----------
    mast
        Any two revolute axes.
    origin_in_head_m, direction_in_head
        (3,) where the ray starts, metres, and (3,) its direction, of any length but zero, in the head frame.
    target_in_rover_m
        (3,) target in the rover frame, metres.
    from_pan_rad, from_tilt_rad
        Where the head is now, for the order.

    Raises
    ------
    Unreachable
        As ``solve``; ``bad_pixel`` for a ray that is not finite or has no direction.
    """
    _check_here(from_pan_rad, from_tilt_rad)
    origin = np.asarray(origin_in_head_m, dtype=np.float64)
    direction = np.asarray(direction_in_head, dtype=np.float64)
    length = float(np.linalg.norm(direction))
    if not (np.isfinite(origin).all() and math.isfinite(length) and length > 0.0):
        raise Unreachable(
            "bad_pixel", f"ray from {origin.tolist()} along {direction.tolist()} has no finite direction"
        )
    ray = _ray(origin.tolist(), (direction / length).tolist())
    target = np.asarray(target_in_rover_m, dtype=np.float64)
    return _solve(_axes(mast), ray, target, from_pan_rad, from_tilt_rad)


def _solve(
    axes: _Axes,
    ray: _Ray,
    target: FloatArray,
    from_pan_rad: float,
    from_tilt_rad: float,
    told: bool = True,
) -> list[Solution]:
    """Solve for one target; a refusal tells by how much only if asked, as that takes a search."""
    x, y, z = _target_in_mast(axes, target)
    if abs(axes.cos_k) < _PARALLEL:
        raise Unreachable(
            "parallel_axes", f"pan and tilt axes are parallel (cos k = {axes.cos_k:.2g}): not a pan/tilt head"
        )
    rho = math.hypot(x, y)
    on_axis = rho <= _EDGE * math.hypot(rho, z)
    azimuth = math.atan2(y, x)
    (cx, _, cz), (dx, _, dz) = ray.c, ray.d
    found: list[Solution] = []
    for u_x, u_y, s in _arm_points(axes, ray, rho, z):
        # q = Rot(y,tilt) w turns w_x, w_z in their plane; q_y = w_y.
        q_x = u_x - axes.a
        q_z = axes.cos_k * z - axes.sin_k * u_y
        w_x = cx + s * dx
        w_z = cz + s * dz
        tilt = math.atan2(q_x * w_z - q_z * w_x, q_x * w_x + q_z * w_z)
        pan = _wrapped(from_pan_rad if on_axis else azimuth - math.atan2(u_y, u_x))
        if not any(_same(pan, other.pan_rad) and _same(tilt, other.tilt_rad) for other in found):
            found.append(Solution(pan, _wrapped(tilt), s))
    if not found:
        raise _why_not(axes, ray, rho, z, told)
    if len(found) > 1:
        found.sort(key=lambda one: _order(one, from_pan_rad, from_tilt_rad))
    return found


def choose(
    solutions: Sequence[Solution],
    pan_limits_rad: tuple[float, float],
    tilt_limits_rad: tuple[float, float],
    from_pan_rad: float = 0.0,
    from_tilt_rad: float = 0.0,
) -> Solution:
    """Return the solution within the joint limits that comes first: upright, then least motion.

    A joint that turns past ±π (limits of 20 to 350 degrees, say) is offered each angle a whole turn up and
    down too.

    Parameters
    ----------
    solutions
        From ``solve``; at least one.
    pan_limits_rad, tilt_limits_rad
        (lowest, highest) of each joint, both included.
    from_pan_rad, from_tilt_rad
        Where the head is now.

    Raises
    ------
    Unreachable
        ``outside_limits``: with the angle, the limit and by how much, for the solution that misses least.
        ``bad_joints``: a limit or an angle is not a number, a limit's lowest is above its highest, or there
        is no solution to choose from.
    """
    _check_here(from_pan_rad, from_tilt_rad)
    for joint, (low, high) in (("pan", pan_limits_rad), ("tilt", tilt_limits_rad)):
        if not low <= high:  # not a number either
            raise Unreachable(
                "bad_joints",
                f"the {joint} limits are [{low}, {high}] rad where two rising numbers are expected",
            )
    if not solutions:
        raise Unreachable("bad_joints", "there is no solution to choose from")
    for one in solutions:
        if not (math.isfinite(one.pan_rad) and math.isfinite(one.tilt_rad)):
            raise Unreachable(
                "bad_joints", f"a solution has pan {one.pan_rad} and tilt {one.tilt_rad} rad: no angles"
            )
    turned = [
        Solution(one.pan_rad + pan_turn, one.tilt_rad + tilt_turn, one.range_m)
        for one in solutions
        for pan_turn in (0.0, math.tau, -math.tau)
        for tilt_turn in (0.0, math.tau, -math.tau)
    ]

    def excess(one: Solution) -> tuple[float, float]:
        return _beyond(one.pan_rad, pan_limits_rad), _beyond(one.tilt_rad, tilt_limits_rad)

    inside = [one for one in turned if excess(one) == (0.0, 0.0)]
    if inside:
        return min(inside, key=lambda one: _order(one, from_pan_rad, from_tilt_rad))
    nearest = min(turned, key=lambda one: max(excess(one)))
    raise Unreachable(
        "outside_limits",
        " and ".join(
            f"{joint} {angle:.6g} rad is {_beyond(angle, limits):.3g} rad beyond the limit "
            f"{limits[0] if angle < limits[0] else limits[1]:.6g} rad"
            for joint, angle, limits in (
                ("pan", nearest.pan_rad, pan_limits_rad),
                ("tilt", nearest.tilt_rad, tilt_limits_rad),
            )
            if _beyond(angle, limits) > 0.0
        ),
    )


def _check_here(from_pan_rad: float, from_tilt_rad: float) -> None:
    """Refuse joint angles that are not finite."""
    if not (math.isfinite(from_pan_rad) and math.isfinite(from_tilt_rad)):
        raise Unreachable(
            "bad_joints", f"the head stands at pan {from_pan_rad}, tilt {from_tilt_rad} rad: no angles"
        )


def _two_numbers(pixel: FloatArray) -> tuple[float, float]:
    if pixel.shape != (2,) or not np.isfinite(pixel).all():
        raise Unreachable("bad_pixel", f"pixel {pixel.tolist()} is not two finite numbers")
    x_px, y_px = pixel.tolist()
    return x_px, y_px


def _target_in_mast(axes: _Axes, target: FloatArray) -> Triple:
    if target.shape != (3,):
        raise Unreachable(
            "bad_target", f"target of shape {target.shape} where three coordinates are expected"
        )
    x, y, z = target.tolist()
    if not (abs(x) < _FARTHEST_M and abs(y) < _FARTHEST_M and abs(z) < _FARTHEST_M):
        raise Unreachable("bad_target", f"target {[x, y, z]} is not three finite numbers below 1e9 m")
    tx, ty, tz = axes.translation
    x, y, z = x - tx, y - ty, z - tz
    r0, r1, r2 = axes.rows
    return (
        r0[0] * x + r1[0] * y + r2[0] * z,
        r0[1] * x + r1[1] * y + r2[1] * z,
        r0[2] * x + r1[2] * y + r2[2] * z,
    )


def _arm_points(axes: _Axes, ray: _Ray, rho: float, z: float) -> Iterator[tuple[float, float, float]]:
    """Yield (u_x, u_y, s) of every solution, s > 0; duplicates may come."""
    # sigma = s + c·d runs along the ray from its point nearest the head's origin: |w|² = miss2 + sigma².
    a = axes.a
    reach2 = rho * rho + z * z + a * a - ray.miss2
    slack = _EDGE * math.hypot(rho, z)
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


def _why_not(axes: _Axes, ray: _Ray, rho: float, z: float, told: bool) -> Unreachable:
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
    if not told:
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


def _reach_edge_m(axes: _Axes, ray: _Ray, rho: float, z: float) -> float | None:
    """Return the distance from the pan axis, beyond rho, from which targets at height z are reached."""

    def reached(distance: float) -> bool:
        return any(True for _ in _arm_points(axes, ray, distance, z))

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


def _order(one: Solution, from_pan_rad: float, from_tilt_rad: float) -> tuple[bool, float]:
    upright = abs(math.remainder(one.tilt_rad, math.tau)) <= 0.5 * math.pi
    return not upright, max(abs(one.pan_rad - from_pan_rad), abs(one.tilt_rad - from_tilt_rad))


def _beyond(angle_rad: float, limits_rad: tuple[float, float]) -> float:
    """Return by how much the angle is outside the limits; 0 inside."""
    return max(limits_rad[0] - angle_rad, angle_rad - limits_rad[1], 0.0)


def _wrapped(angle_rad: float) -> float:
    """Return the angle in (-π, π]."""
    wrapped = math.remainder(angle_rad, math.tau)
    return wrapped if wrapped > -math.pi else math.pi


def _same(one_rad: float, other_rad: float) -> bool:
    return abs(math.remainder(one_rad - other_rad, math.tau)) < _SAME_RAD
