"""Cameras with clocks of their own, lenses and a mount that move with the day's temperature."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from calib.geometry.mode import SensorMode
from calib.geometry.rigid import Rigid
from drivers.clock import ManualClock
from drivers.sim.render import Renderer
from drivers.sim.rover import RoverModel
from drivers.sim.scene import Scene
from drivers.sim.settings import simulation_settings

pytestmark = pytest.mark.usefixtures("one_scene")

QUIET = {"read_noise_dn": 0, "shot_noise_dn": 0}
LEFT, RIGHT = "navcam_left", "navcam_right"


_MADE: list[RoverModel] = []


@pytest.fixture(autouse=True)
def closed() -> Iterator[None]:
    yield
    while _MADE:
        _MADE.pop().close()


def rover(rig: Path, **simulation: Any) -> tuple[RoverModel, ManualClock]:
    clock = ManualClock(1000.0)
    section = {"rover": rig.name, "seed": 5, "samples": 1, "cameras": QUIET, **simulation}
    _MADE.append(RoverModel(simulation_settings(section, rig.parent), clock))
    return _MADE[-1], clock


def test_a_camera_in_another_mode_shows_that_part_of_its_picture(small_rig: Path) -> None:
    full = rover(small_rig)[0].cameras[LEFT].next_frame(1000.0, 1.0).image
    modes = {LEFT: {"crop_px": [32, 24, 160, 128], "flip": "horizontal"}, RIGHT: {"binning": [2, 4]}}
    device, _ = rover(small_rig, sensor_modes=modes)
    part = device.cameras[LEFT].next_frame(1000.0, 1.0).image.astype(int)
    assert np.quantile(np.abs(part - full[24:152, 32:192][:, ::-1]), 0.99) <= 1
    size_px = full.shape[::-1]
    assert device.sensor_modes[LEFT] == SensorMode((160, 128), (32, 24, 160, 128), size_px, (True, False))
    assert device.sensor_modes[RIGHT] == SensorMode((128, 48), (0, 0, *size_px), size_px)
    assert device.cameras[RIGHT].next_frame(1000.0, 1.0).image.shape == (48, 128)


def test_a_camera_exposes_by_its_own_clock_and_stamps_by_it(small_rig: Path) -> None:
    """200 ppm fast: after 500 s a stamp is 0.1 s ahead, and by then the camera has taken one frame more."""
    device, clock = rover(small_rig, clocks={RIGHT: {"offset_s": 0.03, "drift_ppm": 200}})
    first = device.cameras[RIGHT].next_frame(1000.0, 1.0)
    assert first.sequence == 0
    assert device.frame_truth(RIGHT, 0).mid_exposure_s == pytest.approx(1000.034, abs=1e-6)
    clock.advance(1500.0 - clock.now_s())
    left, right = (device.cameras[name].next_frame(1499.9, 1.0) for name in (LEFT, RIGHT))
    truth = device.frame_truth(RIGHT, right.sequence)
    assert right.mid_exposure_s - truth.mid_exposure_s == pytest.approx(0.1, abs=1e-4)
    assert truth.mid_exposure_s == pytest.approx(1000.034 + right.sequence * 0.1 / (1 + 2e-4), abs=1e-6)
    assert left.mid_exposure_s == device.frame_truth(LEFT, left.sequence).mid_exposure_s


@pytest.mark.parametrize(("drift_ppm", "late_s"), [(-500.0, 0.013), (0.0, 0.0), (500.0, -0.2)])
def test_the_next_frame_is_never_the_one_that_was_had(
    small_rig: Path, drift_ppm: float, late_s: float
) -> None:
    """Asked for after its own stamp, whatever the rounding, also under a fault that slows the camera."""
    own = {LEFT: {"drift_ppm": drift_ppm, "stamped_late_s": late_s}}
    device, clock = rover(small_rig, clocks=own)
    device.faults.set(LEFT, "slow", factor=0.7, after_s=3.0)
    clock.advance(2.0)
    before = device.cameras[LEFT].next_frame(clock.now_s(), 1.0)
    for _ in range(20):
        frame = device.cameras[LEFT].next_frame(before.mid_exposure_s - before.exposure_s / 2, 1.0)
        assert frame.sequence > before.sequence
        assert frame.mid_exposure_s - frame.exposure_s / 2 > before.mid_exposure_s - before.exposure_s / 2
        before = frame


DAY = {"amplitude_k": 10.0, "period_s": 400.0}
"""A day of 400 s: noon, 10 K warmer than the mean, at 100 s."""


def test_pictures_and_frame_truth_show_the_warm_camera(small_rig: Path, scene: Scene) -> None:
    """A program that believes the morning's calibration at noon is off by what `frame_truth` says."""
    day = {**DAY, "centre_x_px_per_k": 0.5, "mount_tilt_rad_per_k": 5e-4, "mount_pan_rad_per_k": 2e-4}
    device, clock = rover(small_rig, temperature=day)
    clock.advance(100.0 - 0.05)
    camera = device.cameras[LEFT]
    frame = camera.next_frame(clock.now_s(), 1.0)
    truth = device.frame_truth(LEFT, frame.sequence)
    renderer = Renderer(scene)
    warm = renderer.image(truth.camera_in_rover, Rigid.identity(), 1)
    morning = device.rig.camera_in_rover(LEFT, truth.pan_rad, truth.tilt_rad)
    cold = renderer.image(morning, Rigid.identity(), 1)
    renderer.close()
    inside = np.s_[40:-8, 8:-8]
    assert np.abs(warm[inside] - frame.image[inside]).mean() < 1.0
    assert np.abs(cold[inside] - frame.image[inside]).mean() > 4.0
    point = device.true_point(LEFT, frame.sequence, (128.0, 150.0))
    assert point is not None
    off = morning.project(point)[0] - (128.0, 150.0)
    # 5 px to the left and less by the mount's pan of 2 mrad; the head leans up by 5 mrad, f = 322 px.
    assert off == pytest.approx([-5 + 0.002 * 322, -0.005 * 322 - 10 * 0.05], abs=0.3)
    frame = device.cameras[RIGHT].next_frame(clock.now_s(), 1.0)  # mounted the other way round
    truth = device.frame_truth(RIGHT, frame.sequence)
    point = device.true_point(RIGHT, frame.sequence, (128.0, 150.0))
    assert point is not None
    off = device.rig.camera_in_rover(RIGHT, truth.pan_rad, truth.tilt_rad).project(point)[0] - (128.0, 150.0)
    assert off[0] == pytest.approx(5 + 0.002 * 322, abs=0.3)
