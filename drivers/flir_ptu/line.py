"""The bytes' way to the unit: a serial device, ``socket://HOST:PORT`` or ``rfc2217://HOST:PORT``.

pyserial does the work. Here its blocking read gets a deadline of the monotonic clock, and whatever it lets
through when a cable is pulled (SerialException, OSError, termios.error, TypeError) becomes one error. What
the bytes mean is not known here.
"""

from __future__ import annotations

import logging
import socket
import termios
import time
from urllib.parse import urlsplit

import serial
from serial.urlhandler import protocol_socket

from drivers.errors import LineLost

log = logging.getLogger(__name__)

CONNECT_TIMEOUT_S = 0.5
SLICE_S = 0.02
"""pyserial's own timeout of one read: how sharply a deadline is kept. It never changes while the port is
open, since changing it makes pyserial set up the port anew (over the network with rfc2217)."""

_BROKEN = (serial.SerialException, OSError, termios.error, TypeError, AttributeError, ValueError)
"""What pyserial 3.5 raises when the other side is gone: reset_input_buffer gives termios.error, in_waiting
OSError, a port closed under a read TypeError or AttributeError."""


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
        """Close at once; pyserial 3.5 waits 0.3 s and leaves the descriptor to the garbage collector if the
        other side is gone already."""
        self.is_open = False
        if self._socket is not None:
            self._socket.close()
            self._socket = None


class Line:
    """An open line; closing twice does no harm.

    Parameters
    ----------
    port
        A device path, or a URL that pyserial knows.
    baud
        Bits per second; means nothing to ``socket://``.
    device
        The head's name in errors.

    Raises
    ------
    LineLost
        If it cannot be opened, or another program has it.
    """

    def __init__(self, port: str, baud: int, device: str) -> None:
        self._port = port
        self._device = device
        self.byte_s = 10.0 / baud
        try:
            self._serial = _opened(port, baud)
        except _BROKEN as error:
            raise self._lost("cannot be opened", error) from None

    def send(self, data: bytes) -> None:
        """Write bytes. Raises LineLost."""
        try:
            self._serial.write(data)
        except _BROKEN as error:
            raise self._lost("is gone", error) from None

    def receive(self, until_s: float) -> bytes:
        """Return the bytes that came, at least one, or none if nothing came before a moment.

        Parameters
        ----------
        until_s
            A moment of `time.monotonic`; also after it one look is taken.

        Raises
        ------
        LineLost
            If the line is gone.
        """
        try:
            while True:
                data = bytes(self._serial.read(max(1, self._serial.in_waiting)))
                if data or time.monotonic() >= until_s:
                    return data
        except _BROKEN as error:
            raise self._lost("is gone", error) from None

    def pending(self) -> bytes:
        """Return what has come already, without waiting. Raises LineLost."""
        data = b""
        try:
            while self._serial.in_waiting:
                data += bytes(self._serial.read(self._serial.in_waiting))
        except _BROKEN as error:
            raise self._lost("is gone", error) from None
        return data

    def close(self) -> None:
        """Let go of the port."""
        try:
            self._serial.close()
        except _BROKEN as error:
            log.debug("%s: closing %s: %s", self._device, self._port, error)

    def _lost(self, what: str, error: BaseException) -> LineLost:
        words = getattr(error, "strerror", None) or " ".join(str(error).split()) or type(error).__name__
        return LineLost(f"port {self._port} {what} ({words[:160]})", device=self._device)


def _opened(port: str, baud: int) -> serial.SerialBase:
    """The pyserial port, for this program alone where the kind of port allows it."""
    if port.startswith("socket://"):
        return _SocketPort(port, timeout=SLICE_S, write_timeout=CONNECT_TIMEOUT_S)
    if urlsplit(port).scheme:  # rfc2217 refuses a write timeout, and a network port has no lock
        return serial.serial_for_url(port, baudrate=baud, timeout=SLICE_S)
    return serial.Serial(
        port, baudrate=baud, timeout=SLICE_S, write_timeout=CONNECT_TIMEOUT_S, exclusive=True
    )
