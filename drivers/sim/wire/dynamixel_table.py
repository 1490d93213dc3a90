"""The control table of one simulated servo: what may be read and written, and with which error it refuses."""

from __future__ import annotations

from collections.abc import Callable, Mapping

from drivers.sim.wire.dynamixel_models import SimulatedModel, TableRegister

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
