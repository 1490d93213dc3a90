"""The servos that the driver knows: registers, counts, units and limits, in two tables.

Sources: the control tables of the ROBOTIS e-manual (emanual.robotis.com, one page per model), which the
``.model`` files of dynamixel-sdk 4.1.0 (``dynamixel_easy_sdk/control_table``) repeat without ranges and
units. X and MX servos with protocol 2.0 share one register map, P servos another one that holds the same
registers in the same order, from torque_enable on 448 addresses higher.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Literal

from drivers.errors import BadOptions
from drivers.faults import nearest

Map = Literal["X", "P"]
RPM_RAD_PER_S = math.tau / 60
REV_PER_MIN2_RAD_PER_S2 = math.tau / 3600


@dataclass(frozen=True)
class Register:
    """One entry of a control table: its address, its size in bytes, whether it is signed or permanent.

    ``permanent`` registers (EEPROM) can be written only while torque is off and wear with each write.
    ``window`` is the address and the length of what is read to know the register: see `_WINDOWS`.
    """

    name: str
    address: int
    size: int
    signed: bool = False
    permanent: bool = False
    window: tuple[int, int] = (0, 0)

    def decode(self, data: bytes) -> int:
        """Return the value of the register's little-endian bytes."""
        return int.from_bytes(data, "little", signed=self.signed)

    def decode_window(self, data: bytes) -> int:
        """Return the register's value out of the bytes of its window."""
        at = self.address - self.window[0]
        return self.decode(data[at : at + self.size])

    def encode(self, value: int) -> bytes:
        """Return a value as the register's little-endian bytes; OverflowError if it does not fit."""
        return value.to_bytes(self.size, "little", signed=self.signed)


#   name                    X/MX   P  bytes signed
_REGISTERS = """
    model_number               0    0   2
    firmware                   6    6   1
    id                         7    7   1
    baud                       8    8   1
    return_delay               9    9   1
    drive_mode                10   10   1
    operating_mode            11   11   1
    secondary_id              12   12   1
    homing_offset             20   20   4   signed
    moving_threshold          24   24   4
    temperature_limit         31   31   1
    max_voltage_limit         32   32   2
    min_voltage_limit         34   34   2
    pwm_limit                 36   36   2
    current_limit             38   38   2
    velocity_limit            44   44   4
    max_position_limit        48   48   4   signed
    min_position_limit        52   52   4   signed
    shutdown                  63   63   1
    torque_enable             64  512   1
    status_return_level       68  516   1
    hardware_error            70  518   1
    bus_watchdog              98  546   1
    goal_pwm                 100  548   2   signed
    goal_current             102  550   2   signed
    goal_velocity            104  552   4   signed
    profile_acceleration     108  556   4
    profile_velocity         112  560   4
    goal_position            116  564   4   signed
    realtime_tick            120  568   2
    moving                   122  570   1
    moving_status            123  571   1
    present_pwm              124  572   2   signed
    present_current          126  574   2   signed
    present_velocity         128  576   4   signed
    present_position         132  580   4   signed
    velocity_trajectory      136  584   4   signed
    position_trajectory      140  588   4   signed
    present_voltage          144  592   2
    present_temperature      146  594   1
"""
FIRST_RAM_ADDRESS = 64

# A reply does not say which register it is of, but its length does if no two have the same one: here only
# torque and goal PWM, and shutdown and bus watchdog, which are never asked for one after the other. Each
# window holds registers only that every servo of the table has, without gaps, which servos may refuse. The
# registers around the counter (realtime_tick) are read together with it.
#   X/MX address, bytes   what stands there
_WINDOWS = (
    (0, 13),  # model number to secondary id
    (20, 8),  # homing offset, moving threshold
    (31, 7),  # temperature and voltage limits, PWM limit
    (36, 4),  # PWM limit, current limit
    (44, 12),  # velocity limit, position limits
    (63, 1),  # shutdown
    (64, 2),  # torque, LED
    (68, 3),  # status return level, registered instruction, hardware error
    (98, 1),  # bus watchdog
    (100, 2),  # goal PWM
)


def _window(x: int, size: int, tick: int) -> tuple[int, int]:
    """Address and length, on the X map, of what is read to know a register."""
    for address, length in _WINDOWS:
        if address <= x and x + size <= address + length:
            return address, length
    first, end = min(x, tick), max(x + size, tick + 2)
    return first, end - first


def _maps() -> dict[Map, Mapping[str, Register]]:
    maps: dict[Map, dict[str, Register]] = {"X": {}, "P": {}}
    rows = [line.split() for line in _REGISTERS.strip().splitlines()]
    tick = next(int(row[1]) for row in rows if row[0] == "realtime_tick")
    for name, x, p, size, *signed in rows:
        first, length = _window(int(x), int(size), tick)
        for key, address in (("X", int(x)), ("P", int(p))):
            permanent = int(x) < FIRST_RAM_ADDRESS
            window = (first + address - int(x), length)
            maps["X" if key == "X" else "P"][name] = Register(
                name, address, int(size), bool(signed), permanent, window
            )
    return {key: MappingProxyType(registers) for key, registers in maps.items()}


REGISTERS = _maps()
TICK_ADDRESSES = tuple(registers["realtime_tick"].address for registers in REGISTERS.values())

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


