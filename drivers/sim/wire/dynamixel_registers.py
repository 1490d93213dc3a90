"""Registers of the simulated Dynamixel servos, written down from the maker's manual.

They are on purpose not the driver's: a wrong number in one of the two shows up as a test that fails. Source:
ROBOTIS e-Manual (github.com/ROBOTIS-GIT/emanual), pages of each model; addresses and sizes agree with the
``.model`` tables of dynamixel-sdk (checked in hil_tests).

A row is ``address size name access initial low high``. ``w`` is readable and writable, ``r`` read only.
``initial`` is ``-`` where the servo computes the value or the manual gives none (then 0). Gains, external
ports and what a backup needs are left out.
"""

from __future__ import annotations

from dataclasses import dataclass


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


X_EEPROM = """
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
X_RAM = """
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
MX_MORE = """
 40 4 acceleration_limit       w 32767 0 32767
"""
P_EEPROM = """
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
 63 1 shutdown                 w 58    0 63
"""
P_RAM = """
512 1 torque_enable            w 0     0 1
513 1 led_red                  w 0     0 255
516 1 status_return_level      w 2     0 2
517 1 registered_instruction   r 0
518 1 hardware_error_status    r 0
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
"""


def rows(text: str) -> tuple[TableRegister, ...]:
    """Return the registers of one of the tables above."""
    found = []
    for line in filter(str.strip, text.splitlines()):
        address, size, name, access, initial, *bounds = line.split()
        low, high = (int(b) for b in bounds) if bounds else (0, 256 ** int(size) - 1)
        first = 0 if initial == "-" else int(initial)
        found.append(TableRegister(int(address), int(size), name, access == "w", first, low, high))
    return tuple(found)


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
