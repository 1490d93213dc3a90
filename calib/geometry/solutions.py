"""Joint angles that put a target on a pixel, and which to take: within limits, upright, least motion."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calib.errors import Unreachable
from calib.geometry.rigid import FloatArray, ReadOnlyArrays


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
    down too.

    Parameters
    ----------
    solutions
        From ``solve``; at least one.
    pan_limits_rad, tilt_limits_rad
        (lowest, highest) of each joint, both included.
    from_pan_rad, from_tilt_rad
        Where the head is now, as read.
    read
        The head's readings at a solution's true angles: of these are the limits and the motion. By default
        joints read true.

    Raises
    ------
    Unreachable
        ``outside_limits``: with the angle, the limit and by how much, for the solution that misses least.
        ``bad_joints``: a limit or an angle is not a number, a limit's lowest is above its highest, or there
        is no solution to choose from.
    """
    check_here(from_pan_rad, from_tilt_rad)
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

    def angles(one: Solution) -> tuple[float, float]:
        return (one.pan_rad, one.tilt_rad) if read is None else read(one)

    def excess(one: Solution) -> tuple[float, float]:
        pan_rad, tilt_rad = angles(one)
        return _beyond(pan_rad, pan_limits_rad), _beyond(tilt_rad, tilt_limits_rad)

    inside = [one for one in turned if excess(one) == (0.0, 0.0)]
    if inside:
        return sorted(inside, key=lambda one: order(one, from_pan_rad, from_tilt_rad, read))
    pan_rad, tilt_rad = angles(min(turned, key=lambda one: max(excess(one))))
    raise Unreachable(
        "outside_limits",
        " and ".join(
            f"{joint} {angle:.6g} rad is {_beyond(angle, limits):.3g} rad beyond the limit "
            f"{limits[0] if angle < limits[0] else limits[1]:.6g} rad"
            for joint, angle, limits in (
                ("pan", pan_rad, pan_limits_rad),
                ("tilt", tilt_rad, tilt_limits_rad),
            )
            if _beyond(angle, limits) > 0.0
        ),
    )


def check_here(from_pan_rad: float, from_tilt_rad: float) -> None:
    """Refuse joint angles that are not finite."""
    if not (math.isfinite(from_pan_rad) and math.isfinite(from_tilt_rad)):
        raise Unreachable(
            "bad_joints", f"the head stands at pan {from_pan_rad}, tilt {from_tilt_rad} rad: no angles"
        )


def order(
    one: Solution,
    from_pan_rad: float,
    from_tilt_rad: float,
    read: Callable[[Solution], tuple[float, float]] | None = None,
) -> tuple[bool, float]:
    """Return the key by which solutions are sorted; present angles are readings if ``read`` is given."""
    upright = abs(math.remainder(one.tilt_rad, math.tau)) <= 0.5 * math.pi
    pan_rad, tilt_rad = (one.pan_rad, one.tilt_rad) if read is None else read(one)
    return not upright, max(abs(pan_rad - from_pan_rad), abs(tilt_rad - from_tilt_rad))


def _beyond(angle_rad: float, limits_rad: tuple[float, float]) -> float:
    """Return by how much the angle is outside the limits; 0 inside."""
    return max(limits_rad[0] - angle_rad, angle_rad - limits_rad[1], 0.0)
