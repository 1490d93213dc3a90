"""The options of a head of two servos and of its axes, read strictly; a family of servos adds its own."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import Annotated, Any, ClassVar, Literal, Self

from pydantic import ConfigDict, Field, InstanceOf, model_validator

from calib.files.records import ABSENT, Text, problem
from drivers.approach import ApproachedAxis
from drivers.errors import BadOptions, WrongDevice
from drivers.options import DriverOptions, ReadBy
from drivers.servo_bus.port import Register

STANDS_WITHIN_S = 0.5  # after this process has died: the last poll's age, the patience, and braking
RESTING_POLL_S = 0.1  # of servos at rest: an idle computer stays idle
LEAST_SLACK_COUNTS = 3
LONGEST_REPLY_S = 0.3  # a few of them must fit into a call


@dataclass(frozen=True, kw_only=True)
class CountedModel:
    """A kind of servo, by its counts.

    Attributes
    ----------
    name, number
        As its maker calls it, and as its memory does; None for a whole series, of which it is not compared.
    low_count, high_count, centre_count
        The position limits at most, and where its own angle is zero.
    count_rad, velocity_unit_rad_per_s, acceleration_unit_rad_per_s2, current_unit_A
        One count of position, velocity, acceleration and current; no current where it measures none.
    backlash_rad
        As the maker states it; None where nothing is stated.
    """

    name: str
    number: int | None
    registers: Mapping[str, Register]
    low_count: int
    high_count: int
    centre_count: int
    count_rad: float
    velocity_unit_rad_per_s: float
    acceleration_unit_rad_per_s2: float
    current_unit_A: float | None = None
    backlash_rad: float | None = None


def named_model(find: Callable[[str], CountedModel], names: Iterable[str]) -> ReadBy:
    """Return what annotates a servo's model, which options give by one of its names.

    ``find`` raises BadOptions.
    """

    def found(name: Any) -> CountedModel:
        try:
            return find(str(name))
        except BadOptions as error:
            raise problem("", str(error)) from None

    bare = sorted(name.removesuffix("-T") for name in names)
    letters = {"-": "[-_]"} | {one: f"[{one}{one.lower()}]" for one in map(chr, range(65, 91))}
    spelt = "|".join("".join(letters.get(one, one) for one in name) for name in bare)
    pattern = f"^({spelt})([-_][Tt])?([-_][Rr])?$"
    return ReadBy(found, {"type": "string", "pattern": pattern, "examples": sorted(names)})


class ServoAxisSettings(ApproachedAxis):
    """One axis of the head; its limits are also the servo's position limits."""

    model_config = ConfigDict(populate_by_name=False)

    servo_id: Annotated[int, Field(ge=0, le=252, alias="id")]
    """The servo's id on the line."""
    model: InstanceOf[CountedModel]
    """Which servo."""
    zero_counts: Annotated[int, Field(ge=-(2**31), le=2**31 - 1)] = ABSENT
    """The servo's position where the axis is at zero; left out: the middle of its turn."""
    at_close: Literal["hold", "torque_off"] = "hold"
    """Whether the servo holds when the head is closed, or its torque is switched off (a tilt axis may
    fall)."""
    settle_rad: Annotated[float, Field(gt=0.0, le=0.1)] = ABSENT
    """How near to its goal the axis is in position, a count or more; left out: three counts, at least
    0.001."""

    @model_validator(mode="after")
    def _check_servo(self) -> Self:
        model = self.model
        if self.zero_counts is None:
            object.__setattr__(self, "zero_counts", model.centre_count)
        if self.settle_rad is None:
            object.__setattr__(self, "settle_rad", max(0.001, 3 * model.count_rad))
        if self.settle_rad < model.count_rad:
            raise problem(
                "settle_rad",
                f"{self.settle_rad:g} where a number from {model.count_rad:g} to 0.1 is expected",
            )
        self._check_reach()
        least_rad = model.backlash_rad or 0.0
        if self.approach != "none" and self.approach_rad <= least_rad:
            backlash = f"the backlash of a {model.name}, {least_rad:.4f} rad"
            message = f"{self.approach_rad:g} rad does not take up {backlash}; more is expected"
            raise problem("approach_rad", message)
        return self

    def _check_reach(self) -> None:
        """Refuse limits that the servo cannot hold."""
        model = self.model
        low, high = self.limit_counts
        if low >= high:
            raise problem(
                "limits_rad",
                f"[{self.limits_rad[0]:g}, {self.limits_rad[1]:g}] hold no two counts of a {model.name}, "
                f"whose count is {model.count_rad:.2g} rad; limits further apart are expected",
            )
        if low < model.low_count or high > model.high_count:
            reach = sorted((self.angle_rad(model.low_count), self.angle_rad(model.high_count)))
            raise problem(
                "limits_rad",
                f"they are the servo's counts {low} to {high}, but a {model.name} in position mode holds "
                f"{model.low_count} to {model.high_count}, which with zero_counts {self.zero_counts} is "
                f"{reach[0]:.4f} to {reach[1]:.4f} rad. Mount the horn so that the range does not cross "
                "the seam",
            )

    def counts(self, angle_rad: float) -> int:
        """Return the nearest count to an angle."""
        return self.zero_counts + round(self.sign * angle_rad / self.model.count_rad)

    def angle_rad(self, counts: float) -> float:
        """Return the angle of a position."""
        return float(self.sign * (counts - self.zero_counts) * self.model.count_rad)

    @property
    def limit_counts(self) -> tuple[int, int]:
        """The limits in counts, lower first; rounded inwards."""
        ends = sorted(self.zero_counts + self.sign * a / self.model.count_rad for a in self.limits_rad)
        return math.ceil(ends[0] - 1e-6), math.floor(ends[1] + 1e-6)

    @property
    def slack_counts(self) -> int:
        """How far beyond a limit an axis that was sent to it may be: it droops, or dithers."""
        return max(LEAST_SLACK_COUNTS, math.ceil(self.settle_rad / self.model.count_rad))

    def within_limits(self, counts: int) -> int:
        """Return the nearest count within the limits."""
        low, high = self.limit_counts
        return min(max(counts, low), high)

    def goal_at_place(self, name: str, counts: int) -> int:
        """Return the nearest goal within the limits to where an axis is.

        A few counts beyond a limit are passed (`slack_counts`): an axis that holds at its limit droops, and
        would be locked out for good. Raises WrongDevice if it is outside: moving from there could go the
        wrong way round.
        """
        low, high = self.limit_counts
        if not low - self.slack_counts <= counts <= high + self.slack_counts:
            raise WrongDevice(
                f"{name} is at {counts} counts ({self.angle_rad(counts):.4f} rad), outside its "
                f"limits {low} to {high} ({self.limits_rad[0]:.4f} to {self.limits_rad[1]:.4f} rad): "
                "with torque off turn it inside by hand, or correct zero_counts or limits_rad"
            )
        return self.within_limits(counts)

    def acceleration_counts(self, acceleration_rad_per_s2: float) -> int:
        """Return a profile acceleration, not below the one given: braking takes no longer than promised."""
        return max(1, math.ceil(acceleration_rad_per_s2 / self.model.acceleration_unit_rad_per_s2 - 1e-6))

    def velocity_counts(self, speed_rad_per_s: float) -> int:
        """Return a profile velocity, not above the speed; never 0, which would mean as fast as it can."""
        return max(1, math.floor(speed_rad_per_s / self.model.velocity_unit_rad_per_s + 1e-9))


