"""The simulated rover: pictures from where the head truly was, and the truth that experiments ask for."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from calib.files.mast_file import load_rig
from drivers.clock import ManualClock
from drivers.errors import BadOptions
from drivers.sim.render import Renderer
from drivers.sim.rover import RoverModel
from drivers.sim.scene import Scene
from drivers.sim.settings import simulation_settings

pytestmark = pytest.mark.usefixtures("one_scene")

NOISE_DN = 2.2
"""Mean square of the noise at the brightest ground, as a level."""


def rover(rig: Path, **simulation: object) -> tuple[RoverModel, ManualClock]:
    clock = ManualClock(100.0)
    settings = simulation_settings({"rover": rig.name, "seed": 5, **simulation}, rig.parent)
    return RoverModel(settings, clock), clock


def settle(device: RoverModel, clock: ManualClock, pan: float, tilt: float) -> None:
    device.pan_tilt.move(pan, tilt)
    for _ in range(2000):
        if not device.pan_tilt.read().moving:
            return
        clock.advance(0.01)
    raise AssertionError("the head never settled")


def test_pictures_are_taken_from_the_true_angles_not_the_read_ones(small_rig: Path, scene: Scene) -> None:
    # A gap of 0.02 rad is 6 px of the small Navcam: it cannot hide in the noise.
    device, clock = rover(small_rig, head={"backlash_rad": 0.02, "approach_rad": 0.05})
    settle(device, clock, 0.3, -0.4)
    reading = device.pan_tilt.read()
    frame = device.cameras["navcam_left"].next_frame(clock.now_s(), 1.0)
    renderer = Renderer(scene)
    model = device.rig.cameras["navcam_left"].model
    errors = {}
    for name, joints in (("true", (0.3 - 0.01, -0.4 - 0.01)), ("read", (reading.pan_rad, reading.tilt_rad))):
        clean = renderer.image(model, device.rig.mast.rover_from_head(*joints), 2)
        errors[name] = float(np.sqrt(np.mean((clean - frame.image) ** 2)))
    renderer.close()
    assert errors["true"] < NOISE_DN < 4 * NOISE_DN < errors["read"]


def test_truth_of_a_frame_gives_point_and_pixel_both_ways(small_rig: Path, scene: Scene) -> None:
    device, clock = rover(small_rig)
    settle(device, clock, 0.2, -0.5)
    frame = device.cameras["navcam_left"].next_frame(clock.now_s(), 1.0)
    truth = device.frame_truth("navcam_left", frame.sequence)
    assert truth.mid_exposure_s == frame.mid_exposure_s
    assert (truth.pan_rad, truth.tilt_rad) == device.true_joints(frame.mid_exposure_s)
    pixel = np.array([70.3, 120.8])
    point = device.true_point("navcam_left", frame.sequence, pixel)
    assert point is not None
    assert device.true_pixel("navcam_left", frame.sequence, point) == pytest.approx(pixel, abs=1e-6)
    # Independently of the ray cast: the point lies on the ground, within the relief.
    assert abs(point[2] - scene.ground_z_m(point[0], point[1])) < 1e-3
    sky = device.cameras["navcam_left"].next_frame(clock.now_s(), 1.0)
    settle(device, clock, 0.2, 0.4)
    sky = device.cameras["navcam_left"].next_frame(clock.now_s(), 1.0)
    assert device.true_point("navcam_left", sky.sequence, (128.0, 40.0)) is None
    behind = np.array([-10.0, 0.0, 0.0])
    assert np.isnan(device.true_pixel("navcam_left", sky.sequence, behind)).all()


def test_a_rover_that_is_put_somewhere_stands_on_the_ground_there(small_rig: Path, scene: Scene) -> None:
    device, _ = rover(small_rig)
    pose = device.stand(2.0, -1.0, 0.5, 0.1, -0.05)
    assert device.site_from_rover == pose
    assert pose.translation_m == pytest.approx([2.0, -1.0, scene.ground_z_m(2.0, -1.0)])
    assert pose.rotation == pytest.approx(Rotation.from_euler("ZYX", [0.5, 0.1, -0.05]).as_matrix())
    assert pose.vectors([1.0, 0.0, 0.0])[2] < 0, "the nose is up, and down is positive"
    with pytest.raises(BadOptions, match=r"\(28\.1, 0\) m is off the simulated ground"):
        device.stand(28.1, 0.0, 0.0)


@pytest.mark.parametrize("name", ["rocky8", "skew8"])
def test_the_shipped_mast_file_is_near_the_true_rig_but_not_the_same(repository: Path, name: str) -> None:
    true_rig = load_rig(repository / "configs" / "sim" / f"{name}.yaml")
    stored = load_rig(repository / "configs" / "masts" / f"{name}_simulated.yaml")
    assert stored.rig.provenance["true_rig_digest"] == true_rig.digest, "the mast file is of another true rig"
    true_mast, mast = true_rig.rig.mast, stored.rig.mast
    assert 1e-5 < np.abs(mast.translation_m - true_mast.translation_m).max() < 0.01
    assert 1e-6 < np.abs(mast.rotation_rad - true_mast.rotation_rad).max() < 0.005
    assert (mast.axis_offset_m != 0) == (true_mast.axis_offset_m != 0)
    assert set(stored.rig.cameras) == set(true_rig.rig.cameras)
    assert not stored.notes and not true_rig.notes
    for camera, true_camera in true_rig.rig.cameras.items():
        assert not np.array_equal(stored.rig.cameras[camera].model.H, true_camera.model.H)
