"""Goals that a head accepts, and from which side an axis approaches one to take its backlash up. No I/O."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Literal, get_args

from drivers.errors import OutOfRange

Approach = Literal["none", "positive", "negative", "gravity"]
APPROACHES: tuple[Approach, ...] = get_args(Approach)


def last_turn(approach: Approach, goal_rad: float, gravity_turnover_rad: float) -> int:
    """Return which way the axis turns on the last stretch: 1 for positive, -1 for negative, 0 for either.

    Parameters
    ----------
    approach
        ``positive``, ``negative``, ``none``, or ``gravity``: against the weight, so that gear and weight
        press on the same flank.
    gravity_turnover_rad
        The angle at which the weight changes sides: below it the weight pulls the axis down, so that the
        last stretch turns positive, above it up.
    """
    if approach == "gravity":
        return 1 if goal_rad < gravity_turnover_rad else -1
    return {"none": 0, "positive": 1, "negative": -1}[approach]


@dataclass(frozen=True, kw_only=True)
class ApproachedAxis:
    """The options of an axis, of any driver. Angles are the mast's: pan to the right, tilt up.

    Attributes
    ----------
    limits_rad
        What may be commanded; set in the device too, if it can be.
    sign
        1 if the device counts up where the axis turns positive, else -1.
    approach
        From which side a goal is approached, to take the backlash up: ``none``, ``positive`` (the last
        stretch turns positive), ``negative``, or ``gravity``: against the weight, so that gear and weight
        press on the same flank.
    approach_rad
        How long the last stretch is; more than the backlash.
    gravity_turnover_rad
        The angle at which the weight changes sides, for ``gravity``. Below it the weight pulls the axis down
        (the last stretch turns positive), above it up.
    """

    limits_rad: tuple[float, float]
    sign: int = 1
    approach: Approach = "none"
    approach_rad: float = 0.0
    gravity_turnover_rad: float = math.pi / 2

    def approach_sign(self, goal_rad: float) -> int:
        """Return the direction of the last stretch in counts: 1, -1, or 0 for none."""
        return self.sign * last_turn(self.approach, goal_rad, self.gravity_turnover_rad)


def rising_below_rad(approach: Approach, gravity_turnover_rad: float) -> float | None:
    """Return what `drivers.interfaces.AxisMotion` says of an approach."""
    known = {"none": None, "positive": math.inf, "negative": -math.inf, "gravity": gravity_turnover_rad}
    return known[approach]


def legs_to(
    goal: int, turn: int, stretch: int, limits: tuple[int, int], places: Iterable[int] | None
) -> list[int]:
    """Return the goals of a move, the last one after another where it has to be approached from one side.

    Parameters
    ----------
    goal, stretch, limits
        Where the axis is to stand, how long its last stretch is at least, and the lowest and highest goal,
        all in the device's counts.
    turn
        Which way the counts go on the last stretch: 1, -1, or 0 for either.
    places
        Where the axis stands or comes to rest before it can turn; None if unknown.
    """
    low, high = limits
    start = min(max(goal - turn * stretch, low), high)
    before = places is not None and all(turn * (start - place) >= 0 for place in places)
    return [goal] if before or not turn or start == goal else [start, goal]


def check_goal(
    angles_rad: Sequence[float],
    limits_rad: Sequence[tuple[float, float]],
    speed_rad_per_s: float | None,
    device: str = "",
) -> None:
    """Pass pan and tilt within their limits, and a speed above zero or none. Raises OutOfRange."""
    if speed_rad_per_s is not None and not speed_rad_per_s > 0:
        raise OutOfRange(f"speed {speed_rad_per_s} rad/s is not a positive number", device=device)
    for name, angle, (low, high) in zip(("pan", "tilt"), angles_rad, limits_rad, strict=True):
        if not low <= angle <= high:
            words = f"{name} {angle:.4f} rad is outside the head's limits {low:.4f} to {high:.4f} rad"
            raise OutOfRange(words, device=device)
