"""Servos that lose power or restart under the real driver: it comes back by itself and moves nothing."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from typing import Any

import pytest

from drivers.dynamixel.head import open_head
from drivers.errors import DriverError
from drivers.sim.wire.dynamixel_bus import DynamixelBus
from drivers.sim.wire.dynamixel_servo import SimulatedServo
from drivers.sim.wire.memory_line import MemoryLine
from hil_tests.drivers.sim.wire.dynamixel_host import axis, servo
from hil_tests.drivers.turned import turned

FALLEN_RAD = -0.9


def lost_power(servos: list[SimulatedServo], now_s: float) -> None:
    for one in servos:
        one.set_power(False, now_s)
        one.set_power(True, now_s)


def restarted(servos: list[SimulatedServo], now_s: float) -> None:
    for one in servos:
        one.reboot(now_s)


@pytest.mark.parametrize("happens", [lost_power, restarted])
def test_the_driver_comes_back_without_moving(
    happens: Callable[[list[SimulatedServo], float], None],
) -> None:
    with turned() as it:
        now_s = it.now_s()
        pan, tilt = axis(time_s=now_s), axis(time_s=now_s, number=1, falls_to_rad=FALLEN_RAD)
        servos = [servo("xm430_w350", 1, on=pan), servo("xm430_w350", 2, on=tilt)]

        def held_still() -> bool:
            on = all(one.table["torque_enable"] for one in servos)
            return on and tilt.velocity_rad_per_s(it.now_s()) == 0.0

        def rests() -> bool:
            with suppress(DriverError):  # what is expected meanwhile
                return not head.read().moving and held_still()
            return False

        with MemoryLine(DynamixelBus(servos), it.clock) as line:
            options: dict[str, Any] = {
                "port": line.path,
                "watchdog_s": 0.4,
                "acceleration_rad_per_s2": 15.0,
                "pan": {"id": 1, "model": "XM430-W350", "limits_rad": [-2, 2]},
                "tilt": {"id": 2, "model": "XM430-W350", "limits_rad": [-1, 1]},
            }
            head = open_head(options, it.clock, line.open)
            try:
                head.move(0.4, 0.3)
                reading = it.settled(head)
                assert (reading.pan_rad, reading.tilt_rad) == pytest.approx((0.4, 0.3), abs=2e-3)
                happens(servos, it.now_s())
                it.until(rests, "rest")
                held = [one.angle_rad(it.now_s()) for one in (pan, tilt)]
                assert held[0] == pytest.approx(0.4, abs=1e-3)  # friction held it
                assert FALLEN_RAD <= held[1] < 0.3  # it fell until the driver had switched the torque on
                for one in servos:
                    assert one.table["bus_watchdog"] != 0  # armed again
                    assert one.table["profile_velocity"] > 0
                    assert one.table["profile_acceleration"] > 0
                # Nothing moves until it is told to.
                it.clock.sleep(3.0)
                assert it.settled(head).faults == ()
                assert [one.angle_rad(it.now_s()) for one in (pan, tilt)] == held
                head.move(-0.2, -0.1)
                reading = it.settled(head)
                assert (reading.pan_rad, reading.tilt_rad) == pytest.approx((-0.2, -0.1), abs=2e-3)
            finally:
                head.close()
