"""An open line of bytes to a device: a serial device or ``socket://HOST:PORT``.

pyserial opens it; this module does not know the meaning of the bytes. It adds to pyserial 3.5, for every
driver alike: A wait sleeps in the kernel, with a deadline of CLOCK_MONOTONIC. The line is this program's
alone. A USB adapter's latency timer is set to its least. A host that is away costs 0.5 s, not 5 s, and
closing closes at once. A pulled cable is a `LineLost`; a port that can never be opened is `BadOptions`.
"""

from __future__ import annotations

import contextlib
import errno
import os
import select
import socket
import termios
from pathlib import Path
from typing import Protocol
from urllib.parse import urlsplit

import serial
from serial.urlhandler import protocol_socket

from drivers.errors import BadOptions, LineLost

CHUNK_BYTES = 4096
CONNECT_TIMEOUT_S = WRITE_TIMEOUT_S = 0.5

BY_ID = Path("/dev/serial/by-id")
"""Where udev names USB adapters by maker, model and serial number."""

_BROKEN = (OSError, EOFError, termios.error, ValueError, TypeError, AttributeError, IndexError)
"""What pyserial raises when the other side is gone: SerialException, which is an OSError; reset_input_buffer
gives termios.error; a port closed under a read TypeError or AttributeError."""


def stable_name(port: str) -> str:
    """Return a line's name, the same whatever path leads there: what is kept of a head is kept by it.

    A USB adapter's is that of udev (with its serial number), at any port. That of another device is its path
    without links; of a URL, host and port. A pseudo terminal's number is given again
    to the next one, so the moment at which it was made belongs to its name.
    """
    if "://" in port:
        with contextlib.suppress(ValueError):  # what is no URL is refused where it is opened
            parts = urlsplit(port)
            host = "127.0.0.1" if parts.hostname == "localhost" else parts.hostname
            if host:
                host = f"[{host}]" if ":" in host else host
                return host if parts.port is None else f"{host}:{parts.port}"
        return port
    path = Path(os.path.realpath(port))
    with contextlib.suppress(OSError):
        if path.parent == Path("/dev/pts"):
            return f"pts-{path.name}-{path.stat().st_ctime_ns}"
        links = sorted(link.name for link in BY_ID.iterdir() if Path(os.path.realpath(link)) == path)
        if links:
            return links[0]
    return path.name if path.parent == BY_ID else str(path)


class ByteLine(Protocol):
    """An open line of bytes, as a driver talks on it: a `SerialLine`, or one in memory.

    One thread reads; any may write beside it.
    """

    @property
    def baud(self) -> int:
        """Bits per second."""
        ...

    @property
    def byte_s(self) -> float:
        """Time of one byte on the wire, seconds."""
        ...

    def write(self, data: bytes) -> None:
        """Send bytes. Raises LineLost."""
        ...

    def read(self, wait_s: float) -> bytes:
        """Return the bytes that have come or come within ``wait_s``; else none. Raises LineLost."""
        ...

    def close(self) -> None:
        """Let go of the line, whatever state it is in; twice does no harm."""
        ...


class OpenLine(Protocol):
    """How a driver opens its line: `SerialLine`, unless it is given another."""

    def __call__(self, port: str, baud: int, device: str = "") -> ByteLine:
        """Return an open line; parameters and errors as of `SerialLine`."""
        ...


class _SocketPort(protocol_socket.Serial):  # type: ignore[misc]
    """pyserial's ``socket://`` port; a host that is away costs 0.5 s, not 5 s, and closing closes."""

    _socket: socket.socket | None = None

    def open(self) -> None:
        """Connect."""
        self.logger = None
        self._socket = socket.create_connection(self.from_url(self.portstr), CONNECT_TIMEOUT_S)
        self._socket.setblocking(False)
        self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self.is_open = True

    def close(self) -> None:
        """Close at once; pyserial waits 0.3 s and leaves the descriptor to the garbage collector if the other
        side is gone already."""
        self.is_open = False
        if self._socket is not None:
            self._socket.close()
            self._socket = None


