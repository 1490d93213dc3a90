"""One simulated Feetech servo: its memory, its motion, its protection. It has no watchdog.

The memory tables were written down from the maker's manuals, not from the driver: Feetech's memory tables of
STS/SMS servos, and the addresses in the maker's SDK. A row is ``address size name access initial
low high``; ``w`` is readable and writable. What no row names reads as zero: gains, dead bands and the like.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

from drivers.errors import BadOptions
from drivers.faults import nearest
from drivers.sim.axis import WireAxis
from drivers.sim.wire.dynamixel_models import TableRegister, table_of

_COMMON = """
 0 1 firmware_major      r 3
 3 2 model               r -
 5 1 id                  w 1     0 253
 6 1 baud                w 0     0 7
 7 1 return_delay        w 0     0 254
 8 1 response_level      w 1     0 1
13 1 max_temperature     w 70    0 100
15 1 min_voltage         w 40    0 254
16 2 max_torque          w 1000  0 1000
40 1 torque_enable       w 0     0 1
44 2 goal_time           w 0     0 65535
46 2 goal_speed          w 0     0 65535
56 2 present_position    r -
58 2 present_speed       r -
60 2 present_load        r -
62 1 present_voltage     r -
63 1 present_temperature r -
65 1 status              r -
66 1 moving              r -
69 2 present_current     r -
"""
_OF_STS = """
 1 1 firmware_minor      r 10
 9 2 min_angle           w 0     0 4095
11 2 max_angle           w 4095  0 4095
14 1 max_voltage         w 140   0 254
19 1 unload_condition    w 44    0 254
28 2 protective_current  w 310   0 511
31 2 offset              w 0     0 4095
33 1 mode                w 0     0 3
34 1 protective_torque   w 20    0 100
35 1 protective_time     w 200   0 254
36 1 overload_torque     w 80    0 100
41 1 acceleration        w 0     0 254
42 2 goal_position       w -     0 65535
48 2 torque_limit        w 1000  0 1000
55 1 lock                w 1     0 1
"""
BAUDS = (1_000_000, 500_000, 250_000, 128_000, 115_200, 76_800, 57_600, 38_400)
"""Bits a second by code: address 6 of the maker's memory tables of STS servos."""

RAM_FROM = 40


@dataclass(frozen=True)
class SimulatedFeetech:
    """One model of servo."""

    name: str
    number: int
    cells: tuple[TableRegister, ...]
    turn_rad: float = math.tau
    counts: int = 4096
    volts: float = 12.0

    @property
    def count_rad(self) -> float:
        """One count."""
        return self.turn_rad / self.counts

    @cached_property
    def by_name(self) -> Mapping[str, TableRegister]:
        """Cells by name."""
        return {cell.name: cell for cell in self.cells}


_STS = table_of(_COMMON + _OF_STS)
MODELS: Mapping[str, SimulatedFeetech] = {
    "sts3215": SimulatedFeetech("sts3215", 777, _STS),
    "sts3250": SimulatedFeetech("sts3250", 2825, _STS),
    "sm8512bl": SimulatedFeetech("sm8512bl", 11272, _STS),
}
"""Every model that can be simulated."""


def model_named(name: str) -> SimulatedFeetech:
    """Return a model. Raises BadOptions, with the nearest name."""
    plain = str(name).lower()
    if plain not in MODELS:
        raise BadOptions(f"there is no Feetech servo {name!r} to simulate{nearest(plain, MODELS)}")
    return MODELS[plain]


VOLTAGE, SENSOR, HEAT, CURRENT, OVERLOAD = 1, 2, 4, 8, 32
"""Bits of the status."""

STEP_ACCELERATION = 100
"""Counts per second squared of one unit of acceleration (STS)."""

FASTEST_COUNTS = 3400
"""Counts per second of a goal speed of 0 (assumed: the no-load speed of an STS3215)."""

STEEPEST_RAD_PER_S2 = 60.0
"""Of an acceleration of 0 (assumed)."""

_PROTECTIVE_UNIT_S = 0.01


