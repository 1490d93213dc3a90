"""Servos that lose power or restart under the real driver: it comes back by itself and moves nothing."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable
from typing import Any

import pytest

from drivers.clock import SystemClock
from drivers.dynamixel.head import open_head
from drivers.errors import DriverError
from drivers.interfaces import PanTilt, Reading
from drivers.sim.wire.dynamixel_bus import DynamixelBus
from drivers.sim.wire.dynamixel_servo import SimulatedServo
from drivers.sim.wire.line import PtyLine
from hil_tests.drivers.sim.wire.dynamixel_host import axis, servo

PATIENCE_S = 30.0
FALLEN_RAD = -0.9


def until(head: PanTilt, fits: Callable[[Reading], bool]) -> Reading:
    """Read until a reading fits; faults meanwhile are what is expected."""
    end_s = time.monotonic() + PATIENCE_S
    while True:
        try:
            reading = head.read()
            if fits(reading):
                return reading
        except DriverError as error:
            assert time.monotonic() < end_s, error
        assert time.monotonic() < end_s
        time.sleep(0.02)


def moved(head: PanTilt, pan_rad: float, tilt_rad: float) -> None:
    """Move and wait; `stop` arms a watchdog anew that a busy machine has let expire."""
    end_s = time.monotonic() + PATIENCE_S
    while True:
        try:
            head.move(pan_rad, tilt_rad)
            while True:
                reading = head.read()
                if (
                    not reading.moving
                    and abs(reading.pan_rad - pan_rad) + abs(reading.tilt_rad - tilt_rad) < 2e-3
                ):
                    return
                if reading.faults or time.monotonic() > end_s:
                    break
                time.sleep(0.02)
        except DriverError as error:
            assert time.monotonic() < end_s, error
        assert time.monotonic() < end_s, head.read()
        with contextlib.suppress(DriverError):
            head.stop()


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
    clock = SystemClock()
    now_s = clock.now_s()
    pan, tilt = axis(time_s=now_s), axis(time_s=now_s, number=1, falls_to_rad=FALLEN_RAD)
    servos = [servo("xm430_w350", 1, on=pan), servo("xm430_w350", 2, on=tilt)]
    bus = DynamixelBus(servos)

    def held_still() -> bool:
        on = all(one.table["torque_enable"] for one in servos)
        return on and tilt.velocity_rad_per_s(clock.now_s()) == 0.0

    with PtyLine(bus, clock) as line:
        options: dict[str, Any] = {
            "port": line.path,
            "reply_timeout_s": 0.3,
            "watchdog_s": 0.4,
            "acceleration_rad_per_s2": 15.0,
            "pan": {"id": 1, "model": "XM430-W350", "limits_rad": [-2, 2]},
            "tilt": {"id": 2, "model": "XM430-W350", "limits_rad": [-1, 1]},
        }
        head = open_head(options)
        try:
            moved(head, 0.4, 0.3)
            with bus.held():
                happens(servos, clock.now_s())
            until(head, lambda r: not r.moving and held_still())
            held = [one.angle_rad(clock.now_s()) for one in (pan, tilt)]
            assert held[0] == pytest.approx(0.4, abs=1e-3)  # friction held it
            assert FALLEN_RAD <= held[1] < 0.3  # it fell until the driver had switched the torque on
            for one in servos:
                assert one.table["bus_watchdog"] != 0  # armed again
                assert one.table["profile_velocity"] > 0
                assert one.table["profile_acceleration"] > 0
            # Nothing moves until it is told to.
            time.sleep(0.3)
            until(head, lambda r: not r.moving)
            assert [one.angle_rad(clock.now_s()) for one in (pan, tilt)] == held
            moved(head, -0.2, -0.1)
        finally:
            head.close()
