"""A pan/tilt head of two Dynamixel servos (`drivers.interfaces.PanTilt`).

One thread owns the bus: it reads both servos in one transaction, at least ``poll_hz`` times a second, which
feeds their watchdogs; sends the second leg of a move that approaches its goal from one side; and comes back
after the line was lost. If this process dies, the servos stop by themselves within ``watchdog_s``.

Nothing here moves the head but `move`. When the servos' watchdog has stopped a motion, that is latched:
moving again needs a `stop` (or a new start) first. One that trips while the head is at rest at its goal has
interrupted nothing and is armed anew with a line in the log. A servo's reboot drops its torque and is done
only where the configuration says ``on_hardware_error: reboot``.
"""

from __future__ import annotations

import itertools
import logging
import math
from collections.abc import Sequence

from drivers.dynamixel.link import Link
from drivers.dynamixel.models import (
    WATCHDOG_TRIPPED,
    DynamixelAxisSettings,
    DynamixelSettings,
    dynamixel_settings,
)
from drivers.dynamixel.packets import GroupAnswer
from drivers.dynamixel.registers import RegisterBlock
from drivers.dynamixel.servo import Reboots, Servo, hardware_fault, motion_blocks
from drivers.dynamixel.workshop import BENCH
from drivers.errors import DriverError, HardwareFault, Refused
from drivers.registry import Driver
from drivers.servo_bus.course import ServoSample
from drivers.servo_bus.head import BusHead
from drivers.servo_bus.pair import ServoAxis, ServoPair, SessionWatch
from drivers.servo_bus.port import Part
from drivers.servo_bus.session import GivenUp, distrusted

log = logging.getLogger(__name__)

WATCH_S = 0.2  # how often torque and watchdog registers are read while all goes well


class DynamixelAxis(ServoAxis):
    """One axis of the head."""

    servo: Servo
    settings: DynamixelAxisSettings


class Pair(ServoPair):
    """Pan and tilt on one open line, as `ServoPair`."""

    link: Link
    axes: tuple[DynamixelAxis, ...]

    def __init__(self, link: Link, head: DynamixelSettings, reboots: Reboots) -> None:
        super().__init__(link)
        axes = (("pan", head.pan), ("tilt", head.tilt))
        self.axes = tuple(
            DynamixelAxis(Servo(link, name, axis, head, reboots), link.clock, axis, head)
            for name, axis in axes
        )
        self._head = head
        self._ids = [axis.servo.servo_id for axis in self.axes]
        turns = zip(*(motion_blocks(axis.settings) for axis in self.axes), strict=True)
        self._turns = itertools.cycle([(blocks, self._parts(blocks)) for blocks in turns])

    def _parts(self, blocks: Sequence[RegisterBlock]) -> tuple[Part, ...]:
        """A block of each servo."""
        return tuple(Part(i, b.address, b.length) for i, b in zip(self._ids, blocks, strict=True))

    def samples(self) -> list[ServoSample]:
        """Return what both servos say about their motion now, pan first, in one transaction.

        Raises NoReply, Refused, LineLost as `Link.group_read`, of the servo that is to blame; BadReply if a
        sample is not the answer to this question.
        """
        blocks, parts = next(self._turns)
        answer = self.link.group_read(parts)
        if answer.missing:
            raise self._to_blame(answer)
        samples = []
        for axis, block in zip(self.axes, blocks, strict=True):
            status = answer.statuses[axis.servo.servo_id]
            values = block.decode(status.data)
            samples.append(ServoSample(values, status.alert, answer.sent_s, answer.received_s))
        for axis, sample in zip(self.axes, samples, strict=True):
            axis.servo.truth.check(sample)
        return samples

    def _to_blame(self, answer: GroupAnswer) -> DriverError:
        """Why a group read is not whole: of the servo that does not answer alone either.

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

        Where it decides anything use `Servo.get`. Raises LineLost, BadReply.
        """
        entries = [axis.settings.model.registers[register] for axis in self.axes]
        answer = self.link.group_read(
            [Part(i, *entry.window) for i, entry in zip(self._ids, entries, strict=True)]
        )
        return [
            entry.decode_window(answer.statuses[i].data) if i in answer.statuses else None
            for i, entry in zip(self._ids, entries, strict=True)
        ]

    def arm(self) -> None:
        """Arm both watchdogs with one packet, and see that they are, unless they are off by configuration.

        Raises NoReply, Refused, LineLost, WrongDevice.
        """
        counts = self._head.watchdog_counts
        if not counts:
            return
        self.link.group_write([axis.servo.part("bus_watchdog", counts) for axis in self.axes])
        for axis in self.axes:
            if axis.servo.get("bus_watchdog") != counts:
                axis.servo.set("bus_watchdog", counts)


