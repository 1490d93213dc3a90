"""The models of Dynamixel servo that can be simulated: tables, counts, units, modes.

Source: ROBOTIS e-Manual, the page of each model. Where pages differ between editions the newest was taken.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

from drivers.errors import BadOptions
from drivers.faults import nearest
from drivers.sim.wire.dynamixel_registers import (
    MX_MORE,
    P_EEPROM,
    P_RAM,
    X_EEPROM,
    X_RAM,
    TableRegister,
    rows,
)


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


_RPM = math.tau / 60
_LOAD = "126 2 present_load r - -1000 1000\n"  # instead of a current: 0.1 %


def _series(table: str, without: str = "", **facts: Any) -> dict[str, Any]:
    """What all models of a series have: a table, less some registers, and `SimulatedModel`'s facts."""
    return {"registers": [row for row in rows(table) if row.name not in without.split()], **facts}


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

_X_TABLE, _MX_TABLE = X_EEPROM + X_RAM, X_EEPROM + X_RAM + MX_MORE
_NO_CURRENT = "current_limit goal_current present_current"
_SERIES = {
    "x330_5v": _series(_X_TABLE, **_X330 | {"voltage_v": 5.0}),
    "x330_12v": _series(_X_TABLE, **_X330),
    "x430": _series(_X_TABLE, **_X),
    "x430_24v": _series(_X_TABLE, **_X | {"voltage_v": 24.0, "current_unit_a": 0.00134}),
    "x540_24v": _series(_X_TABLE, **_X | {"voltage_v": 24.0}),
    "x430_of_load": _series(_X_TABLE + _LOAD, _NO_CURRENT, **_X),
    "x430_of_load_2": _series(_X_TABLE + _LOAD, _NO_CURRENT, **_X | {"axes": 2}),
    "mx": _series(_MX_TABLE, **_X | {"current_unit_a": 0.00336}),
    "mx_of_load": _series(_MX_TABLE + _LOAD, _NO_CURRENT, **_X),
    "p42": _series(P_EEPROM + P_RAM, **_P | {"counts_per_turn": 607_500}),
    "p54": _series(P_EEPROM + P_RAM, **_P | {"counts_per_turn": 1_003_846}),
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
    name, number, series, *changes = row.split()
    facts = dict(_SERIES[series])
    registers = {register.name: register for register in facts.pop("registers")}
    for change in changes:
        register, _, values = change.partition("=")
        initial, low, high = map(int, values.split(","))
        registers[register] = replace(registers[register], initial=initial, low=low, high=high)
    table = tuple(sorted(registers.values(), key=lambda register: register.address))
    return SimulatedModel(name=name, number=int(number), registers=table, **facts)


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
