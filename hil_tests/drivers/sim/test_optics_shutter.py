"""Smear and rolling shutter of a moving head, against renderings of every moment and every row."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from drivers.clock import ManualClock
from drivers.errors import BadOptions
from drivers.interfaces import Frame
from drivers.sim.render import Renderer
from drivers.sim.rover import SimulatedRover
from drivers.sim.scene import Scene
from drivers.sim.settings import simulation_settings
from mastctl.devices.joint_history import JointHistory

pytestmark = pytest.mark.usefixtures("one_scene")

QUIET = {"read_noise_dn": 0, "shot_noise_dn": 0}
LONG_S, SHORT_S = 0.06, 0.005
ROW_TIME_S = 1e-4
EYE = "navcam_left"
APART_DN = 1.3
"""What four rays a pixel leave of the texture that is finer than a pixel."""


def rover(rig: Path, **cameras: object) -> tuple[SimulatedRover, ManualClock]:
    clock = ManualClock(100.0)
    section = {"rover": rig.name, "seed": 5, "samples": 2, "cameras": {**QUIET, **cameras}}
    return SimulatedRover(simulation_settings(section, rig.parent), clock), clock


def underway(rig: Path, exposure_s: float, **cameras: object) -> tuple[SimulatedRover, Frame]:
    """A frame from the middle of a long turn, the eye on the ground."""
    device, clock = rover(rig, exposure_s=exposure_s, **cameras)
    device.pan_tilt.move(-0.5, -0.7)
    clock.advance(5.0)
    device.pan_tilt.move(1.5, -0.7)
    clock.advance(1.2)
    return device, device.cameras[EYE].next_frame(clock.now_s(), 1.0)


def seen(device: SimulatedRover, renderer: Renderer, times_s: np.ndarray) -> np.ndarray:
    """The mean light of moments."""
    model = device.rig.cameras[EYE].model
    return np.mean([renderer.image(model, device._pose(EYE, float(time_s)), 2) for time_s in times_s], axis=0)


def rms_dn(image: np.ndarray, truth: np.ndarray) -> float:
    return float(np.sqrt(np.mean((image.astype(float) - truth)[10:] ** 2)))


def moments(begin_s: float, exposure_s: float, count: int = 60) -> np.ndarray:
    return begin_s + (np.arange(count) + 0.5) / count * exposure_s


def test_a_smear_is_the_mean_over_every_moment_of_the_exposure_and_copies_are_not(
    small_rig: Path, scene: Scene
) -> None:
    renderer = Renderer(scene)
    errors_dn = {}
    for smear in (True, False):
        device, frame = underway(small_rig, LONG_S, smear=smear)
        truth = seen(device, renderer, moments(frame.exposure_began_s, LONG_S))
        errors_dn[smear] = rms_dn(frame.image, truth)
    renderer.close()
    assert errors_dn[True] < APART_DN
    assert errors_dn[True] < 0.5 * errors_dn[False]


def test_each_row_of_a_rolling_shutter_is_what_the_camera_saw_at_the_rows_own_time(
    small_rig: Path, scene: Scene
) -> None:
    device, frame = underway(small_rig, SHORT_S, smear=True, row_time_s=ROW_TIME_S)
    renderer = Renderer(scene)
    for row in (5, 90, 186):
        begin_s = frame.exposure_began_s + row * ROW_TIME_S
        own = seen(device, renderer, moments(begin_s, SHORT_S, 20))[row]
        first = seen(device, renderer, moments(frame.exposure_began_s, SHORT_S, 20))[row]
        assert np.sqrt(np.mean((frame.image[row] - own) ** 2)) < 3 * APART_DN, row
        if row > 50:
            # a program that takes all rows as exposed with the first is wrong by several pixels
            apart_px = shift_px(frame.image[row].astype(float), first)
            model = device.rig.cameras[EYE].model
            poses = [device._pose(EYE, t) for t in (frame.exposure_began_s, begin_s)]
            rays = model.ray(np.array([[128.0, row]]))
            ground_m = poses[0].points(rays.origins_m + 3.0 * rays.directions)
            moved_px = model.project(poses[1].inverse.points(ground_m))[0][0] - [128.0, row]
            assert apart_px == pytest.approx(moved_px[0], abs=0.6)
            assert abs(apart_px) > 2.0
    renderer.close()


def shift_px(row: np.ndarray, other: np.ndarray) -> float:
    """By how many columns a row's content lies to the right of another's, by the best correlation."""
    fine = np.arange(20, len(row) - 20)
    shifts = np.arange(-12, 12.01, 0.1)
    columns = np.arange(len(row))
    like = [np.corrcoef(np.interp(fine + s, columns, row), other[fine])[0, 1] for s in shifts]
    return float(shifts[int(np.argmax(like))])


def test_a_resting_head_is_seen_the_same_to_the_last_bit_whatever_its_shutter(small_rig: Path) -> None:
    pictures = []
    for cameras in ({}, {"smear": True, "row_time_s": ROW_TIME_S}):
        device, clock = rover(small_rig, **cameras)
        clock.advance(1.0)
        pictures.append(device.cameras[EYE].next_frame(clock.now_s(), 1.0).image)
    np.testing.assert_array_equal(*pictures)


def test_a_move_that_begins_while_the_last_rows_are_exposed_makes_the_frame_a_moving_one(
    small_rig: Path,
) -> None:
    """A program that counts the first row's exposure alone would measure in a sheared picture."""
    device, clock = rover(small_rig, exposure_s=0.008, smear=True, row_time_s=ROW_TIME_S)
    device.pan_tilt.move(0.0, -0.7)
    clock.advance(4.95)
    rest = device.cameras[EYE].next_frame(clock.now_s(), 1.0)
    history = JointHistory()
    clock.advance(0.1 - clock.now_s() % 0.1)
    begin_s = clock.now_s() + 0.1
    for step in range(80):
        clock.advance(0.1 - 0.004 if step == 0 else 0.001)
        if step == 14:  # 10 ms after the begin: the first 20 rows have been exposed
            device.pan_tilt.move(1.0, -0.7)
            history.move_sent(clock.now_s())
        history.add(device.pan_tilt.read())
    frame = device.cameras[EYE].next_frame(begin_s - 0.001, 1.0)
    assert frame.exposure_began_s == pytest.approx(begin_s, abs=1e-6)
    apart = np.abs(frame.image.astype(int) - rest.image)
    assert apart[:10].max() <= 1 and apart[-10:].max() > 2
    ended_s = frame.mid_exposure_s + frame.exposure_s / 2
    assert ended_s == pytest.approx(begin_s + 0.008 + 191 * ROW_TIME_S)
    assert history.at_exposure(begin_s, frame.mid_exposure_s, ended_s, "head").moving
    assert not history.at_exposure(begin_s, begin_s + 0.004, begin_s + 0.008, "head").moving


@pytest.mark.parametrize(
    ("cameras", "words"),
    [
        ({"row_time_s": -1e-6}, "row_time_s is -1e-06, expected 0 to 0.001"),
        ({"smear": "yes"}, "smear is 'yes', expected true or false"),
        ({"lens": {"f_stop": 8}}, "simulation.cameras.lens has no key 'f_stop'"),
        ({"exposure": {"auto": True}}, "exposure.auto needs exposure.reference_s above 0"),
        ({"jpeg_quality": 101}, "jpeg_quality is 101, expected 0 to 100"),
        ({"row_time_s": 0.0009}, "0.1799 s for all rows of a picture does not fit rate_hz 10"),
    ],
)
def test_settings_that_cannot_be_are_refused_by_name(small_rig: Path, cameras: dict, words: str) -> None:
    with pytest.raises(BadOptions) as refused:
        rover(small_rig, **cameras)
    assert words in str(refused.value)
