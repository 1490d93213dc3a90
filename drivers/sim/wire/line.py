"""The ends of a simulated line: a pseudo terminal or a TCP port for any program, or memory for this process.

On a pseudo terminal the host's bytes count only at the device's baud rate, as on a real line, and both
directions take 10 bits a byte. A line in memory waits on the clock that it is given: on one that is turned, a
driver at one end and a simulator at the other need no real time.
"""

from __future__ import annotations

import contextlib
import errno
import fcntl
import os
import select
import shutil
import socket
import struct
import tempfile
import tty
from abc import abstractmethod
from collections import deque
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from drivers.clock import Clock
from drivers.errors import BadOptions, LineLost
from drivers.faults import FaultPanel
from drivers.sim.wire.carrier import Line, Observer, WireDevice

_TCGETS2 = 0x802C542A  # asm-generic/ioctls.h; struct termios2: 4 flags, line, 19 characters, 2 speeds
PATH = "memory"
ROOM_BYTES = 4096
"""What waits for a host that does not read; more is lost, as on a pseudo terminal."""


class MemoryLine(Line):
    """A serial line in memory; a context manager."""

    path = PATH

    def __init__(
        self,
        device: WireDevice,
        clock: Clock,
        faults: FaultPanel | None = None,
        *,
        wire_time: bool = True,
        observer: Observer | None = None,
    ) -> None:
        super().__init__(device, clock, faults, wire_time=wire_time, observer=observer)
        self._host: MemoryEnd | None = None
        self._sent: deque[tuple[bytes, int]] = deque()  # by hosts, each at its speed
        self._woken = False
        self._thread.start()

    def open(self, port: str, baud: int, device: str = "") -> MemoryEnd:
        """Return the host's end of the line, a `drivers.serial_line.ByteLine`; arguments as of `SerialLine`.

        Raises LineLost if another host has it, it is hung up, or ``port`` is another.
        """
        detail = {"port": port, "while": "opening it"}
        if port != self.path or not self._up:
            raise LineLost(f"{port} cannot be opened: no such file", device=device, detail=detail)
        if self._host is not None and self._host.state == "open":
            raise LineLost(f"{port} cannot be opened: held by another program", device=device, detail=detail)
        self._host = MemoryEnd(self, self._clock, baud, device)
        return self._host

    def put(self, data: bytes, baud: int) -> None:
        """Take bytes of a host."""
        with self._changed:
            self._sent.append((data, baud))
            self._changed.notify_all()

    def _connect(self) -> None:
        pass

    def _disconnect(self) -> None:
        if self._host is not None:
            self._host.end("hung up")
            self._host = None
        self._sent.clear()

    def _listen(self, wait_s: float) -> bytes:
        with self._changed:
            if not (self._sent or self._woken):
                self._changed.wait(wait_s, idle=True)
            self._woken = False
            if not self._sent:
                return b""
            data, baud = self._sent.popleft()
        return self._understood(data, baud)

    def _wake(self) -> None:
        with self._changed:
            self._woken = True
            self._changed.notify_all()

    def _give(self, data: bytes) -> None:
        if self._host is not None:
            self._host.take(self._heard(data, self._host.baud))


class MemoryEnd:
    """The host's end of a line in memory (`drivers.serial_line.ByteLine`); closing twice does no harm."""

    def __init__(self, line: MemoryLine, clock: Clock, baud: int, device: str) -> None:
        self.port = line.path
        self.baud = baud
        self.byte_s = 10.0 / baud
        self.state = "open"
        self._line = line
        self._clock = clock
        self._device = device
        self._arrived = clock.signal()
        self._buffer = bytearray()

    def write(self, data: bytes) -> None:
        """Send bytes. Raises LineLost."""
        self._check("writing")
        self._line.put(data, self.baud)

    def read(self, wait_s: float) -> bytes:
        """Return the bytes that have come or come within ``wait_s``, as soon as there are any; else none.

        Raises LineLost.
        """
        until_s = self._clock.now_s() + wait_s
        with self._arrived:
            while True:
                self._check("reading")
                left_s = until_s - self._clock.now_s()
                if self._buffer or left_s <= 0:
                    data = bytes(self._buffer)
                    self._buffer.clear()
                    return data
                self._arrived.wait(left_s)

    def close(self) -> None:
        """Let go of the line, whatever state it is in."""
        self.end("closed")

    def take(self, data: bytes) -> None:
        """Take bytes of the device; what there is no room for is lost."""
        with self._arrived:
            self._buffer += data[: ROOM_BYTES - len(self._buffer)]
            self._arrived.notify_all()

    def end(self, state: str) -> None:
        """Have every call fail from now on."""
        with self._arrived:
            if self.state == "open":
                self.state = state
            self._arrived.notify_all()

    def _check(self, doing: str) -> None:
        if self.state != "open":
            message = f"{self.port} {self.state} (unplugged?)"
            raise LineLost(message, device=self._device, detail={"port": self.port, "while": doing})


class _KernelLine(Line):
    """A line whose host is beyond the kernel: its thread waits in real time."""

    def __init__(self, *line: Any, **options: Any) -> None:
        super().__init__(*line, **options)
        self._wake_read, self._wake_write = os.pipe()

    @abstractmethod
    def _readable(self) -> list[int]:
        """The descriptors that may have something for ``_take``."""

    @abstractmethod
    def _take(self, ready: Sequence[int]) -> bytes:
        """As `_listen`, of descriptors that have something."""

    def _listen(self, wait_s: float) -> bytes:
        ends = self._readable() if self._up else []
        ready = select.select([self._wake_read, *ends], [], [], wait_s)[0]
        if self._wake_read in ready:
            os.read(self._wake_read, 4096)
        return self._take(ready) if self._up else b""

    def _wake(self) -> None:
        os.write(self._wake_write, b"x")

    def _dismantle(self) -> None:
        os.close(self._wake_read)
        os.close(self._wake_write)


