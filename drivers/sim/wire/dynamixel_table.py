"""The control table of one simulated servo: what may be read and written, and with which error it refuses."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

from drivers.sim.wire.dynamixel_models import SimulatedModel
from drivers.sim.wire.dynamixel_registers import TableRegister

RESULT_FAIL = 0x01
INSTRUCTION_ERROR = 0x02
CRC_ERROR = 0x03
DATA_RANGE = 0x04
DATA_LENGTH = 0x05
DATA_LIMIT = 0x06
ACCESS = 0x07

GOALS = frozenset({"goal_pwm", "goal_current", "goal_velocity", "goal_position"})
WATCHDOG_EXPIRED = 255


class InstructionRefused(Exception):
    """An instruction that the servo answers with an error number."""

    def __init__(self, error: int) -> None:
        super().__init__(f"error {error}")
        self.error = error


@dataclass(frozen=True)
class RegisterChange:
    """One accepted write: to a register, to an indirect pointer, or to a free indirect data byte."""

    value: int
    register: TableRegister | None = None
    pointer: int = -1
    scratch: int = -1


class ControlTable:
    """Stored values and the rules of access; computed values come from ``live``.

    Parameters
    ----------
    live
        Computes the registers that the servo measures (present position and so on): name to value.
    """

    def __init__(self, model: SimulatedModel, live: Mapping[str, Callable[[float], int]]) -> None:
        self.model = model
        self.values = {r.name: r.initial for r in model.registers}
        count = sum(block.count for block in model.indirect)
        self.pointers = [0] * count
        self.scratch = bytearray(count)
        self.reset_pointers()
        self._live = live
        self._spans: dict[tuple[int, int], tuple[TableRegister, ...] | None] = {}

    def __getitem__(self, name: str) -> int:
        return self.values[name]

    def __setitem__(self, name: str, value: int) -> None:
        self.values[name] = value

    def get(self, name: str, default: int) -> int:
        """Return a stored value, or the default where the model has no such register."""
        return self.values.get(name, default)

    def reset_pointers(self) -> None:
        """Let every indirect address point to its own data byte, as from the factory."""
        self.pointers = [block.data + i for block in self.model.indirect for i in range(block.count)]

    def now(self, register: TableRegister, time_s: float) -> int:
        """Return the value of a register at a moment."""
        live = self._live.get(register.name)
        return self.values[register.name] if live is None else live(time_s)

    def read(self, address: int, length: int, time_s: float) -> bytes:
        """Return the bytes of a range.

        Raises Refused (aCCESS where a byte of the range is not defined, DATA_LENGTH for no bytes).
        """
        if length == 0:
            raise InstructionRefused(DATA_LENGTH)
        span = self._span(address, length)
        if span is not None:
            return b"".join(r.to_bytes(self.now(r, time_s)) for r in span)
        known: dict[str, bytes] = {}
        out = bytearray()
        for at in range(address, address + length):
            register, offset, kind, number = self._resolve(at)
            if register is not None:
                if register.name not in known:
                    known[register.name] = register.to_bytes(self.now(register, time_s))
                out.append(known[register.name][offset])
            elif kind == "address":
                out.append(self.pointers[number // 2].to_bytes(2, "little")[number % 2])
            else:
                out.append(self.scratch[number])
        return bytes(out)

    def _span(self, address: int, length: int) -> tuple[TableRegister, ...] | None:
        """The registers that fill a range exactly, the usual case; None otherwise."""
        key = (address, length)
        if key not in self._spans:
            found: list[TableRegister] = []
            at = address
            while at < address + length:
                entry = self.model.by_byte.get(at)
                if entry is None or entry[1] != 0:
                    break
                found.append(entry[0])
                at += entry[0].size
            if len(self._spans) > 1000:  # a fuzzer asks for every range there is
                self._spans.clear()
            self._spans[key] = tuple(found) if at == address + length else None
        return self._spans[key]

    def _resolve(self, at: int) -> tuple[TableRegister | None, int, str, int]:
        """What stands at an address, through at most one indirection."""
        entry = self.model.by_byte.get(at)
        if entry is not None:
            return entry[0], entry[1], "", 0
        indirect = self.model.indirect_bytes.get(at)
        if indirect is None:
            raise InstructionRefused(ACCESS)
        kind, number = indirect
        if kind == "data":
            target = self.model.by_byte.get(self.pointers[number])
            if target is not None:
                return target[0], target[1], "", 0
            other = self.model.indirect_bytes.get(self.pointers[number])
            if other is None or other[0] != "data":
                raise InstructionRefused(ACCESS)
            return None, 0, "data", other[1]
        return None, 0, kind, number

    def changes(self, address: int, data: bytes, *, locked: bool, expired: bool) -> list[RegisterChange]:
        """Return what a write would change; nothing is changed yet.

        Raises Refused with the error number that the servo answers.

        Parameters
        ----------
        locked
            The EEPROM area is locked: torque is on, or the packet came to the secondary id.
        """
        if not data:
            raise InstructionRefused(DATA_LENGTH)
        changes: list[RegisterChange] = []
        at, left = address, data
        while left:
            register, offset, kind, number = self._resolve(at)
            if register is None and kind == "data":
                changes.append(RegisterChange(left[0], scratch=number))
                at, left = at + 1, left[1:]
                continue
            size = 2 if register is None else register.size
            if register is not None and not register.writable:
                raise InstructionRefused(ACCESS)
            if offset != 0 or (kind == "address" and number % 2) or len(left) < size:
                raise InstructionRefused(DATA_LENGTH)
            if at < self.model.ram_from and locked:
                raise InstructionRefused(ACCESS)
            if register is None:
                value = int.from_bytes(left[:2], "little")
                if not self.model.indirect_low <= value <= self.model.indirect_high:
                    raise InstructionRefused(DATA_RANGE)
                changes.append(RegisterChange(value, pointer=number // 2))
            else:
                for step in range(1, size):  # all bytes of it, in their order, also through indirection
                    if self._resolve(at + step)[:2] != (register, step):
                        raise InstructionRefused(DATA_LENGTH)
                value = register.from_bytes(left[:size])
                self._check(register, value, expired)
                changes.append(RegisterChange(value, register=register))
            at, left = at + size, left[size:]
        return changes

    def _check(self, register: TableRegister, value: int, expired: bool) -> None:
        """Refuse a value outside the register's range, or outside the limits set in the table."""
        name, values = register.name, self.values
        if not register.low <= value <= register.high:
            raise InstructionRefused(DATA_RANGE)
        if (name == "operating_mode" and value not in self.model.modes) or (
            name == "drive_mode" and value & ~self.model.drive_bits
        ):
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

    def apply(self, change: RegisterChange) -> None:
        """Store an accepted change."""
        if change.register is not None:
            self.values[change.register.name] = change.value
        elif change.pointer >= 0:
            self.pointers[change.pointer] = change.value
        else:
            self.scratch[change.scratch] = change.value
