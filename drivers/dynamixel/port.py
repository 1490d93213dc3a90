"""The SDK's port, hardened: blocking waits with a monotonic deadline, an exclusive line, typed errors.

What it changes of ``dynamixel_sdk.PortHandler``: a wait sleeps in the kernel instead of spinning, and
gives way to a stop; the deadline runs on CLOCK_MONOTONIC; the line is opened for this process alone;
pyserial's URLs (``socket://host:port``, ``rfc2217://...``) and every baud rate that the adapter can do are
taken; a USB adapter's latency timer is set to its least; the busy flag can never stay set; whatever pyserial
raises becomes `LineLost` with the port's name.
"""

from __future__ import annotations

import contextlib
import errno
import os
import select
import termios
import time
from collections.abc import Callable, Iterator
from typing import Any

import serial
from dynamixel_sdk import PortHandler

from drivers.errors import BadOptions, BadReply, DriverError, LineLost

CHUNK_BYTES = 4096
WRITE_TIMEOUT_S = 0.5
QUIET_S = 0.02  # a USB adapter may hold bytes back for 16 ms
LONGEST_DRAIN_S = 0.3
SLICE_S = 0.005  # how soon a wait sees that it has to give way
REPLY_UNDER_WAY_S = 0.01  # how long it then lets a reply come in that would collide with what is sent next


class Overtaken(Exception):
    """What was under way on the line was broken off, since something more urgent wants it.

    No `DriverError`: nobody on the way up may take it for a fault of the line and try again. Its words say
    how far it had come.
    """

    def __init__(self, words: str = "broken off") -> None:
        super().__init__(words)


