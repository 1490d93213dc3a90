"""A servo, its axis, both on one open line, and the watch over them: what a session needs of each family."""

from __future__ import annotations

import logging
from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any, Generic, Protocol, TypeVar

from drivers.clock import Clock
from drivers.errors import DriverError, HardwareFault, LineLost, WatchdogTripped
from drivers.servo_bus.course import AxisCourse, ServoSample
from drivers.servo_bus.exchange import BusLink
from drivers.servo_bus.settings import HeadSettings, ServoAxisSettings

log = logging.getLogger(__name__)

STAND_ROUNDS = 2
BRAKE_COPIES = 3  # more than one reply can collide with


class HeldServo(Protocol):
    """A servo as an axis needs it; ``dropped`` while its torque is off because setting it up wanted that."""

    dropped: bool

    @property
    def name(self) -> str:
        """For messages."""
        ...

    @property
    def profile(self) -> tuple[int, int]:
        """Acceleration and speed of the configuration, in its counts."""
        ...

    def take_hold(self) -> int:
        """Switch torque on where the axis stands; returns the goal, counts. Raises DriverError."""
        ...

    def get(self, register: str) -> int:
        """Return a register's value. Raises DriverError."""
        ...

    def set(self, register: str, value: int) -> None:
        """Set a register and see that it holds the value. Raises DriverError."""
        ...

    def send_leg(self, profile: tuple[int, int], goal: int) -> None:
        """Set a goal with the profile that leads there. Raises DriverError."""
        ...

    def stand(self) -> object:
        """Make where it is its goal, if it holds. Raises DriverError."""
        ...

    def look(self) -> ServoSample:
        """Return its present motion; a lost reply is asked for again. Raises DriverError."""
        ...

    def release(self, limp: bool) -> None:
        """Leave it alone at the end, with its torque off if ``limp``; never raises."""
        ...


S = TypeVar("S", bound=HeldServo)
A = TypeVar("A", bound=ServoAxisSettings)


class ServoAxis(Generic[S, A]):
    """One axis while its servo is at hand.

    Attributes
    ----------
    hardware_error
        What its servo has reported, in words; empty if nothing.
    """

    def __init__(self, servo: S, clock: Clock, settings: A, head: HeadSettings) -> None:
        self.settings = settings
        self._clock = clock
        self.servo = servo
        self.motion = AxisCourse(self.servo.name, settings, head.settle_s)
        self.hardware_error = ""
        counts = settings.acceleration_counts(head.acceleration_rad_per_s2)
        self.acceleration_rad_per_s2 = counts * settings.model.acceleration_unit_rad_per_s2

    def take_hold(self) -> None:
        """Hold where the axis stands, with nothing commanded; raises as `Servo.take_hold`."""
        self.motion.begin(self.servo.take_hold())
        self.motion.profile = self.servo.profile

    def halt(self) -> int | None:
        """Take where the axis stands if it brakes now as its goal; returns that, None if it holds nothing."""
        if not self.motion.holds or self.motion.sample is None:
            return None
        goal = self.motion.braking_counts(self._clock.now_s(), self.acceleration_rad_per_s2)
        self.motion.halt(goal)
        return goal

    def brake(self) -> None:
        """Brake and hold where that ends, if the axis holds at all; raises as `Servo.set`."""
        goal = self.halt()
        if goal is not None:
            self.servo.set("goal_position", goal)

    def go_on(self) -> None:
        """Send the next leg of a move if the present one has ended; raises as `Servo.set`."""
        goal = self.motion.next_leg()
        if goal is not None:
            self.servo.send_leg(self.motion.profile or self.servo.profile, goal)
            self.motion.begin_leg()


X = TypeVar("X", bound=ServoAxis[Any, Any])
L = TypeVar("L", bound=BusLink)


