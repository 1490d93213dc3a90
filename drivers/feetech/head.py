"""A pan/tilt head of two Feetech servos (`drivers.interfaces.PanTilt`).

One thread owns the bus (`drivers.servo_bus.head`). A servo has no watchdog: its goals are lent to it, so that
both axes stand soon after this process has died (``lease_s``). Nothing here moves the head but `move`.
"""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import closing
from typing import Any

from drivers.clock import Clock
from drivers.errors import NoReply
from drivers.feetech.link import Questions, open_link
from drivers.feetech.pair import FeetechAxis, FeetechPair, ready_pair
from drivers.feetech.settings import FeetechSettings, feetech_settings
from drivers.feetech.watch import FeetechWatch
from drivers.serial_line import OpenLine, SerialLine
from drivers.servo_bus.head import BusHead
from drivers.servo_bus.rest import halt_axes


def open_head(
    options: Mapping[str, Any], clock: Clock | None = None, open_line: OpenLine = SerialLine
) -> FeetechHead:
    """Open the head that the options of ``driver: feetech`` describe; see `settings.FeetechSettings`.

    Raises
    ------
    BadOptions
        For options that cannot be.
    LineLost, NoReply, BadReply, WrongDevice, HardwareFault
        If the servos cannot be reached or do not fit; the line is closed again.
    """
    return FeetechHead(feetech_settings(options), clock, open_line)


class FeetechHead(BusHead):
    """The head; parameters and errors as of `BusHead`."""

    settings: FeetechSettings

    def __init__(
        self, settings: FeetechSettings, clock: Clock | None = None, open_line: OpenLine = SerialLine
    ) -> None:
        self._questions = Questions()
        self._offsets: dict[int, int] = {}
        super().__init__(settings, clock, open_line)

    def _ready(self, clock: Clock, open_line: OpenLine) -> tuple[FeetechPair, FeetechWatch]:
        pair = ready_pair(
            self.settings, self._questions, self._offsets, self._bus.urgent, clock=clock, open_line=open_line
        )
        return pair, FeetechWatch(pair, self.settings.lease_s)


def halt(
    options: Mapping[str, Any], clock: Clock | None = None, open_line: OpenLine = SerialLine
) -> list[str]:
    """Command each axis that holds to stand, as `halt_axes`; its torque stays as it is.

    ``clock`` and ``open_line`` are those of `FeetechLink`. Raises BadOptions, LineLost, NoReply.
    """
    head = feetech_settings(options)
    link = open_link(head.port, head.baud, head.reply_timeout_s, clock=clock, open_line=open_line)
    with closing(link):
        return halt_axes(FeetechPair(link, head, {}).axes, _stood, link.clock)


def _stood(axis: FeetechAxis) -> str:
    """Tell one axis to stand and see that it took that. Raises DriverError."""
    servo = axis.servo
    goal = servo.stand()
    if goal is None:
        return "has its torque off"
    if (held := servo.get("goal_position")) != goal:  # nobody answers the packet that says so
        raise NoReply(f"{servo.name} did not take the command to stand, its goal is {held}")
    return "was commanded to stand where it is, and holds"
