"""The models of Dynamixel servo that can be simulated, and their control tables.

Written down from the maker's manual and on purpose not the driver's: a wrong number in one of the two makes a
test fail. Source: ROBOTIS e-Manual (github.com/ROBOTIS-GIT/emanual), the page of each model; where pages
differ between editions the newest was taken. Addresses and sizes agree with the ``.model`` tables of
dynamixel-sdk (checked in hil_tests).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

from drivers.errors import BadOptions
from drivers.faults import nearest

INSTRUCTION_ERROR = 0x02
CRC_ERROR = 0x03
DATA_RANGE = 0x04
DATA_LENGTH = 0x05
DATA_LIMIT = 0x06
ACCESS = 0x07

GOALS = frozenset({"goal_pwm", "goal_current", "goal_velocity", "goal_position"})
WATCHDOG_EXPIRED = 255
POSITION_MODE, EXTENDED_POSITION_MODE = MODES = 3, 4
"""The operating modes that are simulated; others are refused, and so is a drive mode but reverse."""


@dataclass(frozen=True)
class TableRegister:
    """One item of a control table; ``low`` below zero makes it signed."""

    address: int
    size: int
    name: str
    writable: bool
    initial: int
    low: int
    high: int

    def to_bytes(self, value: int) -> bytes:
        """Return the bytes on the wire, little end first, as many as the register has."""
        return (value & ((1 << 8 * self.size) - 1)).to_bytes(self.size, "little")

    def from_bytes(self, data: bytes) -> int:
        """Return the value that bytes of the wire stand for."""
        return int.from_bytes(data, "little", signed=self.low < 0)


@dataclass(frozen=True)
class SimulatedModel:
    """One model of servo.

    Attributes
    ----------
    zero_counts
        Count in the middle of the turn that position control uses.
    axes
        Servos in one case, each with an id and a table; they share the baud rate.
    """

    name: str
    number: int
    firmware: int
    registers: tuple[TableRegister, ...]
    ram_from: int
    counts_per_turn: int
    zero_counts: int
    velocity_unit_rad_per_s: float
    acceleration_unit_rad_per_s2: float
    current_unit_a: float
    voltage_v: float
    axes: int = 1

    @property
    def count_rad(self) -> float:
        """One count at the output shaft."""
        return math.tau / self.counts_per_turn

    @cached_property
    def by_name(self) -> Mapping[str, TableRegister]:
        """Registers by name."""
        return {register.name: register for register in self.registers}

    @cached_property
    def by_byte(self) -> Mapping[int, tuple[TableRegister, int]]:
        """Register and offset within it for every defined byte."""
        return {r.address + i: (r, i) for r in self.registers for i in range(r.size)}


# A row is ``address size name access initial low high``. ``w`` is readable and writable, ``r`` read only.
# ``initial`` is ``-`` where the servo computes the value or the manual gives none (then 0). Gains, external
# ports and what a backup needs are left out.
_EEPROM = """
  0 2 model_number             r -
  2 4 model_information        r -
  6 1 firmware_version         r -
  7 1 id                       w 1     0 252
  8 1 baud_rate                w 1     0 7
  9 1 return_delay_time        w 250   0 254
 10 1 drive_mode               w 0     0 255
 11 1 operating_mode           w 3     0 16
 12 1 secondary_id             w 255   0 255
 13 1 protocol_type            w 2     2 2
 20 4 homing_offset            w 0     -1044479 1044479
 24 4 moving_threshold         w 10    0 1023
 31 1 temperature_limit        w 80    0 100
 32 2 max_voltage_limit        w 160   95 160
 34 2 min_voltage_limit        w 95    95 160
 36 2 pwm_limit                w 885   0 885
 38 2 current_limit            w 1193  0 1193
 44 4 velocity_limit           w 200   0 1023
 48 4 max_position_limit       w 4095  0 4095
 52 4 min_position_limit       w 0     0 4095
 63 1 shutdown                 w 52    0 63
