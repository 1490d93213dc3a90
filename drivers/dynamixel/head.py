"""A pan/tilt head of two Dynamixel servos (`drivers.interfaces.PanTilt`).

One thread owns the bus: it reads both servos in one transaction, at least ``poll_hz`` times a second, which
feeds their watchdogs; sends the second leg of a move that approaches its goal from one side; and comes back
after the line was lost. If this process dies, the servos stop by themselves within ``watchdog_s``.

Nothing here moves the head but `move`. When the servos' watchdog has stopped a motion, that is latched:
moving again needs a `stop` (or a new start) first. One that trips while the head stands at its goal has
interrupted nothing and is armed anew with a line in the log. A servo's reboot drops its torque and is done
only where the configuration says ``on_hardware_error: reboot``.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Mapping, Sequence
from contextlib import closing
from typing import Any

from drivers.clock import Clock
from drivers.dynamixel.models import WATCHDOG_TRIPPED
from drivers.dynamixel.pair import Axis, Pair, make_ready, open_pair
from drivers.dynamixel.servo import Reboots, hardware_fault_words
from drivers.dynamixel.settings import DynamixelSettings, dynamixel_settings
from drivers.dynamixel.workshop import BENCH
from drivers.errors import BadReply, HardwareFault, Refused
from drivers.registry import Driver
from drivers.serial_line import OpenLine, SerialLine
from drivers.servo_bus.head import BusHead
from drivers.servo_bus.pair import SessionWatch
from drivers.servo_bus.rest import halt_axes
from drivers.servo_bus.session import GivenUp

log = logging.getLogger(__name__)

WATCH_S = 0.2  # how often torque and watchdog registers are looked at while all goes well


class Watch(SessionWatch[Axis]):
    """The watch over two servos, from when they were made ready until the line is given up.

    Attributes
    ----------
    tripped
        Whether a watchdog has stopped a motion; latched until `end_trip`.
    """

    trip_words = (
        "the servos' bus watchdog has stopped the head since this process was silent for too long; "
        "stop arms it anew"
    )
    trip_refusal = "the servos' bus watchdog has stopped the head; stop arms it anew, then move again"

    def __init__(self, pair: Pair, head: DynamixelSettings, reboots: Reboots) -> None:
        super().__init__(pair.axes)
        self._pair = pair
        self._head = head
        self._reboots = reboots
        self._clock = pair.link.clock
        self._looked_s = -math.inf

    def look_soon(self) -> None:
        """Have the next `look` look: the servos may have stopped by themselves."""
        self._looked_s = -math.inf

    def heard_again(self, silence_s: float) -> None:
        """Look soon after a silence: the servos may have stopped by themselves meanwhile."""
        if self._head.watchdog_counts and silence_s > self._head.watchdog_s / 2:
            self.look_soon()

    def has_stopped(self, axis: Axis) -> bool:
        """Return whether an axis' watchdog has tripped; raises as `Servo.get`."""
        return axis.servo.get("bus_watchdog") == WATCHDOG_TRIPPED

    def look(self) -> None:
        """Look now and then, and after every silence, whether a watchdog has tripped or torque is gone.

        Raises GivenUp if something set or restarted the servos that was not this driver; NoReply, Refused,
        LineLost, BadReply.
        """
        now_s = self._clock.now_s()
        errors = any(axis.hardware_error for axis in self._pair.axes)
        expected = (
            self.tripped or errors or not any(axis.motion.other_goal_words() for axis in self._pair.axes)
        )
        if expected and now_s - self._looked_s < WATCH_S:
            return
        self._looked_s = now_s
        for register in ("bus_watchdog", "torque_enable"):
            values = self._sure(register, self._pair.quick_values(register))
            if register == "bus_watchdog" and WATCHDOG_TRIPPED in values:
                self._note_trip()
            for axis, value in zip(self._pair.axes, values, strict=True):
                self._judge(axis, register, value)
        errors = any(axis.hardware_error for axis in self._pair.axes)
        for axis in self._pair.axes:
            if (words := axis.motion.other_goal_words()) and not self.tripped and not errors:
                raise _distrust(words)

    def _sure(self, register: str, values: Sequence[int | None]) -> list[int | None]:
        """The values of a register of both servos; one that is not as it was left is asked for again."""
        return [
            value if value is None or self._as_left(axis, register, value) else axis.servo.get(register)
            for axis, value in zip(self._pair.axes, values, strict=True)
        ]

    def _as_left(self, axis: Axis, register: str, value: int) -> bool:
        """Whether a register is as this driver left it."""
        if register == "bus_watchdog":
            return value == self._head.watchdog_counts
        return bool(value) == axis.motion.holds

    def _judge(self, axis: Axis, register: str, value: int | None) -> None:
        """Give up if a register is not as it was left, and the servo does not report why; as `note_alert`."""
        if value is None or axis.hardware_error:
            return  # asked again soon, or known
        tripped = register == "bus_watchdog" and value == WATCHDOG_TRIPPED
        if not tripped and not self._as_left(axis, register, value):
            if axis.servo.get("hardware_error"):  # since it was polled
                self.note_alert(axis)
                return
            raise _distrust(f"{axis.servo.name} has {value} in {register}")

    def _note_trip(self) -> None:
        """The watchdog of a servo has tripped: latch it if a motion was stopped, else arm it anew."""
        if self.tripped:
            return
        if not all(axis.motion.at_goal() for axis in self._pair.axes):
            self.tripped = True
            log.error("the bus watchdog has stopped the head: this process was silent for too long")
            return
        log.warning("the bus watchdog tripped while the head stood at its goal; it is armed anew")
        for axis in self._pair.axes:
            axis.servo.set("bus_watchdog", 0)
        self.arm()

    def arm(self) -> None:
        """Arm both watchdogs; raises as `Pair.arm`."""
        self._pair.arm()
        if self._head.watchdog_counts:
            self._looked_s = self._clock.now_s()

    def arm_axis(self, axis: Axis) -> None:
        """Arm one watchdog; raises as `Servo.set`."""
        if self._head.watchdog_counts:
            axis.servo.set("bus_watchdog", self._head.watchdog_counts)

    def end_trip(self) -> None:
        """Forget a trip: both axes stand where they were stopped, with their old goals void."""
        super().end_trip()
        self.look_soon()
        log.warning("the head is armed anew after its watchdog had stopped it")

    def note_alert(self, axis: Axis) -> None:
        """A servo reports a hardware error: brake both axes, say which error it is, follow the reboot policy.

        Not every hardware error switches the torque off, so the axis itself is braked too. Raises GivenUp (to
        have the servo rebooted when it is made ready again); NoReply, Refused, LineLost, WrongDevice.
        """
        self._pair.brake()
        error = axis.servo.get("hardware_error")
        if not error:
            log.warning("%s reported a hardware error but has none; the head has braked", axis.servo.name)
            return
        words = hardware_fault_words(axis.servo.name, error)
        if not axis.servo.get("torque_enable"):
            words += "; its torque is off"
            axis.motion.limp()
        axis.hardware_error = words
        for one in self._pair.axes:
            try:
                one.brake()
            except Refused:
                if not one.hardware_error:
                    raise
        log.error("%s", words)
        if axis.settings.on_hardware_error == "reboot" and self._reboots.left(self._clock.now_s()):
            raise GivenUp(HardwareFault(words, detail={"hardware_error": error}))


