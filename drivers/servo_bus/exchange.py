"""Requests to one servo over an open line; every failure names port, servo id, register and instruction.

It does so in its sentence and in ``detail``. No value is ever made up: what a servo did not say is an error.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from typing import TypeVar

from drivers.clock import Clock
from drivers.errors import BadReply, LineLost, NoReply, Refused
from drivers.serial_line import OpenLine
from drivers.servo_bus.port import PacketFormat, Port, StatusPacket

log = logging.getLogger(__name__)
T = TypeVar("T")

READ = 2
"""The instruction that reads, of every family."""

REPLY_TIMEOUT_S = 0.05  # USB adapters hold bytes back for up to 16 ms, the servo for up to 0.5 ms
ATTEMPTS = 3
LATE_S = 0.1  # a reply that did not come is waited out this long before the next question


def again(link: BusLink, ask: Callable[[], T], late_s: float = LATE_S) -> T:
    """Ask again after a lost or wrong reply, when one that is merely late has come."""
    for _ in range(ATTEMPTS - 1):
        try:
            return ask()
        except (NoReply, BadReply):
            link.quiet(late_s)
    return ask()


class BusLink:
    """One open line; for one thread at a time.

    Raises LineLost, BadOptions.

    Parameters
    ----------
    port, baud, reply_timeout_s, urgent, clock, open_line
        As of `Port`; `Overtaken` may come from every method but `write_at_once`.

    Attributes
    ----------
    port
        What packets are sent and received by.
    """

    def __init__(
        self,
        port: str,
        baud: int,
        reply_timeout_s: float,
        packets: PacketFormat,
        urgent: Callable[[], bool],
        clock: Clock | None,
        open_line: OpenLine,
    ) -> None:
        self.name = port
        self.port = Port(port, baud, reply_timeout_s, packets.take, urgent, clock=clock, open_line=open_line)
        self.clock = self.port.clock
        self._packets = packets

    @property
    def baud(self) -> int:
        """Bits per second."""
        return self.port.baud

    def set_baud(self, baud: int) -> None:
        """Open the line anew at another speed. Raises LineLost, BadOptions."""
        self.port.set_baud(baud)

    def find_echo(self) -> bool:
        """Return whether the adapter gives back what is sent; if so, that is dropped from now on.

        Raises LineLost, BadReply if the line is gone, or never quiet.
        """
        self.port.echoes = self.port.comes_back(self._packets.to_nobody)
        return self.port.echoes

    def close(self) -> None:
        """Let go of the line; never raises."""
        self.port.close()

    def undisturbed(self) -> AbstractContextManager[None]:
        """Within it nothing urgent breaks off what is said; for what must not be left half done."""
        return self.port.undisturbed()

    def quiet(self, quiet_s: float) -> None:
        """Drop what comes until nothing has come for ``quiet_s``: late replies. Raises LineLost, BadReply."""
        self.port.drain(quiet_s, 1.0)

    def ask(
        self, servo_id: int, instruction: int, parameters: bytes, length: int, register: str = ""
    ) -> StatusPacket:
        """Send an instruction to one servo and return its reply of ``length`` bytes.

        ``register`` is for messages. Raises NoReply, BadReply, Refused, LineLost.
        """
        word = self._packets.words[instruction]
        packet = self._packets.packet(servo_id, instruction, parameters)
        try:
            self.port.send(packet, self._packets.status_bytes + length)
            while (status := self.port.receive()) is not None:
                if status.servo_id != servo_id or not (status.refused or len(status.data) == length):
                    self.note_unexpected(status)
                elif status.refused:
                    raise self.refusal(status, word, register)
                else:
                    return status
        except LineLost as error:
            raise self.placed(error, [servo_id], word, register) from error
        raise self.silence(servo_id, word, register)

    def read(self, servo_id: int, address: int, length: int, register: str) -> bytes:
        """Return bytes of one servo's table, as they seem to be; raises as `ask`."""
        requested = self._packets.read_parameters(address, length)
        return self.ask(servo_id, READ, requested, length, register).data

    def note_unexpected(self, status: StatusPacket) -> None:
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

    def refusal(self, status: StatusPacket, word: str, register: str) -> Refused:
        """Return the error of a servo that refused."""
        reason = self._packets.refusals.get(status.refused, f"unknown error {status.refused}")
        alert = ", and it reports a hardware error" if status.alert else ""
        return Refused(
            f"servo {status.servo_id} on {self.port.name} refused the {_what(word, register)}: "
            f"{reason}{alert}",
            detail={**self.where(status.servo_id, word, register), "error": status.error},
        )

    def placed(self, error: LineLost, servo_ids: Sequence[int], word: str, register: str = "") -> LineLost:
        """Return the same loss, saying what was being requested."""
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
