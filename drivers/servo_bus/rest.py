"""Axes at rest: when one is, waiting for that, and ``mastctl stop --without-daemon`` of a head."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from drivers.clock import Clock
from drivers.errors import DriverError, NoReply
from drivers.servo_bus.course import ServoSample
from drivers.servo_bus.pair import ServoPair

REST_S = 0.5
LOOK_S = 0.01  # between one look and the next
COME_TO_REST_S, HOLDS_S = 0.5, 0.05  # of an axis that is to hold, at most, and at least
HALT_TRIES, HALT_REST_S = 5, 2.5


class Rest:
    """Whether an axis stands, by its positions within ``span_s`` and its speed.

    The speed alone is no proof: one unit of it is up to 50 counts a second, and the servo may report 0 or 1.
    An axis that turns by two counts or more in ``span_s`` is never taken to stand. In `REST_S` each speed
    that a servo can be set to does, and a reversal by the smallest acceleration.
    """

    def __init__(self, span_s: float = REST_S) -> None:
        self._span_s = span_s
        self._counts = 0
        self._since_s = float("inf")

    def take(self, values: Mapping[str, int], sent_s: float, received_s: float) -> bool:
        """Take a fresh answer, asked for and received at these times; returns whether the axis stands."""
        counts, speed = values["present_position"], abs(values["present_velocity"])
        if received_s < self._since_s or speed > 1 or abs(counts - self._counts) > 1:
            self._counts, self._since_s = counts, received_s
        return sent_s - self._since_s >= self._span_s


def rests(
    look: Callable[[], ServoSample], clock: Clock, within_s: float, rest: Rest
) -> tuple[bool, ServoSample]:
    """Look again and again until an axis stands; returns whether it does, and the last sample."""
    until_s = clock.now_s() + within_s
    while True:
        sample = look()
        stands = rest.take(sample.values, sample.sent_s, sample.received_s)
        if stands or clock.now_s() > until_s:
            return stands, sample
        clock.sleep(LOOK_S)


def come_to_rest(
    look: Callable[[], ServoSample], set_: Callable[[str, int], None], limits: tuple[int, int], clock: Clock
) -> int:
    """Wait until an axis stands (it may have been falling) and hold it there; returns the goal, in counts.

    It holds already: that it does not fall on shows sooner than that it stands.
    """
    _, sample = rests(look, clock, COME_TO_REST_S, Rest(HOLDS_S))
    goal = min(max(sample.counts, limits[0]), limits[1])
    if sample.values["goal_position"] != goal:
        set_("goal_position", goal)
    return goal


def halt_axes(pair: ServoPair[Any, Any]) -> list[str]:
    """Command each axis to stand, by itself, then see that those that hold do.

    Raises NoReply if an axis did not confirm, or still moves; the other was commanded all the same.
    """
    confirmed: dict[str, str] = {}
    failed: dict[str, object] = {}
    for _ in range(HALT_TRIES):  # each once before any of them again
        for axis in pair.axes:
            if axis.servo.name not in confirmed:
                try:
                    confirmed[axis.servo.name] = pair.stood(axis)
                except DriverError as error:
                    failed[axis.servo.name] = error
    missing = {name: error for name, error in failed.items() if name not in confirmed}
    for axis in pair.axes:
        name = axis.servo.name
        if name in confirmed:
            try:
                stands, sample = rests(axis.servo.look, pair.clock, HALT_REST_S, Rest())
                if not stands and sample.values.get("torque_enable", True):
                    missing[name] = "it got the command to stand, but still moves"
            except DriverError as error:
                missing[name] = error
    if missing:
        words = "; ".join(f"{name}: {error}" for name, error in missing.items())
        raise NoReply(f"not halted, it may still move: {words}")
    return [f"{name} {words}" for name, words in confirmed.items()]
