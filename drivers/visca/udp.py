"""VISCA over IP: each frame is a datagram with a number, which its answers bear. Source: Sony's manuals."""

from __future__ import annotations

import contextlib
import select
import socket
from urllib.parse import urlsplit

from drivers.errors import BadOptions, LineLost
from drivers.serial_line import USUAL_UDP_PORT

COMMAND, INQUIRY, CONTROL = b"\x01\x00", b"\x01\x10", b"\x02\x00"
RESET_NUMBER = b"\x01"


class UdpLine:
    """An open way to a head, a `drivers.serial_line.ByteLine` of whole frames; closing twice does no harm.

    A datagram without the number of the last one sent is dropped: a late answer, or a completion.

    Parameters
    ----------
    port
        ``udp://HOST`` or ``udp://HOST:PORT``.
    baud
        Means nothing here.
    device
        The head's name in errors.

    Raises
    ------
    BadOptions
        For a URL that cannot be.
    LineLost
        If there is no way to the host.
    """

    def __init__(self, port: str, baud: int, device: str = "") -> None:
        self.baud = baud
        self.byte_s = 0.0
        self._name, self._device, self._number = port, device, 0
        try:
            parts = urlsplit(port)
            place = (parts.hostname or "", USUAL_UDP_PORT if parts.port is None else parts.port)
        except ValueError:
            place = ("", 0)
        if not place[0]:
            raise BadOptions(f"{port} is not udp://HOST or udp://HOST:PORT", device=device)
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        try:
            self._socket.connect(place)
            self._socket.setblocking(False)
            self._socket.send(CONTROL + (1).to_bytes(2, "big") + bytes(4) + RESET_NUMBER)
        except OSError as error:
            self._socket.close()
            raise self._lost("opening it", error) from error

    def write(self, data: bytes) -> None:
        """Send frames, each with a number of its own. Raises LineLost."""
        try:
            for frame in data.split(b"\xff")[:-1]:
                body = frame + b"\xff"
                self._number = (self._number + 1) & 0xFFFFFFFF
                kind = INQUIRY if body[1] == 0x09 else COMMAND
                size, number = len(body).to_bytes(2, "big"), self._number.to_bytes(4, "big")
                self._socket.send(kind + size + number + body)
        except OSError as error:
            raise self._lost("writing", error) from error

    def read(self, wait_s: float) -> bytes:
        """Return a frame that answers what was sent last, if one has come or comes within ``wait_s``.

        Raises
        ------
        LineLost
            If the host refuses, or this end was closed.
        """
        try:
            if not select.select([self._socket], [], [], wait_s)[0]:
                return b""
            data = self._socket.recv(256)
        except (OSError, ValueError) as error:
            raise self._lost("reading", error) from error
        number = int.from_bytes(data[4:8], "big")
        return data[8:] if len(data) > 8 and data[:2] == b"\x01\x11" and number == self._number else b""

    def close(self) -> None:
        """Let go of it."""
        with contextlib.suppress(OSError):
            self._socket.close()

    def _lost(self, doing: str, error: Exception) -> LineLost:
        words = f"{self._name} failed in {doing}: {getattr(error, 'strerror', None) or error}"
        return LineLost(words, device=self._device, detail={"port": self._name, "while": doing})
