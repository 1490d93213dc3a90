"""Memory tables of the simulated Feetech servos, written down from the maker's manuals, not from the driver.

Sources: Feetech's memory tables of STS/SMS and SCSCL servos, and the addresses in the maker's SDK. A row is
``address size name access initial low high``; ``w`` is readable and writable.
What no row names reads as zero.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

from drivers.errors import BadOptions
from drivers.faults import nearest

STS_ROWS = """
 0 1 firmware_major      r 3
 1 1 firmware_minor      r 10
 2 1 end                 r 0
 3 2 model               r -
 5 1 id                  w 1     0 253
 6 1 baud                w 0     0 7
 7 1 return_delay        w 0     0 254
 8 1 response_level      w 1     0 1
 9 2 min_angle           w 0     0 4095
11 2 max_angle           w 4095  0 4095
13 1 max_temperature     w 70    0 100
14 1 max_voltage         w 140   0 254
15 1 min_voltage         w 40    0 254
16 2 max_torque          w 1000  0 1000
18 1 phase               w 12    0 254
19 1 unload_condition    w 44    0 254
24 2 start_force         w 16    0 1000
26 1 cw_dead             w 1     0 32
27 1 ccw_dead            w 1     0 32
28 2 protective_current  w 310   0 511
30 1 resolution          w 1     1 3
31 2 offset              w 0     0 4095
33 1 mode                w 0     0 3
34 1 protective_torque   w 20    0 100
35 1 protective_time     w 200   0 254
36 1 overload_torque     w 80    0 100
37 1 speed_p_gain        w 10    0 100
38 1 overcurrent_time    w 200   0 254
39 1 speed_i_gain        w 10    0 254
40 1 torque_enable       w 0     0 1
41 1 acceleration        w 0     0 254
42 2 goal_position       w -     0 65535
44 2 goal_time           w 0     0 65535
46 2 goal_speed          w 0     0 65535
48 2 torque_limit        w 1000  0 1000
55 1 lock                w 1     0 1
56 2 present_position    r -
58 2 present_speed       r -
60 2 present_load        r -
62 1 present_voltage     r -
63 1 present_temperature r -
64 1 async_write         r 0
65 1 status              r -
66 1 moving              r -
69 2 present_current     r -
"""
SCS_ROWS = """
 0 1 firmware_major      r 3
 1 1 firmware_minor      r 6
 2 1 end                 r 1
 3 2 model               r -
 5 1 id                  w 1     0 253
 6 1 baud                w 0     0 7
 7 1 return_delay        w 0     0 254
 8 1 response_level      w 1     0 1
 9 2 min_angle           w 0     0 1023
11 2 max_angle           w 1023  0 1023
13 1 max_temperature     w 70    0 100
14 1 max_voltage         w 100   0 254
15 1 min_voltage         w 40    0 254
16 2 max_torque          w 1000  0 1000
18 1 phase               w 0     0 254
19 1 unload_condition    w 36    0 254
24 2 start_force         w 40    0 1023
26 1 cw_dead             w 2     0 32
27 1 ccw_dead            w 2     0 32
37 1 protective_torque   w 40    0 100
38 1 protective_time     w 80    0 254
40 1 torque_enable       w 0     0 1
42 2 goal_position       w -     0 1023
44 2 goal_time           w 0     0 65535
46 2 goal_speed          w 0     0 65535
48 1 lock                w 1     0 1
56 2 present_position    r -
58 2 present_speed       r -
60 2 present_load        r -
62 1 present_voltage     r -
63 1 present_temperature r -
64 1 async_write         r 0
65 1 status              r -
66 1 moving              r -
69 2 present_current     r -
"""
BAUDS = (1_000_000, 500_000, 250_000, 128_000, 115_200, 76_800, 57_600, 38_400)
"""Bits a second by code: address 6 of the maker's memory tables of STS and SCSCL servos."""

RAM_FROM = 40


@dataclass(frozen=True)
class Cell:
    """One entry of a memory table."""

    address: int
    size: int
    name: str
    writable: bool
    initial: int
    low: int
    high: int


@dataclass(frozen=True)
class SimulatedFeetech:
    """One model of servo.

    ``sync_read``: whether it answers a read of several servos at once.
    """

    name: str
    number: int
    cells: tuple[Cell, ...]
    big_end: bool
    turn_rad: float
    counts: int
    sync_read: bool
    volts: float

    @property
    def count_rad(self) -> float:
        """One count."""
        return self.turn_rad / self.counts

    @cached_property
    def by_name(self) -> Mapping[str, Cell]:
        """Cells by name."""
        return {cell.name: cell for cell in self.cells}


def _cells(text: str) -> tuple[Cell, ...]:
    found = []
    for line in text.split("\n"):
        if row := line.split():
            address, size, name, access, initial, *ends = row
            low, high = (int(end) for end in ends or (0, 0))
            start = 0 if initial == "-" else int(initial)
            found.append(Cell(int(address), int(size), name, access == "w", start, low, high))
    return tuple(found)


_STS, _SCS = _cells(STS_ROWS), _cells(SCS_ROWS)
MODELS: Mapping[str, SimulatedFeetech] = {
    "sts3215": SimulatedFeetech("sts3215", 777, _STS, False, math.tau, 4096, True, 12.0),
    "sts3250": SimulatedFeetech("sts3250", 2825, _STS, False, math.tau, 4096, True, 12.0),
    "sm8512bl": SimulatedFeetech("sm8512bl", 11272, _STS, False, math.tau, 4096, True, 12.0),
    "scs0009": SimulatedFeetech("scs0009", 1284, _SCS, True, math.radians(300), 1024, False, 6.0),
}
"""Every model that can be simulated."""


def model_named(name: str) -> SimulatedFeetech:
    """Return a model. Raises BadOptions, with the nearest name."""
    plain = str(name).lower()
    if plain not in MODELS:
        raise BadOptions(f"there is no Feetech servo {name!r} to simulate{nearest(plain, MODELS)}")
    return MODELS[plain]
