"""The simulated rover with the real driver and bytes between: pictures follow the bytes, faults too."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from drivers.clock import Clock
from drivers.errors import DriverError
from drivers.faults import PAN_TILT
from drivers.hardware import DeviceSettings, HardwareSettings, clock_for
from drivers.interfaces import Reading
from drivers.open_hardware import open_hardware
from drivers.sim.rover import RoverModel
from hil_tests.waiting import until

pytestmark = pytest.mark.usefixtures("one_scene")


@contextmanager
def wired(rig: Path) -> Iterator[tuple[RoverModel, Clock]]:
    section = {"rover": rig.name, "seed": 5, "head": "dynamixel_x", "wire": "dynamixel", "speed": "max"}
    sim = DeviceSettings("sim")
    settings = HardwareSettings(sim, {"navcam_left": sim}, section, rig.parent)
    clock = clock_for(settings)
    with open_hardware(settings, clock) as hardware:
        rover = hardware.simulation
        assert rover is not None and hardware.pan_tilt is rover.pan_tilt and hardware.kind == "simulated"
        with clock.at_work():
            yield rover, clock


def settled(device: RoverModel, clock: Clock, pan: float, tilt: float) -> Reading:
    device.pan_tilt.move(pan, tilt)
    until(lambda: not device.pan_tilt.read().moving, "rest", clock=clock)
    return device.pan_tilt.read()


def fails(device: RoverModel) -> bool:
    try:
        device.pan_tilt.read()
    except DriverError:
        return True
    return False


def test_faults_of_the_rover_reach_line_and_axes(small_rig: Path) -> None:
    with wired(small_rig) as (device, clock):
        settled(device, clock, 0.1, 0.0)
        for word in ("off", "hang_up"):
            device.faults.set(PAN_TILT, word)
            until(lambda: fails(device), word, clock=clock)
            device.faults.clear()
            until(lambda: not fails(device), "an answer", clock=clock)
        device.faults.set(PAN_TILT, "stuck", axis=0)
        before = device.true_joints(clock.now_s())
        device.pan_tilt.move(0.4, -0.2)
        until(lambda: abs(device.true_joints(clock.now_s())[1] - before[1]) > 0.15, "tilt", clock=clock)
        assert device.true_joints(clock.now_s())[0] == before[0]


def test_the_same_moves_give_the_same_readings_to_the_last_bit(small_rig: Path) -> None:
    def readings_of_a_run() -> list[Reading]:
        with wired(small_rig) as (device, clock):
            device.pan_tilt.move(0.3, -0.2)
            readings = [device.pan_tilt.read() for _ in range(20)]
            return [*readings, settled(device, clock, -0.1, 0.1)]

    assert readings_of_a_run() == readings_of_a_run()
