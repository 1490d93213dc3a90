"""Both servos of a head on one open line: made ready without moving them, then read and written together.

What is done about what they say is decided elsewhere (`drivers.dynamixel.head`).
"""

from __future__ import annotations

import itertools
import logging
from collections.abc import Callable, Sequence

from drivers.clock import Clock
from drivers.dynamixel.link import Link
from drivers.dynamixel.models import WATCHDOG_TRIPPED
from drivers.dynamixel.packets import GroupAnswer, Part
from drivers.dynamixel.registers import RegisterBlock
from drivers.dynamixel.servo import Reboots, Servo, motion_blocks
from drivers.dynamixel.settings import DynamixelAxisSettings, DynamixelSettings
from drivers.errors import DriverError
from drivers.serial_line import OpenLine, SerialLine
from drivers.servo_bus.course import ServoSample
from drivers.servo_bus.pair import BRAKE_COPIES, ServoAxis, ServoPair

log = logging.getLogger(__name__)

Axis = ServoAxis[Servo, DynamixelAxisSettings]


class Pair(ServoPair[Link, Axis]):
    """Pan and tilt on one open line.

    Parameters
    ----------
    link
        The open line; `close` closes it.
    """

    def __init__(self, link: Link, head: DynamixelSettings) -> None:
        axes = (("pan", head.pan), ("tilt", head.tilt))
        super().__init__(
            link, [ServoAxis(Servo(link, name, axis, head), link.clock, axis, head) for name, axis in axes]
        )
        self._head = head
        self._ids = [axis.settings.servo_id for axis in self.axes]
        turns = zip(*(motion_blocks(axis.settings) for axis in self.axes), strict=True)
        self._turns = itertools.cycle([(blocks, self._parts(blocks)) for blocks in turns])

    def _parts(self, blocks: Sequence[RegisterBlock]) -> tuple[Part, ...]:
        """A block of each servo."""
        return tuple(Part(i, b.address, b.length) for i, b in zip(self._ids, blocks, strict=True))

    def samples(self) -> list[ServoSample]:
        """Return what both servos say about their motion now, pan first, in one transaction.

        Raises NoReply, Refused, LineLost as `Link.group_read`, of the servo that is to blame; BadReply if a
        sample is not the answer to the question just asked.
        """
        blocks, parts = next(self._turns)
        answer = self.link.group_read(parts)
        if answer.missing:
            raise self._to_blame(answer)
        samples = []
        for axis, block in zip(self.axes, blocks, strict=True):
            status = answer.statuses[axis.settings.servo_id]
            values = block.decode(status.data)
            samples.append(ServoSample(values, status.alert, answer.sent_s, answer.received_s))
        for axis, sample in zip(self.axes, samples, strict=True):
            axis.servo.truth.check(sample)
        return samples

    def sample(self, axis: Axis) -> ServoSample:
        """Return one servo's present motion, asking it alone; raises as `samples`."""
        return axis.servo.look_once()

    def brake(self) -> None:
        """Command each axis that holds to brake, as `ServoPair.brake`. Raises LineLost."""
        parts = []
        for axis in self.axes:
            goal = axis.halt()
            if goal is not None:
                parts.append(axis.servo.part("goal_position", goal))
        if parts:
            self.link.write_at_once(parts, BRAKE_COPIES)

    def stood(self, axis: Axis) -> str:
        """Command one axis to stand, unless its watchdog has stopped it; as `ServoPair.stood`."""
        servo = axis.servo
        if servo.get("bus_watchdog") == WATCHDOG_TRIPPED:
            return "was stopped by its watchdog"
        if not servo.get("torque_enable"):
            return "has its torque off"
        servo.stand()
        return "was commanded to stand where it is, and holds"

    def _to_blame(self, answer: GroupAnswer) -> DriverError:
        """Why a group read is not whole, told of the servo that does not answer alone either.

        What they say alone is of other moments, and is not taken.
        """
        for part in next(self._turns)[1]:
            if part.servo_id in answer.missing:
                single = self.link.group_read([part])
                if single.missing:
                    return single.missing[part.servo_id]
        return next(iter(answer.missing.values()))

    def quick_values(self, register: str) -> list[int | None]:
        """Return what a register of both servos seems to be, None where no answer came.

        Where it decides anything ask for it by `Servo.get`. Raises LineLost, BadReply.
        """
        entries = [axis.settings.model.registers[register] for axis in self.axes]
        answer = self.link.group_read(
            [Part(i, *entry.window) for i, entry in zip(self._ids, entries, strict=True)]
        )
        return [
            entry.decode_window(answer.statuses[i].data) if i in answer.statuses else None
            for i, entry in zip(self._ids, entries, strict=True)
        ]

    def send_goals(self, goals: Sequence[int], speeds: Sequence[int]) -> Sequence[int]:
        """Write profile and goal of both axes with one packet and return the goals. Raises LineLost."""
        values = []
        for axis, goal, speed in zip(self.axes, goals, speeds, strict=True):
            acceleration = axis.servo.profile[0]
            axis.motion.profile = acceleration, speed
            values.append(
                [
                    ("profile_acceleration", acceleration),
                    ("profile_velocity", speed),
                    ("goal_position", goal),
                ]
            )
        self.send(values)
        return goals

    def send(self, values: Sequence[Sequence[tuple[str, int]]]) -> None:
        """Write neighbouring registers of each servo, all with one packet. Raises LineLost, BadReply."""
        parts = []
        for axis, pairs in zip(self.axes, values, strict=True):
            entries = [axis.settings.model.registers[name] for name, _ in pairs]
            data = b"".join(entry.encode(value) for entry, (_, value) in zip(entries, pairs, strict=True))
            parts.append(Part(axis.settings.servo_id, entries[0].address, len(data), data))
        self.link.group_write(parts)

    def arm(self) -> None:
        """Arm both watchdogs with one packet, and see that they are, unless they are off by configuration.

        Raises NoReply, Refused, LineLost, WrongDevice.
        """
        counts = self._head.watchdog_counts
        if not counts:
            return
        self.send([[("bus_watchdog", counts)]] * 2)
        for axis in self.axes:
            if axis.servo.get("bus_watchdog") != counts:
                axis.servo.set("bus_watchdog", counts)


def open_pair(
    head: DynamixelSettings,
    urgent: Callable[[], bool] = lambda: False,
    clock: Clock | None = None,
    open_line: OpenLine = SerialLine,
) -> Pair:
    """Open the line to both servos; nothing is sent. Parameters and errors are those of `Link`."""
    link = Link(head.port, head.baud, head.reply_timeout_s, urgent, clock=clock, open_line=open_line)
    return Pair(link, head)


def make_ready(pair: Pair, head: DynamixelSettings, reboots: Reboots) -> None:
    """Make both servos ready, without moving them: checked, set up, holding, armed.

    Without a watchdog an axis may still be under way. Each is commanded to stand first, whatever the other
    does. An axis whose torque was dropped to set it up holds again if it cannot be made ready.

    ``reboots`` are those done to this head. Raises Overtaken if a stop came meanwhile; LineLost, NoReply,
    WrongDevice, HardwareFault, Refused if the servos cannot be reached or do not fit.
    """
    if not head.watchdog_counts:
        pair.stand()
    servos = [axis.servo for axis in pair.axes]
    with pair.holding_in_the_end():
        for servo in servos:
            servo.check_identity()
        for servo in servos:
            servo.check_health(reboots)
            servo.check_place()
        for servo in servos:
            servo.set_profile()  # refused, if at all, before the torque is touched
            servo.set_up()
        for axis in pair.axes:
            axis.take_hold()
        pair.arm()
