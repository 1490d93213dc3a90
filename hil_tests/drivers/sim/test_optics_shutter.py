"""Smear and rolling shutter of a moving head, against renderings of every moment and every row."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from calib.geometry.rigid import Rigid
from drivers.clock import ManualClock
from drivers.interfaces import Frame
from drivers.sim.render import Renderer
from drivers.sim.rover import RoverModel
from drivers.sim.scene import Scene
from drivers.sim.settings import simulation_settings

pytestmark = pytest.mark.usefixtures("one_scene")

QUIET = {"read_noise_dn": 0, "shot_noise_dn": 0}
LONG_S, SHORT_S = 0.06, 0.005
ROW_TIME_S = 1e-4
EYE = "navcam_left"
APART_DN = 1.3
"""What four rays a pixel leave of the texture that is finer than a pixel."""


def rover(rig: Path, **cameras: object) -> tuple[RoverModel, ManualClock]:
    clock = ManualClock(100.0)
    section = {"rover": rig.name, "seed": 5, "samples": 2, "cameras": {**QUIET, **cameras}}
    return RoverModel(simulation_settings(section, rig.parent), clock), clock


def underway(rig: Path, exposure_s: float, **cameras: object) -> tuple[RoverModel, Frame]:
    """A frame from the middle of a long turn, the eye on the ground."""
    device, clock = rover(rig, exposure_s=exposure_s, **cameras)
    device.pan_tilt.move(-0.5, -0.7)
    clock.advance(5.0)
    device.pan_tilt.move(1.5, -0.7)
    clock.advance(1.2)
    return device, device.cameras[EYE].next_frame(clock.now_s(), 1.0)


def pose_at(device: RoverModel, time_s: float) -> Rigid:
    return device.rig.mast.rover_from_head(*device.true_joints(float(time_s)))


def seen(device: RoverModel, renderer: Renderer, times_s: np.ndarray) -> np.ndarray:
    """The mean light of moments."""
    model = device.rig.cameras[EYE].model
    return np.mean([renderer.image(model, pose_at(device, time_s), 2) for time_s in times_s], axis=0)


def rms_dn(image: np.ndarray, truth: np.ndarray) -> float:
    return float(np.sqrt(np.mean((image.astype(float) - truth)[10:] ** 2)))


def moments(begin_s: float, exposure_s: float, count: int = 60) -> np.ndarray:
    return begin_s + (np.arange(count) + 0.5) / count * exposure_s


def test_a_smear_is_the_mean_over_every_moment_of_the_exposure(small_rig: Path, scene: Scene) -> None:
    renderer = Renderer(scene)
    errors_dn = {}
    for smear in (True, False):
        device, frame = underway(small_rig, LONG_S, smear=smear)
        truth = seen(device, renderer, moments(frame.exposure_began_s, LONG_S))
        errors_dn[smear] = rms_dn(frame.image, truth)
    renderer.close()
    assert errors_dn[True] < APART_DN
    assert errors_dn[True] < 0.5 * errors_dn[False]


def test_each_row_of_a_rolling_shutter_is_seen_at_its_own_time(small_rig: Path, scene: Scene) -> None:
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
            poses = [pose_at(device, t) for t in (frame.exposure_began_s, begin_s)]
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


def test_at_rest_the_kind_of_shutter_makes_no_difference(small_rig: Path) -> None:
    pictures = []
    for cameras in ({}, {"smear": True, "row_time_s": ROW_TIME_S}):
        device, clock = rover(small_rig, **cameras)
        clock.advance(1.0)
        pictures.append(device.cameras[EYE].next_frame(clock.now_s(), 1.0).image)
    np.testing.assert_array_equal(pictures[0], pictures[1])