class SimulatedFeetechServo:
    """One servo; every method is given the time and nothing runs by itself.

    ``settings`` are initial values of its memory by name; those of the EEPROM outlast the power switch.
    Raises BadOptions for an unknown model or name, or a value beyond its bounds.
    """

    def __init__(
        self,
        model: str,
        servo_id: int,
        axis: WireAxis,
        *,
        settings: Mapping[str, int] | None = None,
        speed_unit_counts: int = 1,
        time_s: float = 0.0,
    ) -> None:
        self.model = model_named(model)
        self._speed_unit_counts = speed_unit_counts
        self.powered = True
        self.eeprom_writes: list[str] = []
        self._axis = axis
        given = {"id": servo_id, **(settings or {})}
        for name, value in given.items():
            cell = self.model.by_name.get(name)
            if cell is None or not cell.low <= value <= cell.high:
                raise BadOptions(f"{name} {value} cannot be in the memory of a simulated {self.model.name}")
        self.memory = {cell.name: cell.initial for cell in self.model.cells}
        self.memory |= {"model": self.model.number, **given}
        self._kept = dict(self.memory)
        self._pressing_since_s: float | None = None
        self._zero = self.model.counts // 2
        self.memory["goal_position"] = self._position(time_s)

    @property
    def servo_id(self) -> int:
        """The id that it answers to."""
        return self.memory["id"]

    @property
    def baud(self) -> int:
        """Bits a second that it talks at."""
        return BAUDS[self.memory["baud"]]

    @property
    def return_delay_s(self) -> float:
        """How long it waits before it answers."""
        return self.memory["return_delay"] * 2e-6

    @property
    def answers_writes(self) -> bool:
        """Whether it answers more than reads and pings."""
        return self.memory["response_level"] == 1

    def hears(self, time_s: float) -> bool:
        """Return whether it takes part in the traffic."""
        return self.powered and not self._axis.silent(time_s)

    def set_power(self, on: bool, time_s: float) -> None:
        """Switch it off, or on again with what its EEPROM holds."""
        if on and not self.powered:
            ram = {c.name: c.initial for c in self.model.cells if c.address >= RAM_FROM}
            self.memory = self._kept | ram
            if "torque_limit" in self.memory:
                self.memory["torque_limit"] = self.memory["max_torque"]
            self.memory["goal_position"] = self._position(time_s)
        elif not on:
            self.memory["torque_enable"] = 0
            self._axis.halt(time_s)
        self.powered = on

    def status(self, time_s: float) -> int:
        """Return the bits that every answer carries."""
        memory, bits = self.memory, 0
        tenths = round(10 * self.model.volts * self._axis.supply(time_s))
        if not memory["min_voltage"] <= tenths <= memory["max_voltage"]:
            bits |= VOLTAGE
        if self._axis.temperature_c(time_s) > memory["max_temperature"]:
            bits |= HEAT
        since_s = self._pressing_since_s
        if since_s is not None and time_s - since_s >= memory["protective_time"] * _PROTECTIVE_UNIT_S:
            bits |= OVERLOAD
        return bits

    def update(self, time_s: float) -> None:
        """Let happen what happened by itself: protection unloads the motor."""
        if not self.memory["torque_enable"] or not self._axis.blocked(time_s):
            self._pressing_since_s = None
        elif self._pressing_since_s is None:
            self._pressing_since_s = time_s
        if self.memory["torque_enable"] and self.status(time_s) & self.memory["unload_condition"] & ~OVERLOAD:
            self.memory["torque_enable"] = 0
            self._axis.halt(time_s)

    def read(self, address: int, length: int, time_s: float) -> bytes:
        """Return bytes of the memory; zeros where the table has nothing."""
        self._measure(time_s)
        data = bytearray(256)
        for cell in self.model.cells:
            word = self.memory[cell.name].to_bytes(cell.size, "little")
            data[cell.address : cell.address + cell.size] = word
        return bytes(data[address : address + length])

    def write(self, address: int, data: bytes, time_s: float) -> None:
        """Write bytes: whole cells that are writable, values within their bounds; the rest is dropped."""
        moved = False
        for cell in self.model.cells:
            at = cell.address - address
            if not cell.writable or at < 0 or at + cell.size > len(data):
                continue
            word = data[at : at + cell.size]
            value = int.from_bytes(word, "little")
            if cell.low <= value <= cell.high:
                self._put(cell.name, value, cell.address, time_s)
                moved = moved or cell.name in ("goal_position", "torque_enable")
        if moved and self.memory["torque_enable"] == 1:
            self._go(time_s)

    def _put(self, name: str, value: int, address: int, time_s: float) -> None:
        if name == "torque_enable" and value != self.memory[name]:
            if value:
                self.memory["goal_position"] = self._position(time_s)  # it stays where it is
            else:
                self._axis.halt(time_s)
        self.memory[name] = value
        if address < RAM_FROM:
            self.eeprom_writes.append(name)
            if not self.memory["lock"]:
                self._kept[name] = value

    def _offset(self) -> int:
        """The offset: 11 bits and a sign."""
        word = self.memory.get("offset", 0)
        return -(word & 0x7FF) if word & 0x800 else word & 0x7FF

    def _position(self, time_s: float) -> int:
        angle = self._axis.angle_rad(time_s) / self.model.count_rad
        return round(max(-32768.0, min(32767.0, angle))) + self._zero - self._offset()

    def _go(self, time_s: float) -> None:
        """Turn towards the goal, which position control keeps within its limits."""
        memory, count_rad = self.memory, self.model.count_rad
        goal = memory["goal_position"]
        goal = -(goal & 0x7FFF) if goal & 0x8000 else goal
        if memory["max_angle"] > memory["min_angle"]:
            goal = min(max(goal, memory["min_angle"]), memory["max_angle"])
        speed = (memory["goal_speed"] & 0x7FFF) * self._speed_unit_counts or FASTEST_COUNTS
        steep = memory.get("acceleration", 0) * STEP_ACCELERATION * count_rad or STEEPEST_RAD_PER_S2
        angle_rad = (goal - self._zero + self._offset()) * count_rad
        self._axis.goal(time_s, angle_rad, speed * count_rad, steep)

    def _measure(self, time_s: float) -> None:
        """Bring what is measured up to date."""
        memory = self.memory
        velocity = self._axis.velocity_rad_per_s(time_s) / self.model.count_rad
        memory["present_position"] = _signed(self._position(time_s), 15)
        memory["present_speed"] = _signed(round(velocity / self._speed_unit_counts), 15)
        load = 300 if self._axis.blocked(time_s) else 50 if velocity else 0
        memory["present_load"] = _signed(load if velocity >= 0 else -load, 10)
        memory["present_current"] = load // 5
        memory["present_voltage"] = min(255, round(10 * self.model.volts * self._axis.supply(time_s)))
        memory["present_temperature"] = min(255, round(self._axis.temperature_c(time_s)))
        memory["status"] = self.status(time_s)
        memory["moving"] = int(self._axis.under_way(time_s) or self._axis.blocked(time_s))


def _signed(value: int, bit: int) -> int:
    """A number as the servo has it: its size, and a bit for minus."""
    size = min(abs(value), (1 << bit) - 1)
    return size | (1 << bit) if value < 0 else size