def _distrust(words: str) -> GivenUp:
    """Something changed the servos that was not this driver."""
    return GivenUp(BadReply(f"{words}: it restarted, or another program set it"))


def open_head(
    options: Mapping[str, Any], clock: Clock | None = None, open_line: OpenLine = SerialLine
) -> DynamixelHead:
    """Open the head that the options of ``driver: dynamixel`` describe; see `settings.DynamixelSettings`.

    Raises BadOptions for options that cannot be; LineLost, NoReply, WrongDevice, HardwareFault, Refused if
    the servos cannot be reached or do not fit; the line is closed again.
    """
    return DynamixelHead(dynamixel_settings(options), clock, open_line)


class DynamixelHead(BusHead):
    """The head; parameters and errors as of `BusHead`."""

    settings: DynamixelSettings

    def __init__(
        self, settings: DynamixelSettings, clock: Clock | None = None, open_line: OpenLine = SerialLine
    ) -> None:
        self._reboots = Reboots()
        super().__init__(settings, clock, open_line)

    def _open(self) -> Pair:
        return open_pair(self.settings, self._bus.urgent, self._clock, self._open_line)

    def _watch(self, pair: Pair) -> Watch:
        make_ready(pair, self.settings, self._reboots)
        return Watch(pair, self.settings, self._reboots)


def halt(
    options: Mapping[str, Any], clock: Clock | None = None, open_line: OpenLine = SerialLine
) -> list[str]:
    """Command each axis that holds to stand, as `halt_axes`; its torque stays as it is.

    ``clock`` and ``open_line`` are those of `Link`. Raises BadOptions, LineLost, NoReply.
    """
    with closing(open_pair(dynamixel_settings(options), clock=clock, open_line=open_line)) as pair:
        return halt_axes(pair)


DRIVER = Driver(
    lambda options, context: open_head(options, context.clock),
    read_options=dynamixel_settings, halt=halt, probe=BENCH.probe, probe_order=1, bench=BENCH,
)  # fmt: skip
