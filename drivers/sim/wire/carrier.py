"""What every simulated line does: its thread, wire time, what faults make of replies; ends are in ``line``.

A device is a pure state machine (``WireDevice``): bytes and a time in, replies out. A line owns the one
thread that carries bytes to it and from it.
"""

from __future__ import annotations

import heapq
import itertools
import logging
import threading
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Literal, Protocol, Self

from drivers.clock import Clock
from drivers.faults import PAN_TILT, Fault, FaultPanel

log = logging.getLogger(__name__)

MOST_NOISE = 12
"""The longest garbage in front of a reply, bytes."""

POLL_S = 0.005
"""How often a device is polled for what it sends by itself, and the faults of the line are looked at."""

_BITS_PER_BYTE = 10  # 8N1: start, eight, stop

Observer = Callable[[Literal["host", "device"], bytes, float], None]
"""Called in the line's thread with the sender, the bytes, and when they were through."""


@dataclass(frozen=True)
class Reply:
    """Bytes that a simulated device sends, a whole packet or line of text.

    ``delay_s`` counts from the end of what it answers: of the received packet, or of the reply before it.
    ``sender`` is the servo's id; 0 for a pan/tilt unit; below 0 for an adapter's echo, which has no faults.
    By ``late_s`` a fault brings it late to the host; the line is free meanwhile.
    """

    data: bytes
    delay_s: float = 0.0
    sender: int = 0
    late_s: float = 0.0


