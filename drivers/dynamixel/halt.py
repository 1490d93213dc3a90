"""Servos braked by somebody who knows nothing about what they were doing."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from drivers.clock import Clock
from drivers.dynamixel.link import Link
from drivers.dynamixel.pair import ServoAxis
from drivers.dynamixel.servo import WATCHDOG_TRIPPED
from drivers.dynamixel.settings import dynamixel_settings
from drivers.errors import DriverError, NoReply
from drivers.serial_line import OpenLine, SerialLine

TRIES = 5
AT_REST_S = 2.0
SLOW = 1  # counts of speed that a holding servo may show


def halt(
    options: Mapping[str, Any], clock: Clock | None = None, open_line: OpenLine = SerialLine
) -> list[str]:
    """Tell each axis that holds to stand where it is, by itself, and see that it does. Torque stays as it is.

    ``clock`` and ``open_line`` are those of `Link`.

    Raises
    ------
    BadOptions
        For options that cannot be.
    LineLost
        If there is no line.
    NoReply
        If an axis did not confirm; the other was told all the same.
    """
    head = dynamixel_settings(options)
    link = Link(head.port, head.baud, head.reply_timeout_s, clock=clock, open_line=open_line)
    try:
        axes = (ServoAxis(link, "pan", head.pan, head), ServoAxis(link, "tilt", head.tilt, head))
        told: dict[str, str] = {}
        failed: dict[str, DriverError] = {}
        for _ in range(TRIES):  # each once before any of them again
            for axis in axes:
                if axis.servo.name not in told:
                    try:
                        told[axis.servo.name] = _stood(axis)
                    except DriverError as error:
                        failed[axis.servo.name] = error
        missing = {name: error for name, error in failed.items() if name not in told}
        for axis in axes:
            if axis.servo.name in told:
                _see_rest(axis, link.clock)
    finally:
        link.close()
    if missing:
        words = "; ".join(f"{name}: {error}" for name, error in missing.items())
        raise NoReply(f"not halted, it may still move: {words}")
    return [f"{name} {words}" for name, words in told.items()]


def _stood(axis: ServoAxis) -> str:
    """Tell one axis to stand, unless its watchdog has stopped it or it holds nothing."""
    servo = axis.servo
    if servo.get("bus_watchdog") == WATCHDOG_TRIPPED:
        return "was stopped by its watchdog"
    if not servo.get("torque_enable"):
        return "has its torque off"
    servo.stand()
    return "was told to stand where it is, and holds"


def _see_rest(axis: ServoAxis, clock: Clock) -> None:
    """Wait until an axis stands. Raises NoReply."""
    until_s = clock.now_s() + AT_REST_S
    while abs(axis.servo.look().values["present_velocity"]) > SLOW:
        if clock.now_s() > until_s:
            raise NoReply(f"{axis.servo.name} was told to stand, but still moves")
