"""The ends of a simulated line that another program can open: a pseudo terminal or a TCP port.

On a pseudo terminal the host's bytes count only at the device's baud rate, as on a real line, and both
directions take 10 bits a byte.
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
from collections.abc import Sequence
from pathlib import Path

from drivers.clock import Clock
from drivers.errors import BadOptions
from drivers.faults import FaultPanel
from drivers.sim.wire.carrier import Line, Observer
from drivers.sim.wire.carrier import Reply as Reply
from drivers.sim.wire.carrier import WireDevice as WireDevice

_TCGETS2 = 0x802C542A  # asm-generic/ioctls.h; struct termios2: 4 flags, line, 19 characters, 2 speeds


class _KernelLine(Line):
    """A line whose host is beyond the kernel: its thread waits in real time."""

    def __init__(
        self,
        device: WireDevice,
        clock: Clock,
        faults: FaultPanel | None,
        wire_time: bool,
        observer: Observer | None,
    ) -> None:
        super().__init__(device, clock, faults, wire_time, observer)
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
    """A serial line as a pseudo terminal; a context manager.

    Raises BadOptions if ``link`` cannot be made there.

    Parameters
    ----------
    clock
        Time for the device: one that runs by itself (``SystemClock``), since the line waits in real time.
    link
        A stable path to make, a symbolic link to the terminal; one of the line's own when left out.
    wire_time
        Whether bytes take time and the host has to set the device's baud rate to be understood.

    Attributes
    ----------
    path
        What a host opens. It is gone while the line is hung up, and the same when it has come back.
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
        super().__init__(device, clock, faults, wire_time, observer)
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
        return self._understood(data, self._host_baud() if self._wire_time else 0)

    def _host_baud(self) -> int:
        """The speed that the host has set on its end."""
        state = fcntl.ioctl(self._slave, _TCGETS2, bytes(44))
        return int(struct.unpack_from("I", state, 40)[0])

    def _give(self, data: bytes) -> None:
        data = self._heard(data, self._host_baud() if self._wire_time else 0)
        try:
            os.write(self._master, data)
        except OSError as error:
            if error.errno not in (errno.EAGAIN, errno.EIO):
                raise


class TcpLine(_KernelLine):
    """A device behind a TCP port, one host at a time; a context manager.

    Raises BadOptions if it cannot listen there.

    Parameters are as of `PtyLine`; bytes usually take no time: the network is faster than the device.
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
        wire_time: bool = False,
        observer: Observer | None = None,
    ) -> None:
        super().__init__(device, clock, faults, wire_time, observer)
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
