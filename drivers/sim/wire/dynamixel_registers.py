"""Control tables of the simulated Dynamixel servos, written down from the maker's manual.

They are on purpose not the driver's: a wrong number in one of the two shows up as a test that fails. Source:
ROBOTIS e-Manual (github.com/ROBOTIS-GIT/emanual), pages of each model; addresses and sizes agree with the
``.model`` tables of dynamixel-sdk (checked in hil_tests).

A row is ``address size name access initial low high``. ``w`` is readable and writable, ``r`` read only.
``initial`` is ``-`` where the servo computes the value or the manual gives none (then 0).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property


@dataclass(frozen=True)
class Register:
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
        return (value & (256**self.size - 1)).to_bytes(self.size, "little")

    def from_bytes(self, data: bytes) -> int:
        """Return the value that bytes of the wire stand for."""
        return int.from_bytes(data, "little", signed=self.low < 0)


_X_EEPROM = """
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
 60 1 startup_configuration    w 0     0 3
 63 1 shutdown                 w 52    0 63
"""
_X_RAM = """
 64 1 torque_enable            w 0     0 1
 65 1 led                      w 0     0 1
 68 1 status_return_level      w 2     0 2
 69 1 registered_instruction   r 0
 70 1 hardware_error_status    r 0
 76 2 velocity_i_gain          w 1920  0 16383
 78 2 velocity_p_gain          w 100   0 16383
 80 2 position_d_gain          w 0     0 16383
 82 2 position_i_gain          w 0     0 16383
 84 2 position_p_gain          w 800   0 16383
 88 2 feedforward_2nd_gain     w 0     0 16383
 90 2 feedforward_1st_gain     w 0     0 16383
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
147 1 backup_ready             r 0
"""
_X330_MORE = """
 62 1 pwm_slope                w 140   1 255
"""
_X540_MORE = """
 56 1 external_port_mode_1     w 3     0 3
 57 1 external_port_mode_2     w 3     0 3
 58 1 external_port_mode_3     w 3     0 3
152 2 external_port_data_1     w 0     0 4095
154 2 external_port_data_2     w 0     0 4095
156 2 external_port_data_3     w 0     0 4095
"""
_MX_MORE = """
 40 4 acceleration_limit       w 32767 0 32767
"""
_P_EEPROM = """
  0 2 model_number             r -
  2 4 model_information        r -
  6 1 firmware_version         r -
  7 1 id                       w 1     0 252
  8 1 baud_rate                w 1     0 9
  9 1 return_delay_time        w 250   0 254
 10 1 drive_mode               w 0     0 255
 11 1 operating_mode           w 3     0 16
 12 1 secondary_id             w 255   0 255
 13 1 protocol_type            w 2     2 2
 20 4 homing_offset            w 0     -2147483648 2147483647
 24 4 moving_threshold         w 20    0 2920
 31 1 temperature_limit        w 80    0 100
 32 2 max_voltage_limit        w 350   150 350
 34 2 min_voltage_limit        w 150   150 350
 36 2 pwm_limit                w 2009  0 2009
 38 2 current_limit            w 4500  0 4500
 40 4 acceleration_limit       w 10765 0 4306173
 44 4 velocity_limit           w 2920  0 2920
 48 4 max_position_limit       w 303454  -303750 303750
 52 4 min_position_limit       w -303454 -303750 303750
 56 1 external_port_mode_1     w 3     0 3
 57 1 external_port_mode_2     w 3     0 3
 58 1 external_port_mode_3     w 3     0 3
 59 1 external_port_mode_4     w 3     0 3
 60 1 startup_configuration    w 0     0 3
 63 1 shutdown                 w 58    0 63