class PtyLine(_KernelLine):
    """A serial line as a pseudo terminal; a context manager. Its clock has to run by itself.

    A host opens ``path``: the symbolic link ``link``, or one of the line's own. It is gone while the line is
    hung up, and the same when it has come back. With ``wire_time`` bytes take time, and the host has to set
    the device's baud rate to be understood. Raises BadOptions if the link cannot be made there.
    """

    def __init__(
        self,
        device: WireDevice,
        clock: Clock,
        faults: FaultPanel | None = None,
        *,
        link: str | Path | None = None,
        wire_time: bool = True,
        observer: Observer | None = None,
    ) -> None:
        super().__init__(device, clock, faults, wire_time=wire_time, observer=observer)
        self._folder: str | None = None
        if link is None:
            self._folder = tempfile.mkdtemp(prefix="mastctl-line-")
            link = Path(self._folder) / "tty"
        self.path = str(link)
        self._master = self._slave = -1
        try:
            self._connect()
        except OSError as error:
            self._disconnect()
            self._dismantle()
            raise BadOptions(
                f"the link {self.path} to a simulated line cannot be made: {error.strerror}"
            ) from None
        self._thread.start()

    def _connect(self) -> None:
        self._master, self._slave = os.openpty()
        tty.setraw(self._slave)  # no echo, no line editing, before a host opens it
        os.set_blocking(self._master, False)
        target, link = os.ttyname(self._slave), Path(self.path)
        if link.is_symlink() and str(link.readlink()).startswith("/dev/pts/"):
            link.unlink()  # left by a simulator that was killed
        link.symlink_to(target)

    def _disconnect(self) -> None:
        if self._slave < 0:
            return
        link = Path(self.path)
        with contextlib.suppress(OSError):
            if str(link.readlink()) == os.ttyname(self._slave):
                link.unlink()
        # The slave end is held open until here: without any, the master could not be read between two hosts.
        os.close(self._slave)
        os.close(self._master)
        self._master = self._slave = -1

    def _dismantle(self) -> None:
        super()._dismantle()
        if self._folder is not None:
            shutil.rmtree(self._folder, ignore_errors=True)

    def _readable(self) -> list[int]:
        return [self._master]

    def _take(self, ready: Sequence[int]) -> bytes:
        if self._master not in ready:
            return b""
        data = os.read(self._master, 4096)
        return self._understood(data, self._host_baud())

    def _host_baud(self) -> int:
        """The speed that the host has set on its end."""
        state = fcntl.ioctl(self._slave, _TCGETS2, bytes(44))
        return int(struct.unpack_from("I", state, 40)[0])

    def _give(self, data: bytes) -> None:
        data = self._heard(data, self._host_baud())
        try:
            os.write(self._master, data)
        except OSError as error:
            if error.errno not in (errno.EAGAIN, errno.EIO):
                raise


class TcpLine(_KernelLine):
    """A device behind a TCP port, one host at a time; bytes take no time. A context manager.

    Port 0 is any free one. Raises BadOptions if it cannot listen there.
    """

    def __init__(
        self,
        device: WireDevice,
        clock: Clock,
        faults: FaultPanel | None = None,
        host: str = "127.0.0.1",
        port: int = 0,
        *,
        banner: bytes = b"",
        observer: Observer | None = None,
    ) -> None:
        super().__init__(device, clock, faults, wire_time=False, observer=observer)
        self.host, self.port = host, port
        self._banner = banner
        self._listener: socket.socket | None = None
        self._connection: socket.socket | None = None
        try:
            self._connect()
        except (OSError, OverflowError) as error:
            self._disconnect()
            self._dismantle()
            raise BadOptions(f"cannot listen at {host}:{port}: {error}") from None
        self._thread.start()

    def _connect(self) -> None:
        family = socket.AF_INET6 if ":" in self.host else socket.AF_INET
        listener = self._listener = socket.socket(family, socket.SOCK_STREAM)
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        listener.bind((self.host, self.port))
        listener.listen(1)
        listener.setblocking(False)
        self.port = listener.getsockname()[1]

    def _disconnect(self) -> None:
        self._drop()
        if self._listener is not None:
            self._listener.close()
            self._listener = None

    def _drop(self) -> None:
        """Let the host go; replies that are still under way are lost."""
        if self._connection is not None:
            self._connection.close()
            self._connection = None
            self._schedule.clear()

    def _readable(self) -> list[int]:
        ends = [self._listener, self._connection]
        return [end.fileno() for end in ends if end is not None]

    def _take(self, ready: Sequence[int]) -> bytes:
        if self._listener is not None and self._listener.fileno() in ready:
            self._accept()
            return b""
        if self._connection is None or self._connection.fileno() not in ready:
            return b""
        try:
            data = self._connection.recv(4096)
        except BlockingIOError:
            return b""
        except OSError:
            data = b""
        if not data:
            self._drop()
        return data

    def _accept(self) -> None:
        assert self._listener is not None
        try:
            connection, _ = self._listener.accept()
        except OSError:
            return
        if self._connection is not None:
            connection.close()  # taken
            return
        connection.setblocking(False)
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._connection = connection
        if self._banner:
            self._give(self._banner)

    def _give(self, data: bytes) -> None:
        if self._connection is None:
            return
        try:
            self._connection.send(data)
        except BlockingIOError:
            pass
        except OSError:
            self._drop()
