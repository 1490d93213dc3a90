"""The line to servos: packets sent, replies gathered until a deadline, unrequested bytes dropped.

Every wait gives way to a stop; a stop itself goes out whatever is under way. What a packet is, a
`PacketFormat` knows.
"""

from __future__ import annotations

import contextlib
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol

from drivers.clock import Clock, SystemClock
from drivers.errors import BadReply
from drivers.serial_line import OpenLine, SerialLine

QUIET_S = 0.02  # a USB adapter may hold bytes back for 16 ms
LONGEST_DRAIN_S = 0.3
SLICE_S = 0.005  # how soon a wait sees that it has to give way
REPLY_UNDER_WAY_S = 0.01  # how long it then lets a reply come in that would collide with what is sent next


@dataclass(frozen=True)
class StatusPacket:
    """A servo's reply.

    ``refused``: why the servo did not do as instructed, 0 if it did. ``alert``: it reports a fault of its
    own.
    """

    servo_id: int
    error: int
    data: bytes
    refused: int
    alert: bool


@dataclass(frozen=True)
class Register(ABC):
    """One entry of a servo's table: ``size`` bytes at an address."""

    name: str
    address: int
    size: int = 1

    @abstractmethod
    def decode(self, data: bytes) -> int:
        """Return the value of the register's bytes."""

    @abstractmethod
    def encode(self, value: int) -> bytes:
        """Return a value as the register's bytes; OverflowError if it does not fit."""


@dataclass(frozen=True)
class Part:
    """Neighbouring bytes of one servo's table: to be read, or with ``data`` to be written."""

    servo_id: int
    address: int
    length: int
    data: bytes = b""


class Take(Protocol):
    """Takes packets out of what came in."""

    def __call__(self, buffer: bytearray, *, at_end: bool = False) -> StatusPacket | None:
        """Return the next reply and drop it and all before it; ``at_end`` if no more will come."""
        ...


def at_header(buffer: bytearray, header: bytes) -> bool:
    """Drop what comes before the next header; returns whether there is a whole one."""
    start = buffer.find(header)
    if start < 0:
        begun = next(size for size in range(len(header) - 1, -1, -1) if buffer.endswith(header[:size]))
        start = len(buffer) - begun
    del buffer[:start]
    return len(buffer) >= len(header)


@dataclass(frozen=True)
class PacketFormat:
    """What the packets of a family of servos look like.

    An address, and a length beside it, have ``address_bytes``, little-endian. ``to_nobody`` is a write to no
    servo, which none obeys or answers: an adapter that gives it back echoes.
    """

    take: Take
    packet: Callable[[int, int, bytes], bytes]
    address_bytes: int
    group_write: Callable[[Sequence[Part]], bytes]
    status_bytes: int
    instructions: Mapping[int, str]
    refusals: Mapping[int, str]
    to_nobody: bytes


class Overtaken(Exception):
    """What was under way on the line was broken off, since something more urgent wants it.

    No `DriverError`: no caller may treat it as a fault of the line and try again. Its message says how far it
    had come.
    """

    def __init__(self, message: str = "broken off") -> None:
        super().__init__(message)


class Port:
    """An open line to servos, for one thread at a time; ``name`` and ``baud`` are as of `SerialLine`.

    While ``urgent`` says that something urgent waits, every method that sends or waits raises Overtaken; not
    `send_now`. Deadlines run on the ``clock``; the line's own waits have to end by it too. While it is
    ``suspect`` a reply may still be under way: then it is listened until the line is quiet before sending. Of
    an adapter that ``echoes`` (half duplex) what was sent is dropped before a reply. Raises LineLost,
    BadOptions.
    """

    def __init__(
        self,
        name: str,
        baud: int,
        reply_timeout_s: float,
        take: Take,
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
        self.echoes = False
        self._echo = b""
        self._take = take
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
        """Send a packet after what came in unrequested was dropped, and start the deadline of its reply.

        Returns a moment just before it was sent, seconds of the clock. Raises BadReply if the line is never
        quiet; LineLost.
        """
        self._fetch(0.0)
        if self.suspect or (self._past_echo() and self._buffer):
            self.drain()
        sent_s = self.clock.now_s()
        if self._urgent():
            raise Overtaken
        if self.echoes:
            self._echo += packet
        self._line.write(packet)
        wire_s = (len(packet) + reply_bytes) * self._line.byte_s
        self.deadline_s = self.clock.now_s() + self.reply_timeout_s + wire_s
        return sent_s

    def send_now(self, data: bytes) -> None:
        """Send bytes whatever else wants the line or is under way on it. Raises LineLost."""
        self._line.write(data)

    def receive(self, take: Take | None = None) -> StatusPacket | None:
        """Return the next status packet, or None when the deadline passes first.

        ``take`` finds it where it looks otherwise. After a None the port counts as suspect: the reply may
        still come. Raises LineLost.
        """
        take = take or self._take
        while True:
            status = take(self._buffer) if self._past_echo() else None
            if status is not None:
                return status
            if not self._fetch(max(0.0, self.deadline_s - self.clock.now_s())):
                status = take(self._buffer, at_end=True)
                self.suspect = self.suspect or status is None
                return status

    def comes_back(self, packet: bytes) -> bool:
        """Send a packet that none answers; returns whether it comes back. Raises LineLost, BadReply."""
        self.echoes = False
        self.send(packet, 0)
        until_s = self.clock.now_s() + QUIET_S + 2 * len(packet) * self.byte_s
        while len(self._buffer) < len(packet) and self._fetch(max(0.0, until_s - self.clock.now_s())):
            pass
        echoed = bytes(self._buffer) == packet
        self.drain()
        return echoed

    def _past_echo(self) -> bool:
        """Drop the echo of what was sent; returns whether what is in the buffer is more than that."""
        echo = self._echo
        if not echo:
            return True
        if len(self._buffer) < len(echo):
            return not echo.startswith(self._buffer)
        if self._buffer.startswith(echo):
            del self._buffer[: len(echo)]
        else:
            self.suspect = True  # something was said into it
        self._echo = b""
        return True

    def drain(self, quiet_s: float = QUIET_S, longest_s: float = LONGEST_DRAIN_S) -> None:
        """Read and drop everything until the line was quiet for ``quiet_s``.

        Raises BadReply if it never falls quiet; LineLost.
        """
        until_s = self.clock.now_s() + longest_s
        dropped = len(self._buffer)
        self._buffer.clear()
        while self._fetch(quiet_s):
            dropped += len(self._buffer)
            self._buffer.clear()
            if self.clock.now_s() > until_s:
                raise BadReply(
                    f"{self.name} is never quiet: {dropped} bytes in {longest_s:g} s that answer no request",
                    detail={"port": self.name},
                )
        self.suspect = False
        self._echo = b""

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
