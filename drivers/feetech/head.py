"""A pan/tilt head of two Feetech servos (`drivers.interfaces.PanTilt`).

One thread owns the bus (`drivers.servo_bus.head`). A servo has no watchdog: its goals are lent to it, so that
both axes stand soon after this process has died (``lease_s``). Nothing here moves the head but `move`.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from drivers.clock import Clock
from drivers.errors import DriverError, NoReply
from drivers.feetech.link import Questions, open_link
from drivers.feetech.pair import FeetechAxis, FeetechPair, ready_pair
from drivers.feetech.settings import FeetechSettings, feetech_settings
from drivers.feetech.watch import FeetechWatch
from drivers.serial_line import OpenLine, SerialLine
from drivers.servo_bus.head import BusHead

HALT_TRIES, HALT_REST_S = 5, 2.0


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
    """Tell each axis that holds to stand where it is, by itself, and see that it does. Torque stays as it is.

    ``clock`` and ``open_line`` are as of `FeetechLink`.

    Raises
    ------
    BadOptions
        For options that cannot be.
    LineLost
        If there is no line.
    NoReply
        If an axis did not confirm; the other was told all the same.
    """
    head = feetech_settings(options)
    link = open_link(head.port, head.baud, head.reply_timeout_s, clock=clock, open_line=open_line)
    try:
        pair = FeetechPair(link, head, {})
        told: dict[str, str] = {}
        failed: dict[str, DriverError] = {}
        for _ in range(HALT_TRIES):  # each once before any of them again
            for axis in pair.axes:
                if axis.servo.name not in told:
                    try:
                        told[axis.servo.name] = _stood(axis, link.clock)
                    except DriverError as error:
                        failed[axis.servo.name] = error
    finally:
        link.close()
    missing = [f"{name}: {error}" for name, error in failed.items() if name not in told]
    if missing:
        raise NoReply(f"not halted, it may still move: {'; '.join(missing)}")
    return [f"{name} {words}" for name, words in told.items()]


def _stood(axis: FeetechAxis, clock: Clock) -> str:
    """Tell one axis to stand and see that it does. Raises DriverError."""
    goal = axis.servo.stand()
    until_s = clock.now_s() + HALT_REST_S
    while True:
        sample = axis.servo.sample()
        if not sample.values["torque_enable"]:
            return "has its torque off"
        if abs(sample.values["present_velocity"]) <= 1:
            if (held := axis.servo.get("goal_position")) != goal:  # nobody answers the packet that says so
                raise NoReply(f"{axis.servo.name} did not take the command to stand, its goal is {held}")
            return "was told to stand where it is, and holds"
        if clock.now_s() > until_s:
            raise NoReply(f"{axis.servo.name} got the command to stand, but still moves")
