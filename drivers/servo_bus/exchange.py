"""Requests to one servo over an open line; every failure names port, servo id, register and instruction.

It does so in its sentence and in ``detail``. No value is ever made up: what a servo did not say is an error.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from typing import ClassVar, TypeVar

from drivers.clock import Clock
from drivers.errors import BadReply, LineLost, NoReply, Refused
from drivers.serial_line import OpenLine, SerialLine
from drivers.servo_bus.port import PacketFormat, Part, Port, Register, StatusPacket

log = logging.getLogger(__name__)
T = TypeVar("T")

READ, WRITE = 2, 3
"""The instructions that read and write, of every family."""

REPLY_TIMEOUT_S = 0.05  # USB adapters hold bytes back for up to 16 ms, the servo for up to 0.5 ms
ATTEMPTS = 3
LATE_S = 0.1  # a reply that did not come is waited out this long before the next question


def again(link: BusLink, request: Callable[[], T], late_s: float = LATE_S) -> T:
    """Make a request, again after a lost or wrong reply, when one that is merely late has come."""
    for _ in range(ATTEMPTS - 1):
        try:
            return request()
        except (NoReply, BadReply):
            link.quiet(late_s)
    return request()


class BusLink:
    """One open line to servos of a family; for one thread at a time.

    Raises LineLost, BadOptions. `Overtaken` may come from every method but `write_at_once`.

    Parameters are as of `Port`.
    ``finds_echo``: whether it is found out at the start if the adapter gives back what is sent.
    """

    packets: ClassVar[PacketFormat]
    finds_echo: ClassVar[bool] = False

    def __init__(
        self,
        port: str,
        baud: int,
        reply_timeout_s: float = REPLY_TIMEOUT_S,
        urgent: Callable[[], bool] = lambda: False,
        *,
        clock: Clock | None = None,
        open_line: OpenLine = SerialLine,
    ) -> None:
        self.name = port
        take = self.packets.take
        self.port = Port(port, baud, reply_timeout_s, take, urgent, clock=clock, open_line=open_line)
        self.clock = self.port.clock
        try:
            if self.finds_echo:
                self.find_echo()
        except BaseException:
            self.close()
            raise

    @property
    def baud(self) -> int:
        """Bits per second."""
        return self.port.baud

    def set_baud(self, baud: int) -> None:
        """Open the line anew at another speed. Raises LineLost, BadOptions."""
        self.port.set_baud(baud)

    def find_echo(self) -> None:
        """Find out whether the adapter gives back what is sent; if so, that is dropped from now on.

        Raises LineLost, BadReply if the line is gone, or never quiet.
        """
        self.port.echoes = self.port.comes_back(self.packets.to_nobody)

    def close(self) -> None:
        """Let go of the line; never raises."""
        self.port.close()

    def undisturbed(self) -> AbstractContextManager[None]:
        """Within it nothing urgent breaks off what is said; for what must not be left half done."""
        return self.port.undisturbed()

    def quiet(self, quiet_s: float) -> None:
        """Drop what comes until nothing has come for ``quiet_s``: late replies. Raises LineLost, BadReply."""
        self.port.drain(quiet_s, 1.0)

    def request(
        self, servo_id: int, instruction: int, parameters: bytes, length: int, register: str = ""
    ) -> StatusPacket:
        """Send an instruction to one servo and return its reply of ``length`` bytes.

        ``register`` is for messages. Raises NoReply, BadReply, Refused, LineLost.
        """
        name = self.packets.instructions[instruction]
        packet = self.packets.packet(servo_id, instruction, parameters)
        try:
            self.port.send(packet, self.packets.status_bytes + length)
            while (status := self.port.receive()) is not None:
                if status.servo_id != servo_id or not (status.refused or len(status.data) == length):
                    self.note_unexpected(status)
                elif status.refused:
                    raise self.refusal(status, name, register)
                else:
                    return status
        except LineLost as error:
            raise self.placed(error, [servo_id], name, register) from error
        raise self.silence(servo_id, name, register)

    def read(self, servo_id: int, address: int, length: int, register: str) -> bytes:
        """Return bytes of one servo's table, as they seem to be; raises as `request`."""
        parameters = (number.to_bytes(self.packets.address_bytes, "little") for number in (address, length))
        return self.request(servo_id, READ, b"".join(parameters), length, register).data

    def write(self, servo_id: int, register: Register, value: int) -> None:
        """Set a register and wait for the servo's answer; raises as `request`."""
        self.request(servo_id, WRITE, self._written(register, value), 0, register.name)

    def write_unanswered(self, servo_id: int, register: Register, value: int) -> None:
        """Set a register of a servo that may keep silent about it; an answer is dropped. Raises LineLost."""
        self.port.send(self.packets.packet(servo_id, WRITE, self._written(register, value)), 0)
        self.port.drain()

    def _written(self, register: Register, value: int) -> bytes:
        """The parameters of a write."""
        return register.address.to_bytes(self.packets.address_bytes, "little") + register.encode(value)

    def group_write(self, parts: Sequence[Part]) -> None:
        """Write to several servos with one packet; none answers, so read back what must be certain.

        Raises LineLost, BadReply.
        """
        try:
            self.port.send(self.packets.group_write(parts), 0)
        except LineLost as error:
            raise self.placed(error, [part.servo_id for part in parts], "group write") from error

    def write_at_once(self, parts: Sequence[Part], copies: int = 1) -> None:
        """Write to each of several servos by a packet of its own, at once and whatever is under way.

        None answers, nothing is listened to before, and one servo's packet does not hang on another's: what
        is sent may collide with a reply, so send more than one copy where it matters. Raises LineLost.
        """
        packets = b"".join(self.packets.group_write([part]) for part in parts)
        try:
            self.port.send_now(copies * packets)
        except LineLost as error:
            raise self.placed(error, [part.servo_id for part in parts], "group write") from error

    def note_unexpected(self, status: StatusPacket) -> None:
        """Note a reply to another question; the line is listened to until quiet before the next one."""
        self.port.suspect = True
        log.debug("%s: dropped a reply of id %d to no pending request", self.port.name, status.servo_id)

    def silence(self, servo_id: int, instruction: str, register: str) -> NoReply:
        """Return the error of a servo that did not answer."""
        self.port.suspect = True
        return NoReply(
            f"servo {servo_id} on {self.port.name} at {self.port.baud} baud gave no usable answer to "
            f"{_what(instruction, register)} within {1000 * self.port.reply_timeout_s:g} ms",
            detail=self.where(servo_id, instruction, register),
        )

    def refusal(self, status: StatusPacket, instruction: str, register: str) -> Refused:
        """Return the error of a servo that refused."""
        reason = self.packets.refusals.get(status.refused, f"unknown error {status.refused}")
        alert = ", and it reports a hardware error" if status.alert else ""
        return Refused(
            f"servo {status.servo_id} on {self.port.name} refused the {_what(instruction, register)}: "
            f"{reason}{alert}",
            detail={**self.where(status.servo_id, instruction, register), "error": status.error},
        )

    def placed(
        self, error: LineLost, servo_ids: Sequence[int], instruction: str, register: str = ""
    ) -> LineLost:
        """Return the same loss, saying what was being requested."""
        servos = " and ".join(str(servo_id) for servo_id in servo_ids)
        where = self.where(servo_ids[0], instruction, register)
        message = f"{error} during {_what(instruction, register)} of servo {servos}"
        return LineLost(message, detail={**where, **error.detail})

    def where(self, servo_id: int, instruction: str, register: str) -> dict[str, object]:
        """Return the place of an error, for programs."""
        return {
            "port": self.port.name,
            "baud": self.port.baud,
            "servo_id": servo_id,
            "register": register,
            "instruction": instruction,
        }


def _what(instruction: str, register: str) -> str:
    return f"{instruction} of {register}" if register else instruction
