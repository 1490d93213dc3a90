"""One axis as a pure function of time: trapezoid profiles in closed form, with no threads and no sleeps.

A ``Leg`` is one profile: from a position and velocity at a moment to rest at a goal, with bounds on speed
and acceleration. A ``Motion`` is the history of legs, so that the position at a past moment (the middle of
an exposure) can be queried. Both are frozen: a new command gives a new ``Motion``.
"""

from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property

HISTORY_S = 60.0
"""How long a superseded leg is remembered, seconds."""


@dataclass(frozen=True)
class Leg:
    """A move to rest at ``goal_rad``, continuous in position and signed speed from its start.

    The time-optimal trapezoid: accelerate (or brake, or turn round) to the cruise speed, cruise, brake.
    A start faster than ``speed_rad_per_s`` brakes to it first; a goal nearer than the stopping distance
    is overshot and come back to.
    """

    start_s: float
    start_rad: float
    start_rad_per_s: float
    goal_rad: float
    speed_rad_per_s: float
    acceleration_rad_per_s2: float

    @cached_property
    def _phases(self) -> tuple[float, float, float, float, float]:
        """Direction ±1, cruise speed, and the durations of ramp, cruise and braking (speeds along it)."""
        a = self.acceleration_rad_per_s2
        v0 = self.start_rad_per_s
        stop_rad = self.start_rad + v0 * abs(v0) / (2 * a)
        direction = 1.0 if self.goal_rad >= stop_rad else -1.0
        u = direction * v0
        distance = direction * (self.goal_rad - self.start_rad)
        # Ramp u -> p covers |p² - u²|/2a and braking p -> 0 covers p²/2a. Without a cruise
        # they add up to the distance, which gives the peak speed p below.
        peak = math.sqrt(max(0.0, a * distance + u * u / 2))
        cruise = min(peak, self.speed_rad_per_s)
        if u > self.speed_rad_per_s:
            cruise = self.speed_rad_per_s
            covered = u * u / (2 * a)
        else:
            covered = (2 * cruise * cruise - u * u) / (2 * a)
        cruise_s = max(0.0, distance - covered) / cruise if cruise > 0 else 0.0
        return direction, cruise, abs(cruise - u) / a, cruise_s, cruise / a

    @cached_property
    def end_s(self) -> float:
        """When the axis comes to rest at the goal, seconds."""
        _, _, ramp_s, cruise_s, brake_s = self._phases
        return self.start_s + ramp_s + cruise_s + brake_s

    @cached_property
    def turn_rad(self) -> float | None:
        """The position where the axis turns round on this leg; None when it moves one way only."""
        direction, _, _, _, _ = self._phases
        if direction * self.start_rad_per_s >= 0:
            return None
        v0 = self.start_rad_per_s
        return self.start_rad + v0 * abs(v0) / (2 * self.acceleration_rad_per_s2)

    @property
    def turn_s(self) -> float:
        """When it turns round; the start when it does not."""
        if self.turn_rad is None:
            return self.start_s
        return self.start_s + abs(self.start_rad_per_s) / self.acceleration_rad_per_s2

    def accelerations(self) -> tuple[tuple[float, float], ...]:
        """Return from when on it accelerates how much: moments (s) and signed values (rad/s²), the last 0."""
        direction, cruise, ramp_s, cruise_s, _ = self._phases
        change = cruise - direction * self.start_rad_per_s
        ramp = math.copysign(self.acceleration_rad_per_s2, direction * change) if ramp_s > 0 else 0.0
        brake_s = self.start_s + ramp_s + cruise_s
        brake = -direction * self.acceleration_rad_per_s2 if cruise > 0 else 0.0
        return (self.start_s, ramp), (self.start_s + ramp_s, 0.0), (brake_s, brake), (self.end_s, 0.0)

    def at(self, time_s: float) -> tuple[float, float]:
        """Return position (rad) and velocity (rad/s) at a moment; before the start, those of the start."""
        t = time_s - self.start_s
        if t <= 0:
            return self.start_rad, self.start_rad_per_s
        if time_s >= self.end_s:
            return self.goal_rad, 0.0
        direction, cruise, ramp_s, cruise_s, brake_s = self._phases
        if t < ramp_s:
            u = direction * self.start_rad_per_s
            a = math.copysign(self.acceleration_rad_per_s2, cruise - u)
            return self.start_rad + direction * (u * t + a * t * t / 2), direction * (u + a * t)
        # From the goal backwards, so that the leg ends exactly there.
        left_s = ramp_s + cruise_s + brake_s - t
        a = self.acceleration_rad_per_s2
        if left_s <= brake_s:
            return self.goal_rad - direction * a * left_s * left_s / 2, direction * a * left_s
        to_go = cruise * cruise / (2 * a) + cruise * (left_s - brake_s)
        return self.goal_rad - direction * to_go, direction * cruise


