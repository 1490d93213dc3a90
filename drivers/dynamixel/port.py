"""The line to servos: packets sent, replies gathered until a deadline, what nobody asked for dropped.

Every wait gives way to a stop; a stop itself goes out whatever is under way. `Exchange` asks one servo one
thing. Every failure names port, servo id, register and instruction, in its sentence and in ``detail``. No
value is ever made up: what a servo did not say is an error.
"""

from __future__ import annotations

import contextlib
import logging
from collections.abc import Callable, Iterator, Sequence

from drivers.clock import Clock, SystemClock
from drivers.dynamixel.packets import (
    ERROR_WORDS,
    PING,
    READ,
    REBOOT,
    WRITE,
    StatusPacket,
    instruction_packet,
    take_status,
)
from drivers.errors import BadReply, LineLost, NoReply, Refused
from drivers.serial_line import OpenLine, SerialLine

log = logging.getLogger(__name__)

QUIET_S = 0.02  # a USB adapter may hold bytes back for 16 ms
LONGEST_DRAIN_S = 0.3
SLICE_S = 0.005  # how soon a wait sees that it has to give way
REPLY_UNDER_WAY_S = 0.01  # how long it then lets a reply come in that would collide with what is sent next

STATUS_BYTES = 11  # of a reply without data
INSTRUCTION_WORDS = {PING: "ping", READ: "read", WRITE: "write", REBOOT: "reboot"}


class Overtaken(Exception):
    """What was under way on the line was broken off, since something more urgent wants it.

    No `DriverError`: nobody on the way up may take it for a fault of the line and try again. Its words say
    how far it had come.
    """

    def __init__(self, words: str = "broken off") -> None:
        super().__init__(words)


