"""The plain Dynamixel SDK as the host of a simulated bus, without a terminal between and on a clock by hand.

``DirectPort`` has the methods of the SDK's ``PortHandler``; bytes go straight to the bus. Packets are made
and read by the SDK, so nothing here knows the protocol.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from dynamixel_sdk import GroupSyncRead, PacketHandler

from drivers.clock import ManualClock
from drivers.sim.axis import AxisSettings, WireAxis
from drivers.sim.wire.dynamixel_bus import DynamixelBus
from drivers.sim.wire.dynamixel_servo import SimulatedServo

SETTINGS = AxisSettings(
    count_rad=math.tau / 4096,
    backlash_rad=0.0,
    low_rad=-math.pi,
    high_rad=math.pi,
    speed_rad_per_s=10.0,
    acceleration_rad_per_s2=100.0,
)


def axis(**options: Any) -> WireAxis:
    """A plain axis without backlash."""
    return WireAxis(SETTINGS, **options)


def servo(model: str, servo_id: int, *, on: WireAxis | None = None, **settings: int) -> SimulatedServo:
    """A servo at 1 Mbaud that answers at once."""
    quick: Mapping[str, int] = {"baud_rate": 3, "return_delay_time": 0, **settings}
    return SimulatedServo(model, servo_id, on or axis(), settings=quick)


class DirectPort:
    """Stands in for ``dynamixel_sdk.PortHandler``; an empty buffer is a timeout."""

    def __init__(self, bus: DynamixelBus, clock: ManualClock) -> None:
        self.bus = bus
        self.clock = clock
        self.is_using = False
        self.received = b""
        self.senders: list[int] = []
        self._buffer = b""

    def getBaudRate(self) -> int:
        return 1_000_000

    def clearPort(self) -> None:
        self._buffer = b""

    def writePort(self, packet: list[int]) -> int:
        replies = self.bus.receive(bytes(packet), self.clock.now_s())
        self.senders = [reply.sender for reply in replies]
        self.received = self._buffer = b"".join(reply.data for reply in replies)
        return len(packet)

    def readPort(self, length: int) -> list[int]:
        taken, self._buffer = self._buffer[:length], self._buffer[length:]
        return list(taken)

    def setPacketTimeout(self, packet_length: int) -> None:
        pass

    def setPacketTimeoutMillis(self, msec: float) -> None:
        pass

    def isPacketTimeout(self) -> bool:
        return not self._buffer


class Host:
    """The SDK's packet handler on a bus, with a clock that the test turns."""

    def __init__(self, *servos: SimulatedServo, **options: Any) -> None:
        self.clock = ManualClock()
        self.bus = DynamixelBus(servos, **options)
        self.port = DirectPort(self.bus, self.clock)
        self.sdk = PacketHandler(2.0)

    def wait(self, seconds: float, step_s: float = 0.005) -> None:
        """Let time pass as the line does, which polls the bus."""
        for _ in range(round(seconds / step_s)):
            self.clock.advance(step_s)
            self.bus.poll(self.clock.now_s())

    def read(self, servo_id: int, address: int, size: int) -> int:
        """A value, as signed as the SDK leaves it; the transaction has to succeed without an error."""
        data, result, error = self.sdk.readTxRx(self.port, servo_id, address, size)
        assert (result, error) == (0, 0), (result, error)
        return int.from_bytes(bytes(data), "little")

    def signed(self, servo_id: int, address: int, size: int) -> int:
        """As `read`, signed."""
        value = self.read(servo_id, address, size)
        return value - 256**size if value >= 256**size // 2 else value

    def status(self, servo_id: int, address: int, size: int) -> tuple[int, int]:
        """Result and error byte of a read. The SDK adds CRC bytes to the data of an error, so none here."""
        packet = [0] * 14
        packet[4:12] = [servo_id, 7, 0, 2, address & 255, address >> 8, size & 255, size >> 8]
        _, result, error = self.sdk.txRxPacket(self.port, packet)
        return result, error

    def write(self, servo_id: int, address: int, size: int, value: int) -> int:
        """Write and return the error byte; the transaction has to succeed."""
        data = list((value & (256**size - 1)).to_bytes(size, "little"))
        result, error = self.sdk.writeTxRx(self.port, servo_id, address, size, data)
        assert result == 0, result
        return int(error)

    def sync_read(self, address: int, size: int, *ids: int) -> tuple[int, dict[int, int]]:
        """The result, and the values of those that the SDK calls available."""
        group = GroupSyncRead(self.port, self.sdk, address, size)
        for servo_id in ids:
            assert group.addParam(servo_id)
        result = group.txRxPacket()
        there = [i for i in ids if group.isAvailable(i, address, size)]
        return result, {i: group.getData(i, address, size) for i in there}
