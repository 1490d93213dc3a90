"""The plain SDK, unchanged, on a real pseudo terminal in front of the simulated bus.

It has its own port, its own waits and the machine's time, so that all of it needs a kernel.
"""

from __future__ import annotations

from collections.abc import Iterator

import pytest
from dynamixel_easy_sdk import Connector, DxlRuntimeError, OperatingMode
from dynamixel_sdk import (
    COMM_SUCCESS,
    GroupBulkRead,
    GroupSyncRead,
    GroupSyncWrite,
    PacketHandler,
    PortHandler,
)

from drivers.clock import SystemClock
from drivers.sim.wire.dynamixel_bus import DynamixelBus
from drivers.sim.wire.dynamixel_models import MODELS
from drivers.sim.wire.line import PtyLine
from hil_tests.drivers.sim.wire.dynamixel_host import servo
from hil_tests.waiting import until

SDK = PacketHandler(2.0)
PATIENT_MS, IMPATIENT_MS = 20_000, 16


@pytest.fixture(autouse=True)
def patient(monkeypatch: pytest.MonkeyPatch) -> None:
    """The SDK waits 34 ms; a busy machine may take longer to wake the line's thread."""
    monkeypatch.setattr("dynamixel_sdk.port_handler.LATENCY_TIMER", PATIENT_MS)


@pytest.fixture
def impatient(patient: None, monkeypatch: pytest.MonkeyPatch) -> None:
    """The SDK's own 34 ms, for silence; what shall be heard is asked for until it comes."""
    monkeypatch.setattr("dynamixel_sdk.port_handler.LATENCY_TIMER", IMPATIENT_MS)


def heard(port: PortHandler, servo_id: int) -> bool:
    """Whether a ping is answered."""
    return bool(SDK.ping(port, servo_id)[1] == COMM_SUCCESS)


def until_heard(port: PortHandler, servo_id: int) -> None:
    """Ping until there is an answer."""
    until(lambda: heard(port, servo_id), f"an answer of servo {servo_id}")


@pytest.fixture
def port() -> Iterator[PortHandler]:
    """An open port; id 1 is an XL330, id 2 a PH54, id 3 an MX-106, all at 1 Mbaud."""
    bus = DynamixelBus([servo("xl330_m288", 1), servo("ph54_200_s500", 2), servo("mx_106", 3)])
    with PtyLine(bus, SystemClock()) as line:
        handler = PortHandler(line.path)
        assert handler.openPort()
        assert handler.setBaudRate(1_000_000)
        yield handler
        handler.closePort()


def until_holds(port: PortHandler, servo_id: int, address: int, value: int) -> None:
    """Read 4 bytes until they hold the value."""
    until(lambda: SDK.read4ByteTxRx(port, servo_id, address) == (value, COMM_SUCCESS, 0), f"{value}")


def test_ping_and_broadcast_ping(port: PortHandler) -> None:
    assert SDK.ping(port, 2) == (2020, COMM_SUCCESS, 0)
    everybody = {1: [1200, 52], 2: [2020, 14], 3: [321, 45]}
    # its window is the SDK's own, which a busy machine may miss
    until(lambda: SDK.broadcastPing(port) == (everybody, COMM_SUCCESS), "all three")


def test_both_move_and_are_read_together(port: PortHandler) -> None:
    assert SDK.write1ByteTxRx(port, 1, 64, 1) == (COMM_SUCCESS, 0)
    assert SDK.write1ByteTxRx(port, 3, 64, 1) == (COMM_SUCCESS, 0)
    goals = GroupSyncWrite(port, SDK, 116, 4)
    for servo_id, goal in ((1, 2248), (3, 1848)):
        assert goals.addParam(servo_id, list(goal.to_bytes(4, "little")))
    assert goals.txPacket() == COMM_SUCCESS
    until_holds(port, 1, 132, 2248)
    until_holds(port, 3, 132, 1848)
    both = GroupSyncRead(port, SDK, 132, 4)
    assert both.addParam(3)
    assert both.addParam(1)
    assert both.txRxPacket() == COMM_SUCCESS
    assert [both.getData(i, 132, 4) for i in (1, 3)] == [2248, 1848]