"""
_RAM = """
 64 1 torque_enable            w 0     0 1
 65 1 led                      w 0     0 1
 68 1 status_return_level      w 2     0 2
 69 1 registered_instruction   r 0
 70 1 hardware_error_status    r 0
 98 1 bus_watchdog             w 0     0 127
100 2 goal_pwm                 w -     -32768 32767
102 2 goal_current             w -     -32768 32767
104 4 goal_velocity            w 0     -2147483648 2147483647
108 4 profile_acceleration     w 0     0 32767
112 4 profile_velocity         w 0     0 32767
116 4 goal_position            w -     -1048575 1048575
120 2 realtime_tick            r -
122 1 moving                   r -
123 1 moving_status            r -
124 2 present_pwm              r -     -32768 32767
126 2 present_current          r -     -32768 32767
128 4 present_velocity         r -     -2147483648 2147483647
132 4 present_position         r -     -2147483648 2147483647
136 4 velocity_trajectory      r -     -2147483648 2147483647
140 4 position_trajectory      r -     -2147483648 2147483647
144 2 present_input_voltage    r -
146 1 present_temperature      r -
"""
_ACCELERATION_LIMIT = " 40 4 acceleration_limit       w 32767 0 32767\n"
_LOAD = "126 2 present_load r - -1000 1000\n"  # instead of a current: 0.1 %

# The P series: the same EEPROM with other bounds, and the RAM area behind address 512.
_P_BOUNDS = (
    "baud_rate=1,0,9 homing_offset=0,-2147483648,2147483647 moving_threshold=20,0,2920 "
    "max_voltage_limit=350,150,350 min_voltage_limit=150,150,350 pwm_limit=2009,0,2009 "
    "current_limit=4500,0,4500 acceleration_limit=10765,0,4306173 velocity_limit=2920,0,2920 "
    "max_position_limit=303454,-303750,303750 min_position_limit=-303454,-303750,303750 shutdown=58,0,63 "
    "led_red=0,0,255 profile_acceleration=0,0,2147483647 profile_velocity=0,0,2147483647 "
    "goal_position=0,-2147483648,2147483647"
)
_X_RAM, _P_RAM = 64, 512


def table_of(rows: str) -> tuple[TableRegister, ...]:
    """Return the registers of rows as above, by address."""
    found = []
    for line in filter(str.strip, rows.splitlines()):
        address, size, name, access, initial, *bounds = line.split()
        low, high = (int(b) for b in bounds) if bounds else (0, 256 ** int(size) - 1)
        first = 0 if initial == "-" else int(initial)
        found.append(TableRegister(int(address), int(size), name, access == "w", first, low, high))
    return tuple(sorted(found, key=lambda register: register.address))


def _of_p(register: TableRegister) -> TableRegister:
    """A register of an X where a P has it."""
    if register.address < _X_RAM:
        return register
    name = "led_red" if register.name == "led" else register.name
    return replace(register, name=name, address=register.address - _X_RAM + _P_RAM)


def _bounded(table: Iterable[TableRegister], changes: str) -> tuple[TableRegister, ...]:
    """A table in which some registers have other values: ``name=initial,low,high``."""
    registers = {register.name: register for register in table}
    for change in changes.split():
        name, _, values = change.partition("=")
        initial, low, high = map(int, values.split(","))
        registers[name] = replace(registers[name], initial=initial, low=low, high=high)
    return tuple(sorted(registers.values(), key=lambda register: register.address))


_RPM = math.tau / 60
_X: dict[str, Any] = {
    "firmware": 45, "ram_from": 64, "counts_per_turn": 4096, "zero_counts": 2048,
    "velocity_unit_rad_per_s": 0.229 * _RPM, "acceleration_unit_rad_per_s2": 214.577 * _RPM / 60,
    "current_unit_a": 0.00269, "voltage_v": 12.0,
}  # fmt: skip
_X330 = _X | {"firmware": 52, "current_unit_a": 0.001}
_P: dict[str, Any] = {
    "firmware": 14, "ram_from": 512, "zero_counts": 0, "velocity_unit_rad_per_s": 0.01 * _RPM,
    "acceleration_unit_rad_per_s2": _RPM / 60, "current_unit_a": 0.001, "voltage_v": 24.0,
}  # fmt: skip

_X_TABLE = table_of(_EEPROM + _RAM)
_MX_TABLE = table_of(_EEPROM + _RAM + _ACCELERATION_LIMIT)
_P_TABLE = _bounded(map(_of_p, _MX_TABLE), _P_BOUNDS)
_CURRENT = ("current_limit", "goal_current", "present_current")
_X_LOAD, _MX_LOAD = (
    [*(one for one in table if one.name not in _CURRENT), *table_of(_LOAD)] for table in (_X_TABLE, _MX_TABLE)
)
_SERIES: Mapping[str, Mapping[str, Any]] = {
    "x330_5v": _X330 | {"registers": _X_TABLE, "voltage_v": 5.0},
    "x330_12v": _X330 | {"registers": _X_TABLE},
    "x430": _X | {"registers": _X_TABLE},
    "x430_24v": _X | {"registers": _X_TABLE, "voltage_v": 24.0, "current_unit_a": 0.00134},
    "x540_24v": _X | {"registers": _X_TABLE, "voltage_v": 24.0},
    "x430_of_load": _X | {"registers": _X_LOAD},
    "x430_of_load_2": _X | {"registers": _X_LOAD, "axes": 2},
    "mx": _X | {"registers": _MX_TABLE, "current_unit_a": 0.00336},
    "mx_of_load": _X | {"registers": _MX_LOAD},
    "p42": _P | {"registers": _P_TABLE, "counts_per_turn": 607_500},
    "p54": _P | {"registers": _P_TABLE, "counts_per_turn": 1_003_846},
}

_XL330 = "max_voltage_limit=70,31,70 min_voltage_limit=35,31,70 current_limit=1750,0,1750 shutdown=53,0,63"
_XC330 = "max_voltage_limit=140,55,140 min_voltage_limit=55,55,140 current_limit=910,0,910"
_XC330_M = "max_voltage_limit=70,31,70 min_voltage_limit=35,31,70 current_limit=2352,0,2352"
_330 = "baud_rate=1,0,6 temperature_limit=70,0,100"
_24V = "max_voltage_limit=300,110,300 min_voltage_limit=110,110,300"
_XC430 = "max_voltage_limit=160,60,160 min_voltage_limit=60,60,160"
_XL430 = "temperature_limit=72,0,100 max_voltage_limit=140,60,140 min_voltage_limit=60,60,140"
_P54 = "max_position_limit=501433,-501923,501923 min_position_limit=-501433,-501923,501923"

# Name, number, series, and what its registers have otherwise: ``name=initial,low,high``.
_ROWS = (
    f"xl330_m077 1190 x330_5v {_330} {_XL330} velocity_limit=1620,0,2047",
    f"xl330_m288 1200 x330_5v {_330} {_XL330} velocity_limit=445,0,2047",
    f"xc330_t181 1210 x330_12v {_330} {_XC330} velocity_limit=510,0,2047",
    f"xc330_t288 1220 x330_12v {_330} {_XC330} velocity_limit=320,0,2047",
    f"xc330_m181 1230 x330_5v {_330} {_XC330_M} velocity_limit=545,0,2047",
    f"xc330_m288 1240 x330_5v {_330} {_XC330_M} velocity_limit=350,0,2047",
    "xm430_w210 1030 x430 velocity_limit=330,0,1023",
    "xm430_w350 1020 x430",
    "xm540_w150 1130 x430 current_limit=2047,0,2047 velocity_limit=230,0,1023",
    "xm540_w270 1120 x430 current_limit=2047,0,2047 velocity_limit=128,0,1023",
    f"xl430_w250 1060 x430_of_load {_XL430} velocity_limit=265,0,1023",
    f"2xl430_w250 1090 x430_of_load_2 {_XL430} velocity_limit=250,0,1023",
    f"xc430_w150 1070 x430_of_load {_XC430} velocity_limit=460,0,1023 moving_threshold=20,0,1023",
    f"xc430_w240 1080 x430_of_load {_XC430} velocity_limit=306,0,1023 moving_threshold=20,0,1023",
    f"2xc430_w250 1160 x430_of_load_2 {_XC430} velocity_limit=275,0,1023",
    "xh430_w350 1000 x430 current_limit=648,0,648 velocity_limit=130,0,1023",
    "xh430_w210 1010 x430 current_limit=648,0,648 velocity_limit=210,0,1023",
    f"xh430_v350 1040 x430_24v current_limit=689,0,689 velocity_limit=135,0,1023 {_24V}",
    f"xh430_v210 1050 x430_24v current_limit=689,0,689 velocity_limit=227,0,1023 {_24V}",
    "xh540_w270 1100 x430 current_limit=2047,0,2047 velocity_limit=167,0,1023",
    "xh540_w150 1110 x430 current_limit=2047,0,2047 velocity_limit=300,0,1023",
    f"xh540_v270 1140 x540_24v current_limit=1188,0,1188 velocity_limit=128,0,1023 {_24V}",
    f"xh540_v150 1150 x540_24v current_limit=1188,0,1188 velocity_limit=230,0,1023 {_24V}",
    # the XD's tables are the XH's, the manual says
    "xd430_t350 1001 x430 current_limit=648,0,648 velocity_limit=130,0,1023",
    "xd430_t210 1011 x430 current_limit=648,0,648 velocity_limit=210,0,1023",
    "xd540_t270 1101 x430 current_limit=2047,0,2047 velocity_limit=167,0,1023",
    "xd540_t150 1111 x430 current_limit=2047,0,2047 velocity_limit=300,0,1023",
    "mx_28 30 mx_of_load velocity_limit=230,0,1023",
    "mx_64 311 mx velocity_limit=435,0,1023 current_limit=1941,0,1941",
    "mx_106 321 mx velocity_limit=360,0,1023 current_limit=2047,0,2047",
    "ph42_020_s300 2000 p42",
    f"ph54_100_s500 2010 p54 {_P54} current_limit=15900,0,15900 acceleration_limit=4255632,0,4255632",
    f"ph54_200_s500 2020 p54 {_P54} moving_threshold=20,0,2900 current_limit=22740,0,22740"
    " acceleration_limit=9982,0,3992644 velocity_limit=2900,0,2900 shutdown=52,0,63",
)


def _model(row: str) -> SimulatedModel:
    """One row of the table."""
    name, number, series, changes = (*row.split(" ", 3), "")[:4]
    model = SimulatedModel(name, int(number), **_SERIES[series])
    return replace(model, registers=_bounded(model.registers, changes))


MODELS: Mapping[str, SimulatedModel] = {model.name: model for model in map(_model, _ROWS)}
"""Every model that can be simulated, by name."""


def model_named(name: str) -> SimulatedModel:
    """Return a model by its name in any common spelling: ``XM430-W350-T``, ``xm430_w350``.

    Raises BadOptions if there is none, with the nearest name.
    """
    plain = str(name).lower().replace("-", "_")
    for suffix in ("", "_t", "_r"):
        known = plain.removesuffix(suffix)
        if known in MODELS:
            return MODELS[known]
    raise BadOptions(f"there is no servo model {name!r} to simulate{nearest(plain, MODELS)}")


BAUD_RATES: tuple[int, ...] = (
    9600,
    57600,
    115200,
    1_000_000,
    2_000_000,
    3_000_000,
    4_000_000,
    4_500_000,
    6_000_000,
    10_500_000,
)
"""Bits a second by the value of the register Baud Rate."""


class InstructionRefused(Exception):
    """An instruction that the servo answers with an error number."""

    def __init__(self, error: int) -> None:
        super().__init__(f"error {error}")
        self.error = error


class ControlTable:
    """Stored values and the rules of access; computed values come from ``live``."""

    def __init__(self, model: SimulatedModel, live: Mapping[str, Callable[[float], int]]) -> None:
        self.model = model
        self.values = {r.name: r.initial for r in model.registers}
        self._live = live

    def __getitem__(self, name: str) -> int:
        return self.values[name]

    def __setitem__(self, name: str, value: int) -> None:
        self.values[name] = value

    def get(self, name: str, default: int) -> int:
        """Return a stored value, or the default where the model has no such register."""
        return self.values.get(name, default)

    def now(self, register: TableRegister, time_s: float) -> int:
        """Return the value of a register at a moment."""
        live = self._live.get(register.name)
        return self.values[register.name] if live is None else live(time_s)

    def read(self, address: int, length: int, time_s: float) -> bytes:
        """Return the bytes of a range.

        Raises Refused (ACCESS where a byte of the range is not defined, DATA_LENGTH for no bytes).
        """
        if length == 0:
            raise InstructionRefused(DATA_LENGTH)
        out = bytearray()
        while len(out) < length:
            register, offset = self._at(address + len(out))
            out += register.to_bytes(self.now(register, time_s))[offset:]
        return bytes(out[:length])

    def _at(self, address: int) -> tuple[TableRegister, int]:
        """The register at an address, and the offset within it."""
        entry = self.model.by_byte.get(address)
        if entry is None:
            raise InstructionRefused(ACCESS)
        return entry

    def changes(
        self, address: int, data: bytes, *, locked: bool, expired: bool
    ) -> list[tuple[TableRegister, int]]:
        """Return registers and their values after a write; nothing is changed yet.

        Raises Refused with the error number that the servo answers.

        The EEPROM area is ``locked`` while torque is on, and to a packet to the secondary id.
        """
        if not data:
            raise InstructionRefused(DATA_LENGTH)
        changes: list[tuple[TableRegister, int]] = []
        at, left = address, data
        while left:
            register, offset = self._at(at)
            if not register.writable:
                raise InstructionRefused(ACCESS)
            if offset != 0 or len(left) < register.size:
                raise InstructionRefused(DATA_LENGTH)
            if at < self.model.ram_from and locked:
                raise InstructionRefused(ACCESS)
            value = register.from_bytes(left[: register.size])
            self._check(register, value, expired)
            changes.append((register, value))
            at, left = at + register.size, left[register.size :]
        return changes

    def _check(self, register: TableRegister, value: int, expired: bool) -> None:
        """Refuse a value outside the register's range, or outside the limits set in the table."""
        name, values = register.name, self.values
        if not register.low <= value <= register.high:
            raise InstructionRefused(DATA_RANGE)
        if (name == "operating_mode" and value not in MODES) or (name == "drive_mode" and value > 1):
            raise InstructionRefused(DATA_RANGE)
        if expired and (name in GOALS or (name == "bus_watchdog" and value != 0)):
            raise InstructionRefused(DATA_RANGE)
        if name == "goal_position":
            # The position limits hold in position control only.
            low, high = values["min_position_limit"], values["max_position_limit"]
            if values["operating_mode"] == 3 and not low <= value <= high:
                raise InstructionRefused(DATA_LIMIT)
        elif name in GOALS:
            if abs(value) > values[name.replace("goal_", "") + "_limit"]:
                raise InstructionRefused(DATA_LIMIT)
        elif (
            self.model.ram_from == 512
            and name in ("profile_velocity", "profile_acceleration")
            and value > values[name.replace("profile_", "") + "_limit"]
        ):
            raise InstructionRefused(DATA_LIMIT)
