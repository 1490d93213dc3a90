"""One servo's control table over a link: read, set and seen to hold, asked again where a reply was lost."""

from __future__ import annotations

from collections.abc import Mapping

from drivers.dynamixel.link import Link, Pinged
from drivers.dynamixel.packets import GroupAnswer, Part
from drivers.dynamixel.registers import ControlItem, RegisterBlock
from drivers.errors import BadReply, Refused, WrongDevice
from drivers.servo_bus.exchange import ATTEMPTS, LATE_S, again
from drivers.servo_bus.port import QUIET_S


def identified(link: Link, servo_id: int, name: str) -> Pinged:
    """Return who answers a ping, twice in a row and around a silence: a servo may answer nothing else yet.

    Raises BadReply if it says another thing each time; NoReply, LineLost.
    """
    before = again(link, lambda: link.ping(servo_id))
    for _ in range(ATTEMPTS):
        link.quiet(QUIET_S)
        now = again(link, lambda: link.ping(servo_id))
        if now == before:
            return now
        before = now
    raise BadReply(f"{name} says another thing about itself each time it is asked")


class ServoTable:
    """The control table of one servo."""

    def __init__(self, link: Link, servo_id: int, registers: Mapping[str, ControlItem], name: str) -> None:
        self.name = name
        self._link = link
        self._servo_id = servo_id
        self._registers = registers

    def get(self, register: str) -> int:
        """Return a register's value; a lost reply is asked for again. Raises as `Link.proven`."""
        return self.get_all(register)[register]

    def get_all(self, *registers: str) -> dict[str, int]:
        """Return several registers' values by name, as `get` does one, at the cost of one."""
        entries = [self._registers[register] for register in registers]
        values = again(self._link, lambda: self._link.proven(self._servo_id, *entries))
        return dict(zip(registers, values, strict=True))

    def write(self, register: str, value: int) -> None:
        """Set a register, again where the reply was lost, which is the same. Raises as `Link.write`."""
        again(self._link, lambda: self._link.write(self._servo_id, self._registers[register], value))

    def set(self, register: str, value: int) -> None:
        """Set a register and see that it holds the value.

        Raises WrongDevice if the servo says that it did but holds another value; Refused, NoReply, BadReply,
        LineLost.
        """
        refused: Refused | None = None
        for _ in range(ATTEMPTS):
            try:
                self.write(register, value)
            except Refused as error:
                if refused is not None:
                    raise
                refused = error  # it may be that of another write
            stored = self.get(register)
            if stored == value:
                return
            self._link.quiet(LATE_S if refused is None else QUIET_S)
        raise WrongDevice(f"{self.name} holds {stored} in {register} after {value} was written to it")

    def clear_watchdog(self, goal: int) -> None:
        """Clear a watchdog that has tripped; raises as `set`.

        Once cleared, the servo may go on to its old goal: that is void in the same moment.
        """
        self._link.write_at_once([self.part("bus_watchdog", 0), self.part("goal_position", goal)])
        self.set("bus_watchdog", 0)

    def part(self, register: str, value: int) -> Part:
        """Return a register and its new value, for a packet."""
        entry = self._registers[register]
        return Part(self._servo_id, entry.address, entry.size, entry.encode(value))

    def block(self, block: RegisterBlock) -> GroupAnswer:
        """Return neighbouring registers, asked one time; raises as `Link.block`."""
        return self._link.block(Part(self._servo_id, block.address, block.length))
