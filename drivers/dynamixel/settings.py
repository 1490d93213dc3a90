"""The options of a Dynamixel head as a configuration gives them, checked strictly."""

from __future__ import annotations

import math
from functools import partial
from typing import Annotated, ClassVar, Literal, Self

from pydantic import Field, model_validator

from calib.files.records import ABSENT, problem
from drivers.dynamixel.models import MODELS, ServoModel, model_named
from drivers.options import read_options
from drivers.servo_bus.port import QUIET_S
from drivers.servo_bus.settings import RESTING_POLL_S, HeadSettings, ServoAxisSettings, named_model

USUAL_WATCHDOG_S, SHORTEST_WATCHDOG_S = 0.3, 0.1
WATCHDOG_STEP_S = 0.02
SILENCE_SPARE_S = 0.05  # the servo's oscillator against ours
POLL_BYTES = 20 + 2 * (11 + 43)  # the longer of the two instructions, and two replies of 43 bytes of data


class DynamixelAxisSettings(ServoAxisSettings):
    """One axis."""

    model: Annotated[ServoModel, named_model(model_named, MODELS)]
    """Which servo."""
    on_hardware_error: Literal["report", "reboot"] = "report"
    """``report`` leaves the servo as it is; ``reboot`` restarts it, which drops its torque."""
    current_limit_A: Annotated[float, Field(ge=0.0001, le=30.0)] | None = None
    """Written to the servo; left out: it stays as it is."""

    @model_validator(mode="after")
    def _check_current(self) -> Self:
        model, limit_A = self.model, self.current_limit_A
        if limit_A is None:
            return self
        if model.current_unit_A is None:
            raise problem("current_limit_A", f"a {model.name} has no current limit")
        if not 1 <= round(limit_A / model.current_unit_A) <= model.most_current_counts:
            most_A = model.most_current_counts * model.current_unit_A
            bounds = f"{model.current_unit_A:g} to {most_A:.4g} A for a {model.name}"
            raise problem("current_limit_A", f"{limit_A:g} A where {bounds} is expected")
        return self


class DynamixelSettings(HeadSettings):
    """A head of two servos on one bus."""

    poll_bytes: ClassVar[int] = POLL_BYTES

    pan: DynamixelAxisSettings
    """The pan axis."""
    tilt: DynamixelAxisSettings
    """The tilt axis."""
    baud: Annotated[int, Field(ge=9600, le=10_500_000)] = 1_000_000
    """The line's bits per second."""
    watchdog_s: Annotated[float, Field(ge=0.0, le=0.5)] = ABSENT
    """After this silence the servos stop by themselves; 0 switches that off. Left out: 0.3 s, or as much less
    as it takes to be at rest 0.5 s after the last poll, braking included."""

    @model_validator(mode="after")
    def _check_watchdog(self) -> Self:
        self._set_patience("watchdog_s", USUAL_WATCHDOG_S, SHORTEST_WATCHDOG_S)
        trips_s = self.watchdog_counts * WATCHDOG_STEP_S
        most_s = round(trips_s - 1 / self.poll_hz - QUIET_S, 9)
        if self.watchdog_s and self.reply_timeout_s > most_s:
            raise problem(
                "reply_timeout_s",
                f"{self.reply_timeout_s:g} s with watchdog_s {self.watchdog_s:.3g}, which the servos count "
                f"as {trips_s:.3g} s: one lost reply would stop the head; {most_s:.3g} s or less is expected",
            )
        return self

    @property
    def watchdog_counts(self) -> int:
        """The watchdog register's value, rounded down; 0 for off."""
        return math.floor(self.watchdog_s / WATCHDOG_STEP_S + 1e-6)

    @property
    def resting_poll_s(self) -> float:
        """How often servos at rest are read, seconds; a lost reply must not trip the watchdog."""
        if not self.watchdog_counts:
            return super().resting_poll_s
        silence_s = self.watchdog_counts * WATCHDOG_STEP_S - self.reply_timeout_s - QUIET_S
        return max(1 / self.poll_hz, min(RESTING_POLL_S, silence_s / 2))

    @property
    def silence_s(self) -> float:
        """How long nothing may be sent so that the watchdogs have stopped both axes; 0 without them."""
        if not self.watchdog_counts:
            return 0.0
        brakes_s = self.speed_rad_per_s / self.acceleration_rad_per_s2
        return self.watchdog_counts * WATCHDOG_STEP_S + brakes_s + SILENCE_SPARE_S


dynamixel_settings = partial(read_options, DynamixelSettings)
"""Return the head that the options of ``driver: dynamixel`` describe. Raises BadOptions."""
