"""Exact pointing: the joint angles that bring a target onto a pixel of a head camera, and which to take.

The pixel's ray (origin c, unit direction d, both in the head frame) comes from the camera model itself. So
lens distortion, a moving entrance point, oblique H and V and a principal point off centre are all exact, for
any pixel. The paper (section IV) turns the camera by a small rotation vector instead, eqs. (19)-(22). The
letters are those of calib.geometry.reach.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from calib.errors import Unreachable
from calib.geometry.cahvor import CameraModel
from calib.geometry.reach import EDGE, Arm
from calib.geometry.rig import Mast
from calib.geometry.rigid import FloatArray


@dataclass(frozen=True, slots=True)
class Solution:
    """Joint angles that put the target on the pixel, and its range from the ray's origin.

    The angles are in (-π, π] from ``solve``; ``choose`` may return them a whole turn away. The ray begins at
    the camera's C, or its moved entrance point.
    """

    pan_rad: float
    tilt_rad: float
    range_m: float


def solve(
    mast: Mast,
    camera_in_head: CameraModel,
    target_in_rover_m: ArrayLike,
    pixel_px: ArrayLike | None = None,
    *,
    from_pan_rad: float = 0.0,
    from_tilt_rad: float = 0.0,
) -> list[Solution]:
    """Return every pair of joint angles that puts a target (3,) on a pixel (2,), the best first.

    Without a pixel it is the image centre. Upright solutions (tilt within ±π/2) come first, then by the
    larger of ``|Δpan|`` and ``|Δtilt|`` from where the head is now. The differences are plain ones, not taken
    round the circle: a head with a cable cannot pass ±π. Each has the target in front of the camera
    (range_m > 0). Limits are left to ``choose``. For a target on the pan axis every pan does; from_pan_rad is
    returned. Extends section IV of the paper, eqs. (11)-(25); see docs/explanation/pointing.md.

    Raises
    ------
    Unreachable
        ``blind_cone``: too near the pan axis, with the distance from the axis that could be reached.
        ``too_near``: nearer than the ray can be brought, with both distances. ``bad_pixel``, ``bad_target``:
        the pixel has no ray, or the target is not three finite numbers below 1e9 m. ``parallel_axes``:
        ``|cos k|`` < 0.001. ``bad_joints``: where the head is now is not finite.

    Examples
    --------
    >>> import numpy as np
    >>> from calib.geometry.cahvor import CameraModel
    >>> from calib.geometry.rig import Mast
    >>> mast = Mast(np.array([0.0, 0.0, -1.5]), np.zeros(3))
    >>> forward, right, down = np.eye(3)
    >>> H, V = 100 * right + 50 * forward, 100 * down + 50 * forward
    >>> camera = CameraModel("CAHV", (101, 101), np.zeros(3), forward, H, V)
    >>> [best, over_the_shoulder] = solve(mast, camera, [0.0, 3.0, -1.5])
    >>> round(best.pan_rad, 6), abs(round(best.tilt_rad, 6)), round(best.range_m, 6)
    (1.570796, 0.0, 3.0)
    """
    _refuse_present(from_pan_rad, from_tilt_rad)
    target = np.asarray(target_in_rover_m, dtype=np.float64)
    pixel = np.asarray(camera_in_head.image_center_px if pixel_px is None else pixel_px, dtype=np.float64)
    if pixel.shape != (2,) or not np.isfinite(pixel).all():
        raise Unreachable("bad_pixel", f"pixel {pixel.tolist()} is not two finite numbers")
    ray = camera_in_head.ray(pixel)
    if not ray.valid:
        raise Unreachable(
            "bad_pixel",
            f"pixel ({pixel[0]:g}, {pixel[1]:g}) has no ray in this "
            f"{camera_in_head.kind} camera{camera_in_head.why_no_ray}",
        )
    if target.shape != (3,):
        raise Unreachable(
            "bad_target", f"target of shape {target.shape} where three coordinates are expected"
        )
    # Coordinates from here on are a mistake; their squares would overflow in the end.
    if not (np.abs(target) < 1e9).all():
        raise Unreachable("bad_target", f"target {target.tolist()} is not three finite numbers below 1e9 m")
    x, y, z = ((target - mast.translation_m) @ mast.rover_from_mast.rotation).tolist()
    k = mast.axis_twist_rad
    arm = Arm(mast.axis_offset_m, math.sin(k), math.cos(k), _triple(ray.origins_m), _triple(ray.directions))
    # The axes are parallel to a milliradian, and the mast is not a pan/tilt head.
    if abs(arm.cos_k) < 1e-3:
        raise Unreachable(
            "parallel_axes", f"pan and tilt axes are parallel (cos k = {arm.cos_k:.2g}): not a pan/tilt head"
        )
    rho = math.hypot(x, y)
    on_axis = rho <= EDGE * math.hypot(rho, z)
    azimuth = math.atan2(y, x)
    (cx, _, cz), (dx, _, dz) = arm.c, arm.d
    found: list[Solution] = []
    for u_x, u_y, s in arm.points(rho, z):
        # q = Rot(y,tilt) w turns w_x, w_z in their plane; q_y = w_y.
        q_x, q_z = u_x - arm.a, arm.cos_k * z - arm.sin_k * u_y
        w_x, w_z = cx + s * dx, cz + s * dz
        tilt = math.atan2(q_x * w_z - q_z * w_x, q_x * w_x + q_z * w_z)
        pan = _wrapped(from_pan_rad if on_axis else azimuth - math.atan2(u_y, u_x))
        if not any(_same(pan, other.pan_rad) and _same(tilt, other.tilt_rad) for other in found):
            found.append(Solution(pan, _wrapped(tilt), s))
    if not found:
        raise arm.why_not(rho, z)
    return sorted(found, key=lambda one: _order(one, from_pan_rad, from_tilt_rad))


def choose(
    solutions: Sequence[Solution],
    pan_limits_rad: tuple[float, float],
    tilt_limits_rad: tuple[float, float],
    from_pan_rad: float = 0.0,
    from_tilt_rad: float = 0.0,
    read: Callable[[Solution], tuple[float, float]] | None = None,
) -> Solution:
    """Return the solution within the joint limits that comes first: the first of `ordered`."""
    return ordered(solutions, pan_limits_rad, tilt_limits_rad, from_pan_rad, from_tilt_rad, read)[0]


def ordered(
    solutions: Sequence[Solution],
    pan_limits_rad: tuple[float, float],
    tilt_limits_rad: tuple[float, float],
    from_pan_rad: float = 0.0,
    from_tilt_rad: float = 0.0,
    read: Callable[[Solution], tuple[float, float]] | None = None,
) -> list[Solution]:
    """Return the solutions within the joint limits: upright ones first, then by least motion.

    A joint that turns past ±π (limits of 20 to 350 degrees, say) is offered each angle a whole turn up and
    down too. ``read`` gives the head's readings at a solution's true angles: limits, both ends included,
    motion and where the head is now are of these. By default joints read true.

    Raises
    ------
    Unreachable
        ``outside_limits``: with the angle, the limit and by how much, for the solution that misses least.
        ``bad_joints``: a limit or where the head is is not a number, a limit's lowest is above its highest,
        or there is no solution to choose from.
    """
    _refuse_present(from_pan_rad, from_tilt_rad)
    read = read or _true_angles
    limits = (pan_limits_rad, tilt_limits_rad)
    for joint, (low, high) in zip(("pan", "tilt"), limits, strict=True):
        if not low <= high:  # not a number either
            raise Unreachable(
                "bad_joints",
                f"the {joint} limits are [{low}, {high}] rad where two rising numbers are expected",
            )
    if not solutions:
        raise Unreachable("bad_joints", "there is no solution to choose from")
    turns = (0.0, math.tau, -math.tau)
    turned = [
        Solution(one.pan_rad + pan, one.tilt_rad + tilt, one.range_m)
        for one in solutions
        for pan in turns
        for tilt in turns
    ]

    def beyond(one: Solution) -> list[float]:
        """By how much each angle is outside its limits; 0 inside."""
        return [
            max(low - angle, angle - high, 0.0) for angle, (low, high) in zip(read(one), limits, strict=True)
        ]

    inside = [one for one in turned if not any(beyond(one))]
    if inside:
        return sorted(inside, key=lambda one: _order(one, from_pan_rad, from_tilt_rad, read))
    nearest = min(turned, key=lambda one: max(beyond(one)))
    each = zip(("pan", "tilt"), read(nearest), beyond(nearest), limits, strict=True)
    raise Unreachable(
        "outside_limits",
        " and ".join(
            f"{joint} {angle:.6g} rad is {excess:.3g} rad beyond the limit "
            f"{low if angle < low else high:.6g} rad"
            for joint, angle, excess, (low, high) in each
            if excess > 0.0
        ),
    )


def _refuse_present(from_pan_rad: float, from_tilt_rad: float) -> None:
    """Refuse joint angles that are not finite."""
    if not (math.isfinite(from_pan_rad) and math.isfinite(from_tilt_rad)):
        raise Unreachable(
            "bad_joints", f"the head is at pan {from_pan_rad}, tilt {from_tilt_rad} rad: no angles"
        )


def _true_angles(one: Solution) -> tuple[float, float]:
    return one.pan_rad, one.tilt_rad


def _order(
    one: Solution,
    from_pan_rad: float,
    from_tilt_rad: float,
    read: Callable[[Solution], tuple[float, float]] = _true_angles,
) -> tuple[bool, float]:
    """The key by which solutions are sorted; present angles are what ``read`` gives."""
    upright = abs(math.remainder(one.tilt_rad, math.tau)) <= 0.5 * math.pi
    pan_rad, tilt_rad = read(one)
    return not upright, max(abs(pan_rad - from_pan_rad), abs(tilt_rad - from_tilt_rad))


def _triple(vector: Sequence[float] | FloatArray) -> tuple[float, float, float]:
    x, y, z = vector
    return float(x), float(y), float(z)


def _wrapped(angle_rad: float) -> float:
    """Return the angle in (-π, π]."""
    wrapped = math.remainder(angle_rad, math.tau)
    return wrapped if wrapped > -math.pi else math.pi


def _same(one_rad: float, other_rad: float) -> bool:
    # Solutions so close are one: at the edge of reach two meet, good to the root of rounding.
    return abs(math.remainder(one_rad - other_rad, math.tau)) < 1e-7