@dataclass(frozen=True)
class Motion:
    """The legs of an axis, oldest first; a leg holds until the next one starts.

    A leg may start in the future: the second part of an approach from one side waits for the first.
    """

    legs: tuple[Leg, ...]

    @staticmethod
    def at_rest(time_s: float, position_rad: float) -> Motion:
        """Return the motion of an axis that stands still."""
        return Motion((Leg(time_s, position_rad, 0.0, position_rad, 1.0, 1.0),))

    def leg_index(self, time_s: float) -> int:
        """Return which leg holds at a moment; the oldest for one before the history."""
        return max(0, bisect_right(self.legs, time_s, key=lambda leg: leg.start_s) - 1)

    def at(self, time_s: float) -> tuple[float, float]:
        """Return position (rad) and velocity (rad/s) at a moment."""
        return self.legs[self.leg_index(time_s)].at(time_s)

    def shocks(self, until_s: float) -> Iterator[tuple[float, float]]:
        """Yield from which moments (s) on it accelerates how much (rad/s²), until a moment, oldest first."""
        for number, leg in enumerate(self.legs):
            after = self.legs[number + 1 :]
            end_s = after[0].start_s if after else math.inf
            for time_s, acceleration in leg.accelerations():
                if time_s >= end_s or time_s > until_s:
                    break
                yield time_s, acceleration

    @property
    def end_s(self) -> float:
        """When the last leg is done, seconds."""
        return self.legs[-1].end_s

    @property
    def stood_since_s(self) -> float:
        """When it last stops turning; minus infinity if it never turned. Orders to stay do not count."""
        ends_s = [*(leg.start_s for leg in self.legs[1:]), math.inf]
        turns = [min(leg.end_s, end_s) for leg, end_s in zip(self.legs, ends_s, strict=True)]
        return max((t for leg, t in zip(self.legs, turns, strict=True) if t > leg.start_s), default=-math.inf)

    def kept(self, time_s: float) -> int:
        """Return the index of the oldest leg that a command at ``time_s`` still remembers."""
        return self.leg_index(time_s - HISTORY_S)

    def _then(self, time_s: float, new: Sequence[Leg]) -> Motion:
        """The legs that have started, within the history, followed by new ones."""
        first, last = self.kept(time_s), self.leg_index(time_s)
        return Motion((*self.legs[first : last + 1], *new))

    def moved(
        self,
        time_s: float,
        goals_rad: Sequence[float],
        speed_rad_per_s: float,
        acceleration_rad_per_s2: float,
    ) -> Motion:
        """Return the motion with a command at ``time_s``: to the goals one after the other, from as it is."""
        position, velocity = self.at(time_s)
        start_s = time_s
        legs: list[Leg] = []
        for goal in goals_rad:
            leg = Leg(start_s, position, velocity, goal, speed_rad_per_s, acceleration_rad_per_s2)
            legs.append(leg)
            start_s, position, velocity = leg.end_s, goal, 0.0
        return self._then(time_s, legs)

    def stopped(self, time_s: float, acceleration_rad_per_s2: float) -> Motion:
        """Return the motion braked from ``time_s`` to rest at the nearest place the acceleration allows."""
        position, velocity = self.at(time_s)
        stop_rad = position + velocity * abs(velocity) / (2 * acceleration_rad_per_s2)
        speed = max(abs(velocity), 1e-9)
        leg = Leg(time_s, position, velocity, stop_rad, speed, acceleration_rad_per_s2)
        return self._then(time_s, [leg])

    def jammed(self, time_s: float) -> Motion:
        """Return the motion seized at ``time_s``: at rest at once, the one jump in velocity; a fault."""
        return self._then(time_s, Motion.at_rest(time_s, self.at(time_s)[0]).legs)
