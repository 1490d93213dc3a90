"""The options of a Feetech head as a configuration gives them, checked strictly."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

from drivers.errors import BadOptions
from drivers.feetech.models import BAUD_RATES, FeetechModel, model_named
from drivers.options import OptionReader
from drivers.servo_bus.settings import (
    HeadSettings,
    ServoAxisSettings,
    axis_values,
    check_axis,
    check_polling,
    head_values,
    patience_s,
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


@dataclass(frozen=True, kw_only=True)
class FeetechSettings(HeadSettings[FeetechAxisSettings]):
    """A head of two servos on one bus, as of `HeadSettings`.

    Attributes
    ----------
    lease_s
        A goal is sent only so far ahead of its axis: that is what an axis goes on for, and brakes, when this
        process is gone. 0: goals are sent as they are, and nothing stops a head whose host is gone.
    """

    lease_s: float = USUAL_LEASE_S

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
    values = head_values(read, _axis, 250.0, 39.0)
    if values["pan"].model.order != values["tilt"].model.order:
        raise BadOptions("options.pan.model and options.tilt.model are of two series, expected one on a bus")
    baud: int = read.one_of("baud", 1_000_000, BAUD_RATES, ", ")
    check_polling(read, baud, values["poll_hz"], POLL_BYTES)
    return FeetechSettings(
        **values,
        baud=baud,
        lease_s=patience_s(read, values, "lease_s", USUAL_LEASE_S, SHORTEST_LEASE_S),
        reply_timeout_s=read.number("reply_timeout_s", 0.05, 0.002, 0.3),
    )


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
