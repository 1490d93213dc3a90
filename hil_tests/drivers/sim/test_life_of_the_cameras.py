"""Cameras with clocks of their own, lenses and a mount that move with the day's temperature."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from calib.files.mast_file import load_rig, save_rig
from calib.geometry.rigid import Rigid
from calib.geometry.sensor_mode import SensorMode
from drivers.clock import ManualClock
from drivers.errors import BadFrame, BadOptions, NoFreshFrame
from drivers.frame_times import Pairing, corrected, learned
from drivers.sim.camera_settings import STEP_K, CameraClock, ClockSettings, TemperatureSettings
from drivers.sim.render import Renderer
from drivers.sim.rover import SimulatedRover
from drivers.sim.scene import Scene
from drivers.sim.settings import simulation_settings
from mastctl.devices.frames import checked

pytestmark = pytest.mark.usefixtures("one_scene")

QUIET = {"read_noise_dn": 0, "shot_noise_dn": 0}
LEFT, RIGHT = "navcam_left", "navcam_right"


_MADE: list[SimulatedRover] = []


@pytest.fixture(autouse=True)
def closed() -> Iterator[None]:
    yield
    while _MADE:
        _MADE.pop().close()


def rover(rig: Path, **simulation: Any) -> tuple[SimulatedRover, ManualClock]:
    clock = ManualClock(1000.0)
    section = {"rover": rig.name, "seed": 5, "samples": 1, "cameras": QUIET, **simulation}
    _MADE.append(SimulatedRover(simulation_settings(section, rig.parent), clock))
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


@pytest.mark.parametrize("flip", [(False, False), (True, False)])
def test_a_part_of_a_rig_that_reads_a_part_of_its_sensor_counts_from_the_sensor(
    small_rig: Path, tmp_path: Path, flip: tuple[bool, bool]
) -> None:
    rig = load_rig(small_rig).rig
    width, height = rig.cameras[LEFT].model.size_px
    own = SensorMode((width, height), (100, 60, 2 * width, 2 * height), (1000, 900), flip)
    modal = replace(rig, cameras={**rig.cameras, LEFT: replace(rig.cameras[LEFT], sensor_mode=own)})
    save_rig(modal, tmp_path / "modal.yaml")
    modes = {LEFT: {"crop_px": [32, 24, 160, 128], "binning": [2, 1], "flip": "horizontal"}}
    device, _ = rover(tmp_path / "modal.yaml", sensor_modes=modes)
    told = SensorMode((80, 128), (164, 108, 320, 256), (1000, 900), (not flip[0], False))
    assert device.sensor_modes[LEFT] == told


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


def test_a_picture_asked_for_after_the_move_is_one_of_the_move_by_a_clock_that_is_ahead(
    small_rig: Path,
) -> None:
    """Naive: to take stamps for the host's time. `offset_s` takes back what is constant."""
    own = {LEFT: {"stamped_late_s": 0.5}}
    device, clock = rover(small_rig, clocks=own, head="dynamixel_x", cameras={**QUIET, "readout_s": 0.1})
    device.pan_tilt.move(0.3, -0.4)
    while device.pan_tilt.read().moving:
        clock.advance(0.01)
    settled_s = clock.now_s()
    naive = device.cameras[LEFT].next_frame(settled_s, 1.0)
    truth = device.frame_truth(LEFT, naive.sequence)
    assert naive.mid_exposure_s > settled_s > truth.mid_exposure_s
    assert abs(truth.pan_rad - 0.3) * 1290 > 5
    mended = corrected(device.cameras[LEFT], -0.5).next_frame(settled_s, 1.0)
    truth = device.frame_truth(LEFT, mended.sequence)
    assert mended.mid_exposure_s == pytest.approx(truth.mid_exposure_s, abs=1e-6)
    assert truth.mid_exposure_s > settled_s
    assert truth.pan_rad == pytest.approx(0.3, abs=3e-3)


@pytest.mark.parametrize("offset_s", [0.004, 0.03, 0.049])
def test_eyes_that_expose_apart_are_paired_with_their_nearest_all_day(
    small_rig: Path, offset_s: float
) -> None:
    device, clock = rover(small_rig, clocks={RIGHT: {"offset_s": offset_s, "drift_ppm": -40}})
    left, right = device.cameras[LEFT], device.cameras[RIGHT]
    for after_s in (1000.05, 1060.0, 1120.02):
        clock.advance(max(0.0, after_s - clock.now_s()))
        pairing = Pairing(LEFT, {RIGHT: learned(left, right)})
        moments = pairing.moments(after_s)
        frames = {name: device.cameras[name].next_frame(moments[name], 1.0) for name in (LEFT, RIGHT)}
        while again := pairing.again({name: Began(frame) for name, frame in frames.items()}):
            for name, moment_s in again.items():
                frames[name] = device.cameras[name].next_frame(moment_s, 1.0)
        times = [device.frame_truth(name, frame.sequence).mid_exposure_s for name, frame in frames.items()]
        assert abs(times[0] - times[1]) <= 0.05 + 0.002 + 40e-6 * 120