class ServoPair(ABC, Generic[L, X]):
    """Pan and tilt on one open line.

    Parameters
    ----------
    link
        The open line; `close` closes it.
    """

    def __init__(self, link: L, axes: Sequence[X]) -> None:
        self.link = link
        self.axes = tuple(axes)

    @property
    def clock(self) -> Clock:
        """Of the line's deadlines."""
        return self.link.clock

    @abstractmethod
    def samples(self) -> Sequence[ServoSample]:
        """Return both servos' present motion, pan first, in one transaction. Raises DriverError."""

    @abstractmethod
    def sample(self, axis: X) -> ServoSample:
        """Return one servo's present motion, asking it alone. Raises DriverError."""

    @abstractmethod
    def send_goals(self, goals: Sequence[int], speeds: Sequence[int]) -> Sequence[int]:
        """Write profile and goal of both axes with one packet; returns as much of the goals as was sent.

        Raises LineLost, BadReply.
        """

    @abstractmethod
    def brake(self) -> None:
        """Command each axis that holds to brake, whatever the line or the other axis does.

        Nothing is requested and there is no answer: `sample` shows the goal. Raises LineLost.
        """

    @abstractmethod
    def stood(self, axis: X) -> str:
        """Command one axis to stand and see that it took that; returns its state in words.

        Raises DriverError.
        """

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

    @contextmanager
    def holding_in_the_end(self) -> Iterator[None]:
        """Have each servo hold again whose torque was dropped within, if that fails."""
        try:
            yield
        except (
            BaseException
        ):  # a stop or a closing that broke it off too: what hangs on an axis must not fall
            with self.link.undisturbed():
                for axis in self.axes:
                    if axis.servo.dropped:
                        _hold_again(axis)
            raise

    def close(self) -> None:
        """Close the line."""
        self.link.close()


def _hold_again(axis: ServoAxis[Any, Any]) -> None:
    """Switch on the torque that setting a servo up has dropped; never raises."""
    servo: HeldServo = axis.servo
    low, high = axis.settings.limit_counts
    servo.dropped = False
    try:
        servo.set("goal_position", min(max(servo.look().counts, low), high))  # it may droop beyond a limit
        servo.set("torque_enable", 1)
    except DriverError as error:
        log.warning("%s: its torque is off and could not be switched on again: %s", servo.name, error)


class SessionWatch(ABC, Generic[X]):
    """Looks for what servos do by themselves, from when they were made ready until the line is given up.

    Attributes
    ----------
    tripped
        Whether silence has stopped a motion; latched until `end_trip`.
    """

    trip_words = ""
    """Of the fault, while tripped."""

    trip_refusal = ""
    """Of moves, while tripped."""

    def __init__(self, axes: Sequence[X]) -> None:
        self.tripped = False
        self._axes = axes

    @abstractmethod
    def heard_again(self, silence_s: float) -> None:
        """Note how long nothing was heard of the servos. Raises LineLost."""

    @abstractmethod
    def look(self) -> None:
        """Look whether they are as they were left. Raises GivenUp, DriverError."""

    def look_soon(self) -> None:
        """Have the next `look` look."""

    @abstractmethod
    def note_alert(self, axis: X) -> None:
        """A servo reports a fault: brake both axes and say which. Raises GivenUp, DriverError."""

    def own_words(self, axis: X) -> list[str]:
        """Return what forbids an axis to move, in plain words."""
        return [axis.hardware_error] if axis.hardware_error else []

    def check_free(self) -> None:
        """See that nothing forbids a move. Raises HardwareFault, WatchdogTripped."""
        for axis in self._axes:
            for words in self.own_words(axis):
                raise HardwareFault(words)
        if self.tripped:
            raise WatchdogTripped(self.trip_refusal)

    def arm(self) -> None:
        """Have silence stop the servos from now on. Raises DriverError."""

    def arm_axis(self, axis: X) -> None:
        """The same of one axis. Raises DriverError."""

    def has_stopped(self, axis: X) -> bool:
        """Return whether silence has stopped an axis, which obeys no goal then. Raises DriverError."""
        return False

    def end_trip(self) -> None:
        """Forget a trip: both axes stand where they were stopped, with their old goals void."""
        self.tripped = False

    def faults(self, now_s: float) -> tuple[str, ...]:
        """Return what is wrong, in plain words."""
        words = [one for axis in self._axes for one in self.own_words(axis)]
        words += [self.trip_words] if self.tripped else []
        words += [axis.motion.stuck_words(now_s) for axis in self._axes]
        return tuple(word for word in words if word)