class Port(PortHandler):  # type: ignore[misc]
    """A line to servos. Used by one thread only (the SDK's layers keep state in it).

    Parameters
    ----------
    name
        A serial device, or a URL that pyserial understands.
    baud
        Bits per second.
    reply_timeout_s
        How long a reply may take beyond its time on the wire.
    urgent
        Says that something urgent waits for the line: then nothing more is sent and no wait goes on.

    Raises
    ------
    Overtaken
        From every method that sends or waits, while something urgent waits; not from `write_now`.
    LineLost
        If it cannot be opened: no such device, no permission, or held by another program.
    BadOptions
        For a URL or baud rate that cannot be.
    """

    is_open: bool
    port_name: str
    ser: Any

    def __init__(
        self, name: str, baud: int, reply_timeout_s: float, urgent: Callable[[], bool] = lambda: False
    ) -> None:
        super().__init__(name)
        self._urgent = urgent
        self.baudrate = baud
        self.reply_timeout_s = reply_timeout_s
        self.suspect = False  # a reply may still be under way: listen until it is quiet before sending
        self.buffer = bytearray()
        self.deadline_s = 0.0
        self.received_bytes = 0
        self._descriptor: int | None = None
        self._poll: select.poll | None = None
        self.openPort()

    @property
    def is_using(self) -> bool:
        """Always false: one thread owns the port, and the SDK's flag stays set after any exception."""
        return False

    @is_using.setter
    def is_using(self, value: bool) -> None:
        pass

    # What the SDK calls

    def getCFlagBaud(self, baudrate: int) -> int:
        """Take any baud rate; whether the adapter can do it is seen when it is set."""
        return baudrate

    def setupPort(self, cflag_baud: int) -> bool:
        """Open the line. Raises LineLost, BadOptions."""
        if self.is_open:
            self.closePort()
        url = "://" in self.port_name
        try:
            self.ser = serial.serial_for_url(
                self.port_name,
                baudrate=cflag_baud,
                timeout=0.01,
                **({} if url else {"exclusive": True, "write_timeout": WRITE_TIMEOUT_S}),
            )
        except (ValueError, TypeError, OverflowError, NotImplementedError) as error:
            raise BadOptions(f"{self.port_name} at {cflag_baud} baud: {_words(error)}") from error
        except (OSError, EOFError, termios.error) as error:  # SerialException is an OSError
            raise self._lost("opening it", error) from error
        try:
            self._descriptor = self.ser.fileno()
            self._poll = select.poll()
            self._poll.register(self._descriptor, select.POLLIN)
        except (OSError, AttributeError, ValueError):  # rfc2217 has no file behind it
            self._descriptor = self._poll = None
        with contextlib.suppress(OSError, ValueError, NotImplementedError, AttributeError):
            self.ser.set_low_latency_mode(True)  # 1 ms instead of 16 ms, where the adapter has such a timer
        self.is_open = True
        self.tx_time_per_byte = 10_000.0 / cflag_baud
        self.buffer.clear()
        with self.low_level("emptying its input"):
            self.ser.reset_input_buffer()
        return True

    def closePort(self) -> None:
        """Let go of the line, whatever state it is in."""
        self.is_open = False
        self._descriptor = self._poll = None
        with contextlib.suppress(OSError, EOFError, termios.error, ValueError, TypeError, AttributeError):
            self.ser.close()

    def clearPort(self) -> None:
        """Drop what came in unasked; if anything did, listen until the line is quiet."""
        if self.suspect or self.pending():
            self.drain()

    def getBytesAvailable(self) -> int:
        """Return how many bytes have come in and were not taken."""
        self._fetch(0.0)
        return len(self.buffer)

    def readPort(self, length: int) -> bytes:
        """Return up to ``length`` bytes, waiting for the first until the packet's deadline."""
        if not self.buffer and length > 0:
            self.fill()
        taken = bytes(self.buffer[:length])
        del self.buffer[:length]
        return taken

    def writePort(self, packet: bytes | list[int]) -> int:
        """Send bytes; returns how many."""
        if self._urgent():
            raise Overtaken
        return self.write_now(bytes(packet))

    def write_now(self, data: bytes) -> int:
        """Send bytes whatever else wants the line or is under way on it; returns how many."""
        if self._descriptor is None or "://" in self.port_name:
            with self.low_level("writing"):
                return int(self.ser.write(data) or len(data))
        sent = 0
        try:
            sent = os.write(self._descriptor, data)
        except BlockingIOError:
            pass
        except OSError as error:
            raise self._lost("writing", error) from error
        if sent < len(data):  # the driver's buffer is full: let pyserial wait for room
            with self.low_level("writing"):
                self.ser.write(data[sent:])
        return len(data)

    def setPacketTimeout(self, packet_length: int) -> None:
        """Start the deadline of a reply of so many bytes."""
        self.deadline_s = time.monotonic() + self.reply_timeout_s + packet_length * self.byte_s

    def setPacketTimeoutMillis(self, msec: float) -> None:
        """Start a deadline of so many milliseconds."""
        self.deadline_s = time.monotonic() + msec / 1000

    def isPacketTimeout(self) -> bool:
        """Whether the deadline has passed."""
        return time.monotonic() > self.deadline_s

    def getCurrentTime(self) -> float:
        """Return milliseconds of CLOCK_MONOTONIC, which no time server turns."""
        return time.monotonic() * 1000

    # What our layers use

    @contextlib.contextmanager
    def undisturbed(self) -> Iterator[None]:
        """Within it nothing urgent is given way to."""
        urgent, self._urgent = self._urgent, lambda: False
        try:
            yield
        finally:
            self._urgent = urgent

    @property
    def byte_s(self) -> float:
        """Time of one byte on the wire, seconds."""
        return float(self.tx_time_per_byte) / 1000

    def fill(self) -> bool:
        """Wait for more bytes until the deadline; returns whether any came. Raises LineLost."""
        return self._fetch(max(0.0, self.deadline_s - time.monotonic()))

    def pending(self) -> bool:
        """Whether bytes that nobody asked for have come in. Raises LineLost."""
        return bool(self.buffer) or self._fetch(0.0)

    def drain(self, quiet_s: float = QUIET_S, longest_s: float = LONGEST_DRAIN_S) -> int:
        """Read and drop everything until the line was quiet for ``quiet_s``; returns how much it was.

        Raises
        ------
        BadReply
            If it never falls quiet.
        LineLost
            If the line is gone.
        """
        until_s = time.monotonic() + longest_s
        dropped = len(self.buffer)
        self.buffer.clear()
        while self._fetch(quiet_s):
            dropped += len(self.buffer)
            self.buffer.clear()
            if time.monotonic() > until_s:
                raise BadReply(
                    f"{self.port_name} is never quiet: {dropped} bytes in {longest_s:g} s that nobody wants",
                    detail={"port": self.port_name},
                )
        self.suspect = False
        return dropped

    @contextlib.contextmanager
    def low_level(self, doing: str) -> Iterator[None]:
        """Turn whatever a serial line raises into LineLost."""
        try:
            yield
        except DriverError:
            raise
        except (OSError, EOFError, termios.error, ValueError, TypeError, AttributeError, IndexError) as error:
            raise self._lost(doing, error) from error

    def _fetch(self, wait_s: float) -> bool:
        """Move bytes that come within ``wait_s`` to the buffer; returns whether any did."""
        if not self.is_open:
            raise LineLost(f"{self.port_name} is closed", detail={"port": self.port_name})
        until_s = time.monotonic() + wait_s
        give_way_s = None
        while True:
            now_s = time.monotonic()
            if self._urgent():
                give_way_s = give_way_s or now_s + REPLY_UNDER_WAY_S
            if self._fetch_once(max(0.0, min(until_s - now_s, SLICE_S))):
                return True
            if time.monotonic() >= until_s:
                return False
            if give_way_s is not None and now_s >= give_way_s:
                self.suspect = True
                raise Overtaken

    def _fetch_once(self, wait_s: float) -> bool:
        """The same for a short wait."""
        if self._poll is None or self._descriptor is None:
            return self._fetch_from_object(wait_s)
        try:
            # poll counts whole milliseconds; rounding up never cuts a deadline short
            if not self._poll.poll(-int(-wait_s * 1000 // 1)):
                return False
            data = os.read(self._descriptor, CHUNK_BYTES)
        except BlockingIOError:
            return False
        except OSError as error:
            raise self._lost("reading", error) from error
        if not data:
            raise LineLost(
                f"{self.port_name} hung up (unplugged?)", detail={"port": self.port_name, "while": "reading"}
            )
        self.buffer += data
        self.received_bytes += len(data)
        return True

    def _fetch_from_object(self, wait_s: float) -> bool:
        """The same for a line without a file descriptor."""
        until_s = time.monotonic() + wait_s
        with self.low_level("reading"):
            while True:
                data = self.ser.read(max(1, self.ser.in_waiting)) if wait_s or self.ser.in_waiting else b""
                self.buffer += data
                self.received_bytes += len(data)
                if data or time.monotonic() >= until_s:
                    return bool(data)

    def _lost(self, doing: str, error: BaseException) -> LineLost:
        what = "cannot be opened" if doing == "opening it" else f"failed in {doing} (unplugged?)"
        return LineLost(
            f"{self.port_name} {what}: {_words(error)}",
            detail={"port": self.port_name, "while": doing},
        )


def _words(error: BaseException) -> str:
    """What a low-level exception says, on one line, without what the caller says already."""
    number = (
        error.args[0] if isinstance(error, termios.error) and error.args else getattr(error, "errno", None)
    )
    if number in (errno.EAGAIN, errno.EBUSY):
        return "held by another program"
    if number == errno.ENOTTY or "Inappropriate ioctl" in str(error):
        return "it is no serial line"
    if isinstance(number, int):
        return os.strerror(number).lower()
    return " ".join(str(error).split())[:200] or type(error).__name__