class Port:
    """An open line to servos, for one thread at a time.

    Parameters
    ----------
    name, baud
        As of `SerialLine`.
    reply_timeout_s
        How long a reply may take beyond its time on the wire.
    urgent
        Says that something urgent waits for the line: then nothing more is sent and no wait goes on.
    clock
        Deadlines run on it; the machine's when left out. The line's own waits have to end by it too.
    open_line
        Opens the line.

    Attributes
    ----------
    clock
        That of the deadlines.
    suspect
        Whether a reply may still be under way: then it is listened until the line is quiet before sending.
    deadline_s
        Until when `receive` waits, seconds of the clock.
    received_bytes
        In all, since the line was opened.

    Raises
    ------
    Overtaken
        From every method that sends or waits, while something urgent waits; not from `send_now`.
    LineLost, BadOptions
        As `SerialLine`.
    """

    def __init__(
        self,
        name: str,
        baud: int,
        reply_timeout_s: float,
        urgent: Callable[[], bool] = lambda: False,
        *,
        clock: Clock | None = None,
        open_line: OpenLine = SerialLine,
    ) -> None:
        self.name = name
        self.clock = clock or SystemClock()
        self.reply_timeout_s = reply_timeout_s
        self.suspect = False
        self.deadline_s = 0.0
        self.received_bytes = 0
        self._urgent = urgent
        self._buffer = bytearray()
        self._open_line = open_line
        self._line = open_line(name, baud)

    @property
    def baud(self) -> int:
        """Bits per second."""
        return self._line.baud

    @property
    def byte_s(self) -> float:
        """Time of one byte on the wire, seconds."""
        return self._line.byte_s

    def set_baud(self, baud: int) -> None:
        """Open the line anew at another speed. Raises LineLost, BadOptions."""
        self._line.close()
        self._buffer.clear()
        self._line = self._open_line(self.name, baud)

    def close(self) -> None:
        """Let go of the line, whatever state it is in."""
        self._line.close()

    @contextlib.contextmanager
    def undisturbed(self) -> Iterator[None]:
        """Within it nothing urgent is given way to."""
        urgent, self._urgent = self._urgent, lambda: False
        try:
            yield
        finally:
            self._urgent = urgent

    def send(self, packet: bytes, reply_bytes: int) -> float:
        """Send a packet after what came in unasked was dropped, and start the deadline of its reply.

        Returns
        -------
        float
            A moment just before it was sent, seconds of the clock.

        Raises
        ------
        BadReply
            If the line is never quiet.
        LineLost
            If it is gone.
        """
        if self.suspect or self._buffer or self._fetch(0.0):
            self.drain()
        sent_s = self.clock.now_s()
        if self._urgent():
            raise Overtaken
        self._line.write(packet)
        wire_s = (len(packet) + reply_bytes) * self._line.byte_s
        self.deadline_s = self.clock.now_s() + self.reply_timeout_s + wire_s
        return sent_s

    def send_now(self, data: bytes) -> None:
        """Send bytes whatever else wants the line or is under way on it. Raises LineLost."""
        self._line.write(data)

    def receive(self, *, fast: bool = False) -> StatusPacket | None:
        """Return the next status packet, or None when the deadline passes first.

        After a None the port counts as suspect: the reply may still come. Raises LineLost.
        """
        while True:
            status = take_status(self._buffer, fast=fast)
            if status is not None:
                return status
            if not self._fetch(max(0.0, self.deadline_s - self.clock.now_s())):
                status = take_status(self._buffer, at_end=True, fast=fast)
                self.suspect = self.suspect or status is None
                return status

    def drain(self, quiet_s: float = QUIET_S, longest_s: float = LONGEST_DRAIN_S) -> None:
        """Read and drop everything until the line was quiet for ``quiet_s``.

        Raises
        ------
        BadReply
            If it never falls quiet.
        LineLost
            If the line is gone.
        """
        until_s = self.clock.now_s() + longest_s
        dropped = len(self._buffer)
        self._buffer.clear()
        while self._fetch(quiet_s):
            dropped += len(self._buffer)
            self._buffer.clear()
            if self.clock.now_s() > until_s:
                raise BadReply(
                    f"{self.name} is never quiet: {dropped} bytes in {longest_s:g} s that nobody wants",
                    detail={"port": self.name},
                )
        self.suspect = False

    def _fetch(self, wait_s: float) -> bool:
        """Move bytes that come within ``wait_s`` to the buffer; returns whether any did."""
        until_s = self.clock.now_s() + wait_s
        give_way_s = None
        while True:
            now_s = self.clock.now_s()
            if self._urgent():
                give_way_s = give_way_s or now_s + REPLY_UNDER_WAY_S
            if data := self._line.read(max(0.0, min(until_s - now_s, SLICE_S))):
                self._buffer += data
                self.received_bytes += len(data)
                return True
            if self.clock.now_s() >= until_s:
                return False
            if give_way_s is not None and now_s >= give_way_s:
                self.suspect = True
                raise Overtaken


class Exchange:
    """Asking one servo at a time; for the thread that has the port.

    Parameters
    ----------
    port
        Open. `Overtaken` may come from whatever asks.
    """

    def __init__(self, port: Port) -> None:
        self.port = port

    def ask(
        self, servo_id: int, instruction: int, parameters: bytes, length: int, register: str = ""
    ) -> StatusPacket:
        """Send an instruction to one servo and return its reply of ``length`` bytes.

        ``register`` is for messages. Raises NoReply, BadReply, Refused, LineLost.
        """
        word = INSTRUCTION_WORDS[instruction]
        packet = instruction_packet(servo_id, instruction, parameters)
        try:
            self.port.send(packet, STATUS_BYTES + length)
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
        asked = address.to_bytes(2, "little") + length.to_bytes(2, "little")
        return self.ask(servo_id, READ, asked, length, register).data

    def quiet(self, quiet_s: float) -> None:
        """Drop what comes until nothing has come for ``quiet_s``: late replies. Raises LineLost, BadReply."""
        self.port.drain(quiet_s, 1.0)

    def stray(self, status: StatusPacket) -> None:
        """Note a reply to another question; the line is listened to until quiet before the next one."""
        self.port.suspect = True
        log.debug("%s: dropped a reply of id %d that nobody waits for", self.port.name, status.servo_id)

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
        reason = ERROR_WORDS.get(status.refused, f"unknown error {status.refused}")
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
