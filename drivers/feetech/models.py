"""The Feetech servos that the driver knows: memory, counts, units, and what the numbers mean.

Sources: the maker's memory tables of STS/SMS and SCSCL servos, and the addresses in its SDK. The maker
states no backlash. A count of speed is one count a second in the maker's SDK of 2020, and 50 in that of 2025:
it depends on the firmware and has to be configured (``speed_unit_counts``).
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Literal

from drivers.errors import BadOptions
from drivers.faults import nearest

BAUD_RATES = (1_000_000, 500_000, 250_000, 128_000, 115_200, 57_600, 38_400, 19_200)
"""By their code."""

STATUS_WORDS = MappingProxyType(
    {
        0x01: "input voltage out of its limits",
        0x02: "angle sensor fault",
        0x04: "overheating",
        0x08: "overcurrent",
        0x20: "overload",
    }
)
POSITION_MODE = 0
UNLOCKED, LOCKED = 0, 1
FIRST_RAM_ADDRESS = 40


@dataclass(frozen=True)
class Register:
    """One entry of a memory table.

    Attributes
    ----------
    name, address, size
        Where it stands.
    sign_bit
        The bit that says minus; the rest is the size of the number. None for a number of zero or more.
    """

    name: str
    address: int
    size: int = 1
    sign_bit: int | None = None

    @property
    def permanent(self) -> bool:
        """Whether it lies in the EEPROM, which wears."""
        return self.address < FIRST_RAM_ADDRESS

    def decode(self, data: bytes, order: Literal["little", "big"]) -> int:
        """Return the value of the register's bytes."""
        word = int.from_bytes(data, order)
        if self.sign_bit is None:
            return word
        size = word & ((1 << self.sign_bit) - 1)
        return -size if word >> self.sign_bit & 1 else size

    def encode(self, value: int, order: Literal["little", "big"]) -> bytes:
        """Return a value as the register's bytes; OverflowError if it does not fit."""
        if value < 0 and self.sign_bit is not None:
            value = -value | 1 << self.sign_bit
        return value.to_bytes(self.size, order)


def _table(*more: Register) -> Mapping[str, Register]:
    """The registers that all series have where SCS and STS have them, and more."""
    common = (
        Register("firmware_major", 0), Register("firmware_minor", 1), Register("model_number", 3, 2),
        Register("id", 5), Register("baud", 6), Register("return_delay", 7), Register("response_level", 8),
        Register("min_angle_limit", 9, 2), Register("max_angle_limit", 11, 2),
        Register("temperature_limit", 13), Register("max_voltage_limit", 14),
        Register("min_voltage_limit", 15), Register("max_torque", 16, 2),
        Register("unload_condition", 19), Register("torque_enable", 40),
        Register("goal_position", 42, 2), Register("goal_time", 44, 2), Register("goal_speed", 46, 2),
        Register("present_position", 56, 2, 15), Register("present_velocity", 58, 2, 15),
        Register("present_load", 60, 2, 10), Register("present_voltage", 62),
        Register("present_temperature", 63), Register("status", 65), Register("moving", 66),
    )  # fmt: skip
    return MappingProxyType({r.name: r for r in sorted((*common, *more), key=lambda r: r.address)})


STS = _table(
    Register("protective_current", 28, 2), Register("offset", 31, 2, 11), Register("operating_mode", 33),
    Register("protective_torque", 34), Register("protective_time", 35), Register("overload_torque", 36),
    Register("acceleration", 41), Register("torque_limit", 48, 2), Register("lock", 55),
    Register("present_current", 69, 2, 15),
)  # fmt: skip
SCS = _table(Register("protective_torque", 37), Register("protective_time", 38), Register("lock", 48))


@dataclass(frozen=True)
class FeetechModel:
    """One kind of servo; attributes as of `drivers.servo_bus.settings.CountedModel`.

    Attributes
    ----------
    number
        What stands in its memory; None for a whole series, of which it is not compared.
    registers
        Its memory table.
    order
        Which byte of a word comes first.
    """

    name: str
    number: int | None
    registers: Mapping[str, Register]
    order: Literal["little", "big"]
    turn_rad: float
    counts_per_turn: int
    speed_unit_counts: int = 1
    current_unit_A: float | None = None
    low_count: int = 0
    backlash_rad: float | None = None

    @property
    def high_count(self) -> int:
        """The highest position limit."""
        return self.counts_per_turn - 1

    @property
    def centre_count(self) -> int:
        """The middle of its range."""
        return self.counts_per_turn // 2

    @property
    def count_rad(self) -> float:
        """One count."""
        return self.turn_rad / self.counts_per_turn

    @property
    def velocity_unit_rad_per_s(self) -> float:
        """One count of speed."""
        return self.speed_unit_counts * self.count_rad

    @property
    def acceleration_unit_rad_per_s2(self) -> float:
        """One count of acceleration, 100 counts a second squared; of an SCS what is taken for it."""
        return 100 * self.count_rad

    @property
    def is_scs(self) -> bool:
        """Whether it is of the SCS series: no torque limit, no acceleration, no read of several servos."""
        return self.order == "big"


def _sts(name: str, number: int | None) -> FeetechModel:
    return FeetechModel(name, number, STS, "little", math.tau, 4096, current_unit_A=0.0065)


def _scs(name: str, number: int | None) -> FeetechModel:
    return FeetechModel(name, number, SCS, "big", math.radians(300), 1024)


MODELS: Mapping[str, FeetechModel] = MappingProxyType(
    {
        model.name: model
        for model in (
            _sts("STS3215", 777), _sts("STS3250", 2825), _sts("SM8512BL", 11272), _scs("SCS0009", 1284),
            _sts("STS", None), _sts("SMS", None), _scs("SCS", None),
        )
    }
)  # fmt: skip
"""By name; a series, such as ``STS``, takes any servo of it: 4096 counts a turn, or 1024 over 300 degrees."""

MODELS_BY_NUMBER = {model.number: model for model in MODELS.values() if model.number is not None}


def model_named(name: str) -> FeetechModel:
    """Return the model that a configuration names. Raises BadOptions, with the nearest known name."""
    found = MODELS.get(str(name).upper())
    if found is None:
        raise BadOptions(
            f"there is no Feetech servo {name!r}{nearest(str(name).upper(), MODELS)}; one that is not in the "
            "table is named by its series: STS, SMS or SCS"
        )
    return found


def status_words(error: int) -> str:
    """Return what a status says, in plain words; empty for a servo that is well."""
    words = [word for bit, word in STATUS_WORDS.items() if error & bit]
    unknown = error & ~sum(STATUS_WORDS)
    return " and ".join(words + ([f"unknown status bits 0x{unknown:02x}"] if unknown else []))