class LineFaults:
    """The faults of one line, taken from a panel; without a panel there are none."""

    def __init__(self, panel: FaultPanel | None, device: object = None) -> None:
        self._panel = panel
        self._renamed = getattr(device, "renamed", None)  # of a device whose replies name their sender
        self._held: list[Reply] = []  # a reply that waits to change places with the next one

    def hung_up(self, time_s: float) -> bool:
        """Return whether the cable is pulled."""
        return self._panel is not None and self._panel.find(PAN_TILT, "hang_up", time_s) is not None

    def deaf(self, time_s: float) -> bool:
        """Return whether the device has no power to hear anything."""
        return self._panel is not None and self._panel.find(PAN_TILT, "off", time_s) is not None

    def apply(self, replies: Sequence[Reply], time_s: float) -> list[Reply]:
        """Return what goes out for the replies of one moment, in this order."""
        panel = self._panel
        if panel is None:
            return list(replies)
        sent: list[Reply] = []
        for reply in replies:
            if reply.sender < 0:
                sent.append(reply)
                continue
            if self.deaf(time_s) or panel.strikes(PAN_TILT, time_s):
                continue
            if panel.takes(PAN_TILT, "mute", time_s, reply.sender):
                continue
            one = self._damaged(panel, reply, time_s)
            if not self._held and panel.takes(PAN_TILT, "swapped", time_s, reply.sender):
                self._held = [one]
                continue
            sent += [one, *self._held]
            self._held = []
            if panel.takes(PAN_TILT, "duplicate", time_s, reply.sender):
                sent.append(replace(one, delay_s=0.0))
        return sent

    def _damaged(self, panel: FaultPanel, reply: Reply, time_s: float) -> Reply:
        """A reply of another sender, with a wrong byte, cut short, with garbage in front, or late."""
        data, late_s = reply.data, 0.0
        if (fault := panel.takes(PAN_TILT, "misnamed", time_s, reply.sender)) and self._renamed:
            data = self._renamed(data, int(fault.number("as_id")))
        if data and (fault := panel.takes(PAN_TILT, "corrupt", time_s, reply.sender)):
            place = _below(panel, fault, len(data))
            changed = data[place] ^ (1 + _below(panel, fault, 255))
            data = data[:place] + bytes([changed]) + data[place + 1 :]
        if panel.takes(PAN_TILT, "half", time_s, reply.sender):
            data = data[: max(1, len(data) // 2)]
        if fault := panel.takes(PAN_TILT, "noise", time_s, reply.sender):
            size = 1 + _below(panel, fault, MOST_NOISE)
            data = bytes(_below(panel, fault, 256) for _ in range(size)) + data
        if fault := panel.find(PAN_TILT, "delayed", time_s):
            late_s += fault.number("delay_s")
        if fault := panel.takes(PAN_TILT, "late", time_s, reply.sender):
            late_s += fault.number("delay_s")
        return replace(reply, data=data, late_s=late_s)


def _below(panel: FaultPanel, fault: Fault, bound: int) -> int:
    """A whole number from 0 to under ``bound``."""
    return int(panel.draw(fault) * bound)


class WireDevice(Protocol):
    """Everything at the device's end of a line, as a state machine without threads and without sleeping.

    The line calls it from one thread, with times that never run backwards.
    """

    @property
    def baud(self) -> int:
        """Bits a second that it listens and answers at, now."""
        ...

    def receive(self, data: bytes, time_s: float) -> Sequence[Reply]:
        """Take bytes, in chunks of any size, and return what it answers."""
        ...

    def poll(self, time_s: float) -> Sequence[Reply]:
        """Return what it sends by itself, or at last sends for an answer that it delayed."""
        ...


class Line(ABC):
    """The thread, the schedule of bytes on the wire, and the faults of the replies; ends are subclasses."""

    def __init__(
        self,
        device: WireDevice,
        clock: Clock,
        faults: FaultPanel | None,
        *,
        wire_time: bool,
        observer: Observer | None,
    ) -> None:
        self.device = device
        self._clock = clock
        self._faults = LineFaults(faults, device)
        self._wire_time = wire_time
        self._observer = observer
        self._schedule: list[tuple[float, int, bool, bytes]] = []  # when, order, to the device?, bytes
        self._order = itertools.count()
        self._to_device_free_s = self._to_host_free_s = -float("inf")
        self._changed = clock.signal()
        self._up = self._wanted_up = True
        self._closing = self._ended = False
        self._thread = clock.thread(self._run, "simulated line")

    def hang_up(self) -> None:
        """Break the connection, as if the cable were pulled; return when it is broken."""
        self._want(up=False)

    def come_back(self) -> None:
        """Make the connection again; return when it can be opened."""
        self._want(up=True)

    def close(self) -> None:
        """End the thread and let go of what the line holds; a second call does nothing."""
        if self._closing:
            return
        self._closing = True
        self._wake()
        with self._changed:
            while not self._ended:
                self._changed.wait()
        self._thread.join()  # it waits for nothing any more
        self._disconnect()
        self._dismantle()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *raised: object) -> None:
        self.close()

    @abstractmethod
    def _connect(self) -> None:
        """Make the end that a host can open."""

    @abstractmethod
    def _disconnect(self) -> None:
        """Break it; nothing if it is broken."""

    def _dismantle(self) -> None:  # noqa: B027  # memory has nothing
        """Let go of what outlives a hang-up."""

    @abstractmethod
    def _listen(self, wait_s: float) -> bytes:
        """Wait until the host sends, `_wake` is called, or so long at most; return what the host has sent,
        empty for nothing that the device would understand."""

    @abstractmethod
    def _wake(self) -> None:
        """End a `_listen` that is under way, or the next one; from any thread."""

    @abstractmethod
    def _give(self, data: bytes) -> None:
        """Hand bytes to the host; what it does not make room for is lost, as on a real line."""

    def _understood(self, data: bytes, host_baud: int) -> bytes:
        """What is left for the device of bytes that a host sends at a speed."""
        if not self._wire_time:
            return data
        if hasattr(self.device, "host_baud"):  # a bus, with devices of several baud rates
            self.device.host_baud = host_baud
        return data if host_baud == self.device.baud else b""  # else framing errors only

    def _heard(self, data: bytes, host_baud: int) -> bytes:
        """What a host that listens at a speed takes for the device's bytes."""
        if self._wire_time and host_baud != self.device.baud:
            return bytes(byte ^ 0xA5 for byte in data)
        return data

    def _want(self, up: bool) -> None:
        with self._changed:
            self._wanted_up = up
            self._changed.notify_all()  # for a thread that waits for the opposite, which does not come now
        if self._closing or threading.current_thread() is self._thread:
            return
        self._wake()
        with self._changed:
            while self._up != up and self._wanted_up == up and not self._ended:
                self._changed.wait()

    def _run(self) -> None:
        """Carry bytes until the line is closed."""
        while not self._closing:
            now_s = self._clock.now_s()
            try:
                self._follow(now_s)
                wait_s = POLL_S
                if self._schedule:
                    wait_s = min(wait_s, max(0.0, self._schedule[0][0] - self._clock.now_s()))
                data = self._listen(wait_s)
                if data:
                    self._arrive(data, self._clock.now_s())
            except Exception:  # a defect of the simulator must show, and not end the line in silence
                log.exception("the simulated line stumbled")
                self._clock.sleep(POLL_S)
        with self._changed:
            self._ended = True
            self._changed.notify_all()

    def _follow(self, now_s: float) -> None:
        """Hang up or come back, poll the device, and carry out what is due."""
        up = self._wanted_up and not self._faults.hung_up(now_s)
        if up != self._up:
            if up:
                self._connect()
            else:
                self._disconnect()
                self._schedule.clear()
            with self._changed:
                self._up = up
                self._changed.notify_all()
        while self._schedule and self._schedule[0][0] <= now_s:
            time_s, _, to_device, data = heapq.heappop(self._schedule)
            if to_device:
                self._deliver(data, time_s)
            else:
                self._send(data, time_s)
        self._answer(self.device.poll(now_s), now_s)

    def _wire_s(self, size: int) -> float:
        return size * _BITS_PER_BYTE / self.device.baud if self._wire_time else 0.0

    def _arrive(self, data: bytes, now_s: float) -> None:
        """Bytes have left the host; they are through to the device after their wire time."""
        through_s = max(now_s, self._to_device_free_s) + self._wire_s(len(data))
        self._to_device_free_s = through_s
        if through_s <= now_s:
            self._deliver(data, now_s)
        else:
            heapq.heappush(self._schedule, (through_s, next(self._order), True, data))

    def _deliver(self, data: bytes, time_s: float) -> None:
        if self._observer is not None:
            self._observer("host", data, time_s)
        if self._faults.deaf(time_s):
            return
        self._answer(self.device.receive(data, time_s), time_s)

    def _answer(self, replies: Sequence[Reply], time_s: float) -> None:
        """Put replies on the wire one after the other, as the faults leave them."""
        if not replies or not self._up:
            return
        for sent in self._faults.apply(replies, time_s):
            start_s = max(time_s, self._to_host_free_s) + sent.delay_s
            through_s = start_s + self._wire_s(len(sent.data))
            self._to_host_free_s = through_s
            through_s += sent.late_s
            if through_s <= time_s:
                self._send(sent.data, time_s)
            else:
                heapq.heappush(self._schedule, (through_s, next(self._order), False, sent.data))

    def _send(self, data: bytes, time_s: float) -> None:
        if self._observer is not None:
            self._observer("device", data, time_s)
        if self._up:
            self._give(data)