class Began:
    def __init__(self, frame: Any) -> None:
        self.sequence = frame.sequence
        self.exposure_began_s = frame.mid_exposure_s - frame.exposure_s / 2


def test_stamps_ahead_of_the_host_are_refused_and_the_hosts_own_are_not(small_rig: Path) -> None:
    fast = {LEFT: {"drift_ppm": 78}, RIGHT: {"drift_ppm": 78, "own_stamps": False}}
    device, clock = rover(small_rig, clocks=fast)
    clock.advance(600.0)
    asked_s = clock.now_s() - 0.2
    left, right = (device.cameras[name].next_frame(asked_s, 1.0) for name in (LEFT, RIGHT))
    assert checked(right, RIGHT, (256, 192), asked_s, clock.now_s()).sequence == right.sequence
    assert right.mid_exposure_s == device.frame_truth(RIGHT, right.sequence).mid_exposure_s
    with pytest.raises(BadFrame, match=r"stamped to end 0\.0\d+ s in the future"):
        checked(left, LEFT, (256, 192), asked_s, left.mid_exposure_s - 78e-6 * 600 + 0.03)


@pytest.mark.parametrize("drift_ppm", [-500.0, -37.0, 0.0, 37.0, 500.0])
@pytest.mark.parametrize("late_s", [0.0, 0.013, -0.2])
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


def test_stamps_are_turned_into_times_and_back() -> None:
    clock = CameraClock(ClockSettings(0.01, 123.0, 0.02), 5000.0)
    for true_s in (5000.0, 5000.5, 9000.25):
        assert clock.true_s(clock.stamp_s(true_s)) == pytest.approx(true_s, abs=2e-9)
    plain = CameraClock(ClockSettings(), 5000.0)
    assert (plain.stamp_s(7.1), plain.true_period_s(0.1)) == (7.1, 0.1)
    assert 7.1 < plain.true_s(7.1) < 7.1 + 2e-9


DAY = {"amplitude_k": 10.0, "period_s": 400.0}
"""A day of 400 s: noon, 10 K warmer than the mean, at 100 s."""


def test_the_day_is_a_sine_in_small_steps() -> None:
    day = TemperatureSettings(amplitude_k=10.0, period_s=400.0)
    times_s = np.linspace(0, 800, 333)
    found = np.array([day.change_k(t) for t in times_s])
    assert np.abs(found - 10 * np.sin(2 * np.pi * times_s / 400)).max() <= STEP_K / 2
    assert day.change_k(0.0) == 0.0
    from_noon = replace(day, phase_rad=np.pi / 2)
    assert [from_noon.change_k(t) for t in (0.0, 100.0, 200.0, 400.0)] == [10.0, 0.0, -10.0, 10.0]


def test_a_warm_lens_has_another_focal_length_and_centre(small_rig: Path) -> None:
    """By projecting points: at the centre, and to its right and below it."""
    device, _ = rover(small_rig)
    model = replace(device.rig.cameras[LEFT].model, kind="CAHV", R=np.zeros(3))
    day = TemperatureSettings(focal_ppm_per_k=50.0, centre_x_px_per_k=0.1, centre_y_px_per_k=-0.02)
    right = np.cross(model.A, np.cross(model.H, model.A))
    right /= np.linalg.norm(right)
    ahead, aside = model.C + 3 * model.A, model.C + 3 * model.A + 0.9 * right
    for is_right, sign in ((False, 1.0), (True, -1.0)):
        warm = day.camera(model, is_right, 8.0)
        centre, was_centre = warm.project(ahead)[0], model.project(ahead)[0]
        assert centre - was_centre == pytest.approx([sign * 0.8, -0.16], abs=1e-9)
        out, was_out = warm.project(aside)[0] - centre, model.project(aside)[0] - was_centre
        assert out == pytest.approx((1 + 400e-6) * was_out, rel=1e-9)
    assert day.camera(model, False, 0.0) is model


def test_pictures_show_the_warm_camera_and_the_truth_tells_of_it(small_rig: Path, scene: Scene) -> None:
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


def test_a_day_that_changes_the_camera_draws_no_stale_picture(small_rig: Path) -> None:
    """A head at rest: the same picture while a step of temperature lasts, another at the next one."""
    device, clock = rover(small_rig, temperature={**DAY, "centre_x_px_per_k": 1.0})
    pictures = {}
    for _ in range(6):
        clock.advance(0.4)  # a step lasts 0.4 s about the mean
        frame = device.cameras[LEFT].next_frame(clock.now_s(), 1.0)
        truth = device.frame_truth(LEFT, frame.sequence)
        key = truth.camera_in_rover.H.tobytes()
        assert np.array_equal(pictures.setdefault(key, frame.image), frame.image)
    assert len(pictures) >= 4
    assert len({image.tobytes() for image in pictures.values()}) == len(pictures)


