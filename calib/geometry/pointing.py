"""Exact pointing: the joint angles that bring a target onto a chosen pixel of a head camera.

The pixel's ray (origin c, unit direction d, both in the head frame) comes from the camera model itself. So
lens distortion, a moving entrance point, oblique H and V and a principal point off centre are all exact, for
any pixel. The paper (section IV) turns the camera by a small rotation vector instead, eqs. (19)-(22). The
letters are those of calib.geometry.reach.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from calib.errors import Unreachable
from calib.geometry.cahvor import CameraModel
from calib.geometry.reach import EDGE, Arm
from calib.geometry.rig import Mast
from calib.geometry.rigid import FloatArray
from calib.geometry.solutions import Solution, Solutions, check_here, order

_MOST = 4
"""Pairs of joint angles that a target can have: as many as the quartic has roots."""


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
        For one target never empty. Upright solutions (tilt within ±π/2) first, then by the larger of
        ``|Δpan|`` and ``|Δtilt|``. The differences are plain ones, not taken round the circle: a head with a
        cable cannot pass ±π.
        Each has the target in front of the camera (range_m > 0). Limits are left to ``choose``. For a target
        on the pan axis every pan does; from_pan_rad is returned.

    Raises
    ------
    Unreachable
        ``blind_cone``: too near the pan axis, with the distance from the axis that could be reached.
        ``too_near``: nearer than the ray can be brought, with both distances. ``bad_pixel``, ``bad_target``:
        the pixel has no ray, or the target is not three finite numbers below 1e9 m. ``parallel_axes``:
        ``|cos k|`` < 0.001. ``bad_joints``: where the head is now is not finite.

    Notes
    -----
    Extends section IV of the paper, eqs. (11)-(25); see docs/explanation/pointing.md.

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
    check_here(from_pan_rad, from_tilt_rad)
    target = np.asarray(target_in_rover_m, dtype=np.float64)
    pixel = np.asarray(camera_in_head.image_center_px if pixel_px is None else pixel_px, dtype=np.float64)
    if target.ndim > 1 or pixel.ndim > 1:
        return solve_many(  # type: ignore[return-value]  # a type checker cannot tell the shapes apart
            mast, camera_in_head, target, pixel, from_pan_rad=from_pan_rad, from_tilt_rad=from_tilt_rad
        )
    if pixel.shape != (2,) or not np.isfinite(pixel).all():
        raise Unreachable("bad_pixel", f"pixel {pixel.tolist()} is not two finite numbers")
    rays = camera_in_head.ray(pixel)
    if not rays.valid:
        raise Unreachable(
            "bad_pixel",
            f"pixel ({pixel[0]:g}, {pixel[1]:g}) has no ray in this "
            f"{camera_in_head.kind} camera{camera_in_head.why_no_ray}",
        )
    return _solve(mast, rays.origins_m, rays.directions, target, from_pan_rad, from_tilt_rad, explain=True)


def solve_many(
    mast: Mast,
    camera_in_head: CameraModel,
    targets_in_rover_m: ArrayLike,
    pixels_px: ArrayLike | None = None,
    *,
    from_pan_rad: float = 0.0,
    from_tilt_rad: float = 0.0,
) -> Solutions:
    """Return the joint angles of many targets (..., 3), each as ``solve`` gives them for that target alone.

    A target that cannot be reached, or is no target, does not stop the others: ``refused`` has its code. The
    wanted pixels (..., 2) are broadcast against the targets.

    Raises
    ------
    Unreachable
        ``bad_target``, ``bad_pixel``: arrays of another shape, or that do not go together.
        ``parallel_axes``, ``bad_joints``: as ``solve``.
    """
    check_here(from_pan_rad, from_tilt_rad)
    targets = np.asarray(targets_in_rover_m, dtype=np.float64)
    pixels = np.asarray(camera_in_head.image_center_px if pixels_px is None else pixels_px, dtype=np.float64)
    for array, width, code, name in (
        (targets, 3, "bad_target", "targets"),
        (pixels, 2, "bad_pixel", "pixels"),
    ):
        if array.ndim == 0 or array.shape[-1] != width:
            raise Unreachable(code, f"{name} of shape {array.shape} where (..., {width}) is expected")
    try:
        shape = np.broadcast_shapes(targets.shape[:-1], pixels.shape[:-1])
    except ValueError:
        raise Unreachable(
            "bad_target",
            f"targets of shape {targets.shape} and pixels of shape {pixels.shape} do not go together",
        ) from None
    rays = camera_in_head.ray(np.broadcast_to(pixels, (*shape, 2)))
    every_target = np.broadcast_to(targets, (*shape, 3))
    found = np.full((3, *shape, _MOST), np.nan)
    refused = np.full(shape, "", dtype="<U10")
    for at in np.ndindex(shape):
        try:
            if not rays.valid[at]:
                raise Unreachable("bad_pixel", "the pixel has no ray")
            solutions = _solve(
                mast, rays.origins_m[at], rays.directions[at], every_target[at],
                from_pan_rad, from_tilt_rad, explain=False,
            )  # fmt: skip
        except Unreachable as refusal:
            if refusal.code == "parallel_axes":  # the mast's fault, not the target's
                raise
            refused[at] = refusal.code
            continue
        for column, one in enumerate(solutions[:_MOST]):
            found[(slice(None), *at, column)] = one.pan_rad, one.tilt_rad, one.range_m
    for array in (found, refused):
        array.setflags(write=False)
    pan_rad, tilt_rad, range_m = found
    return Solutions(pan_rad, tilt_rad, range_m, refused)


def _solve(
    mast: Mast,
    origin_m: FloatArray,
    direction: FloatArray,
    target: FloatArray,
    from_pan_rad: float,
    from_tilt_rad: float,
    explain: bool,
) -> list[Solution]:
    """Solve for one target; a refusal says by how much if it is to explain itself, which takes a search."""
    if target.shape != (3,):
        raise Unreachable(
            "bad_target", f"target of shape {target.shape} where three coordinates are expected"
        )
    # Coordinates from here on are a mistake; their squares would overflow in the end.
    if not (np.abs(target) < 1e9).all():
        raise Unreachable("bad_target", f"target {target.tolist()} is not three finite numbers below 1e9 m")
    x, y, z = ((target - mast.translation_m) @ mast.rover_from_mast.rotation).tolist()
    k = mast.axis_twist_rad
    arm = Arm(mast.axis_offset_m, math.sin(k), math.cos(k), _triple(origin_m), _triple(direction))
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
        raise arm.why_not(rho, z, explain)
    return sorted(found, key=lambda one: order(one, from_pan_rad, from_tilt_rad))


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
