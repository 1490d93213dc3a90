"""A simulated line in memory: its host is in this process, and every wait runs on the clock that is given.

On a clock that is turned, a driver at one end and a simulator at the other need no real time.
"""

from __future__ import annotations

from collections import deque

from drivers.clock import Clock
from drivers.errors import LineLost
from drivers.faults import FaultPanel
from drivers.sim.wire.carrier import Line, Observer, WireDevice

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
        super().__init__(device, clock, faults, wire_time, observer)
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
