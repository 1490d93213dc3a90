"""The simulated rover with the real driver and bytes between: pictures follow the bytes, faults too."""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest

from drivers.clock import Clock, ManualClock
from drivers.errors import BadOptions, DriverError
from drivers.faults import PAN_TILT
from drivers.hardware import DeviceSettings, HardwareSettings, clock_for
from drivers.interfaces import Reading
from drivers.open_hardware import open_hardware
from drivers.sim.render import Renderer
from drivers.sim.rover import SimulatedRover
from drivers.sim.scene import Scene
from drivers.sim.settings import simulation_settings
from hil_tests.left_behind import held
from hil_tests.waiting import NET_S, until

pytestmark = pytest.mark.usefixtures("one_scene")

NOISE_DN = 2.2
"""Mean square of the noise at the brightest ground, as a level."""

# What a settled reading may be off the true angle: the count, half the backlash, and the sag.
WIRES = {
    "dynamixel_x": ("dynamixel", 0.0016 + 0.0022 + 1e-4),
    "ph42": ("dynamixel", 0.0009 + 1e-4),
    "ptu_d46_70": ("flir_ptu", 0.00006 + 0.0001 + 1e-4),
}


@contextmanager
def wired(
    rig: Path, head: str, speed: int | str = "max", **options: object
) -> Iterator[tuple[SimulatedRover, Clock]]:
    section = {"rover": rig.name, "seed": 5, "head": {"preset": head, **options}, "wire": WIRES[head][0]}
    sim = DeviceSettings("sim")
    settings = HardwareSettings(sim, {"navcam_left": sim}, {**section, "speed": speed}, rig.parent)
    clock = clock_for(settings)
    with open_hardware(settings, clock) as hardware:
        rover = hardware.simulation
        assert rover is not None and hardware.pan_tilt is rover.pan_tilt and hardware.kind == "simulated"
        with clock.at_work():
            yield rover, clock


def settled(device: SimulatedRover, clock: Clock, pan: float, tilt: float) -> Reading:
    device.pan_tilt.move(pan, tilt)
    until(lambda: not device.pan_tilt.read().moving, "rest", clock=clock)
    return device.pan_tilt.read()


def fails(device: SimulatedRover) -> bool:
    try:
        device.pan_tilt.read()
    except DriverError:
        return True
    return False


@pytest.mark.parametrize(
    ("head", "speed"), [*((head, "max") for head in WIRES), ("dynamixel_x", 1), ("ptu_d46_70", 1)]
)
def test_pictures_are_taken_from_where_the_bytes_sent_the_axes(
    small_rig: Path, scene: Scene, head: str, speed: int | str
) -> None:
    before = held()
    with wired(small_rig, head, speed) as (device, clock):
        reading = settled(device, clock, 0.3, -0.4)
        now_s = clock.now_s()
        true = device.true_joints(now_s)
        for read, truly, goal in zip((reading.pan_rad, reading.tilt_rad), true, (0.3, -0.4), strict=True):
            assert abs(read - truly) < WIRES[head][1] and abs(truly - goal) < WIRES[head][1]
        frame = device.cameras["navcam_left"].next_frame(now_s, NET_S)
        model = device.rig.cameras["navcam_left"].model
        renderer = Renderer(scene)
        errors = []
        for joints in (true, (0.0, 0.0)):
            clean = renderer.image(model, device.rig.mast.rover_from_head(*joints), 2)
            errors.append(float(np.sqrt(np.mean((clean - frame.image) ** 2))))
        renderer.close()
        assert errors[0] < NOISE_DN < 4 * NOISE_DN < errors[1]
    assert held() <= before


@pytest.mark.parametrize("head", ["dynamixel_x", "ptu_d46_70"])
def test_faults_of_the_rover_reach_line_and_axes(small_rig: Path, head: str) -> None:
    with wired(small_rig, head) as (device, clock):
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


@pytest.mark.parametrize("head", ["ph42", "ptu_d46_70"])
def test_behind_bytes_a_head_reads_wrong_hangs_in_its_play_and_settles_all_the_same(
    small_rig: Path, head: str
) -> None:
    options = {
        "backlash_rad": 0.004,
        "approach_rad": 0.01,
        "ring_hz": 9.0,
        "ring_damping": 0.2,
        "settle_s": 1.0,
    }
    options |= {"tilt_harmonics_rad": [[0.003, 0.0]], "gravity_turnover_rad": -0.3, "gravity_friction": 0.05}
    with wired(small_rig, head, **options) as (device, clock):
        for tilt, side in ((-0.6, -1), (0.1, 1), (-0.5, -1)):
            reading = settled(device, clock, 0.1, tilt)
            true = device.true_joints(clock.now_s())[1]
            off = true - reading.tilt_rad
            expected = 0.003 * math.cos(reading.tilt_rad) + side * 0.002 - 5e-5 * math.cos(true)
            assert off == pytest.approx(expected, abs=3e-5)


@pytest.mark.parametrize("head", WIRES)
def test_on_the_simulations_clock_the_same_moves_give_the_same_readings_to_the_last_bit(
    small_rig: Path, head: str
) -> None:
    def told() -> list[Reading]:
        with wired(small_rig, head) as (device, clock):
            device.pan_tilt.move(0.3, -0.2)
            readings = [device.pan_tilt.read() for _ in range(20)]
            return [*readings, settled(device, clock, -0.1, 0.1)]

    assert told() == told()


def test_a_wire_needs_a_clock_that_goes_on_by_itself(small_rig: Path) -> None:
    settings = simulation_settings({"rover": small_rig.name, "wire": "dynamixel"}, small_rig.parent)
    assert settings.head.name == "dynamixel_x"
    with pytest.raises(BadOptions, match="needs a clock that goes on by itself"):
        SimulatedRover(settings, ManualClock())
