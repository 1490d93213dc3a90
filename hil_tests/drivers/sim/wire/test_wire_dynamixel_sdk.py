"""The plain SDK, unchanged, on a real pseudo terminal in front of the simulated bus.

It has its own port, its own waits and the machine's time, so that all of it needs a kernel.
"""

from __future__ import annotations

import pytest
from dynamixel_easy_sdk import Connector, DxlRuntimeError, OperatingMode

from drivers.clock import SystemClock
from drivers.sim.wire.dynamixel_bus import DynamixelBus
from drivers.sim.wire.line import PtyLine
from hil_tests.drivers.sim.wire.dynamixel_host import servo
from hil_tests.waiting import until

PATIENT_MS = 20_000


@pytest.fixture(autouse=True)
def patient(monkeypatch: pytest.MonkeyPatch) -> None:
    """The SDK waits 34 ms; a busy machine may take longer to wake the line's thread."""
    monkeypatch.setattr("dynamixel_sdk.port_handler.LATENCY_TIMER", PATIENT_MS)


@pytest.mark.parametrize("model", ["xm430_w350", "xl330_m288", "mx_28", "ph54_200_s500"])
def test_the_makers_easy_sdk_drives_each_kind_of_model(model: str) -> None:
    """``dynamixel_easy_sdk`` finds registers in the wheel's tables by model number, not in ours."""
    bus = DynamixelBus([servo(model, 7)])
    with PtyLine(bus, SystemClock()) as line:
        connector = Connector(line.path, 1_000_000)
        motor = connector.createMotor(7)
        assert motor.model_name == f"{model}.model"
        with pytest.raises(DxlRuntimeError):
            motor.setOperatingMode(OperatingMode.VELOCITY)
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