def test_bulk_and_fast_reads(port: PortHandler) -> None:
    bulk = GroupBulkRead(port, SDK)
    assert bulk.addParam(2, 592, 3)
    assert bulk.addParam(1, 132, 4)
    for read in (bulk.txRxPacket, bulk.fastBulkRead):
        assert read() == COMM_SUCCESS
        assert [bulk.getData(2, 592, 2), bulk.getData(2, 594, 1), bulk.getData(1, 132, 4)] == [240, 35, 2048]
    fast = GroupSyncRead(port, SDK, 0, 7)
    assert fast.addParam(2)
    assert fast.addParam(1)
    assert fast.fastSyncRead() == COMM_SUCCESS
    assert [fast.getData(i, 0, 2) for i in (1, 2)] == [1200, 2020]


def test_errors_come_through(port: PortHandler) -> None:
    assert SDK.write1ByteTxRx(port, 1, 64, 1) == (COMM_SUCCESS, 0)
    assert SDK.write1ByteTxRx(port, 1, 11, 4) == (COMM_SUCCESS, 7)
    assert SDK.write4ByteTxRx(port, 1, 116, 5000) == (COMM_SUCCESS, 6)
    assert SDK.write1ByteTxRx(port, 1, 68, 3) == (COMM_SUCCESS, 4)
    assert SDK.write2ByteTxRx(port, 1, 116, 1) == (COMM_SUCCESS, 5)


def test_reboot(port: PortHandler, monkeypatch: pytest.MonkeyPatch) -> None:
    assert SDK.write1ByteTxRx(port, 1, 65, 1) == (COMM_SUCCESS, 0)
    assert SDK.read1ByteTxRx(port, 1, 65) == (1, COMM_SUCCESS, 0)
    assert SDK.reboot(port, 1) == (COMM_SUCCESS, 0)
    monkeypatch.setattr("dynamixel_sdk.port_handler.LATENCY_TIMER", IMPATIENT_MS)  # it boots, and is silent
    until(lambda: SDK.read1ByteTxRx(port, 1, 65) == (0, COMM_SUCCESS, 0), "its return")


@pytest.mark.usefixtures("impatient")
def test_the_wrong_baud_rate_is_silence(port: PortHandler) -> None:
    assert port.setBaudRate(57600)
    assert SDK.ping(port, 1)[1] != COMM_SUCCESS
    assert port.setBaudRate(1_000_000)
    until_heard(port, 1)


@pytest.mark.usefixtures("impatient")
def test_servos_of_different_baud_rates_on_one_line() -> None:
    bus = DynamixelBus([servo("xm430_w350", 1), servo("xm430_w350", 2, baud_rate=1)])
    with PtyLine(bus, SystemClock()) as line:
        handler = PortHandler(line.path)
        for baud, there in ((57600, 2), (1_000_000, 1), (2_000_000, 0)):
            assert handler.setBaudRate(baud)
            if there:
                until_heard(handler, there)
            assert all(SDK.ping(handler, i)[1] != COMM_SUCCESS for i in (1, 2) if i != there)

        def changes() -> bool:
            """Tell it the other rate; only its answer there shows that it was heard in time."""
            assert handler.setBaudRate(57600)
            SDK.write1ByteTxRx(handler, 2, 8, 3)
            assert handler.setBaudRate(1_000_000)
            return heard(handler, 2)

        until(changes, "servo 2 at its new rate")
        assert bus.servos[1].table["baud_rate"] == 3
        handler.closePort()


@pytest.mark.parametrize("model", sorted(MODELS))
def test_the_makers_easy_sdk_drives_every_model(model: str) -> None:
    """``dynamixel_easy_sdk`` finds registers in the wheel's tables by model number, not in ours."""
    bus = DynamixelBus([servo(model, 7)])
    with PtyLine(bus, SystemClock()) as line:
        connector = Connector(line.path, 1_000_000)
        motor = connector.createMotor(7)
        assert motor.model_name == f"{model}.model"
        motor.setOperatingMode(OperatingMode.VELOCITY)
        motor.enableTorque()
        motor.setGoalVelocity(20)
        until(lambda: motor.getPresentVelocity() == 20, "its speed")
        motor.setGoalVelocity(0)
        with pytest.raises(DxlRuntimeError):
            motor.setGoalVelocity(motor.getVelocityLimit() + 1)
        motor.disableTorque()
        motor.setMaxPositionLimit(3000)
        assert motor.getMaxPositionLimit() == 3000
        motor.setOperatingMode(OperatingMode.POSITION)
        motor.enableTorque()
        with pytest.raises(DxlRuntimeError):
            motor.setGoalPosition(3001)
        goal = motor.getPresentPosition() - 10
        motor.setGoalPosition(goal)
        until(lambda: motor.getPresentPosition() == goal, "its goal")
        assert motor.isTorqueOn() == 1
        connector.closePort()