"""
_P_RAM = """
512 1 torque_enable            w 0     0 1
513 1 led_red                  w 0     0 255
514 1 led_green                w 0     0 255
515 1 led_blue                 w 0     0 255
516 1 status_return_level      w 2     0 2
517 1 registered_instruction   r 0
518 1 hardware_error_status    r 0
524 2 velocity_i_gain          w 0     0 32767
526 2 velocity_p_gain          w 0     0 32767
528 2 position_d_gain          w 0     0 32767
530 2 position_i_gain          w 0     0 32767
532 2 position_p_gain          w 0     0 32767
536 2 feedforward_2nd_gain     w 0     0 32767
538 2 feedforward_1st_gain     w 0     0 32767
546 1 bus_watchdog             w 0     0 127
548 2 goal_pwm                 w -     -32768 32767
550 2 goal_current             w -     -32768 32767
552 4 goal_velocity            w 0     -2147483648 2147483647
556 4 profile_acceleration     w 0     0 2147483647
560 4 profile_velocity         w 0     0 2147483647
564 4 goal_position            w -     -2147483648 2147483647
568 2 realtime_tick            r -
570 1 moving                   r -
571 1 moving_status            r -
572 2 present_pwm              r -     -32768 32767
574 2 present_current          r -     -32768 32767
576 4 present_velocity         r -     -2147483648 2147483647
580 4 present_position         r -     -2147483648 2147483647
584 4 velocity_trajectory      r -     -2147483648 2147483647
588 4 position_trajectory      r -     -2147483648 2147483647
592 2 present_input_voltage    r -
594 1 present_temperature      r -
600 2 external_port_data_1     w 0     0 4095
602 2 external_port_data_2     w 0     0 4095
604 2 external_port_data_3     w 0     0 4095
606 2 external_port_data_4     w 0     0 4095
878 1 backup_ready             r 0
"""


def _rows(text: str) -> tuple[Register, ...]:
    rows = []
    for line in text.strip().splitlines():
        address, size, name, access, initial, *bounds = line.split()
        low, high = (int(b) for b in bounds) if bounds else (0, 256 ** int(size) - 1)
        first = 0 if initial == "-" else int(initial)
        rows.append(Register(int(address), int(size), name, access == "w", first, low, high))
    return tuple(rows)


@dataclass(frozen=True)
class IndirectBlock:
    """A run of indirect addresses (2 bytes each) and of the data bytes (1 each) that stand for them."""

    address: int
    data: int
    count: int


@dataclass(frozen=True)
class Model:
    """One model of servo.

    Attributes
    ----------
    name, number, firmware
        As a ping answers.
    registers
        Its control table, without the indirect blocks.
    indirect
        The indirect blocks; ``indirect_low`` to ``indirect_high`` is what they may point to.
    counts_per_turn
        Counts of one turn of the output shaft.
    zero_counts
        Count in the middle of the turn that position control uses.
    velocity_unit_rad_per_s, acceleration_unit_rad_per_s2, current_unit_a
        One unit of the velocity, acceleration and current registers.
    modes
        Operating modes: 0 current, 1 velocity, 3 position, 4 extended, 5 current-based position, 16 PWM.
    drive_bits
        Bits that Drive Mode takes.
    fast
        It answers fast sync and bulk reads.
    voltage_v
        What it is fed with, the manual's recommendation.
    """

    name: str
    number: int
    firmware: int
    registers: tuple[Register, ...]
    indirect: tuple[IndirectBlock, ...]
    indirect_low: int
    indirect_high: int
    ram_from: int
    counts_per_turn: int
    zero_counts: int
    velocity_unit_rad_per_s: float
    acceleration_unit_rad_per_s2: float
    current_unit_a: float
    modes: frozenset[int]
    drive_bits: int
    fast: bool
    voltage_v: float

    @property
    def count_rad(self) -> float:
        """One count at the output shaft."""
        return math.tau / self.counts_per_turn

    @cached_property
    def by_name(self) -> Mapping[str, Register]:
        """Registers by name."""
        return {register.name: register for register in self.registers}

    @cached_property
    def by_byte(self) -> Mapping[int, tuple[Register, int]]:
        """Register and offset within it for every defined byte, indirect blocks aside."""
        return {r.address + i: (r, i) for r in self.registers for i in range(r.size)}

    @cached_property
    def indirect_bytes(self) -> Mapping[int, tuple[str, int]]:
        """What each byte of the indirect blocks is: ("address", 2 · number + byte) or ("data", number)."""
        table: dict[int, tuple[str, int]] = {}
        number = 0
        for block in self.indirect:
            for i in range(block.count):
                table[block.address + 2 * i] = ("address", 2 * number)
                table[block.address + 2 * i + 1] = ("address", 2 * number + 1)
                table[block.data + i] = ("data", number)
                number += 1
        return table


_RPM = math.tau / 60
_X_MODES = frozenset({0, 1, 3, 4, 5, 16})
_X_INDIRECT = (IndirectBlock(168, 224, 28), IndirectBlock(578, 634, 28))


def _changed(rows: Sequence[Register], changes: Mapping[str, tuple[int, int, int]]) -> tuple[Register, ...]:
    """Rows with other ``(initial, low, high)`` for some names."""
    names = {row.name for row in rows}
    assert changes.keys() <= names, changes.keys() - names
    return tuple(
        Register(r.address, r.size, r.name, r.writable, *changes[r.name]) if r.name in changes else r
        for r in sorted(rows, key=lambda row: row.address)
    )


def _x(
    name: str,
    number: int,
    changes: Mapping[str, tuple[int, int, int]],
    *,
    more: str = "",
    without: frozenset[str] = frozenset(),
    firmware: int = 45,
    indirect: tuple[IndirectBlock, ...] = _X_INDIRECT,
    current_unit_a: float = 0.00269,
    modes: frozenset[int] = _X_MODES,
    drive_bits: int = 0b1101,
    fast: bool = True,
    voltage_v: float = 12.0,
) -> Model:
    rows = [r for r in _rows(_X_EEPROM + _X_RAM.lstrip("\n") + more.lstrip("\n")) if r.name not in without]
    return Model(
        name=name,
        number=number,
        firmware=firmware,
        registers=_changed(rows, changes),
        indirect=indirect,
        indirect_low=64,
        indirect_high=max(block.data + block.count for block in indirect) - 1,
        ram_from=64,
        counts_per_turn=4096,
        zero_counts=2048,
        velocity_unit_rad_per_s=0.229 * _RPM,
        acceleration_unit_rad_per_s2=214.577 * _RPM / 60,
        current_unit_a=current_unit_a,
        modes=modes,
        drive_bits=drive_bits,
        fast=fast,
        voltage_v=voltage_v,
    )


def _x330(
    name: str, number: int, changes: Mapping[str, tuple[int, int, int]], voltage_v: float, **initial: int
) -> Model:
    gains = {key: (value, 0, 16383) for key, value in initial.items()}
    return _x(
        name,
        number,
        {"baud_rate": (1, 0, 6), "temperature_limit": (70, 0, 100), **changes, **gains},
        more=_X330_MORE,
        firmware=52,
        indirect=(IndirectBlock(168, 208, 20),),
        current_unit_a=0.001,
        voltage_v=voltage_v,
    )


_XL330 = {
    "max_voltage_limit": (70, 31, 70),
    "min_voltage_limit": (35, 31, 70),
    "current_limit": (1750, 0, 1750),
    "shutdown": (53, 0, 63),
}
_XC330 = {
    "max_voltage_limit": (140, 55, 140),
    "min_voltage_limit": (55, 55, 140),
    "current_limit": (910, 0, 910),
    "pwm_slope": (255, 1, 255),
}
_MX = {"position_p_gain": (850, 0, 16383)}
_MX_WITHOUT = frozenset({"startup_configuration", "backup_ready"})
_540 = {"current_limit": (2047, 0, 2047)}


def _velocity(initial: int, high: int = 1023) -> dict[str, tuple[int, int, int]]:
    return {"velocity_limit": (initial, 0, high)}


def _p(
    name: str, number: int, half_turn: int, limit: int, changes: Mapping[str, tuple[int, int, int]]
) -> Model:
    positions = {
        "max_position_limit": (limit, -half_turn, half_turn),
        "min_position_limit": (-limit, -half_turn, half_turn),
    }
    return Model(
        name=name,
        number=number,
        firmware=14,
        registers=_changed(_rows(_P_EEPROM + _P_RAM.lstrip("\n")), {**positions, **changes}),
        indirect=(IndirectBlock(168, 634, 128),),
        indirect_low=512,
        indirect_high=1023,
        ram_from=512,
        counts_per_turn=2 * half_turn,
        zero_counts=0,
        velocity_unit_rad_per_s=0.01 * _RPM,
        acceleration_unit_rad_per_s2=_RPM / 60,
        current_unit_a=0.001,
        modes=frozenset({0, 1, 3, 4, 16}),
        drive_bits=0b0001,
        fast=True,
        voltage_v=24.0,
    )


def _gains(i: int, p: int, position_p: int) -> dict[str, tuple[int, int, int]]:
    return {
        "velocity_i_gain": (i, 0, 32767),
        "velocity_p_gain": (p, 0, 32767),
        "position_p_gain": (position_p, 0, 32767),
    }


_ALL = (
    _x330(
        "xl330_m077",
        1190,
        {**_XL330, **_velocity(1620, 2047)},
        5.0,
        velocity_i_gain=400,
        velocity_p_gain=40,
        position_i_gain=400,
        position_p_gain=400,
    ),
    _x330(
        "xl330_m288",
        1200,
        {**_XL330, **_velocity(445, 2047)},
        5.0,
        velocity_i_gain=1600,
        velocity_p_gain=180,
        position_p_gain=400,
    ),
    _x330(
        "xc330_t181",
        1210,
        {**_XC330, **_velocity(510, 2047)},
        12.0,
        velocity_i_gain=1200,
        velocity_p_gain=40,
        position_p_gain=900,
    ),
    _x330(
        "xc330_t288",
        1220,
        {**_XC330, **_velocity(320, 2047)},
        12.0,
        velocity_i_gain=1200,
        velocity_p_gain=40,
        position_p_gain=900,
    ),
    _x("xm430_w350", 1020, {}),
    _x("xm540_w270", 1120, {**_540, **_velocity(128)}, more=_X540_MORE, drive_bits=0b1111),
    _x("xh540_w270", 1100, {**_540, **_velocity(167)}, more=_X540_MORE, drive_bits=0b1111),
    _x("xh540_w150", 1110, {**_540, **_velocity(300)}, more=_X540_MORE, drive_bits=0b1111),
    # No current sensor: address 126 is Present Load (0.1 %), and there is nothing at 38 and 102.
    _x(
        "mx_28",
        30,
        {**_MX, **_velocity(230)},
        more=_MX_MORE + "126 2 present_load r - -1000 1000\n",
        without=_MX_WITHOUT | {"current_limit", "goal_current", "present_current"},
        modes=frozenset({1, 3, 4, 16}),
        drive_bits=0b0101,
        fast=False,
    ),
    _x(
        "mx_64",
        311,
        {**_MX, **_velocity(435), "current_limit": (1941, 0, 1941)},
        more=_MX_MORE,
        without=_MX_WITHOUT,
        current_unit_a=0.00336,
        drive_bits=0b0101,
        fast=False,
    ),
    _x(
        "mx_106",
        321,
        {**_MX, **_velocity(360), "current_limit": (2047, 0, 2047)},
        more=_MX_MORE,
        without=_MX_WITHOUT,
        current_unit_a=0.00336,
        drive_bits=0b0111,
        fast=False,
    ),
    _p("ph42_020_s300", 2000, 303750, 303454, {}),
    _p(
        "ph54_100_s500",
        2010,
        501923,
        501433,
        {
            "current_limit": (15900, 0, 15900),
            "acceleration_limit": (4255632, 0, 4255632),
            **_gains(1290, 3593, 502),
        },
    ),
    _p(
        "ph54_200_s500",
        2020,
        501923,
        501433,
        {
            "moving_threshold": (20, 0, 2900),
            "current_limit": (22740, 0, 22740),
            "acceleration_limit": (9982, 0, 3992644),
            "velocity_limit": (2900, 0, 2900),
            "shutdown": (52, 0, 63),
            **_gains(2209, 6153, 314),
        },
    ),
)

MODELS: Mapping[str, Model] = {model.name: model for model in _ALL}
"""Every model that can be simulated, by name."""

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
