"""Which of several joint angles the head is sent to: those that it can reach, upright, soonest."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from calib.mast.solutions import Solution, order, ordered
from mastctl.devices.keep_out import KeptOut, NoWay, Pair
from mastctl.devices.limits import Limits
from mastctl.devices.ways import Way


def reached(
    solutions: Sequence[Solution],
    limits: Limits,
    way: Callable[[Pair, Pair], Way],
    here: Pair,
    read: Callable[[Solution], Pair],
) -> Solution:
    """Return the solution to take: upright ones first, then the one that is reached soonest.

    Parameters
    ----------
    solutions
        Of the closed form; at least one.
    limits
        Of the joints: an angle is taken whole turns away too, where a cable lets the pan turn so far.
    way
        Plans the moves from one pose to another, in readings.
    here
        Where the head rests, as read.
    read
        The readings to send the head to, so that it comes to a solution's true angles.

    Raises
    ------
    Unreachable
        If none lies within the limits.
    KeptOut, NoWay
        If keep-outs stand against all that do; of the one that would have been taken.
    """
    found: list[tuple[bool, float, Solution]] = []
    refused: KeptOut | NoWay | None = None
    for one in ordered(solutions, limits.pan_rad, limits.tilt_rad, *here, read):
        try:
            time_s = way(here, read(one)).time_s
        except (KeptOut, NoWay) as error:
            refused = refused or error
        else:
            found.append((order(one, *here)[0], time_s, one))
    if not found:
        assert refused is not None
        raise refused
    return min(found, key=lambda candidate: candidate[:2])[2]
