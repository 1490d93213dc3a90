"""Both servos of a head on one open line, and the watch over them: what a session needs of each family."""

from __future__ import annotations

import logging
from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any, Generic, TypeVar

from drivers.clock import Clock
from drivers.errors import DriverError, HardwareFault, LineLost, WatchdogTripped
from drivers.servo_bus.axis import HeldServo, ServoAxis
from drivers.servo_bus.course import ServoSample
from drivers.servo_bus.link import BusLink

log = logging.getLogger(__name__)

STAND_ROUNDS = 2
BRAKE_COPIES = 3  # more than one reply can collide with
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

        Nothing is asked and there is no answer: `sample` shows the goal. Raises LineLost.
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
                except DriverError as error:  # told, with what it is, when the servo is made ready
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
