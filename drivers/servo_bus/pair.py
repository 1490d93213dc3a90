"""Both axes of a head on one open line, and the watch over them: what a session needs of each family."""

from __future__ import annotations

import logging
from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence
from contextlib import contextmanager

from drivers.clock import Clock
from drivers.errors import DriverError, HardwareFault, LineLost, NoReply, WatchdogTripped
from drivers.servo_bus.course import AxisCourse, ServoSample
from drivers.servo_bus.exchange import BusLink
from drivers.servo_bus.servo import BusServo, Rest, rests
from drivers.servo_bus.settings import HeadSettings, ServoAxisSettings

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

    Attributes
    ----------
    tripped
        Whether silence has stopped a motion; latched until `end_trip`.
    trip_fault, trip_refusal
        The fault, and the refusal of moves, while tripped.
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
