"""Both axes of a head on one open line, and the watch over them: what a session needs of each family."""

from __future__ import annotations

import logging
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager

from drivers.clock import Clock
from drivers.errors import DriverError, HardwareFault, LineLost, NoReply, WatchdogTripped, WrongDevice
from drivers.servo_bus.course import AxisCourse, ServoSample, Truth
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


log = logging.getLogger(__name__)

STAND_ROUNDS = 2
BRAKE_COPIES = 3  # more than one reply can collide with
HALT_TRIES, HALT_REST_S = 5, 2.5


class ServoAxis:
    """One axis while its servo is at hand."""

    def __init__(
        self, servo: BusServo, clock: Clock, settings: ServoAxisSettings, head: HeadSettings
    ) -> None:
        self.settings = settings
        self._clock = clock
        self.servo = servo
        self.motion = AxisCourse(self.servo.name, settings, head.settle_s)
        self.hardware_error = ""
        counts = settings.acceleration_counts(head.acceleration_rad_per_s2)
        self.acceleration_rad_per_s2 = counts * settings.model.acceleration_unit_rad_per_s2

    def take_hold(self) -> None:
        """Hold where the axis is, with nothing commanded; raises as `BusServo.take_hold`."""
        self.motion.begin(self.servo.take_hold())
        self.motion.profile = self.servo.profile

    def halt(self) -> int | None:
        """Make where braking ends the goal, and return it; None for an axis that holds nothing."""
        if not self.motion.holds or self.motion.sample is None:
            return None
        goal = self.motion.braking_counts(self._clock.now_s(), self.acceleration_rad_per_s2)
        self.motion.halt(goal)
        return goal

    def brake(self) -> None:
        """Brake and hold where that ends, if the axis holds at all; raises as `BusServo.set`."""
        goal = self.halt()
        if goal is not None:
            self.servo.set("goal_position", goal)

    def reach(self) -> int:
        """Return how far the axis may be sent now, as a goal."""
        return self.motion.goal

    def go_on(self) -> None:
        """Send the next leg of a move if the present one has ended; raises as `BusServo.send_leg`."""
        goal = self.motion.next_leg()
        if goal is not None:
            self.servo.send_leg(self.motion.profile or self.servo.profile, goal)
            self.motion.begin_leg()

    def hold_again(self) -> None:
        """Switch on the torque that setting the servo up has dropped; never raises."""
        servo = self.servo
        servo.dropped = False
        try:  # it may droop beyond a limit
            servo.set("goal_position", self.settings.within_limits(servo.sample().counts))
            servo.set("torque_enable", 1)
        except DriverError as error:
            log.warning("%s: its torque is off and could not be switched on again: %s", servo.name, error)


