"""Registers of servos: where they stand, by the tables that ROBOTIS ships with dynamixel-sdk.

``dynamixel_easy_sdk/control_table`` holds a file a model, with the address and size of each register, and the
middle and the ends of the turn in position mode. The signs of most are from the ROBOTIS e-manual
(emanual.robotis.com, one page per model).
"""

from __future__ import annotations

import struct
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from importlib.util import find_spec
from pathlib import Path
from types import MappingProxyType
from typing import NamedTuple

from drivers.servo_bus.port import Register

_NAMES = {
    "Firmware Version": "firmware",
    "Baud Rate": "baud",
    "Return Delay Time": "return_delay",
    "Secondary(Shadow) ID": "secondary_id",
    "Hardware Error Status": "hardware_error",
    "Present Load": "present_current",
    "Present Input Voltage": "present_voltage",
}
"""What is called otherwise here than in the tables of the SDK, small letters and underscores aside."""

_KNOWN = """
    model_number firmware id baud return_delay drive_mode operating_mode secondary_id -homing_offset
    moving_threshold temperature_limit max_voltage_limit min_voltage_limit pwm_limit current_limit
    velocity_limit -max_position_limit -min_position_limit shutdown torque_enable status_return_level
    hardware_error bus_watchdog -goal_pwm -goal_current -goal_velocity profile_acceleration profile_velocity
    -goal_position realtime_tick moving moving_status -present_pwm -present_current -present_velocity
    -present_position -velocity_trajectory -position_trajectory present_voltage present_temperature
"""
"""The registers that the driver uses, with a minus in front of those that may be below zero."""

# A reply does not say which register it is of, but its length does if no two have the same one: here only
# torque and goal PWM, and shutdown and bus watchdog, which are never read one after the other. Each
# window holds registers only that every servo of the table has, without gaps, which servos may refuse. The
# registers around the counter (realtime_tick) are read together with it.
_WINDOWS = {
    "model_number": 13,  # to secondary id
    "homing_offset": 8,  # and moving threshold
    "temperature_limit": 7,  # to PWM limit
    "pwm_limit": 4,  # and current limit
    "velocity_limit": 12,  # to position limits
    "shutdown": 1,
    "torque_enable": 2,  # and LED
    "status_return_level": 3,  # to hardware error
    "bus_watchdog": 1,
    "goal_pwm": 2,
}
"""What is read to know a register: from which one on how many bytes."""


@dataclass(frozen=True)
class ControlItem(Register):
    """One entry of a control table, little-endian.

    ``window`` is the address and the length of what is read to know the register: see `_WINDOWS`.
    """

    signed: bool = False
    window: tuple[int, int] = (0, 0)

    def decode(self, data: bytes) -> int:
        """Return its value, as `Register`."""
        return int.from_bytes(data, "little", signed=self.signed)

    def decode_window(self, data: bytes) -> int:
        """Return the register's value out of the bytes of its window."""
        at = self.address - self.window[0]
        return self.decode(data[at : at + self.size])

    def encode(self, value: int) -> bytes:
        """Return its bytes, as `Register`."""
        return value.to_bytes(self.size, "little", signed=self.signed)


class VendorTable(NamedTuple):
    """What the SDK says of one model: its registers, and the ends and the middle of its turn."""

    registers: Mapping[str, ControlItem]
    low_count: int
    high_count: int
    centre_count: int


def vendor_table(number: int) -> VendorTable:
    """Return what the SDK says of the model that answers a ping with a number."""
    found = _sections(_files()[number])
    turn = {name: round(float(value)) for name, value in found["type info"]}
    ends = (turn[f"value_of_{end}_radian_position"] for end in ("min", "max", "zero"))
    return VendorTable(_registers(found["control table"]), *ends)


@cache
def _files() -> Mapping[int, Path]:
    """The SDK's tables by model number; found without importing it, which takes a serial library along."""
    found = find_spec("dynamixel_easy_sdk")
    if found is None or not found.submodule_search_locations:
        raise ImportError("the servos' tables are missing: pip install 'dynamixel-sdk>=4.0.5'")
    folder = Path(found.submodule_search_locations[0]) / "control_table"
    lines = (folder / "dynamixel.model").read_text(encoding="utf-8").splitlines()[1:]
    return {int(number): folder / file for number, file in (line.split() for line in lines if line.strip())}


def _sections(file: Path) -> dict[str, list[list[str]]]:
    """The rows of a vendor's file by section, without the line that names the columns."""
    found: dict[str, list[list[str]]] = {}
    rows: list[list[str]] = []
    for line in file.read_text(encoding="utf-8").splitlines():
        if line.startswith("["):
            rows = found.setdefault(line.strip("[] "), [])
        elif line.strip():
            rows.append(line.strip().split("\t"))
    return {section: rows[1:] for section, rows in found.items()}


def _registers(rows: Sequence[Sequence[str]]) -> Mapping[str, ControlItem]:
    """The registers of one model, those that the driver knows, by name."""
    places: dict[str, tuple[int, int]] = {}
    for address, length, theirs in rows:
        places[_NAMES.get(theirs, theirs.lower().replace(" ", "_"))] = int(address), int(length)
    tick = places["realtime_tick"][0]
    windows = [(places[name][0], count) for name, count in _WINDOWS.items()]
    registers: dict[str, ControlItem] = {}
    for word in _KNOWN.split():
        name = word.removeprefix("-")
        if name not in places:
            continue
        at, size = places[name]
        first, end = min(at, tick), max(at + size, tick + 2)
        fitting = (w for w in windows if w[0] <= at and at + size <= sum(w))
        window = next(fitting, (first, end - first))
        registers[name] = ControlItem(name, at, size, word != name, window)
    return MappingProxyType(registers)


class RegisterBlock:
    """Neighbouring registers that are read in one go, and their decoding."""

    def __init__(self, registers: Mapping[str, ControlItem], first: str, last: str) -> None:
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
