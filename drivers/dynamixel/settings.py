"""The options of a Dynamixel head as a configuration gives them, checked strictly."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from typing import Any, Literal

from drivers.dynamixel.models import ServoModel, model_named
from drivers.options import OptionReader
from drivers.servo_bus.port import QUIET_S
from drivers.servo_bus.settings import (
    RESTING_POLL_S,
    HeadSettings,
    ServoAxisSettings,
    axis_values,
    check_axis,
    check_polling,
    head_values,
    patience_s,
)

OnHardwareError = Literal["report", "reboot"]

USUAL_WATCHDOG_S, SHORTEST_WATCHDOG_S = 0.3, 0.1
WATCHDOG_STEP_S = 0.02
LONGEST_REPLY_S = 0.3  # a few of them must fit into a call
SILENCE_SPARE_S = 0.05  # the servo's oscillator against ours
POLL_BYTES = 20 + 2 * (11 + 43)  # the longer of the two instructions, and two replies of 43 bytes of data


@dataclass(frozen=True, kw_only=True)
class DynamixelAxisSettings(ServoAxisSettings):
    """One axis, as of `ServoAxisSettings`.

    Attributes
    ----------
    on_hardware_error
        ``report`` leaves the servo as it is; ``reboot`` restarts it, which drops its torque.
    current_limit_A
        Written to the servo; None leaves it as it is.
    """

    model: ServoModel
    on_hardware_error: OnHardwareError = "report"
    current_limit_A: float | None = None


@dataclass(frozen=True, kw_only=True)
class DynamixelSettings(HeadSettings[DynamixelAxisSettings]):
    """A head of two servos on one bus, as of `HeadSettings`; a lost reply must not trip the watchdog.

    Attributes
    ----------
    watchdog_s
        After this silence the servos stop by themselves; 0 switches that off. Left out: 0.3 s, or as much
        less as it takes to stand 0.5 s after the last poll, braking included.
    """

    watchdog_s: float = USUAL_WATCHDOG_S
    name: str = field(default="dynamixel", init=False)

    @property
    def watchdog_counts(self) -> int:
        """The watchdog register's value, rounded down; 0 for off."""
        return _watchdog_counts(self.watchdog_s)

    @property
    def resting_poll_s(self) -> float:
        """How often servos that stand are read, seconds; a lost reply must not trip the watchdog."""
        if not self.watchdog_counts:
            return max(1 / self.poll_hz, RESTING_POLL_S)
        silence_s = self.watchdog_counts * WATCHDOG_STEP_S - self.reply_timeout_s - QUIET_S
        return max(1 / self.poll_hz, min(RESTING_POLL_S, silence_s / 2))

    @property
    def silence_s(self) -> float:
        """How long nothing may be sent so that the watchdogs have stopped both axes; 0 without them."""
        if not self.watchdog_counts:
            return 0.0
        brakes_s = self.speed_rad_per_s / self.acceleration_rad_per_s2
        return self.watchdog_counts * WATCHDOG_STEP_S + brakes_s + SILENCE_SPARE_S


def _watchdog_counts(watchdog_s: float) -> int:
    """The watchdog register's value, rounded down."""
    return math.floor(watchdog_s / WATCHDOG_STEP_S + 1e-6)


def dynamixel_settings(options: Mapping[str, Any]) -> DynamixelSettings:
    """Return the head that the options of ``driver: dynamixel`` describe.

    Raises BadOptions for an unknown or missing key or a value that cannot be: which, what it is, what would
    be right.
    """
    known = tuple(one.name for one in fields(DynamixelSettings) if one.init)
    read = OptionReader(options, known, ("port", "pan", "tilt"))
    values = head_values(read, _axis, 500.0, 1000.0)
    baud: int = read.whole("baud", 1_000_000, 9600, 10_500_000)
    check_polling(read, baud, values["poll_hz"], POLL_BYTES)
    watchdog_s = patience_s(read, values, "watchdog_s", USUAL_WATCHDOG_S, SHORTEST_WATCHDOG_S)
    return DynamixelSettings(
        **values,
        baud=baud,
        watchdog_s=watchdog_s,
        reply_timeout_s=_reply_timeout_s(read, watchdog_s, values["poll_hz"]),
    )


def _reply_timeout_s(read: OptionReader, watchdog_s: float, poll_hz: float) -> float:
    """The patience with a reply; a lost one must not trip the watchdog."""
    reply_timeout_s: float = read.number("reply_timeout_s", 0.05, 0.002, LONGEST_REPLY_S)
    trips_s = _watchdog_counts(watchdog_s) * WATCHDOG_STEP_S
    most_s = round(trips_s - 1 / poll_hz - QUIET_S, 9)
    if watchdog_s and reply_timeout_s > most_s:
        raise read.refused(
            "reply_timeout_s",
            f" is {reply_timeout_s:g} s with watchdog_s {watchdog_s:.3g}, which the servos count as "
            f"{trips_s:.3g} s: one lost reply would stop the head; expected {most_s:.3g} s or less",
        )
    return reply_timeout_s


def _axis(options: OptionReader, name: str) -> DynamixelAxisSettings:
    """One axis of the options."""
    read, values = axis_values(options, name, model_named, ("on_hardware_error", "current_limit_A"))
    axis = DynamixelAxisSettings(
        **values,
        on_hardware_error=read.one_of("on_hardware_error", "report", ("report", "reboot")),
        current_limit_A=read.number("current_limit_A", None, 0.0001, 30.0),
    )
    check_axis(read, axis)
    _check_current(read, axis)
    return axis


def _check_current(read: OptionReader, axis: DynamixelAxisSettings) -> None:
    """Refuse a limit of the current that the servo does not know."""
    model, limit_A = axis.model, axis.current_limit_A
    if limit_A is None:
        return
    if model.current_unit_A is None:
        raise read.refused("current_limit_A", f": a {model.name} has no current limit")
    if not 1 <= round(limit_A / model.current_unit_A) <= model.most_current_counts:
        most_A = model.most_current_counts * model.current_unit_A
        raise read.refused(
            "current_limit_A",
            f" is {limit_A:g} A, expected {model.current_unit_A:g} to {most_A:.4g} A for a {model.name}",
        )