class ServoPair(ABC):
    """Pan and tilt on one open line."""

    axes: tuple[ServoAxis, ...]

    def __init__(self, link: BusLink) -> None:
        self.link = link

    @property
    def clock(self) -> Clock:
        """Of the line's deadlines."""
        return self.link.clock

    @abstractmethod
    def samples(self) -> Sequence[ServoSample]:
        """Return both servos' present motion, pan first, in one transaction. Raises DriverError."""

    def make_ready(self, goes_on: bool) -> None:
        """Make both servos ready, without moving them: checked, set up, holding, armed.

        Of servos that no silence stops (``goes_on``) an axis may still be under way. Each is commanded to
        stand first, whatever the other does. An axis whose torque was dropped to set it up holds again if it
        cannot be made ready. Raises Overtaken if a stop came meanwhile; LineLost, NoReply, BadReply,
        WrongDevice, HardwareFault, Refused if the servos cannot be reached or do not fit.
        """
        if goes_on:
            self.stand()
        servos = [axis.servo for axis in self.axes]
        with self.holding_in_the_end():
            for servo in servos:
                servo.check_identity()
            for servo in servos:
                servo.check_health()
                servo.check_place()
            for servo in servos:
                servo.set_up()
            for axis in self.axes:
                axis.take_hold()
            self.arm()

    def arm(self) -> None:  # noqa: B027
        """Have silence stop the servos from now on. Raises DriverError."""

    def send_goals(self, speeds: Sequence[int]) -> Sequence[int]:
        """Write profile and goal of both axes with one packet; returns as much of the goals as was sent.

        Raises LineLost, BadReply.
        """
        parts, sent = [], []
        for axis, speed in zip(self.axes, speeds, strict=True):
            axis.motion.profile = axis.servo.profile[0], speed
            sent.append(axis.reach())
            parts.append(axis.servo.leg(axis.motion.profile, sent[-1]))
            axis.motion.note_sent(sent[-1])
        self.link.group_write(parts)
        return sent

    def brake(self) -> None:
        """Command each axis that holds to brake, whatever the line or the other axis does.

        Nothing is requested and there is no answer: a sample shows the goal. Raises LineLost.
        """
        halted = [(axis, axis.halt()) for axis in self.axes]
        parts = [axis.servo.part("goal_position", goal) for axis, goal in halted if goal is not None]
        if parts:
            self.link.write_at_once(parts, BRAKE_COPIES)

    def stand(self) -> None:
        """Command each axis that is under way to stand, as far as it answers. Raises LineLost."""
        waiting = list(self.axes)
        for _ in range(STAND_ROUNDS):
            for axis in tuple(waiting):
                try:
                    axis.servo.stand()
                except LineLost:
                    raise
                except DriverError as error:  # reported when the servo is made ready
                    log.debug("%s was not commanded to stand: %s", axis.servo.name, error)
                else:
                    waiting.remove(axis)

    def halt(self) -> list[str]:
        """Command each axis to stand, by itself, then see that those that hold do; returns their states.

        Raises NoReply if an axis did not confirm, or still moves; the other was commanded all the same.
        """
        confirmed: dict[str, str] = {}
        failed: dict[str, object] = {}
        for _ in range(HALT_TRIES):  # each once before any of them again
            for axis in self.axes:
                if axis.servo.name not in confirmed:
                    try:
                        confirmed[axis.servo.name] = axis.servo.stood()
                    except DriverError as error:
                        failed[axis.servo.name] = error
        missing = {name: error for name, error in failed.items() if name not in confirmed}
        for axis in self.axes:
            name = axis.servo.name
            if name in confirmed:
                try:
                    at_rest, sample = rests(axis.servo.sample, self.clock, HALT_REST_S, Rest())
                    if not at_rest and sample.values.get("torque_enable", True):
                        missing[name] = "it got the command to stand, but still moves"
                except DriverError as error:
                    missing[name] = error
        if missing:
            reasons = "; ".join(f"{name}: {error}" for name, error in missing.items())
            raise NoReply(f"not halted, it may still move: {reasons}")
        return [f"{name} {state}" for name, state in confirmed.items()]

    @contextmanager
    def holding_in_the_end(self) -> Iterator[None]:
        """Have each servo hold again whose torque was dropped within, if that fails."""
        try:
            yield
        except BaseException:  # a stop too, or a closing: what hangs on an axis must not fall
            with self.link.undisturbed():
                for axis in self.axes:
                    if axis.servo.dropped:
                        axis.hold_again()
            raise

    def close(self) -> None:
        """Close the line."""
        self.link.close()


class SessionWatch(ABC):
    """Watches for what servos do by themselves, from when they were made ready until the line is given up.

    ``tripped``: silence has stopped a motion; latched until `end_trip`. Then there is the fault
    ``trip_fault``, and moves are refused with ``trip_refusal``.
    """

    trip_fault = ""
    trip_refusal = ""

    def __init__(self, pair: ServoPair) -> None:
        self.tripped = False
        self._axes = pair.axes

    @abstractmethod
    def heard_again(self, silence_s: float) -> None:
        """Note how long nothing was heard of the servos. Raises LineLost."""

    @abstractmethod
    def check(self) -> None:
        """See that they are as they were left. Raises GivenUp, DriverError."""

    def check_soon(self) -> None:  # noqa: B027
        """Have the next `check` query the servos."""

    @abstractmethod
    def note_alert(self, axis: ServoAxis) -> None:
        """A servo reports a fault: brake both axes and say which. Raises GivenUp, DriverError."""

    def faults_of(self, axis: ServoAxis) -> list[str]:
        """Return what forbids an axis to move, in sentences."""
        return [axis.hardware_error] if axis.hardware_error else []

    def check_free(self) -> None:
        """See that nothing forbids a move. Raises HardwareFault, WatchdogTripped."""
        for axis in self._axes:
            for fault in self.faults_of(axis):
                raise HardwareFault(fault)
        if self.tripped:
            raise WatchdogTripped(self.trip_refusal)

    def arm(self) -> None:  # noqa: B027
        """Have silence stop the servos from now on. Raises DriverError."""

    def arm_axis(self, axis: ServoAxis) -> None:  # noqa: B027
        """The same of one axis. Raises DriverError."""

    def has_stopped(self, axis: ServoAxis) -> bool:
        """Return whether silence has stopped an axis, which obeys no goal then. Raises DriverError."""
        return False

    def end_trip(self) -> None:
        """Forget a trip: both axes are where they were stopped, with their old goals void."""
        self.tripped = False

    def faults(self, now_s: float) -> tuple[str, ...]:
        """Return what is wrong, in sentences."""
        found = [fault for axis in self._axes for fault in self.faults_of(axis)]
        found += [self.trip_fault] if self.tripped else []
        found += [axis.motion.stuck_fault(now_s) for axis in self._axes]
        return tuple(fault for fault in found if fault)
