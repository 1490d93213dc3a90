"""One simulated Dynamixel servo: its instructions, its watchdog, its protection, its start."""

from __future__ import annotations

from collections.abc import Callable, Mapping

from drivers.errors import BadOptions
from drivers.sim.axis import WireAxis
from drivers.sim.wire.dynamixel_drive import Drive
from drivers.sim.wire.dynamixel_models import (
    BAUD_RATES,
    MODES,
    WATCHDOG_EXPIRED,
    ControlTable,
    SimulatedModel,
    model_named,
)

ALERT = 0x80
VOLTAGE, HALL, HEAT, ENCODER, SHOCK, OVERLOAD = (1 << bit for bit in range(6))
"""Bits of Hardware Error Status."""

BOOT_S = 0.3
"""How long a servo is deaf after a reboot, seconds (assumed; the manual gives none)."""

OVERLOAD_S = 0.5
"""How long an axis pushes in vain before it counts as overload, seconds (assumed)."""

_WATCHDOG_UNIT_S = 0.02
_ANSWER_BITS = 120.0  # of an answer without data, and a byte to spare


class SimulatedServo:
    """One servo; every method is given the time and nothing runs by itself.

    Raises BadOptions for an unknown model or register, or a value beyond its bounds.

    ``settings`` are initial values of registers, by name; those of the EEPROM outlast a reboot.
    """

    def __init__(
        self,
        model: str,
        servo_id: int,
        axis: WireAxis,
        *,
        settings: Mapping[str, int] | None = None,
        time_s: float = 0.0,
    ) -> None:
        self.model: SimulatedModel = model_named(model)
        self.powered = True
        self.table = ControlTable(self.model, self._live())
        for name, value in {"id": servo_id, **(settings or {})}.items():
            register = self.model.by_name.get(name)
            if register is None:
                raise BadOptions(f"servo model {self.model.name} has no register {name!r}")
            if not register.low <= value <= register.high:
                raise BadOptions(
                    f"{name} is {value} for a simulated {self.model.name}, "
                    f"expected {register.low} to {register.high}"
                )
        self.table.values.update({"model_number": self.model.number, "firmware_version": self.model.firmware})
        self.table.values.update({"id": servo_id, **(settings or {})})
        self.drive = Drive(self.model, self.table, axis, time_s)
        self._axis = axis
        self._raised = 0
        self.mate: SimulatedServo | None = None
        self._since_s: float | None = None
        self._started_s = self._fed_s = self._retune_s = time_s
        self._rate = self.table["baud_rate"]
        self._starting = False
        self._start_registers(time_s)

    # What the bus reads

    @property
    def servo_id(self) -> int:
        """The id that it answers to."""
        return self.table["id"]

    @property
    def baud(self) -> int:
        """Bits a second that it talks at; a new rate holds once the write was answered at the old one."""
        return BAUD_RATES[self._rate]

    @property
    def return_delay_s(self) -> float:
        """How long it waits before it answers."""
        return self.table["return_delay_time"] * 2e-6

    def hears(self, time_s: float) -> bool:
        """Return whether it takes part in the traffic: has power, is not starting and not dead."""
        return self.powered and time_s >= self._started_s and not self._axis.silent(time_s)

    def alert(self) -> int:
        """Return the bit that every answer of a servo with a hardware error carries."""
        return ALERT if self.table["hardware_error_status"] else 0

    def feed(self, time_s: float) -> None:
        """Feed the bus watchdog: an instruction packet, to whomever, was on the bus."""
        self._fed_s = time_s

    def answers(self, code: str) -> bool:
        """Return whether the status return level lets it answer ``ping``, ``read`` or another instruction."""
        return self.table["status_return_level"] >= {"ping": 0, "read": 1}.get(code, 2)

    def set_power(self, on: bool, time_s: float) -> None:
        """Switch it off, or on again with what the EEPROM holds."""
        if on == self.powered:
            return
        self.powered = on
        self.table["torque_enable"] = 0
        self.drive.stop(time_s)
        if on:
            self._boot(time_s)

    def raise_error(self, bits: int) -> None:
        """Let a hardware error happen, for example ``ENCODER`` or ``SHOCK``; it stays until a reboot."""
        self._raised |= bits

    def update(self, time_s: float) -> None:
        """Let happen what happened by itself until now: the watchdog, and the servo's own protection."""
        if self._rate != self.table["baud_rate"] and time_s >= self._retune_s:
            self._rate = self.table["baud_rate"]
        if not self.hears(time_s):
            return
        if self._starting:
            self._starting = False
            self._start_registers(self._started_s)
        limit = self.table["bus_watchdog"]
        if self.table["torque_enable"] and 0 < limit < WATCHDOG_EXPIRED:
            expiry_s = self._fed_s + limit * _WATCHDOG_UNIT_S
            if time_s > expiry_s:
                # The stop is put where it belongs in time, so that pictures between show it too.
                self.table["bus_watchdog"] = WATCHDOG_EXPIRED
                self.table["goal_velocity"] = 0
                self.drive.stop(expiry_s)
        self._protect(time_s)

    # Instructions

    def ping(self) -> bytes:
        """Return the parameters of the answer to a ping."""
        return self.model.number.to_bytes(2, "little") + bytes((self.model.firmware,))

    def read(self, address: int, length: int, time_s: float) -> bytes:
        """Return the bytes of a range, or raise Refused."""
        return self.table.read(address, length, time_s)

    def write(self, address: int, data: bytes, time_s: float, *, by_group: bool = False) -> None:
        """Write at once, or raise Refused; ``by_group`` is a packet to the secondary id."""
        locked = by_group or self.table["torque_enable"] == 1
        changes = self.table.changes(address, data, locked=locked, expired=self._expired())
        aimed = False
        for register, value in changes:
            name = register.name
            if name == "torque_enable":
                self._torque(value == 1, time_s)
                continue
            self.table[name] = value
            if name == "goal_position":
                aimed = True
            elif name == "operating_mode":
                self._reset_mode(time_s)
            elif name == "drive_mode":
                self.drive.into_one_turn(time_s)
            elif name == "baud_rate":
                self._retune_s = time_s + self.return_delay_s + _ANSWER_BITS / self.baud
                if self.mate is not None:
                    self.mate.table["baud_rate"] = self.table["baud_rate"]
                    self.mate._retune_s = self._retune_s
        if aimed and self.table["torque_enable"]:
            self.drive.go(time_s)

    def reboot(self, time_s: float) -> None:
        """Start anew: torque drops at once, errors are gone, the RAM area is as from the factory."""
        self.table["torque_enable"] = 0
        self.drive.stop(time_s)
        self._boot(time_s)

    # Inside

    def _expired(self) -> bool:
        return self.table["bus_watchdog"] == WATCHDOG_EXPIRED

    def _torque(self, on: bool, time_s: float) -> None:
        """Switch the torque; after a shutdown it stays off silently, only the alert bit shows."""
        if on == bool(self.table["torque_enable"]):
            return
        if on and self.table["hardware_error_status"] & self.table["shutdown"]:
            return
        self.table["torque_enable"] = int(on)
        self._fed_s = time_s
        if on:
            self.drive.torque_on(time_s)
        else:
            self.drive.stop(time_s)

    def _reset_mode(self, time_s: float) -> None:
        """A new operating mode: the profile and the limits of the goals are reset."""
        self.table["profile_velocity"] = self.table["profile_acceleration"] = 0
        self._reset_goals(time_s)
        if self.table["operating_mode"] in MODES:
            self.drive.into_one_turn(time_s)
            self.table["goal_position"] = self.drive.position(time_s)

    def _reset_goals(self, time_s: float) -> None:
        self.table["goal_pwm"] = self.table["pwm_limit"]
        if "goal_current" in self.table.values:
            self.table["goal_current"] = self.table["current_limit"]
        self.table["goal_velocity"] = 0
        self.table["goal_position"] = self.drive.position(time_s)

    def _boot(self, time_s: float) -> None:
        """Everything that is not EEPROM as from the factory; deaf for a while."""
        for register in self.model.registers:
            if register.address >= self.model.ram_from:
                self.table[register.name] = register.initial
        self._raised = 0
        self._since_s = None
        self._started_s = self._fed_s = self._retune_s = time_s + BOOT_S
        self._starting = True

    def _start_registers(self, time_s: float) -> None:
        self.drive.into_one_turn(time_s)
        self._reset_goals(time_s)

    def _voltage(self, time_s: float) -> int:
        return round(10 * self.model.voltage_v * self._axis.supply(time_s))

    def _protect(self, time_s: float) -> None:
        """Set hardware errors, and drop the torque for those in the shutdown mask."""
        table, found = self.table, self._raised
        if not table["min_voltage_limit"] <= self._voltage(time_s) <= table["max_voltage_limit"]:
            found |= VOLTAGE
        if self._axis.temperature_c(time_s) > table["temperature_limit"]:
            found |= HEAT
        if self.drive.pushes(time_s):
            self._since_s = time_s if self._since_s is None else self._since_s
            if time_s - self._since_s >= OVERLOAD_S:
                found |= OVERLOAD
        else:
            self._since_s = None
        table["hardware_error_status"] |= found
        if table["hardware_error_status"] & table["shutdown"] and table["torque_enable"]:
            self._torque(False, time_s)

    def _live(self) -> Mapping[str, Callable[[float], int]]:
        """The registers that are measured, by name."""
        return {
            "realtime_tick": lambda t: int((t - self._started_s) * 1000) % 32768,
            "moving": lambda t: self.drive.moving(t),
            "moving_status": lambda t: self.drive.moving_status(t),
            "present_pwm": lambda t: round(self.drive.effort(t) * self.table["pwm_limit"]),
            "present_current": lambda t: round(self.drive.effort(t) * self.table["current_limit"]),
            "present_load": lambda t: round(self.drive.effort(t) * 1000),
            "present_velocity": lambda t: self.drive.velocity(t),
            "present_position": lambda t: self.drive.position(t),
            "velocity_trajectory": lambda t: self.drive.trajectory_velocity(t),
            "position_trajectory": lambda t: self.drive.trajectory_position(t),
            "present_input_voltage": lambda t: self._voltage(t),
            "present_temperature": lambda t: round(self._axis.temperature_c(t)),
        }
