"""When an axis is taken to stand: by the places that it tells, beside its speed."""

from __future__ import annotations

import pytest

from drivers.servo_bus.course import ServoSample
from drivers.servo_bus.pair import Rest, come_to_rest, rests
from drivers.simulation_clock import SimulationClock

START_S = 100.0


class Axis:
    """One that moves until a moment, and tells its speed in coarse units."""

    def __init__(self, counts_per_s: float, told_speed: int) -> None:
        self.clock = SimulationClock(start_s=START_S)
        self.rests_s = START_S + 0.73
        self.held = {"goal_position": 1000}
        self._speed, self._told = counts_per_s, told_speed

    def counts(self) -> int:
        return 1000 + int(self._speed * (min(self.clock.now_s(), self.rests_s) - START_S))

    def look(self) -> ServoSample:
        sent_s = self.clock.now_s()
        self.clock.sleep(0.001)
        values = {"present_position": self.counts(), "present_velocity": self._told, **self.held}
        return ServoSample(values, False, sent_s, self.clock.now_s())


@pytest.mark.parametrize("counts_per_s", [4.0, 15.6, 40.0, 75.0])
@pytest.mark.parametrize("told_speed", [0, 1])
def test_an_axis_that_tells_no_speed_and_moves_does_not_stand(counts_per_s: float, told_speed: int) -> None:
    axis = Axis(counts_per_s, told_speed)
    with axis.clock.at_work():
        assert rests(axis.look, axis.clock, 2.0, Rest())[0]
        assert axis.clock.now_s() >= axis.rests_s


def test_an_axis_that_turns_back_slowly_does_not_stand_at_its_turn() -> None:
    axis = Axis(0.0, 0)
    axis.counts = lambda: 1000 + int(50 * (axis.clock.now_s() - START_S - 1.0) ** 2)  # type: ignore[method-assign]
    with axis.clock.at_work():
        assert not rests(axis.look, axis.clock, 2.0, Rest())[0], "100 counts/s2, the smallest of all servos"


@pytest.mark.parametrize("counts_per_s", [40.0, 75.0])
def test_an_axis_that_falls_slowly_is_held_where_it_comes_to_rest(counts_per_s: float) -> None:
    axis = Axis(counts_per_s, 1)
    with axis.clock.at_work():
        axis.rests_s = START_S + 0.23
        goal = come_to_rest(axis.look, axis.held.__setitem__, int, axis.clock)
        assert axis.clock.now_s() >= axis.rests_s
        assert goal == axis.held["goal_position"] == axis.counts()


def test_an_axis_that_never_stands_is_said_to_move() -> None:
    axis = Axis(20.0, 0)
    axis.rests_s = START_S + 99.0
    with axis.clock.at_work():
        assert not rests(axis.look, axis.clock, 2.0, Rest())[0]