class Watch(SessionWatch):
    """The watch over two servos, as `SessionWatch`; a trip is a watchdog that has stopped a motion."""

    trip_fault = (
        "the servos' bus watchdog has stopped the head since this process was silent for too long; "
        "stop arms it anew"
    )
    trip_refusal = "the servos' bus watchdog has stopped the head; stop arms it anew, then move again"

    def __init__(self, pair: Pair, head: DynamixelSettings, reboots: Reboots) -> None:
        super().__init__(pair)
        self._pair = pair
        self._head = head
        self._reboots = reboots
        self._clock = pair.link.clock
        self._checked_s = -math.inf

    def check_soon(self) -> None:
        """Have the next `check` query the servos: they may have stopped by themselves."""
        self._checked_s = -math.inf

    def heard_again(self, silence_s: float) -> None:
        """Check soon after a silence: the servos may have stopped by themselves meanwhile."""
        if self._head.watchdog_counts and silence_s > self._head.watchdog_s / 2:
            self.check_soon()

    def has_stopped(self, axis: ServoAxis) -> bool:
        """Return whether an axis' watchdog has tripped; raises as `Servo.get`."""
        return axis.servo.get("bus_watchdog") == WATCHDOG_TRIPPED

    def check(self) -> None:
        """See now and then, and after every silence, whether a watchdog has tripped or torque is gone.

        Raises GivenUp if something set or restarted the servos that was not this driver; NoReply, Refused,
        LineLost, BadReply.
        """
        now_s = self._clock.now_s()
        errors = any(axis.hardware_error for axis in self._pair.axes)
        expected = self.tripped or errors or not any(axis.motion.foreign_goal() for axis in self._pair.axes)
        if expected and now_s - self._checked_s < WATCH_S:
            return
        self._checked_s = now_s
        for register in ("bus_watchdog", "torque_enable"):
            values = self._sure(register, self._pair.quick_values(register))
            if register == "bus_watchdog" and WATCHDOG_TRIPPED in values:
                self._note_trip()
            for axis, value in zip(self._pair.axes, values, strict=True):
                self._judge(axis, register, value)
        errors = any(axis.hardware_error for axis in self._pair.axes)
        for axis in self._pair.axes:
            if (reason := axis.motion.foreign_goal()) and not self.tripped and not errors:
                raise distrusted(reason)

    def _sure(self, register: str, values: Sequence[int | None]) -> list[int | None]:
        """The values of a register of both servos; one that is not as it was left is read again."""
        return [
            value if value is None or self._as_left(axis, register, value) else axis.servo.get(register)
            for axis, value in zip(self._pair.axes, values, strict=True)
        ]

    def _as_left(self, axis: ServoAxis, register: str, value: int) -> bool:
        """Whether a register is as this driver left it."""
        if register == "bus_watchdog":
            return value == self._head.watchdog_counts
        return bool(value) == axis.motion.holds

    def _judge(self, axis: ServoAxis, register: str, value: int | None) -> None:
        """Give up if a register is not as it was left, and the servo does not report why; as `note_alert`."""
        if value is None or axis.hardware_error:
            return  # read again soon, or known
        tripped = register == "bus_watchdog" and value == WATCHDOG_TRIPPED
        if not tripped and not self._as_left(axis, register, value):
            if axis.servo.get("hardware_error"):  # since it was polled
                self.note_alert(axis)
                return
            raise distrusted(f"{axis.servo.name} has {value} in {register}")

    def _note_trip(self) -> None:
        """The watchdog of a servo has tripped: latch it if a motion was stopped, else arm it anew."""
        if self.tripped:
            return
        if not all(axis.motion.at_goal() for axis in self._pair.axes):
            self.tripped = True
            log.error("the bus watchdog has stopped the head: this process was silent for too long")
            return
        log.warning("the bus watchdog tripped while the head was at rest at its goal; it is armed anew")
        for axis in self._pair.axes:
            axis.servo.set("bus_watchdog", 0)
        self.arm()

    def arm(self) -> None:
        """Arm both watchdogs; raises as `Pair.arm`."""
        self._pair.arm()
        if self._head.watchdog_counts:
            self._checked_s = self._clock.now_s()

    def arm_axis(self, axis: ServoAxis) -> None:
        """Arm one watchdog; raises as `Servo.set`."""
        if self._head.watchdog_counts:
            axis.servo.set("bus_watchdog", self._head.watchdog_counts)

    def end_trip(self) -> None:
        """Forget a trip: both axes are where they were stopped, with their old goals void."""
        super().end_trip()
        self.check_soon()
        log.warning("the head is armed anew after its watchdog had stopped it")

    def note_alert(self, axis: ServoAxis) -> None:
        """A servo reports a hardware error: brake both axes, say which error it is, follow the reboot policy.

        Not every hardware error switches the torque off, so the axis itself is braked too. Raises GivenUp (to
        have the servo rebooted when it is made ready again); NoReply, Refused, LineLost, WrongDevice.
        """
        self._pair.brake()
        error = axis.servo.get("hardware_error")
        if not error:
            log.warning("%s reported a hardware error but has none; the head has braked", axis.servo.name)
            return
        fault = hardware_fault(axis.servo.name, error)
        if not axis.servo.get("torque_enable"):
            fault += "; its torque is off"
            axis.motion.limp()
        axis.hardware_error = fault
        for one in self._pair.axes:
            try:
                one.brake()
            except Refused:
                if not one.hardware_error:
                    raise
        log.error("%s", fault)
        if (
            isinstance(axis, DynamixelAxis)
            and axis.settings.on_hardware_error == "reboot"
            and self._reboots.left(self._clock.now_s())
        ):
            raise GivenUp(HardwareFault(fault, detail={"hardware_error": error}))


class DynamixelHead(BusHead):
    """The head; parameters and errors as of `BusHead`."""

    settings: DynamixelSettings
    settings_type, link_type, pair_type, memory_type = DynamixelSettings, Link, Pair, Reboots

    def _watch(self, pair: Pair) -> Watch:
        return Watch(pair, self.settings, self._memory)


open_head, halt = DynamixelHead.from_options, DynamixelHead.halt_alone
DRIVER = Driver(
    lambda options, context: open_head(options, context.clock),
    read_options=dynamixel_settings, halt=halt, probe=BENCH.probe, probe_order=1, bench=BENCH,
)  # fmt: skip
