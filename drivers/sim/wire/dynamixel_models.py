"""The models of Dynamixel servo that can be simulated: tables, counts, units, modes.

Source: ROBOTIS e-Manual, the page of each model. Where pages differ between editions the newest was taken.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

from drivers.errors import BadOptions
from drivers.faults import nearest
from drivers.sim.wire.dynamixel_registers import (
    MX_MORE,
    P_EEPROM,
    P_RAM,
    X330_MORE,
    X540_MORE,
    X_EEPROM,
    X_RAM,
    TableRegister,
    rows,
)


@dataclass(frozen=True)
class IndirectBlock:
    """A run of indirect addresses (2 bytes each) and of the data bytes (1 each) that stand for them."""

    address: int
    data: int
    count: int


@dataclass(frozen=True)
class SimulatedModel:
    """One model of servo.

    Attributes
    ----------
    indirect
        The indirect blocks; ``indirect_low`` to ``indirect_high`` is what they may point to.
    zero_counts
        Count in the middle of the turn that position control uses.
    velocity_unit_rad_per_s, acceleration_unit_rad_per_s2, current_unit_a
        One unit of the velocity, acceleration and current registers.
    modes
        Operating modes: 0 current, 1 velocity, 3 position, 4 extended, 5 current-based position, 16 PWM.
    axes
        Servos in one case, each with an id and a table; they share the baud rate.
    """

    name: str
    number: int
    firmware: int
    registers: tuple[TableRegister, ...]
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


def _changed(
    table: Sequence[TableRegister], changes: Mapping[str, tuple[int, int, int]]
) -> tuple[TableRegister, ...]:
    """Rows with other ``(initial, low, high)`` for some names."""
    assert changes.keys() <= {row.name for row in table}
    return tuple(
        TableRegister(r.address, r.size, r.name, r.writable, *changes[r.name]) if r.name in changes else r
        for r in sorted(table, key=lambda row: row.address)
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
    axes: int = 1,
) -> SimulatedModel:
    table = [r for r in rows(X_EEPROM + X_RAM + more) if r.name not in without]
    return SimulatedModel(
        name=name,
        number=number,
        firmware=firmware,
        registers=_changed(table, changes),
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
        axes=axes,
    )


def _x330(
    name: str, number: int, changes: Mapping[str, tuple[int, int, int]], voltage_v: float, **initial: int
) -> SimulatedModel:
    gains = {key: (value, 0, 16383) for key, value in initial.items()}
    return _x(
        name,
        number,
        {"baud_rate": (1, 0, 6), "temperature_limit": (70, 0, 100), **changes, **gains},
        more=X330_MORE,
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
_XC330_M = {
    "max_voltage_limit": (70, 31, 70),
    "min_voltage_limit": (35, 31, 70),
    "current_limit": (2352, 0, 2352),
}
_MX = {"position_p_gain": (850, 0, 16383)}
_MX_WITHOUT = frozenset({"startup_configuration", "backup_ready"})
_540 = {"current_limit": (2047, 0, 2047)}


_LOAD_ONLY = frozenset({"current_limit", "goal_current", "present_current"})
_LOAD = "126 2 present_load r - -1000 1000\n"


def _velocity(initial: int, high: int = 1023) -> dict[str, tuple[int, int, int]]:
    return {"velocity_limit": (initial, 0, high)}


def _voltage(high: int, low: int = 60) -> dict[str, tuple[int, int, int]]:
    return {"max_voltage_limit": (high, low, high), "min_voltage_limit": (low, low, high)}


def _x430_of_load(
    name: str, number: int, changes: Mapping[str, tuple[int, int, int]], axes: int = 1
) -> SimulatedModel:
    """A servo without a current sensor: address 126 is Present Load (0.1 %), 38 and 102 are empty."""
    modes, without = frozenset({1, 3, 4, 16}), _LOAD_ONLY
    bits = 0b1101
    if axes == 2:
        without, bits = without | _MX_WITHOUT, 0b0001
    return _x(name, number, changes, more=_LOAD, without=without, modes=modes, drive_bits=bits, axes=axes)


def _xh(
    name: str, number: int, velocity: int, current: int, *, unit_a: float = 0.00269, volts: float = 12.0
) -> SimulatedModel:
    """An XH or XD servo; the XD's tables are the XH's, the manual says."""
    changes = {
        "current_limit": (current, 0, current),
        **_velocity(velocity),
        **(_voltage(300, 110) if volts == 24 else {}),
    }
    if "540" in name:
        return _x(name, number, changes, more=X540_MORE, drive_bits=0b1111, voltage_v=volts)
    return _x(name, number, changes, current_unit_a=unit_a, voltage_v=volts)


def _p(
    name: str, number: int, half_turn: int, limit: int, changes: Mapping[str, tuple[int, int, int]]
) -> SimulatedModel:
    positions = {
        "max_position_limit": (limit, -half_turn, half_turn),
        "min_position_limit": (-limit, -half_turn, half_turn),
    }
    return SimulatedModel(
        name=name,
        number=number,
        firmware=14,
        registers=_changed(rows(P_EEPROM + P_RAM), {**positions, **changes}),
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
    _x330(
        "xc330_m181",
        1230,
        {**_XC330_M, **_velocity(545, 2047)},
        5.0,
        velocity_i_gain=1400,
        velocity_p_gain=100,
        position_d_gain=500,
        position_p_gain=1200,
    ),
    _x330(
        "xc330_m288",
        1240,
        {**_XC330_M, **_velocity(350, 2047)},
        5.0,
        velocity_i_gain=1600,
        velocity_p_gain=50,
        position_d_gain=500,
        position_p_gain=1100,
    ),
    _x("xm430_w210", 1030, _velocity(330)),
    _x("xm430_w350", 1020, {}),
    _x("xm540_w150", 1130, {**_540, **_velocity(230)}, more=X540_MORE, drive_bits=0b1111),
    _x("xm540_w270", 1120, {**_540, **_velocity(128)}, more=X540_MORE, drive_bits=0b1111),
    _x430_of_load("xl430_w250", 1060, {"temperature_limit": (72, 0, 100), **_voltage(140), **_velocity(265)}),
    _x430_of_load(
        "2xl430_w250", 1090, {"temperature_limit": (72, 0, 100), **_voltage(140), **_velocity(250)}, axes=2
    ),
    _x430_of_load("xc430_w150", 1070, {**_voltage(160), **_velocity(460), "moving_threshold": (20, 0, 1023)}),
    _x430_of_load("xc430_w240", 1080, {**_voltage(160), **_velocity(306), "moving_threshold": (20, 0, 1023)}),
    _x430_of_load("2xc430_w250", 1160, {**_voltage(160), **_velocity(275)}, axes=2),
    _xh("xh430_w350", 1000, 130, 648),
    _xh("xh430_w210", 1010, 210, 648),
    _xh("xh430_v350", 1040, 135, 689, unit_a=0.00134, volts=24.0),
    _xh("xh430_v210", 1050, 227, 689, unit_a=0.00134, volts=24.0),
    _xh("xh540_w270", 1100, 167, 2047),
    _xh("xh540_w150", 1110, 300, 2047),
    _xh("xh540_v270", 1140, 128, 1188, volts=24.0),
    _xh("xh540_v150", 1150, 230, 1188, volts=24.0),
    _xh("xd430_t350", 1001, 130, 648),
    _xh("xd430_t210", 1011, 210, 648),
    _xh("xd540_t270", 1101, 167, 2047),
    _xh("xd540_t150", 1111, 300, 2047),
    _x(
        "mx_28",
        30,
        {**_MX, **_velocity(230)},
        more=MX_MORE + _LOAD,
        without=_MX_WITHOUT | _LOAD_ONLY,
        modes=frozenset({1, 3, 4, 16}),
        drive_bits=0b0101,
        fast=False,
    ),
    _x(
        "mx_64",
        311,
        {**_MX, **_velocity(435), "current_limit": (1941, 0, 1941)},
        more=MX_MORE,
        without=_MX_WITHOUT,
        current_unit_a=0.00336,
        drive_bits=0b0101,
        fast=False,
    ),
    _x(
        "mx_106",
        321,
        {**_MX, **_velocity(360), "current_limit": (2047, 0, 2047)},
        more=MX_MORE,
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

MODELS: Mapping[str, SimulatedModel] = {model.name: model for model in _ALL}
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
