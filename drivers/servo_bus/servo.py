"""One configured servo of any family: read, held where it is, set up; and whether its axis is at rest."""

from __future__ import annotations

import logging
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping

from drivers.clock import Clock
from drivers.errors import HardwareFault, WrongDevice
from drivers.servo_bus.course import ServoSample, Truth
from drivers.servo_bus.exchange import BusLink, again
from drivers.servo_bus.port import Part
from drivers.servo_bus.settings import HeadSettings, ServoAxisSettings

log = logging.getLogger(__name__)

REST_S = 0.5
SAMPLE_EVERY_S = 0.01
COME_TO_REST_S, HOLDS_S = 0.5, 0.05  # of an axis that is to hold, at most, and at least


class Rest:
    """Whether an axis is at rest, by its positions within ``span_s`` and its speed.

    The speed alone is no proof: one unit of it is up to 50 counts a second, and the servo may report 0 or 1.
    An axis that turns by two counts or more in ``span_s`` is never taken to be at rest. In `REST_S` each
    speed that a servo can be set to does, and a reversal by the smallest acceleration.
    """

    def __init__(self, span_s: float = REST_S) -> None:
        self._span_s = span_s
        self._counts = 0
        self._since_s = float("inf")

    def take(self, values: Mapping[str, int], sent_s: float, received_s: float) -> bool:
        """Take a fresh answer, requested and received at these times; returns whether the axis is at rest."""
        counts, speed = values["present_position"], abs(values["present_velocity"])
        if received_s < self._since_s or speed > 1 or abs(counts - self._counts) > 1:
            self._counts, self._since_s = counts, received_s
        return sent_s - self._since_s >= self._span_s


def rests(
    sample: Callable[[], ServoSample], clock: Clock, within_s: float, rest: Rest
) -> tuple[bool, ServoSample]:
    """Take samples until an axis is at rest; returns whether it is, and the last one."""
    until_s = clock.now_s() + within_s
    while True:
        last = sample()
        at_rest = rest.take(last.values, last.sent_s, last.received_s)
        if at_rest or clock.now_s() > until_s:
            return at_rest, last
        clock.sleep(SAMPLE_EVERY_S)


def come_to_rest(
    sample: Callable[[], ServoSample],
    set_: Callable[[str, int], None],
    within_limits: Callable[[int], int],
    clock: Clock,
) -> int:
    """Wait until an axis is at rest (it may have been falling) and hold it there; returns the goal, counts.

    It holds already: that it does not fall on shows sooner than that it is at rest.
    """
    _, last = rests(sample, clock, COME_TO_REST_S, Rest(HOLDS_S))
    goal = within_limits(last.counts)
    if last.values["goal_position"] != goal:
        set_("goal_position", goal)
    return goal


class BusServo(ABC):
    """One configured servo on an open line; a family says how it is read and set.

    Its methods raise NoReply, BadReply, Refused, LineLost.

    ``dropped``: whether its torque is off because setting it up needed that.
    """

    def __init__(self, link: BusLink, axis: str, settings: ServoAxisSettings, head: HeadSettings) -> None:
        self.name = f"{axis} (servo {settings.servo_id})"
        self.servo_id = settings.servo_id
        self.truth = Truth(self.name, settings)
        self.dropped = False
        self._link = link
        self._settings = settings
        self._head = head
        self._registers = settings.model.registers

    @abstractmethod
    def get(self, register: str) -> int:
        """Return a register's value; a lost reply is requested again."""

    @abstractmethod
    def set(self, register: str, value: int) -> None:
        """Set a register and see that it holds the value. Raises WrongDevice if it holds another one."""

    @abstractmethod
    def check_identity(self) -> None:
        """See that the servo is the one configured, and that it answers every instruction.

        Raises WrongDevice if it is another one, or has changed.
        """

    @abstractmethod
    def check_health(self) -> None:
        """See that the servo reports no fault. Raises HardwareFault."""

    @abstractmethod
    def set_up(self) -> None:
        """Bring the servo's permanent settings to what the configuration says; the torque may be off then.

        Raises WrongDevice if a setting cannot be used, or must change while torque may not be dropped.
        """

    @abstractmethod
    def leg(self, profile: tuple[int, int], goal: int) -> Part:
        """Return a goal with the acceleration and the speed that lead there, for a packet."""

    @abstractmethod
    def sample_once(self) -> ServoSample:
        """Return what the servo says about its motion now, requested one time."""

    @abstractmethod
    def send_leg(self, profile: tuple[int, int], goal: int) -> None:
        """Set a goal with the profile that leads there."""

    @abstractmethod
    def stand(self) -> object:
        """Make where the servo is its goal, if its torque is on."""

    @abstractmethod
    def stood(self) -> str:
        """Have the servo stand, see that it took that, and return its state, as the end of a sentence."""

    @abstractmethod
    def release(self, limp: bool) -> None:
        """Leave it alone at the end, with its torque off if ``limp``; never raises."""

    @abstractmethod
    def _aim_at_place(self) -> bool:
        """Make the place where the axis is its goal, with the profile set; returns whether the torque is
        on."""

    @abstractmethod
    def _set_permanent(self, values: Mapping[str, int]) -> None:
        """Set permanent registers; the torque is off."""

    def part(self, register: str, value: int) -> Part:
        """Return a register and its new value, for a packet."""
        entry = self._registers[register]
        return Part(self.servo_id, entry.address, entry.size, entry.encode(value))

    def neighbours(self, values: Mapping[str, int]) -> Part:
        """Return neighbouring registers and their new values, for a packet."""
        parts = [self.part(name, value) for name, value in values.items()]
        data = b"".join(part.data for part in parts)
        return Part(self.servo_id, parts[0].address, len(data), data)

    @property
    def profile(self) -> tuple[int, int]:
        """Acceleration and speed of the configuration, in the servo's counts."""
        settings, head = self._settings, self._head
        acceleration = settings.acceleration_counts(head.acceleration_rad_per_s2)
        return acceleration, settings.velocity_counts(head.speed_rad_per_s)

    def sample(self) -> ServoSample:
        """Return what the servo says about its motion now; what was lost is requested again."""
        return again(self._link, self.sample_once)

    def check_place(self) -> int:
        """Return the count that may be the axis' goal where it is, as `ServoAxisSettings.goal_at_place`."""
        return self._settings.goal_at_place(self.name, self.sample().counts)

    def take_hold(self) -> int:
        """Switch torque on where the axis is, with the profile set; returns the goal, counts.

        An old goal is void: the present position is the goal before anything can move.
        """
        if not self._aim_at_place():
            self.set("goal_position", self.check_place())
            try:
                self.set("torque_enable", 1)
            except WrongDevice:
                raise HardwareFault(
                    f"{self.name} does not switch its torque on; it may be shut down by a hardware error"
                ) from None
        self.dropped = False
        return come_to_rest(self.sample, self.set, self._settings.within_limits, self._link.clock)

    def _change(self, different: Mapping[str, int]) -> None:
        """Set permanent registers that differ; the torque may be off then.

        Raises WrongDevice if the torque may not be dropped for it.
        """
        if not different:
            return
        changes = ", ".join(f"{name} {value}" for name, value in different.items())
        if self.get("torque_enable"):
            if not self._head.torque_off_at_start:
                raise WrongDevice(
                    f"{self.name} must be set to {changes}, which it takes only with torque off, but torque "
                    "is on and the axis may fall. Support it and set torque_off_at_start: true, or switch "
                    "the servo off and on"
                )
            self.dropped = True
            self.set("torque_enable", 0)
        log.info("%s: setting %s", self.name, changes)
        self._set_permanent(different)
