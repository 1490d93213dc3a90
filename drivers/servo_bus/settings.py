"""The options of a head of two servos and of its axes, read strictly; a family of servos adds its own."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Generic, Literal, TypeVar

from drivers.approach import APPROACHES, ApproachedAxis
from drivers.errors import BadOptions, WrongDevice
from drivers.options import OptionReader

Rest = Literal["hold", "torque_off"]

STANDS_WITHIN_S = 0.5  # after this process has died: the last poll's age, the patience, and braking
RESTING_POLL_S = 0.1  # of servos that stand: an idle computer stays idle
LEAST_SLACK_COUNTS = 3


@dataclass(frozen=True, kw_only=True)
class CountedModel:
    """A kind of servo, by its counts.

    Attributes
    ----------
    name, number
        As its maker calls it, and as its memory does; None for a whole series, of which it is not compared.
    registers
        Of its table, by name.
    low_count, high_count, centre_count
        The position limits at most, and where its own angle is zero.
    count_rad, velocity_unit_rad_per_s, acceleration_unit_rad_per_s2, current_unit_A
        One count of position, velocity, acceleration and current; no current where it measures none.
    backlash_rad
        As the maker states it; None where nothing is stated.
    """

    name: str
    number: int | None
    registers: Mapping[str, Any]
    low_count: int
    high_count: int
    centre_count: int
    count_rad: float
    velocity_unit_rad_per_s: float
    acceleration_unit_rad_per_s2: float
    current_unit_A: float | None = None
    backlash_rad: float | None = None


@dataclass(frozen=True, kw_only=True)
class ServoAxisSettings(ApproachedAxis):
    """One axis of the head, as of `ApproachedAxis`; its limits are also the servo's position limits.

    Attributes
    ----------
    at_close
        Whether the servo holds when the head is closed, or its torque is switched off (a tilt axis may fall).
    settle_rad
        How near to its goal the axis counts as in position.
    """

    servo_id: int
    model: CountedModel
    zero_counts: int
    at_close: Rest = "hold"
    settle_rad: float = 0.01

    def counts(self, angle_rad: float) -> int:
        """Return the nearest count to an angle."""
        return self.zero_counts + round(self.sign * angle_rad / self.model.count_rad)

    def angle_rad(self, counts: float) -> float:
        """Return the angle of a position."""
        return self.sign * (counts - self.zero_counts) * self.model.count_rad

    @property
    def limit_counts(self) -> tuple[int, int]:
        """The limits in counts, lower first; rounded inwards."""
        ends = sorted(self.zero_counts + self.sign * a / self.model.count_rad for a in self.limits_rad)
        return math.ceil(ends[0] - 1e-6), math.floor(ends[1] + 1e-6)

    @property
    def slack_counts(self) -> int:
        """How far beyond a limit an axis that was sent to it may stand: it droops, or dithers."""
        return max(LEAST_SLACK_COUNTS, math.ceil(self.settle_rad / self.model.count_rad))

    def held_counts(self, name: str, counts: int) -> int:
        """Return the nearest goal within the limits to where an axis stands.

        A few counts beyond a limit are passed (`slack_counts`): an axis that holds at its limit droops, and
        would be locked out for good. Raises WrongDevice if it stands outside: moving from there could go the
        wrong way round.
        """
        low, high = self.limit_counts
        if not low - self.slack_counts <= counts <= high + self.slack_counts:
            raise WrongDevice(
                f"{name} stands at {counts} counts ({self.angle_rad(counts):.4f} rad), outside its "
                f"limits {low} to {high} ({self.limits_rad[0]:.4f} to {self.limits_rad[1]:.4f} rad): "
                "with torque off turn it inside by hand, or correct zero_counts or limits_rad"
            )
        return min(max(counts, low), high)

    def acceleration_counts(self, acceleration_rad_per_s2: float) -> int:
        """Return a profile acceleration, not below the one given: braking takes no longer than promised."""
        return max(1, math.ceil(acceleration_rad_per_s2 / self.model.acceleration_unit_rad_per_s2 - 1e-6))

    def velocity_counts(self, speed_rad_per_s: float) -> int:
        """Return a profile velocity, not above the speed; never 0, which would mean as fast as it can."""
        return max(1, math.floor(speed_rad_per_s / self.model.velocity_unit_rad_per_s + 1e-9))


A = TypeVar("A", bound=ServoAxisSettings)


@dataclass(frozen=True, kw_only=True)
class HeadSettings(Generic[A]):
    """A head of two servos on one bus; a family of servos adds its own.

    Attributes
    ----------
    port, baud
        The line: a serial device or a pyserial URL, and its bits per second.
    speed_rad_per_s, acceleration_rad_per_s2
        Of the profile inside the servos; the speed is also the cap of every move.
    poll_hz
        How often the servos are read while they move, if no client asks.
    reply_timeout_s
        How long a reply may take beyond its time on the wire; a lost one must not trip a watchdog.
    settle_s
        How long both axes must stand in position to count as settled.
    torque_off_at_start
        Whether torque may be dropped at start-up where permanent settings must be changed.
    """

    port: str
    pan: A
    tilt: A
    baud: int = 1_000_000
    speed_rad_per_s: float = 1.0
    acceleration_rad_per_s2: float = 4.0
    poll_hz: float = 50.0
    reply_timeout_s: float = 0.05
    settle_s: float = 0.1
    torque_off_at_start: bool = False

    @property
    def resting_poll_s(self) -> float:
        """How often servos that stand are read, seconds."""
        return max(1 / self.poll_hz, RESTING_POLL_S)

    @property
    def silence_s(self) -> float:
        """How long nothing may be sent so that both axes have stopped by themselves; 0 if they never do."""
        return 0.0


AXIS_KEYS = (
    "id", "model", "zero_counts", "sign", "limits_rad", "approach", "approach_rad", "gravity_turnover_rad",
    "at_close", "settle_rad",
)  # fmt: skip
"""What the options of an axis hold, whatever the servo."""


def axis_values(
    options: OptionReader, name: str, model_named: Callable[[str], CountedModel], more: tuple[str, ...] = ()
) -> tuple[OptionReader, Mapping[str, Any]]:
    """Return the reader of an axis' options, and the values of `AXIS_KEYS` as `ServoAxisSettings` has them.

    Raises BadOptions for an unknown or missing key or a value that cannot be.

    Parameters
    ----------
    name
        ``pan`` or ``tilt``.
    model_named
        Finds a model; raises BadOptions.
    """
    expected = "a mapping with id, model, zero_counts ..."
    read = options.section(name, expected, (*AXIS_KEYS, *more), ("id", "model", "limits_rad"))
    try:
        model = model_named(read.values["model"])
    except BadOptions as error:
        raise read.refused("model", f": {error}") from None
    limits_rad = read.pair("limits_rad", "[low, high] in radians")
    if not limits_rad[0] < limits_rad[1]:
        raise read.bad("limits_rad", "[low, high] with low below high")
    return read, {
        "servo_id": read.whole("id", 1, 0, 252),
        "model": model,
        "zero_counts": read.whole("zero_counts", model.centre_count, -(2**31), 2**31 - 1),
        "limits_rad": limits_rad,
        "sign": read.one_of("sign", 1, (1, -1)),
        "approach": read.one_of("approach", "none", APPROACHES),
        "approach_rad": read.number("approach_rad", 0.0, 0.0, 0.5),
        "gravity_turnover_rad": read.number("gravity_turnover_rad", math.pi / 2, -math.pi, math.pi),
        "at_close": read.one_of("at_close", "hold", ("hold", "torque_off")),
        "settle_rad": read.number("settle_rad", max(0.001, 3 * model.count_rad), model.count_rad, 0.1),
    }


def head_values(
    read: OptionReader, axis: Callable[[OptionReader, str], A], most_poll_hz: float, steepest: float
) -> dict[str, Any]:
    """Return the values of a head's options as `HeadSettings` has them, without baud and patience.

    Raises BadOptions for a value that cannot be.

    Parameters
    ----------
    most_poll_hz, steepest
        Bounds of ``poll_hz`` and ``acceleration_rad_per_s2``.
    """
    values = {
        "port": read.text("port", "a serial device such as /dev/ttyUSB0 or a URL"),
        "pan": axis(read, "pan"),
        "tilt": axis(read, "tilt"),
        "poll_hz": read.number("poll_hz", 50.0, 10.0, most_poll_hz),
        "speed_rad_per_s": read.number("speed_rad_per_s", 1.0, 0.03, 10.0),
        "acceleration_rad_per_s2": read.number("acceleration_rad_per_s2", 4.0, 0.4, steepest),
        "settle_s": read.number("settle_s", 0.1, 0.0, 5.0),
        "torque_off_at_start": read.flag("torque_off_at_start", False),
    }
    number = values["pan"].servo_id
    if number == values["tilt"].servo_id:
        raise BadOptions(f"options.pan.id and options.tilt.id are both {number}, expected two ids")
    return values


def check_polling(read: OptionReader, baud: int, poll_hz: float, poll_bytes: int) -> None:
    """Refuse bits per second that are too few to read both servos as often as is asked."""
    wire_s = poll_bytes * 10 / baud
    if wire_s > 1 / poll_hz:
        raise read.refused(
            "baud",
            f" {baud}: reading both servos takes {1000 * wire_s:.1f} ms, too long for "
            f"poll_hz {poll_hz:g}; expected {math.ceil(poll_bytes * 10 * poll_hz)} baud or more "
            "(mastctl servo set-id has --new-baud)",
        )


def patience_s(
    read: OptionReader, head: Mapping[str, Any], key: str, usual_s: float, shortest_s: float
) -> float:
    """Return how long a servo goes on after the last packet; 0: for ever.

    It is short enough for the head to stand `STANDS_WITHIN_S` after the last poll, braking included. Raises
    BadOptions if it is too long, or none is short enough.
    """
    speed, acceleration = head["speed_rad_per_s"], head["acceleration_rad_per_s2"]
    brakes_s = speed / acceleration
    longest_s = round(STANDS_WITHIN_S - 1 / head["poll_hz"] - brakes_s, 9)
    braking = f"braking from {speed:g} rad/s at {acceleration:g} rad/s2 takes {brakes_s:.3g} s"
    if longest_s < shortest_s and read.values.get(key) != 0:
        least = speed / (STANDS_WITHIN_S - 1 / head["poll_hz"] - shortest_s)
        raise read.refused(
            "acceleration_rad_per_s2",
            f" is {acceleration:g}: {braking}, so that no {key} stops the head within {STANDS_WITHIN_S:g} s "
            f"in all; expected {least:.3g} or more, a lower speed_rad_per_s, or {key}: 0 to do without",
        )
    value: float = read.number(key, min(usual_s, longest_s), 0.0, STANDS_WITHIN_S)
    if value and not shortest_s <= value <= longest_s:
        raise read.refused(
            key,
            f" is {value:.3g} s, and {braking}; expected {shortest_s:g} to {longest_s:.3g} s, which with the "
            f"last poll's age is {STANDS_WITHIN_S:g} s in all, or 0 to do without",
        )
    return value


def check_axis(read: OptionReader, axis: ServoAxisSettings) -> None:
    """Refuse limits that the servo cannot hold, and an approach that takes no backlash up."""
    _check_reach(read, axis)
    _check_approach(read, axis)


def _check_reach(read: OptionReader, axis: ServoAxisSettings) -> None:
    """Refuse limits that the servo cannot hold."""
    model = axis.model
    low, high = axis.limit_counts
    if low >= high:
        raise read.refused(
            "limits_rad",
            f" [{axis.limits_rad[0]:g}, {axis.limits_rad[1]:g}] hold no two counts of a {model.name}, whose "
            f"count is {model.count_rad:.2g} rad; expected limits further apart",
        )
    if low < model.low_count or high > model.high_count:
        reach = sorted((axis.angle_rad(model.low_count), axis.angle_rad(model.high_count)))
        raise read.refused(
            "limits_rad",
            f" are the servo's counts {low} to {high}, but a {model.name} in position mode holds "
            f"{model.low_count} to {model.high_count}, which with zero_counts {axis.zero_counts} is "
            f"{reach[0]:.4f} to {reach[1]:.4f} rad. Mount the horn so that the range does not cross the seam",
        )


def _check_approach(read: OptionReader, axis: ServoAxisSettings) -> None:
    """Refuse an approach that takes no backlash up."""
    if (axis.approach == "none") != (axis.approach_rad == 0.0):
        raise read.refused(
            "approach",
            f" is {axis.approach!r} with approach_rad {axis.approach_rad:g}; expected a stretch above zero "
            "with a side, and neither or both",
        )
    least = axis.model.backlash_rad or 0.0
    if axis.approach != "none" and axis.approach_rad <= least:
        raise read.refused(
            "approach_rad",
            f" {axis.approach_rad:g} rad does not take up the backlash of a {axis.model.name}, "
            f"{least:.4f} rad; expected more",
        )
