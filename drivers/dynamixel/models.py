"""The servos that the driver knows: counts, units and limits, and what the numbers in their registers mean.

Sources: the tables of dynamixel-sdk (`drivers.dynamixel.registers`); for what these do not say, which are
currents, backlash, the units of velocity and acceleration, the meaning of bits and codes, and since which
firmware there is a watchdog, the ROBOTIS e-manual (emanual.robotis.com, one page per model). The tables' own
velocity unit is 0.05 % below the manual's.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from types import MappingProxyType
from typing import Annotated, ClassVar, Literal, Self

from pydantic import Field, model_validator

from calib.files.records import ABSENT, problem
from drivers.dynamixel.registers import ControlItem, vendor_table
from drivers.errors import BadOptions
from drivers.faults import nearest
from drivers.options import read_options
from drivers.servo_bus.port import QUIET_S
from drivers.servo_bus.settings import (
    RESTING_POLL_S,
    CountedModel,
    HeadSettings,
    ServoAxisSettings,
    named_model,
)

RPM_RAD_PER_S = math.tau / 60
REV_PER_MIN2_RAD_PER_S2 = math.tau / 3600
POSITION_MODE = 3
NO_SECONDARY_ID = 253  # and above
WATCHDOG_TRIPPED = 255
USUAL_WATCHDOG_S, SHORTEST_WATCHDOG_S = 0.3, 0.1
WATCHDOG_STEP_S = 0.02
SILENCE_SPARE_S = 0.05  # the servo's oscillator against ours
POLL_BYTES = 20 + 2 * (11 + 43)  # the longer of the two instructions, and two replies of 43 bytes of data

# By code: e-manual, control_table_baudrate_2.md (X, MX to 7, X330 to 6), p/control_table_8_baud_rate.md.
BAUD_RATES = MappingProxyType(
    {
        0: 9600,
        1: 57_600,
        2: 115_200,
        3: 1_000_000,
        4: 2_000_000,
        5: 3_000_000,
        6: 4_000_000,
        7: 4_500_000,
        8: 6_000_000,
        9: 10_500_000,
    }
)

# By bit: e-manual, Hardware Error Status (70; of a P 518) and the table of Shutdown (63).
HARDWARE_ERRORS = MappingProxyType(
    {
        0x01: "input voltage out of its limits",
        0x02: "motor hall sensor fault",
        0x04: "overheating",
        0x08: "motor encoder fault",
        0x10: "electrical shock or lack of power",
        0x20: "overload",
    }
)

# E-manual, Operating Mode (11).
OPERATING_MODES = MappingProxyType(
    {
        0: "current",
        1: "velocity",
        3: "position",
        4: "extended position",
        5: "current-based position",
        16: "PWM",
    }
)


@dataclass(frozen=True, kw_only=True)
class ServoModel(CountedModel):
    """One kind of servo, as of `CountedModel`.

    ``most_current_counts`` bounds its current limit; 0 for a servo that measures its load only.
    """

    number: int
    registers: Mapping[str, ControlItem]
    most_current_counts: int
    watchdog_firmware: int


def _x(
    name: str, number: int, current_unit_A: float | None, most_current_counts: int, backlash_deg: float | None
) -> ServoModel:
    """A servo of the X or MX series: 12-bit encoder on the output shaft."""
    return ServoModel(
        name=name,
        number=number,
        **vendor_table(number)._asdict(),
        count_rad=math.tau / 4096,
        velocity_unit_rad_per_s=0.229 * RPM_RAD_PER_S,
        acceleration_unit_rad_per_s2=214.577 * REV_PER_MIN2_RAD_PER_S2,
        current_unit_A=current_unit_A,
        backlash_rad=None if backlash_deg is None else math.radians(backlash_deg),
        most_current_counts=most_current_counts,
        watchdog_firmware=38,
    )


def _p(name: str, number: int, most_current_counts: int) -> ServoModel:
    """A servo of the P series: counts on the motor's side of the gear."""
    table = vendor_table(number)
    return ServoModel(
        name=name,
        number=number,
        **table._asdict(),
        count_rad=math.tau / (table.high_count - table.low_count),
        velocity_unit_rad_per_s=0.01 * RPM_RAD_PER_S,
        acceleration_unit_rad_per_s2=REV_PER_MIN2_RAD_PER_S2,
        current_unit_A=0.001,
        backlash_rad=math.radians(0.1),
        most_current_counts=most_current_counts,
        watchdog_firmware=0,
    )


