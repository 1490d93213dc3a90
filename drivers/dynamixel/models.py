"""The servos that the driver knows: counts, units and limits, and what the numbers in their registers mean.

Sources: the tables of dynamixel-sdk (`drivers.dynamixel.registers`); for what these do not say, which are
currents, backlash, the units of velocity and acceleration, the meaning of bits and codes, and since which
firmware there is a watchdog, the ROBOTIS e-manual (emanual.robotis.com, one page per model). The tables' own
velocity unit is 0.05 % below the manual's.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from types import MappingProxyType

from drivers.dynamixel.registers import ControlItem, vendor_names, vendor_table
from drivers.errors import BadOptions
from drivers.faults import nearest
from drivers.servo_bus.settings import CountedModel

RPM_RAD_PER_S = math.tau / 60
REV_PER_MIN2_RAD_PER_S2 = math.tau / 3600
POSITION_MODE = 3
NO_SECONDARY_ID = 253  # and above
WATCHDOG_TRIPPED = 255

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

Meaning = Callable[["ServoModel", int], str]


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
    for number, theirs in vendor_names().items():
        if number not in MODELS_BY_NUMBER and wanted.startswith(theirs.upper().replace("_", "-")):
            raise BadOptions(f"the driver does not know {what_is_needed(number)}")
    raise BadOptions(f"there is no servo model {name!r}{nearest(wanted, MODELS)}")


def what_is_needed(number: int) -> str:
    """Return what a servo is that the driver does not drive, and what it would need, by its model number."""
    theirs = vendor_names().get(number)
    if theirs is None:
        return (
            f"the model number {number}, nor do the tables of the installed dynamixel-sdk: needed is a "
            "dynamixel-sdk that holds its .model table"
        )
    servo = f"the {theirs} (model number {number}); mastctl rig servo info reads it"
    if theirs.startswith("ym"):
        return f"{servo}. It needs registers laid out as those of X or P, which the Y family's are not"
    return f"{servo}. Needed is a row in drivers/dynamixel/models.py: its unit of current and its backlash"


def hardware_error_names(value: int) -> list[str]:
    """Return the errors in a hardware-error register."""
    names = [name for bit, name in HARDWARE_ERRORS.items() if value & bit]
    unknown = value & ~sum(HARDWARE_ERRORS)
    return names + ([f"unknown hardware error bits 0x{unknown:02x}"] if unknown else [])


def register_meaning(model: ServoModel, name: str, value: int) -> str:
    """Return what a register's number means; empty where the number says it."""
    meaning = _MEANINGS.get(name)
    return "" if meaning is None else meaning(model, value)


def _angle(model: ServoModel, value: int) -> str:
    return f"{math.degrees((value - model.centre_count) * model.count_rad):.3f} deg from its middle"


def _velocity(model: ServoModel, value: int) -> str:
    return f"{value * model.velocity_unit_rad_per_s:.4f} rad/s"


def _acceleration(model: ServoModel, value: int) -> str:
    return f"{value * model.acceleration_unit_rad_per_s2:.4f} rad/s2" if value else "as hard as it can"


def _current(model: ServoModel, value: int) -> str:
    return "" if model.current_unit_A is None else f"{value * model.current_unit_A:.3f} A"


def _load(model: ServoModel, value: int) -> str:
    return f"{value / 10:.1f} % load" if model.current_unit_A is None else _current(model, value)


def _volts(model: ServoModel, value: int) -> str:
    return f"{value / 10:.1f} V"


def _errors(model: ServoModel, value: int) -> str:
    return ", ".join(hardware_error_names(value)) or "none"


_MEANINGS: Mapping[str, Meaning] = {
    "model_number": lambda model, value: model.name,
    "baud": lambda model, value: f"{BAUD_RATES[value]} baud" if value in BAUD_RATES else "unknown baud rate",
    "return_delay": lambda model, value: f"{2 * value} us",
    "operating_mode": lambda model, value: OPERATING_MODES.get(value, "unknown mode"),
    "secondary_id": lambda model, value: "none" if value >= NO_SECONDARY_ID else "also obeys this id",
    "min_position_limit": _angle,
    "max_position_limit": _angle,
    "present_position": _angle,
    "goal_position": _angle,
    "position_trajectory": _angle,
    "homing_offset": lambda model, value: f"{math.degrees(value * model.count_rad):.3f} deg",
    "velocity_limit": _velocity,
    "goal_velocity": _velocity,
    "profile_velocity": lambda model, value: _velocity(model, value) if value else "as fast as it can",
    "present_velocity": _velocity,
    "velocity_trajectory": _velocity,
    "moving_threshold": _velocity,
    "profile_acceleration": _acceleration,
    "current_limit": _current,
    "goal_current": _current,
    "present_current": _load,
    "max_voltage_limit": _volts,
    "min_voltage_limit": _volts,
    "present_voltage": _volts,
    "temperature_limit": lambda model, value: f"{value} C",
    "present_temperature": lambda model, value: f"{value} C",
    "hardware_error": _errors,
    "shutdown": lambda model, value: f"shuts down on: {_errors(model, value)}",
    "bus_watchdog": lambda model, value: {0: "off", WATCHDOG_TRIPPED: "tripped"}.get(
        value, f"{20 * value} ms"
    ),
    "torque_enable": lambda model, value: "on" if value else "off",
    "status_return_level": lambda model, value: {
        0: "answers pings",
        1: "answers reads",
        2: "answers everything",
    }.get(value, "unknown"),
    "moving_status": lambda model, value: "in position" if value & 1 else "not in position",
}