def test_range_from_two_warm_eyes_is_off_as_their_centres_move_apart(small_rig: Path) -> None:
    """Mirrored mounts: 0.05 px/K in each eye is 1 px of disparity at 10 K, which is not seen by one eye."""
    day = TemperatureSettings(amplitude_k=10.0, centre_x_px_per_k=0.05, focal_ppm_per_k=0.0)
    device, _ = rover(small_rig)
    point = np.array([6.0, 0.0, -1.4])
    across = []
    for name, is_right in ((LEFT, False), (RIGHT, True)):
        model = device.rig.cameras[name].model
        across.append(day.camera(model, is_right, 10.0).project(point)[0] - model.project(point)[0])
    assert across[0][0] - across[1][0] == pytest.approx(1.0, abs=0.01)


def test_all_of_it_with_camera_faults(small_rig: Path) -> None:
    """A frozen camera stays frozen through the day, and a stuck one says how old its frame is."""
    own = {LEFT: {"offset_s": 0.02, "drift_ppm": 100, "stamped_late_s": 0.01}}
    device, clock = rover(small_rig, clocks=own, temperature=DAY)
    clock.advance(5.0)
    device.faults.set(LEFT, "frozen")
    images = []
    for _ in range(3):
        images.append(device.cameras[LEFT].next_frame(clock.now_s(), 1.0).image)
        clock.advance(20.0)
    assert all(np.array_equal(image, images[0]) for image in images)
    device.faults.clear(LEFT)
    device.faults.set(LEFT, "stuck")
    clock.advance(2.0)
    with pytest.raises(NoFreshFrame, match="came again and again"):
        device.cameras[LEFT].next_frame(clock.now_s(), 0.5)


@pytest.mark.parametrize(
    ("section", "words"),
    [
        ({"clocks": {"navcam_lfet": {}}}, "there is no camera 'navcam_lfet'; did you mean 'navcam_left'"),
        ({"sensor_modes": {"pancam": {}}}, "simulation.sensor_modes: there is no camera 'pancam'"),
        (
            {"sensor_modes": {LEFT: {"flip": "up"}}},
            "sensor_modes.navcam_left.flip is 'up', expected none",
        ),
        ({"sensor_modes": {LEFT: {"binning": [2]}}}, "binning is .2., expected 2 whole numbers from 1 to 64"),
        ({"sensor_modes": {LEFT: {"binning": [3, 1]}}}, "navcam_left: binning by 3 does not divide"),
        ({"sensor_modes": 3}, "simulation.sensor_modes is 3, expected crop_px, binning and flip"),
        ({"sensor_modes": {LEFT: 3}}, "simulation.sensor_modes.navcam_left is 3, expected keys and values"),
        ({"clocks": [1]}, "simulation.clocks is .1., expected keys and values by camera's name"),
        ({"clocks": {LEFT: {"drift": 3}}}, "simulation.clocks.navcam_left has no key 'drift'"),
        (
            {"clocks": {LEFT: {"drift_ppm": 900}}},
            "navcam_left.drift_ppm is 900.0, expected a number",
        ),
        (
            {"clocks": {LEFT: {"offset_s": -0.1}}},
            "navcam_left.offset_s is -0.1, expected a number from 0",
        ),
        ({"temperature": {"amplitude_k": math.inf}}, "simulation.temperature.amplitude_k is inf"),
        (
            {"temperature": {"period_s": 0}},
            "simulation.temperature.period_s is 0.0, expected a",
        ),
        ({"temperature": {"focal_ppm_per_K": 3}}, "has no key 'focal_ppm_per_K'; did you mean"),
    ],
)
def test_clocks_and_days_that_cannot_be_are_refused_in_words(
    small_rig: Path, section: dict[str, Any], words: str
) -> None:
    with pytest.raises(BadOptions, match=words):
        rover(small_rig, **section)


def test_a_rig_calibrated_in_a_part_of_its_sensor_is_simulated_in_that_mode(
    small_rig: Path, tmp_path: Path
) -> None:
    rig = load_rig(small_rig).rig
    size_px = rig.cameras[LEFT].model.size_px
    part = SensorMode(size_px, (40, 24, *size_px), (2 * size_px[0], 2 * size_px[1]))
    there = replace(rig.cameras[LEFT], sensor_mode=part)
    save_rig(replace(rig, cameras={**rig.cameras, LEFT: there}), tmp_path / "part.yaml")
    assert rover(tmp_path / "part.yaml")[0].sensor_modes[LEFT] == part