# Current units and limits, backlash: e-manual, and the makers' data sheets where they state backlash
# (15' for XM430, XM540, XH430, XH540; XD has the tables and gears of XH; 20' for MX; under 6' for PH; nothing
# for XL and XC). XL430, XC430 and MX-28 measure their load, no current. A 2XL430 and a 2XC430 are two servos
# in one case, with an id and a table each; they share the baud rate alone.
_MODELS = (
    #  name             number  A/count  most counts  backlash, degrees
    _x("XL330-M077-T", 1190, 0.001, 1750, None),
    _x("XL330-M288-T", 1200, 0.001, 1750, None),
    _x("XC330-T181-T", 1210, 0.001, 910, None),
    _x("XC330-T288-T", 1220, 0.001, 910, None),
    _x("XC330-M181-T", 1230, 0.001, 2352, None),
    _x("XC330-M288-T", 1240, 0.001, 2352, None),
    _x("XL430-W250", 1060, None, 0, None),
    _x("2XL430-W250", 1090, None, 0, None),
    _x("XC430-W150", 1070, None, 0, None),
    _x("XC430-W240", 1080, None, 0, None),
    _x("2XC430-W250", 1160, None, 0, None),
    _x("XM430-W350", 1020, 0.00269, 1193, 0.25),
    _x("XM430-W210", 1030, 0.00269, 1193, 0.25),
    _x("XM540-W270", 1120, 0.00269, 2047, 0.25),
    _x("XM540-W150", 1130, 0.00269, 2047, 0.25),
    _x("XH430-W350", 1000, 0.00269, 648, 0.25),
    _x("XH430-W210", 1010, 0.00269, 648, 0.25),
    _x("XH430-V350", 1040, 0.00134, 689, 0.25),
    _x("XH430-V210", 1050, 0.00134, 689, 0.25),
    _x("XH540-W270", 1100, 0.00269, 2047, 0.25),
    _x("XH540-W150", 1110, 0.00269, 2047, 0.25),
    _x("XH540-V270", 1140, 0.00269, 1188, 0.25),
    _x("XH540-V150", 1150, 0.00269, 1188, 0.25),
    _x("XD430-T350", 1001, 0.00269, 648, 0.25),
    _x("XD430-T210", 1011, 0.00269, 648, 0.25),
    _x("XD540-T270", 1101, 0.00269, 2047, 0.25),
    _x("XD540-T150", 1111, 0.00269, 2047, 0.25),
    _x("MX-28", 30, None, 0, 0.33),
    _x("MX-64", 311, 0.00336, 1941, 0.33),
    _x("MX-106", 321, 0.00336, 2047, 0.33),
    #  name             number  most counts of current
    _p("PH42-020-S300", 2000, 4500),
    _p("PH54-100-S500", 2010, 15900),
    _p("PH54-200-S500", 2020, 22740),
)

MODELS: Mapping[str, ServoModel] = MappingProxyType({model.name: model for model in _MODELS})
MODELS_BY_NUMBER: Mapping[int, ServoModel] = MappingProxyType({model.number: model for model in _MODELS})
TICK_ADDRESSES = tuple(sorted({model.registers["realtime_tick"].address for model in _MODELS}))


def model_named(name: str) -> ServoModel:
    """Return the model that a configuration names; the letter after the gear may be left out.

    Raises BadOptions if there is none, with the nearest known name.
    """
    wanted = str(name).upper().replace("_", "-")
    for known, model in MODELS.items():
        if wanted.removesuffix("-T").removesuffix("-R") == known.removesuffix("-T"):
            return model
    hint = nearest(wanted, MODELS)
    raise BadOptions(f"there is no servo model {name!r}{hint}; another needs a row in dynamixel/models.py")


def hardware_error_names(value: int) -> list[str]:
    """Return the errors in a hardware-error register."""
    names = [name for bit, name in HARDWARE_ERRORS.items() if value & bit]
    unknown = value & ~sum(HARDWARE_ERRORS)
    return names + ([f"unknown hardware error bits 0x{unknown:02x}"] if unknown else [])


def register_meaning(model: ServoModel, name: str, value: int) -> str:
    """Return what a register's number means; empty where the number says it."""
    known = {
        "model_number": {value: model.name},
        "baud": {code: f"{rate} baud" for code, rate in BAUD_RATES.items()},
        "operating_mode": OPERATING_MODES,
        "torque_enable": {0: "off", 1: "on"},
        "bus_watchdog": {0: "off", WATCHDOG_TRIPPED: "tripped"},
        "profile_velocity": {0: "as fast as it can"},
        "profile_acceleration": {0: "as hard as it can"},
    }
    if value in known.get(name, {}):
        return known[name][value]
    if name in ("hardware_error", "shutdown"):
        return ", ".join(hardware_error_names(value)) or "none"
    if name.endswith(("_position", "_position_limit")):
        return f"{math.degrees((value - model.centre_count) * model.count_rad):.3f} deg from its middle"
    if name.endswith(("_velocity", "velocity_limit")):
        return f"{value * model.velocity_unit_rad_per_s:.4f} rad/s"
    if name.endswith(("_current", "current_limit")) and model.current_unit_A is not None:
        return f"{value * model.current_unit_A:.3f} A"
    if "voltage" in name:
        return f"{value / 10:.1f} V"
    return ""


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