@dataclass(frozen=True)
class Model:
    """One kind of servo.

    Attributes
    ----------
    name, number
        As ROBOTIS names it, and what a ping answers.
    registers
        Its register map, by name.
    counts_per_turn
        Of the output shaft.
    low_count, high_count
        What its position limits may be in position mode.
    centre_count
        Where its own angle is zero.
    velocity_unit_rad_per_s, acceleration_unit_rad_per_s2
        Of one count of velocity and profile acceleration.
    current_unit_A, most_current_counts
        One count of current, and the most that its current limit may be; None and 0 for a servo that measures
        its load only.
    backlash_rad
        As the maker states it; None where nothing is stated.
    watchdog_firmware
        The first firmware with a bus watchdog.
    """

    name: str
    number: int
    registers: Mapping[str, Register]
    counts_per_turn: int
    low_count: int
    high_count: int
    centre_count: int
    velocity_unit_rad_per_s: float
    acceleration_unit_rad_per_s2: float
    current_unit_A: float | None
    most_current_counts: int
    backlash_rad: float | None
    watchdog_firmware: int

    @property
    def count_rad(self) -> float:
        """One count, radians."""
        return math.tau / self.counts_per_turn


_X = (REGISTERS["X"], 4096, 0, 4095, 2048, 0.229 * RPM_RAD_PER_S, 214.577 * REV_PER_MIN2_RAD_PER_S2)


def _x(
    name: str, number: int, current_unit_A: float | None, most_current_counts: int, backlash_deg: float | None
) -> Model:
    """A servo of the X or MX series: 12-bit encoder on the output shaft."""
    backlash = None if backlash_deg is None else math.radians(backlash_deg)
    return Model(name, number, *_X, current_unit_A, most_current_counts, backlash, watchdog_firmware=38)


def _p(
    name: str, number: int, counts_per_turn: int, half_turn_counts: int, most_current_counts: int
) -> Model:
    """A servo of the P series: counts on the motor's side of the gear."""
    units = 0.01 * RPM_RAD_PER_S, 1.0 * REV_PER_MIN2_RAD_PER_S2
    return Model(
        name,
        number,
        REGISTERS["P"],
        counts_per_turn,
        -half_turn_counts,
        half_turn_counts,
        0,
        *units,
        0.001,
        most_current_counts,
        math.radians(0.1),
        watchdog_firmware=0,
    )


# Current units and limits, backlash: e-manual, and the makers' data sheets where they state backlash
# (15' for XM430, XM540, XH540; 20' for MX; under 6' for PH; nothing for XL330 and XC330).
_MODELS = (
    #  name             number  A/count  most counts  backlash, degrees
    _x("XL330-M077-T", 1190, 0.001, 1750, None),
    _x("XL330-M288-T", 1200, 0.001, 1750, None),
    _x("XC330-T181-T", 1210, 0.001, 910, None),
    _x("XC330-T288-T", 1220, 0.001, 910, None),
    _x("XC330-M181-T", 1230, 0.001, 2352, None),
    _x("XC330-M288-T", 1240, 0.001, 2352, None),
    _x("XM430-W350", 1020, 0.00269, 1193, 0.25),
    _x("XM430-W210", 1030, 0.00269, 1193, 0.25),
    _x("XM540-W270", 1120, 0.00269, 2047, 0.25),
    _x("XM540-W150", 1130, 0.00269, 2047, 0.25),
    _x("XH540-W270", 1100, 0.00269, 2047, 0.25),
    _x("XH540-W150", 1110, 0.00269, 2047, 0.25),
    _x("MX-28", 30, None, 0, 0.33),
    _x("MX-64", 311, 0.00336, 1941, 0.33),
    _x("MX-106", 321, 0.00336, 2047, 0.33),
    #  name             number  counts a turn  half a turn  most counts of current
    _p("PH42-020-S300", 2000, 607_500, 303_750, 4500),
    _p("PH54-100-S500", 2010, 1_003_846, 501_923, 15900),
    _p("PH54-200-S500", 2020, 1_003_846, 501_923, 22740),
)
MODELS: Mapping[str, Model] = MappingProxyType({model.name: model for model in _MODELS})
MODELS_BY_NUMBER: Mapping[int, Model] = MappingProxyType({model.number: model for model in _MODELS})


def model_named(name: str) -> Model:
    """Return the model that a configuration names; the letter after the gear may be left out.

    Raises
    ------
    BadOptions
        If there is none, with the nearest known name.
    """
    wanted = str(name).upper().replace("_", "-")
    for known, model in MODELS.items():
        if wanted in (known, known.removesuffix("-T")):
            return model
    raise BadOptions(f"there is no servo model {name!r}{nearest(wanted, MODELS)}")


def hardware_error_words(value: int) -> list[str]:
    """Return what a hardware-error register says, in plain words."""
    words = [word for bit, word in HARDWARE_ERRORS.items() if value & bit]
    unknown = value & ~sum(HARDWARE_ERRORS)
    return words + ([f"unknown hardware error bits 0x{unknown:02x}"] if unknown else [])


class Block:
    """Neighbouring registers that are read in one go, and their decoding.

    Parameters
    ----------
    registers
        A register map.
    first, last
        The names of its ends.
    """

    def __init__(self, registers: Mapping[str, Register], first: str, last: str) -> None:
        start, end = registers[first].address, registers[last].address
        inside = sorted((r for r in registers.values() if start <= r.address <= end), key=lambda r: r.address)
        codes, at = "<", start
        for register in inside:
            codes += "x" * (register.address - at)
            code = {1: "B", 2: "H", 4: "I"}[register.size]
            codes += code.lower() if register.signed else code
            at = register.address + register.size
        self.address = start
        self.length = at - start
        self._names = tuple(register.name for register in inside)
        self._struct = struct.Struct(codes)

    def decode(self, data: bytes) -> dict[str, int]:
        """Return the registers' values by name; ``data`` has ``length`` bytes."""
        return dict(zip(self._names, self._struct.unpack(data), strict=True))
