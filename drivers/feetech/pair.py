"""Both servos of a head on one open line: made ready without moving them, then read and written together.

Goals are lent: of a way only as much is sent as its axis goes in ``lease_s``, and every look at the servos
sends more of it. A servo has no watchdog; when its host is gone it comes to the end of what it was lent.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

from drivers.clock import Clock
from drivers.errors import NoReply
from drivers.feetech.link import FeetechLink, Questions, open_link
from drivers.feetech.servo import FeetechServo
from drivers.feetech.settings import FeetechAxisSettings, FeetechSettings
from drivers.serial_line import OpenLine, SerialLine
from drivers.servo_bus.axis import ServoAxis
from drivers.servo_bus.course import ServoSample
from drivers.servo_bus.pair import BRAKE_COPIES, ServoPair


class FeetechAxis(ServoAxis[FeetechServo, FeetechAxisSettings]):
    """One axis, to which its way is lent."""

    def __init__(
        self, servo: FeetechServo, clock: Clock, settings: FeetechAxisSettings, head: FeetechSettings
    ) -> None:
        super().__init__(servo, clock, settings, head)
        self._lease_s = head.lease_s

    def stretch(self) -> int:
        """Return how far the axis may be sent now."""
        motion = self.motion
        return motion.stretch(self._lease_s, self.acceleration_rad_per_s2) if self._lease_s else motion.goal

    def go_on(self) -> None:
        """Send the next leg of a move if the present one has ended, or more of the way. Raises LineLost."""
        motion = self.motion
        if motion.next_leg() is not None:
            motion.begin_leg()
            goal: int | None = self.stretch()
        else:
            goal = motion.more_of_the_way(self.stretch())
        if goal is not None:
            self.servo.send_leg(motion.profile or self.servo.profile, goal)
            motion.lent(goal)


class FeetechPair(ServoPair[FeetechLink, FeetechAxis]):
    """Pan and tilt on one open line, as `ServoPair`."""

    def __init__(self, link: FeetechLink, head: FeetechSettings, offsets: dict[int, int]) -> None:
        axes = (("pan", head.pan), ("tilt", head.tilt))
        super().__init__(
            link,
            [
                FeetechAxis(FeetechServo(link, name, axis, head, offsets), link.clock, axis, head)
                for name, axis in axes
            ],
        )

    def samples(self) -> list[ServoSample]:
        """Return what both servos say about their motion now; raises as `FeetechLink.samples`."""
        asked = {axis.servo.servo_id: (axis.settings.model, axis.servo.torque_limit) for axis in self.axes}
        found = self.link.samples(asked)
        for axis in self.axes:
            axis.servo.truth.check(found[axis.servo.servo_id])
        return [found[axis.servo.servo_id] for axis in self.axes]

    def sample(self, axis: FeetechAxis) -> ServoSample:
        """Return what one servo says about its motion now, asking it alone; raises as `samples`."""
        return axis.servo.sample()

    def send_goals(self, goals: Sequence[int], speeds: Sequence[int]) -> Sequence[int]:
        """Write profile and goal of both axes with one packet, as far as goals are lent; returns that.

        Raises LineLost, BadReply.
        """
        data, address, sent = {}, 0, []
        for axis, speed in zip(self.axes, speeds, strict=True):
            axis.motion.profile = axis.servo.profile[0], speed
            sent.append(axis.stretch())
            address, data[axis.servo.servo_id] = axis.servo.goal_bytes(axis.motion.profile, sent[-1])
            axis.motion.lent(sent[-1])
        self.link.group_write(address, data)
        return sent

    def brake(self) -> None:
        """Tell each axis that holds to brake, whatever the line or the other axis does. Raises LineLost."""
        data, address = {}, 0
        for axis in self.axes:
            goal = axis.halt()
            if goal is not None:
                entry = axis.settings.model.registers["goal_position"]
                address, data[axis.servo.servo_id] = (
                    entry.address,
                    entry.encode(goal, axis.settings.model.order),
                )
        if data:
            self.link.shout(address, data, BRAKE_COPIES)

    def stood(self, axis: FeetechAxis) -> str:
        """Command one axis to stand, as `ServoPair.stood`. Raises DriverError."""
        servo = axis.servo
        goal = servo.stand()
        if goal is None:
            return "has its torque off"
        if (held := servo.get("goal_position")) != goal:  # nobody answers the packet that says so
            raise NoReply(f"{servo.name} did not take the command to stand, its goal is {held}")
        return "was commanded to stand where it is, and holds"


def open_pair(
    head: FeetechSettings,
    questions: Questions | None = None,
    offsets: dict[int, int] | None = None,
    urgent: Callable[[], bool] = lambda: False,
    clock: Clock | None = None,
    open_line: OpenLine = SerialLine,
) -> FeetechPair:
    """Open the line to both servos; nothing is set.

    ``questions`` and ``offsets`` are of the head, over all its lines; ``urgent``, ``clock`` and ``open_line``
    of `Port`. Raises LineLost, BadReply.
    """
    link = open_link(
        head.port, head.baud, head.reply_timeout_s, urgent,
        questions=questions, clock=clock, open_line=open_line,
    )  # fmt: skip
    return FeetechPair(link, head, {} if offsets is None else offsets)


def make_ready(pair: FeetechPair, head: FeetechSettings) -> None:
    """Make both servos ready, without moving them: checked, set up, holding.

    Without a lease each is commanded to stand first, whatever the other does: it may still be under way.

    Raises
    ------
    Overtaken
        If a stop came meanwhile.
    LineLost, NoReply, BadReply, WrongDevice, HardwareFault
        If the servos cannot be reached or do not fit.
    """
    servos = [axis.servo for axis in pair.axes]
    if not head.lease_s:
        pair.stand()
    with pair.holding_in_the_end():
        for servo in servos:
            servo.check_identity()
        for servo in servos:
            servo.check_health()
            servo.check_place()
        for servo in servos:
            servo.set_up()
        for axis in pair.axes:
            axis.take_hold()
