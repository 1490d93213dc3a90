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
    """Joint angles that put the target on the pixel, and its range from the ray's origin.

    The angles are in (-π, π] from ``solve``; ``choose`` may return them a whole turn away. The ray begins at
    the camera's C, or its moved entrance point.
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
        The head's readings at a solution's true angles: limits and motion are of these. By default joints
        read true.

    Raises
    ------
    Unreachable
        ``outside_limits``: with the angle, the limit and by how much, for the solution that misses least.
        ``bad_joints``: a limit or an angle is not a number, a limit's lowest is above its highest, or there
        is no solution to choose from.
    """
    check_here(from_pan_rad, from_tilt_rad)
    limits = (pan_limits_rad, tilt_limits_rad)
    for joint, (low, high) in zip(("pan", "tilt"), limits, strict=True):
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
            max(low - angle, angle - high, 0.0)
            for angle, (low, high) in zip(_readings(one, read), limits, strict=True)
        ]

    inside = [one for one in turned if not any(beyond(one))]
    if inside:
        return sorted(inside, key=lambda one: order(one, from_pan_rad, from_tilt_rad, read))
    nearest = min(turned, key=lambda one: max(beyond(one)))
    each = zip(("pan", "tilt"), _readings(nearest, read), beyond(nearest), limits, strict=True)
    raise Unreachable(
        "outside_limits",
        " and ".join(
            f"{joint} {angle:.6g} rad is {excess:.3g} rad beyond the limit "
            f"{low if angle < low else high:.6g} rad"
            for joint, angle, excess, (low, high) in each
            if excess > 0.0
        ),
    )


def check_here(from_pan_rad: float, from_tilt_rad: float) -> None:
    """Refuse joint angles that are not finite."""
    if not (math.isfinite(from_pan_rad) and math.isfinite(from_tilt_rad)):
        raise Unreachable(
            "bad_joints", f"the head is at pan {from_pan_rad}, tilt {from_tilt_rad} rad: no angles"
        )


def order(
    one: Solution,
    from_pan_rad: float,
    from_tilt_rad: float,
    read: Callable[[Solution], tuple[float, float]] | None = None,
) -> tuple[bool, float]:
    """Return the key by which solutions are sorted; present angles are readings if ``read`` is given."""
    upright = abs(math.remainder(one.tilt_rad, math.tau)) <= 0.5 * math.pi
    pan_rad, tilt_rad = _readings(one, read)
    return not upright, max(abs(pan_rad - from_pan_rad), abs(tilt_rad - from_tilt_rad))


def _readings(one: Solution, read: Callable[[Solution], tuple[float, float]] | None) -> tuple[float, float]:
    return (one.pan_rad, one.tilt_rad) if read is None else read(one)
