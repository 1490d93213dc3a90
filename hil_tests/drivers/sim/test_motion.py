"""The axis as a function of time, against integration, hand-worked cases and its own bounds."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from drivers.sim.motion import Leg, Motion

SPEED, ACCELERATION = 0.8, 2.0
POSITION_TOLERANCE_RAD = 1e-9
angles = st.floats(-3.0, 3.0)
speeds = st.floats(-2.0, 2.0)


def leg(start: float, velocity: float, goal: float, speed: float = SPEED) -> Leg:
    return Leg(5.0, start, velocity, goal, speed, ACCELERATION)


@pytest.mark.parametrize(
    ("distance", "duration_s"),
    [
        # Textbook rest-to-rest times: 2·sqrt(d/a) without a cruise, d/v + v/a with one; v²/a = 0.32 rad.
        (0.02, 2 * math.sqrt(0.02 / 2.0)),
        (0.32 - 1e-9, 2 * math.sqrt(0.32 / 2.0)),
        (0.32 + 1e-9, 0.32 / 0.8 + 0.8 / 2.0),
        (1.6, 1.6 / 0.8 + 0.8 / 2.0),
        (-1.6, 1.6 / 0.8 + 0.8 / 2.0),
        (0.0, 0.0),
    ],
)
def test_rest_to_rest_takes_the_textbook_time(distance: float, duration_s: float) -> None:
    move = leg(0.3, 0.0, 0.3 + distance)
    assert move.end_s - 5.0 == pytest.approx(duration_s, abs=1e-8)
    assert move.at(move.end_s) == (0.3 + distance, 0.0)
    just_before = move.at(math.nextafter(move.end_s, 0.0))
    assert just_before[0] == pytest.approx(0.3 + distance, abs=POSITION_TOLERANCE_RAD)


@settings(max_examples=150)
@given(start=angles, velocity=speeds, goal=angles, speed=st.floats(0.05, 3.0))
def test_velocity_integrates_to_position_and_keeps_the_bounds(
    start: float, velocity: float, goal: float, speed: float
) -> None:
    move = leg(start, velocity, goal, speed)
    t = np.linspace(move.start_s, move.end_s + 0.1, 4001)
    states = np.array([move.at(float(s)) for s in t])
    position, rate = states.T
    dt = t[1] - t[0]
    # A trapezoid sum is exact but in the cells that hold one of the profile's (at most four) corners.
    corner_error = 4 * 2 * ACCELERATION * dt * dt
    travelled = np.concatenate([[0.0], np.cumsum((rate[1:] + rate[:-1]) / 2 * dt)])
    assert np.abs(start + travelled - position).max() <= corner_error + 1e-9
    assert np.abs(np.diff(rate)).max() <= ACCELERATION * dt * (1 + 1e-6) + 1e-9
    assert np.abs(rate).max() <= max(speed, abs(velocity)) + 1e-9
    assert tuple(states[-1]) == (goal, 0.0)


@settings(max_examples=150)
@given(first=angles, second=angles, when=st.floats(0.0, 4.0), speed=st.floats(0.05, 3.0), stop=st.booleans())
def test_a_new_command_under_way_is_continuous(
    first: float, second: float, when: float, speed: float, stop: bool
) -> None:
    before = Motion.at_rest(0.0, 0.0).moved(0.0, [first], SPEED, ACCELERATION)
    after = before.moved(when, [second], speed, ACCELERATION)
    if stop:
        after = before.stopped(when, ACCELERATION)
    step_s = 1e-7
    for moment in (when - step_s, when, when + step_s):
        reference = before.at(when)
        position, velocity = after.at(moment)
        assert position == pytest.approx(reference[0], abs=2 * SPEED * step_s + 1e-9)
        assert velocity == pytest.approx(reference[1], abs=2 * ACCELERATION * step_s + 1e-9)
    assert after.at(when - 0.1) == before.at(when - 0.1), "the past does not change"


def test_the_position_of_a_past_moment_can_be_asked_for_a_minute_long() -> None:
    motion = Motion.at_rest(0.0, 0.0)
    for second in range(200):
        motion = motion.moved(float(second), [0.1 * (second % 2)], SPEED, ACCELERATION)
    assert len(motion.legs) < 70
    assert motion.at(150.0)[0] == pytest.approx(0.1)
    assert motion.at(150.999)[0] == pytest.approx(0.0)