class SerialLine:
    """An open line; closing twice does no harm.

    One thread reads; any may write beside it. Raises LineLost if it cannot be opened: no such device, no
    permission, or held by another program; BadOptions for a URL or a baud rate that cannot be.

    ``baud`` is bits per second, any that the adapter can do; means nothing to ``socket://``.
    """

    def __init__(self, port: str, baud: int, device: str = "") -> None:
        self.port = port
        self.baud = baud
        self.byte_s = 10.0 / baud
        self._device = device
        self._is_url = "://" in port
        self._serial = self._opened()
        self._descriptor: int = self._serial.fileno()
        self._poll = select.poll()
        self._poll.register(self._descriptor, select.POLLIN)
        with contextlib.suppress(OSError, ValueError, NotImplementedError, AttributeError):
            self._serial.set_low_latency_mode(True)  # 1 ms instead of 16 ms, where the adapter has a timer
        try:
            self._serial.reset_input_buffer()
        except _BROKEN as error:
            self.close()
            raise self._lost("emptying its input", error) from error

    def write(self, data: bytes) -> None:
        """Send bytes. Raises LineLost."""
        try:
            sent = 0 if self._is_url else _written(self._descriptor, data)
            if sent < len(data):  # its buffer is full: pyserial waits for room
                self._serial.write(data[sent:])
        except _BROKEN as error:
            raise self._lost("writing", error) from error

    def read(self, wait_s: float) -> bytes:
        """Return the bytes that have come or come within ``wait_s``, as soon as there are any; else none.

        Raises LineLost.
        """
        try:
            # poll counts whole milliseconds; rounding up never cuts a deadline short
            if not self._poll.poll(-int(-wait_s * 1000 // 1)):
                return b""
            data = os.read(self._descriptor, CHUNK_BYTES)
        except BlockingIOError:
            return b""
        except _BROKEN as error:
            raise self._lost("reading", error) from error
        if not data:
            message = f"{self.port} hung up (unplugged?)"
            raise LineLost(message, device=self._device, detail=self._at("reading"))
        return data

    def close(self) -> None:
        """Let go of the line, whatever state it is in."""
        with contextlib.suppress(*_BROKEN):
            self._serial.close()

    def _opened(self) -> serial.SerialBase:
        """The pyserial port, for this program alone where the kind of port allows it."""
        try:
            if self._is_url:
                parts = urlsplit(self.port)
                if parts.scheme != "socket" or not parts.hostname or parts.port is None:
                    raise ValueError("expected a serial device or socket://HOST:PORT")
                return _SocketPort(self.port, timeout=0, write_timeout=WRITE_TIMEOUT_S)
            return serial.serial_for_url(
                self.port, baudrate=self.baud, timeout=0, exclusive=True, write_timeout=WRITE_TIMEOUT_S
            )
        except (ValueError, TypeError, OverflowError, NotImplementedError) as error:
            message = f"{self.port} at {self.baud} baud: {_reason(error)}"
            raise BadOptions(message, device=self._device) from error
        except (OSError, EOFError, termios.error) as error:
            message = f"{self.port} cannot be opened: {_reason(error)}{_unit_hint(self.port)}"
            raise LineLost(message, device=self._device, detail=self._at("opening it")) from error

    def _lost(self, doing: str, error: BaseException) -> LineLost:
        message = f"{self.port} failed in {doing} (unplugged?): {_reason(error)}"
        return LineLost(message, device=self._device, detail=self._at(doing))

    def _at(self, doing: str) -> dict[str, object]:
        return {"port": self.port, "while": doing}


def _unit_hint(port: str) -> str:
    """What an address that is not reached may lack in a service: systemd drops its packets silently."""
    if "://" not in port or "INVOCATION_ID" not in os.environ:
        return ""
    return "; if it is on and answers elsewhere, the unit has to allow its address (IPAddressAllow)"


def _written(descriptor: int, data: bytes) -> int:
    """Write to a file what it takes at once; returns how much that was."""
    try:
        return os.write(descriptor, data)
    except BlockingIOError:
        return 0


def _reason(error: BaseException) -> str:
    """What a low-level exception says, on one line, without what the caller says already."""
    number = (
        error.args[0] if isinstance(error, termios.error) and error.args else getattr(error, "errno", None)
    )
    if number in (errno.EAGAIN, errno.EBUSY):
        return "held by another program"
    if number == errno.ENOTTY or "Inappropriate ioctl" in str(error):
        return "it is no serial line"
    if isinstance(number, int) and number > 0:  # a host's name that is not known has one below zero
        return os.strerror(number).lower()
    return " ".join(str(getattr(error, "strerror", None) or error).split())[:200] or type(error).__name__
