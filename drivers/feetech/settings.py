"""The options of a Feetech head as a configuration gives them, checked strictly."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

from drivers.errors import BadOptions
from drivers.feetech.models import BAUD_RATES, FeetechModel, model_named
from drivers.options import OptionReader
from drivers.servo_bus.settings import (
    RESTING_POLL_S,
    STANDS_WITHIN_S,
    ServoAxisSettings,
    axis_values,
    check_axis,
    checked_pair,
)

USUAL_LEASE_S, SHORTEST_LEASE_S = 0.2, 0.05
POLL_BYTES = 24 + 2 * (6 + 47)  # a write and a read of both servos, and two replies of the longest question


@dataclass(frozen=True, kw_only=True)
class FeetechAxisSettings(ServoAxisSettings):
    """One axis, as of `ServoAxisSettings`.

    Attributes
    ----------
    model
        Which servo.
    torque_percent
        Bound of the motor's drive; None: as much as the servo's EEPROM allows.
    """

    model: FeetechModel
    torque_percent: float | None = None

    @property
    def torque_limit(self) -> int | None:
        """The bound in the servo's counts, 0.1 %."""
        return None if self.torque_percent is None else round(10 * self.torque_percent)

    @property
    def speed_unit_counts(self) -> int:
        """Counts per second of one unit of its speed."""
        return self.model.speed_unit_counts


@dataclass(frozen=True)
class FeetechSettings:
    """A head of two servos on one bus.

    Attributes
    ----------
    port, baud, speed_rad_per_s, acceleration_rad_per_s2, poll_hz, reply_timeout_s, settle_s
        As of a Dynamixel head.
    lease_s
        A goal is sent only so far ahead of its axis: that is what an axis goes on for, and brakes, when this
        process is gone. 0: goals are sent as they are, and nothing stops a head whose host is gone.
    torque_off_at_start
        Whether torque may be dropped at start-up where permanent settings must be changed.
    """

    port: str
    pan: FeetechAxisSettings
    tilt: FeetechAxisSettings
    baud: int = 1_000_000
    speed_rad_per_s: float = 1.0
    acceleration_rad_per_s2: float = 4.0
    lease_s: float = USUAL_LEASE_S
    poll_hz: float = 50.0
    reply_timeout_s: float = 0.05
    settle_s: float = 0.1
    torque_off_at_start: bool = False

    @property
    def resting_poll_s(self) -> float:
        """How often servos that stand are read, seconds."""
        return max(1 / self.poll_hz, RESTING_POLL_S)

    @property
    def silence_s(self) -> float:
        """How long nothing may be sent so that both axes have come to the end of what was lent to them."""
        return self.lease_s + 2 * self.speed_rad_per_s / self.acceleration_rad_per_s2 if self.lease_s else 0.0


def feetech_settings(options: Mapping[str, Any]) -> FeetechSettings:
    """Return the head that the options of ``driver: feetech`` describe.

    Raises
    ------
    BadOptions
        For an unknown or missing key or a value that cannot be: which, what it is, what would be right.
    """
    read = OptionReader(options, FeetechSettings.__dataclass_fields__, ("port", "pan", "tilt"))
    port = read.text("port", "a serial device such as /dev/ttyUSB0 or a URL")
    pan, tilt = (_axis(read, name) for name in ("pan", "tilt"))
    checked_pair(pan, tilt)
    if pan.model.order != tilt.model.order:
        raise BadOptions("options.pan.model and options.tilt.model are of two series, expected one on a bus")
    poll_hz = read.number("poll_hz", 50.0, 10.0, 250.0)
    baud: int = read.one_of("baud", 1_000_000, BAUD_RATES, ", ")
    if POLL_BYTES * 10 / baud > 1 / poll_hz:
        raise read.refused(
            "baud",
            f" {baud}: reading both servos takes {POLL_BYTES * 1e4 / baud:.1f} ms, too long for poll_hz "
            f"{poll_hz:g}; expected {math.ceil(POLL_BYTES * 10 * poll_hz)} baud or more, or a lower poll_hz",
        )
    speed = read.number("speed_rad_per_s", 1.0, 0.03, 10.0)
    acceleration = read.number("acceleration_rad_per_s2", 4.0, 0.4, 39.0)
    return FeetechSettings(
        port=port,
        pan=pan,
        tilt=tilt,
        baud=baud,
        speed_rad_per_s=speed,
        acceleration_rad_per_s2=acceleration,
        lease_s=_lease_s(read, speed, acceleration, poll_hz),
        poll_hz=poll_hz,
        reply_timeout_s=read.number("reply_timeout_s", 0.05, 0.002, 0.3),
        settle_s=read.number("settle_s", 0.1, 0.0, 5.0),
        torque_off_at_start=read.flag("torque_off_at_start", False),
    )


def _lease_s(read: OptionReader, speed: float, acceleration: float, poll_hz: float) -> float:
    """The lease, short enough for the head to stand in time after the last poll."""
    brakes_s = speed / acceleration
    longest_s = round(STANDS_WITHIN_S - 1 / poll_hz - brakes_s, 9)
    if longest_s < SHORTEST_LEASE_S and read.values.get("lease_s") != 0:
        left_s = STANDS_WITHIN_S - 1 / poll_hz - SHORTEST_LEASE_S
        raise read.refused(
            "acceleration_rad_per_s2",
            f" is {acceleration:g}: braking from {speed:g} rad/s takes {brakes_s:.3g} s, and no lease stops "
            f"the head within {STANDS_WITHIN_S:g} s; expected {speed / left_s:.3g} or more, or lease_s: 0",
        )
    lease_s: float = read.number("lease_s", min(USUAL_LEASE_S, longest_s), 0.0, STANDS_WITHIN_S)
    if lease_s and not SHORTEST_LEASE_S <= lease_s <= longest_s:
        raise read.refused(
            "lease_s",
            f" is {lease_s:.3g} s, and braking from {speed:g} rad/s takes {brakes_s:.3g} s; expected "
            f"{SHORTEST_LEASE_S:g} to {longest_s:.3g} s, or 0 to do without",
        )
    return lease_s


def _axis(options: OptionReader, name: str) -> FeetechAxisSettings:
    """One axis of the options."""
    read, values = axis_values(options, name, model_named, ("torque_percent", "speed_unit_counts"))
    unit = read.one_of("speed_unit_counts", 1, (1, 50))
    percent = read.number("torque_percent", None, 2.0, 100.0)
    if percent is not None and values["model"].is_scs:
        raise read.refused("torque_percent", f": a {values['model'].name} has no torque limit")
    axis = FeetechAxisSettings(
        **{**values, "model": replace(values["model"], speed_unit_counts=unit)},
        torque_percent=percent,
    )
    check_axis(read, axis)
    return axis
