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

from collections.abc import Mapping
from contextlib import closing
from typing import Any

from drivers.clock import Clock
from drivers.dynamixel.pair import Pair, make_ready, open_pair
from drivers.dynamixel.servo import Reboots
from drivers.dynamixel.settings import DynamixelSettings, dynamixel_settings
from drivers.dynamixel.watch import Watch
from drivers.registry import Driver
from drivers.serial_line import OpenLine, SerialLine
from drivers.servo_bus.head import BusHead
from drivers.servo_bus.rest import halt_axes


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
    lambda options, context: open_head(options, context.clock), read_options=dynamixel_settings, halt=halt
)
