"""Asking one servo one thing; every failure names port, servo id, register and instruction.

It does so in its sentence and in ``detail``. No value is ever made up: what a servo did not say is an error.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from typing import Protocol, TypeVar

from drivers.errors import BadReply, LineLost, NoReply, Refused
from drivers.servo_bus.port import PacketFormat, Port, Status

log = logging.getLogger(__name__)
T = TypeVar("T")

READ = 2
"""The instruction that reads, of every family."""

ATTEMPTS = 3
LATE_S = 0.1  # a reply that did not come is waited out this long before the next question


class Quiets(Protocol):
    """A line that can be left silent."""

    def quiet(self, quiet_s: float) -> None:
        """Drop what comes until nothing has come for ``quiet_s``. Raises LineLost, BadReply."""
        ...


def again(link: Quiets, ask: Callable[[], T], late_s: float = LATE_S) -> T:
    """Ask again after a lost or wrong reply, when one that is merely late has come."""
    for _ in range(ATTEMPTS - 1):
        try:
            return ask()
        except (NoReply, BadReply):
            link.quiet(late_s)
    return ask()


class Exchange:
    """Asking one servo at a time; for the thread that has the port.

    Parameters
    ----------
    port
        Open. `Overtaken` may come from whatever asks.
    """

    def __init__(self, port: Port, packets: PacketFormat) -> None:
        self.port = port
        self.packets = packets

    def ask(
        self, servo_id: int, instruction: int, parameters: bytes, length: int, register: str = ""
    ) -> Status:
        """Send an instruction to one servo and return its reply of ``length`` bytes.

        ``register`` is for messages. Raises NoReply, BadReply, Refused, LineLost.
        """
        word = self.packets.words[instruction]
        packet = self.packets.packet(servo_id, instruction, parameters)
        try:
            self.port.send(packet, self.packets.status_bytes + length)
            while (status := self.port.receive()) is not None:
                if status.servo_id != servo_id or not (status.refused or len(status.data) == length):
                    self.stray(status)
                elif status.refused:
                    raise self.refusal(status, word, register)
                else:
                    return status
        except LineLost as error:
            raise self.placed(error, [servo_id], word, register) from error
        raise self.silence(servo_id, word, register)

    def read(self, servo_id: int, address: int, length: int, register: str) -> bytes:
        """Return bytes of one servo's table, as they seem to be; raises as `ask`."""
        asked = self.packets.read_parameters(address, length)
        return self.ask(servo_id, READ, asked, length, register).data

    def quiet(self, quiet_s: float) -> None:
        """Drop what comes until nothing has come for ``quiet_s``: late replies. Raises LineLost, BadReply."""
        self.port.drain(quiet_s, 1.0)

    def stray(self, status: Status) -> None:
        """Note a reply to another question; the line is listened to until quiet before the next one."""
        self.port.suspect = True
        log.debug("%s: dropped a reply of id %d to no pending request", self.port.name, status.servo_id)

    def silence(self, servo_id: int, word: str, register: str) -> NoReply:
        """Return the error of a servo that did not answer."""
        self.port.suspect = True
        return NoReply(
            f"servo {servo_id} on {self.port.name} at {self.port.baud} baud gave no usable answer to "
            f"{_what(word, register)} within {1000 * self.port.reply_timeout_s:g} ms",
            detail=self.where(servo_id, word, register),
        )

    def refusal(self, status: Status, word: str, register: str) -> Refused:
        """Return the error of a servo that refused."""
        reason = self.packets.refusals.get(status.refused, f"unknown error {status.refused}")
        alert = ", and it reports a hardware error" if status.alert else ""
        return Refused(
            f"servo {status.servo_id} on {self.port.name} refused the {_what(word, register)}: "
            f"{reason}{alert}",
            detail={**self.where(status.servo_id, word, register), "error": status.error},
        )

    def placed(self, error: LineLost, servo_ids: Sequence[int], word: str, register: str = "") -> LineLost:
        """Return the same loss, saying what was being asked."""
        servos = " and ".join(str(servo_id) for servo_id in servo_ids)
        where = self.where(servo_ids[0], word, register)
        words = f"{error} during {_what(word, register)} of servo {servos}"
        return LineLost(words, detail={**where, **error.detail})

    def where(self, servo_id: int, word: str, register: str) -> dict[str, object]:
        """Return the place of an error, for programs."""
        return {
            "port": self.port.name,
            "baud": self.port.baud,
            "servo_id": servo_id,
            "register": register,
            "instruction": word,
        }


def _what(word: str, register: str) -> str:
    return f"{word} of {register}" if register else word
