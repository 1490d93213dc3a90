"""Goals that a head accepts, and from which side an axis approaches one to take its backlash up. No I/O."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from typing import Annotated, Any, Literal, Self

from pydantic import ConfigDict, Field, model_validator

from calib.files.records import problem
from drivers.errors import OutOfRange
from drivers.options import Ascending, DriverOptions

_STRETCH: Any = {
    "if": {"required": ["approach"], "properties": {"approach": {"not": {"const": "none"}}}},
    "then": {"required": ["approach_rad"], "properties": {"approach_rad": {"exclusiveMinimum": 0}}},
    "else": {"properties": {"approach_rad": {"const": 0}}},
}


class ApproachedAxis(DriverOptions):
    """The options of an axis, of any driver. Angles are the mast's: pan to the right, tilt up."""

    model_config = ConfigDict(json_schema_extra=_STRETCH)

    limits_rad: Annotated[tuple[float, float], Ascending()]
    """What may be commanded; set in the device too, if it can be."""
    sign: Literal[1, -1] = 1
    """1 if the device counts up where the axis turns positive, else -1."""
    approach: Literal["none", "positive", "negative", "gravity"] = "none"
    """From which side a goal is approached, to take the backlash up: ``none``, ``positive`` (the last stretch
    turns positive), ``negative``, or ``gravity``: against the weight, so that gear and weight press on the
    same flank."""
    approach_rad: Annotated[float, Field(ge=0.0, le=0.5)] = 0.0
    """How long the last stretch is; more than the backlash."""
    gravity_turnover_rad: Annotated[float, Field(ge=-math.pi, le=math.pi)] = math.pi / 2
    """The angle at which the weight changes sides, for ``gravity``. Below it the weight pulls the axis down
    (the last stretch turns positive), above it up."""

    @model_validator(mode="after")
    def _check_stretch(self) -> Self:
        if (self.approach == "none") != (self.approach_rad == 0.0):
            stretch = f"{self.approach_rad:g} with approach {self.approach!r}"
            raise problem(
                "approach_rad", f"{stretch}; a stretch above zero with a side, or neither, is expected"
            )
        return self

    @property
    def rising_below_rad(self) -> float | None:
        """The angle below which the last stretch turns positive, and above which negative; None for no
        side."""
        ends = {"none": None, "positive": math.inf, "negative": -math.inf}
        return self.gravity_turnover_rad if self.approach == "gravity" else ends[self.approach]

    def approach_sign(self, goal_rad: float) -> int:
        """Return the direction of the last stretch in counts: 1, -1, or 0 for none."""
        below_rad = self.rising_below_rad
        return 0 if below_rad is None else self.sign if goal_rad < below_rad else -self.sign


def legs_to(
    goal: int, turn: int, stretch: int, limits: tuple[int, int], places: Iterable[int] | None
) -> list[int]:
    """Return the goals of a move, the last one after another where it has to be approached from one side.

    All are in the device's counts. ``turn``: which way the counts go on the last stretch, 1, -1, or 0 for
    either; ``stretch``: its length at least; ``limits``: the lowest and the highest goal; ``places``: where
    the axis is or comes to rest before it can turn, None if unknown.
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
            message = f"{name} {angle:.4f} rad is outside the head's limits {low:.4f} to {high:.4f} rad"
            raise OutOfRange(message, device=device)
