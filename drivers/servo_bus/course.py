"""What one axis is doing, judged from its samples: legs of a move, settling, truth of a sample. No I/O."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

from drivers.approach import legs_to
from drivers.errors import BadReply
from drivers.interfaces import AxisReport, Side
from drivers.servo_bus.settings import ServoAxisSettings

FASTEST_RAD_PER_S = 15.0  # no servo of the tables turns faster
LEAP_RAD = 0.05
STILL_RAD = 5e-4
STUCK_S = 1.0
IN_POSITION_BIT, PROFILE_BIT = 0x01, 0x02


@dataclass(frozen=True)
class ServoSample:
    """What one servo said about itself in one transaction, in its own units.

    ``sent_s`` and ``received_s`` are seconds of CLOCK_MONOTONIC; it was measured between them.
    """

    values: Mapping[str, int]
    alert: bool
    sent_s: float
    received_s: float

    @property
    def counts(self) -> int:
        """Present position."""
        return self.values["present_position"]


class Truth:
    """Judges whether a servo can be where a sample says, after where it was before.

    That a sample is of its question is seen by the link.
    """

    def __init__(self, name: str, settings: ServoAxisSettings) -> None:
        self._name = name
        self._settings = settings
        self._last: ServoSample | None = None

    def forget(self) -> None:
        """Take the next sample whatever it says: the servo restarted."""
        self._last = None

    def check(self, sample: ServoSample) -> None:
        """Take a sample as true. Raises BadReply if the position has leapt."""
        last = self._last
        if last is not None:
            most_ms = 1000 * (sample.received_s - last.sent_s)
            leap_rad = abs(sample.counts - last.counts) * self._settings.model.count_rad
            if leap_rad > LEAP_RAD + FASTEST_RAD_PER_S * most_ms / 1000:
                raise BadReply(
                    f"{self._name}: the position leapt from {last.counts} to {sample.counts} counts in "
                    f"{most_ms:.0f} ms, which no servo can"
                )
        self._last = sample


class AxisCourse:
    """One axis' goals and whether it has come to rest."""

    def __init__(self, name: str, settings: ServoAxisSettings, settle_s: float) -> None:
        self.name = name
        self.settings = settings
        self._settle_s = settle_s
        self._legs: list[int] = []  # goals still to come, counts
        self._commanded_rad: float | None = None
        self._side: Side = "unknown"
        self._rest: tuple[int, float] | None = None  # counts and since when
        self._sample: ServoSample | None = None
        self._sampled = False  # since the goal was sent
        self._speed_rad_per_s = 0.0  # of the profile
        self.goal = 0
        self.sent: int | None = None  # what of the way to the goal was sent; None: all of it
        self._sent_before: int | None = None  # which a servo holds that did not hear the last of it
        self.profile: tuple[int, int] | None = None  # acceleration and velocity that were sent, counts
        self.holds = True

    @property
    def sample(self) -> ServoSample | None:
        """The last true sample."""
        return self._sample

    @property
    def heard_s(self) -> float:
        """When the last true sample came, seconds of CLOCK_MONOTONIC; minus infinity before the first."""
        return -math.inf if self._sample is None else self._sample.received_s

    def begin(self, goal: int) -> None:
        """Stand at a goal, nothing commanded: after start-up."""
        self._legs, self._commanded_rad, self._rest = [], None, None
        self._sample, self._sampled = None, False
        self._side = "unknown"
        self.goal, self.sent, self.holds = goal, None, True

    def plan(self, angle_rad: float, speed_rad_per_s: float, acceleration_rad_per_s2: float) -> int:
        """Take a new goal and return the count to send first: the goal, or the start of the last stretch."""
        settings, sample = self.settings, self._sample
        assert sample is not None
        low, high = settings.limit_counts  # a goal at a limit may round to a count that the servo refuses
        final = min(max(settings.counts(angle_rad), low), high)
        turn = settings.approach_sign(angle_rad)
        stretch = math.ceil(settings.approach_rad / settings.model.count_rad)
        if (
            final == self.goal
            and self._side == _side(turn * settings.sign)
            and self.settled(sample.received_s)
        ):
            turn = 0  # it stands there, and came from that side
        places = sample.counts, self.stopping_counts(acceleration_rad_per_s2)
        self._commanded_rad, self._speed_rad_per_s = angle_rad, speed_rad_per_s
        self._set(legs_to(final, turn, stretch, (low, high), places))
        return self.goal

    def halt(self, goal: int) -> None:
        """Take where a stop will end as the goal."""
        self._commanded_rad = None
        self._set([goal])

    def limp(self) -> None:
        """Torque is off: the axis holds nothing."""
        self.halt(self._sample.counts if self._sample else self.goal)
        self.holds, self._side = False, "unknown"

    def _set(self, legs: list[int]) -> None:
        here = self._sample.counts if self._sample else legs[0]
        self.goal, self._legs = legs[0], legs[1:]
        self._note_side(self.goal - here)
        self._rest, self._sampled, self.sent, self._sent_before = None, False, None, None

    def stretch(self, lease_s: float, acceleration_rad_per_s2: float) -> int:
        """Return how much of the way to the goal to send now, as a goal.

        It reaches as far as the axis comes in ``lease_s`` at its profile's speed, and brakes then: so far an
        axis goes when its host is gone.
        """
        sample, speed = self._sample, self._speed_rad_per_s
        assert sample is not None
        reach_rad = speed * lease_s + speed**2 / (2 * acceleration_rad_per_s2)
        reach = math.ceil(reach_rad / self.settings.model.count_rad) + 1
        return min(max(self.goal, sample.counts - reach), sample.counts + reach)

    def note_sent(self, goal: int) -> None:
        """Note that so much of the way was sent."""
        self._sent_before = self.sent
        self.sent = None if goal == self.goal else goal
        self._sampled = False

    def more_of_the_way(self, stretch: int) -> int | None:
        """Return what to send next where a way is sent in parts, which never go back; None for nothing."""
        sample = self._sample
        if sample is None or not self.holds or not self._sampled:
            return None
        sent = self.goal if self.sent is None else self.sent
        if sample.values["goal_position"] not in (sent, self._sent_before):
            return None  # another program's
        if self.sent is not None and abs(self.goal - stretch) < abs(self.goal - sent):
            return stretch
        return None if sample.values["goal_position"] == sent else sent

    def next_leg(self) -> int | None:
        """Return the next goal to send when the present leg has ended; `begin_leg` when it was sent.

        None for a servo that does not hold what was sent: it would turn by another program's profile.
        """
        sample = self._sample
        if not self._legs or sample is None or not self._arrived(sample) or self._speed(sample) > 1:
            return None
        if self.foreign_goal():
            return None
        return self._legs[0]

    def begin_leg(self) -> None:
        """Take the next leg's goal as the goal."""
        self._set(self._legs)

    def stopping_counts(self, acceleration_rad_per_s2: float) -> int:
        """Return where the axis would stand if it braked now, within its limits."""
        sample, model = self._sample, self.settings.model
        assert sample is not None
        velocity = sample.values["present_velocity"] * model.velocity_unit_rad_per_s
        way_rad = velocity * abs(velocity) / (2 * acceleration_rad_per_s2)
        low, high = self.settings.limit_counts
        return min(max(sample.counts + round(way_rad / model.count_rad), low), high)

    def braking_counts(self, now_s: float, acceleration_rad_per_s2: float) -> int:
        """Return the goal that makes the axis brake now and stay; needs no new sample.

        Where the last sample is not of now, the axis is taken to have gone on as its profile says: with
        ``acceleration_rad_per_s2`` to the speed of its move. It is never sent beyond the goal that it has, so
        that a stop given again and again to an axis that does not answer moves it no further. An axis at its
        goal keeps that goal: what it droops below it is not made the next one.
        """
        sample, model = self._sample, self.settings.model
        assert sample is not None
        if self.at_goal():
            return self.goal
        left = self.goal - sample.counts
        toward = 1 if left > 0 else -1
        velocity = toward * sample.values["present_velocity"] * model.velocity_unit_rad_per_s
        if velocity < 0:
            return self.stopping_counts(acceleration_rad_per_s2)
        age_s = max(0.0, now_s - sample.received_s)
        top = max(velocity, self._speed_rad_per_s)
        rising_s = min(age_s, (top - velocity) / acceleration_rad_per_s2)
        way_rad = velocity * rising_s + acceleration_rad_per_s2 * rising_s**2 / 2 + top * (age_s - rising_s)
        velocity += acceleration_rad_per_s2 * rising_s
        way_rad += velocity**2 / (2 * acceleration_rad_per_s2)
        way = min(abs(left), round(way_rad / model.count_rad))
        low, high = self.settings.limit_counts
        return min(max(sample.counts + toward * way, low), high)

    def braking_well(self, goal: int, acceleration_rad_per_s2: float) -> bool:
        """Whether a goal that a stop sent is, by the last sample, near enough to where the axis can stand."""
        off = abs(goal - self.braking_counts(-math.inf, acceleration_rad_per_s2))
        return off * self.settings.model.count_rad <= self.settings.settle_rad

    def take(self, sample: ServoSample) -> None:
        """Take a true sample."""
        noise = max(1, round(STILL_RAD / self.settings.model.count_rad))
        still = self._speed(sample) <= 1
        if not still or self._rest is None or abs(sample.counts - self._rest[0]) > noise:
            self._rest = (sample.counts, sample.received_s)
        self._sample, self._sampled = sample, True

    def settled(self, now_s: float) -> bool:
        """Whether the axis is in position (or let go) and has stood for the dwell."""
        sample = self._sample
        if sample is None or self._legs or self._rest is None or self._speed(sample) > 1:
            return False
        in_position = self._arrived(sample) or not self.holds
        return in_position and now_s - self._rest[1] >= self._settle_s

    def at_goal(self) -> bool:
        """Whether nothing is under way: it stands at its last goal, or holds nothing."""
        sample = self._sample
        if sample is None or self._legs or self._speed(sample) > 1:
            return False
        return self._arrived(sample) or not self.holds

    def stuck_fault(self, now_s: float) -> str:
        """Say that the axis stands away from its goal; empty if it does not."""
        sample = self._sample
        if sample is None or self._rest is None or not self.holds or self._arrived(sample):
            return ""
        if self._speed(sample) > 1 or now_s - self._rest[1] < STUCK_S:
            return ""
        left_rad = (self.goal - sample.counts) * self.settings.model.count_rad
        return f"{self.name} stands still {abs(left_rad):.4f} rad from its goal: something holds it"

    def foreign_goal(self) -> str:
        """Say that the servo holds another goal or profile than was sent; empty if it does not."""
        if self._sample is None or not self.holds or not self._sampled:
            return ""
        values = self._sample.values
        sent = self.goal if self.sent is None else self.sent
        if values["goal_position"] not in (sent, self._sent_before):
            return f"{self.name} holds the goal {values['goal_position']} where {sent} was sent"
        if self.profile is None:
            return ""
        acceleration = values.get("profile_acceleration", self.profile[0])  # not in every block
        stored = acceleration, values["profile_velocity"]
        if stored == self.profile:
            return ""
        return (
            f"{self.name} holds the profile acceleration {stored[0]} and velocity {stored[1]} where "
            f"{self.profile[0]} and {self.profile[1]} were sent (0 is as fast as it can)"
        )

    def report(self) -> AxisReport | None:
        """Return where it was sent and where it stands; None before the first sample."""
        sample, settings = self._sample, self.settings
        if sample is None:
            return None
        final = self._legs[-1] if self._legs else self.goal
        return AxisReport(
            commanded_rad=self._commanded_rad,
            goal_counts=final,
            goal_rad=settings.angle_rad(final),
            measured_counts=sample.counts,
            measured_rad=settings.angle_rad(sample.counts),
            side=self._side,
            backlash_rad=settings.model.backlash_rad,
            temperature_C=sample.values["present_temperature"],
            count_rad=settings.model.count_rad,
        )

    def _arrived(self, sample: ServoSample) -> bool:
        """In position: the servo says so or it is near enough, and no profile is under way."""
        status = sample.values["moving_status"]
        near = abs(sample.counts - self.goal) * self.settings.model.count_rad <= self.settings.settle_rad
        close = abs(sample.counts - self.goal) * self.settings.model.count_rad <= 4 * self.settings.settle_rad
        return (near or (close and bool(status & IN_POSITION_BIT))) and not status & PROFILE_BIT

    def _speed(self, sample: ServoSample) -> int:
        return abs(sample.values["present_velocity"])

    def _note_side(self, way_counts: int) -> None:
        """Remember which way the axis turns last, if that takes the backlash up."""
        backlash_rad = self.settings.model.backlash_rad or 0.0
        if abs(way_counts) * self.settings.model.count_rad > backlash_rad:
            self._side = _side(self.settings.sign * way_counts)
        elif way_counts and self._side != _side(self.settings.sign * way_counts):
            self._side = "unknown"


def _side(way: int) -> Side:
    return "positive" if way > 0 else "negative"