class HeadSettings(DriverOptions):
    """A head of two servos on one bus."""

    poll_bytes: ClassVar[int] = 0  # on the wire, of one reading of both servos

    port: Text
    """The line: a serial device such as /dev/ttyUSB0, or a pyserial URL."""
    pan: ServoAxisSettings
    """The pan axis."""
    tilt: ServoAxisSettings
    """The tilt axis."""
    baud: int = 1_000_000
    """The line's bits per second."""
    speed_rad_per_s: Annotated[float, Field(ge=0.03, le=10.0)] = 1.0
    """Of the profile inside the servos, and the cap of every move."""
    acceleration_rad_per_s2: Annotated[float, Field(ge=0.4, le=1000.0)] = 4.0
    """Of the profile inside the servos."""
    poll_hz: Annotated[float, Field(ge=10.0, le=500.0)] = 50.0
    """How often the servos are read while they move, if no client reads."""
    reply_timeout_s: Annotated[float, Field(ge=0.002, le=LONGEST_REPLY_S)] = 0.05
    """How long a reply may take beyond its time on the wire."""
    settle_s: Annotated[float, Field(ge=0.0, le=5.0)] = 0.1
    """How long both axes must be in position to count as settled."""
    torque_off_at_start: bool = False
    """Whether torque may be dropped at start-up where permanent settings must be changed."""

    @model_validator(mode="after")
    def _check_line(self) -> Self:
        if self.pan.servo_id == self.tilt.servo_id:
            raise problem("pan.id", f"{self.pan.servo_id}, as tilt.id; two ids are expected")
        wire_s = self.poll_bytes * 10 / self.baud
        if wire_s > 1 / self.poll_hz:
            raise problem(
                "baud",
                f"{self.baud}: reading both servos takes {1000 * wire_s:.1f} ms, too long for "
                f"poll_hz {self.poll_hz:g}; {math.ceil(self.poll_bytes * 10 * self.poll_hz)} baud or more is "
                "expected (mastctl rig servo set-id has --new-baud)",
            )
        return self

    def _set_patience(self, key: str, usual_s: float, shortest_s: float) -> None:
        """Check how long a servo goes on after the last packet (0: for ever), or set the usual time.

        It is short enough for the head to be at rest `STANDS_WITHIN_S` after the last poll, braking included.
        """
        speed, acceleration = self.speed_rad_per_s, self.acceleration_rad_per_s2
        brakes_s = speed / acceleration
        longest_s = round(STANDS_WITHIN_S - 1 / self.poll_hz - brakes_s, 9)
        braking = f"braking from {speed:g} rad/s at {acceleration:g} rad/s2 takes {brakes_s:.3g} s"
        value_s: float | None = getattr(self, key)
        if longest_s < shortest_s and value_s != 0:
            least = speed / (STANDS_WITHIN_S - 1 / self.poll_hz - shortest_s)
            raise problem(
                "acceleration_rad_per_s2",
                f"{acceleration:g}: {braking}, so that no {key} stops the head within {STANDS_WITHIN_S:g} s "
                f"in all; {least:.3g} or more, a lower speed_rad_per_s, or {key}: 0 to do without is "
                "expected",
            )
        if value_s is None:
            object.__setattr__(self, key, min(usual_s, longest_s))
        elif value_s and not shortest_s <= value_s <= longest_s:
            raise problem(
                key,
                f"{value_s:.3g} s, and {braking}; {shortest_s:g} to {longest_s:.3g} s, which with the last "
                f"poll's age is {STANDS_WITHIN_S:g} s in all, or 0 to do without is expected",
            )

    @property
    def resting_poll_s(self) -> float:
        """How often servos at rest are read, seconds."""
        return max(1 / self.poll_hz, RESTING_POLL_S)

    @property
    def silence_s(self) -> float:
        """How long nothing may be sent so that both axes have stopped by themselves; 0 if they never do."""
        return 0.0
