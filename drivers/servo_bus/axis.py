"""One axis of a head and the servo that turns it, whatever its family."""

from __future__ import annotations

from typing import Any, Generic, Protocol, TypeVar

from drivers.clock import Clock
from drivers.servo_bus.course import AxisCourse, ServoSample
from drivers.servo_bus.settings import HeadSettings, ServoAxisSettings


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

    def __init__(self, servo: S, clock: Clock, settings: A, head: HeadSettings[Any]) -> None:
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

    def let_go(self) -> None:
        """Switch the torque off; raises as `Servo.set`."""
        self.servo.set("torque_enable", 0)
        self.motion.limp()

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
