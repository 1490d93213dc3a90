"""The simulated rover: pictures from where the head truly was, and the truth that experiments ask for."""

from __future__ import annotations

import threading
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from calib.files.mast_file import load_rig
from calib.geometry.rigid import Rigid, rot_z
from drivers.clock import ManualClock
from drivers.errors import BadOptions, NoFreshFrame, NoReply
from drivers.sim.render import Renderer
from drivers.sim.rover import TRUTH_FRAMES, SimulatedRover
from drivers.sim.scene import Scene
from drivers.sim.settings import simulation_settings

pytestmark = pytest.mark.usefixtures("one_scene")

NOISE_DN = 2.2
"""Mean square of the noise at the brightest ground, as a level."""


def rover(rig: Path, **simulation: object) -> tuple[SimulatedRover, ManualClock]:
    clock = ManualClock(100.0)
    settings = simulation_settings({"rover": rig.name, "seed": 5, **simulation}, rig.parent)
    return SimulatedRover(settings, clock), clock


def settle(device: SimulatedRover, clock: ManualClock, pan: float, tilt: float) -> None:
    device.pan_tilt.move(pan, tilt)
    for _ in range(2000):
        if not device.pan_tilt.read().moving:
            return
        clock.advance(0.01)
    raise AssertionError("the head never settled")


def test_pictures_are_taken_from_the_mechanical_angles_not_the_read_ones(
    small_rig: Path, scene: Scene
) -> None:
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


def test_truth_follows_the_rover_when_it_stands_elsewhere(small_rig: Path, scene: Scene) -> None:
    device, clock = rover(small_rig)
    device.site_from_rover = Rigid(rot_z(0.4), np.array([1.0, -0.5, 0.0]))
    settle(device, clock, 0.0, -0.5)
    frame = device.cameras["navcam_left"].next_frame(clock.now_s(), 1.0)
    point = device.true_point("navcam_left", frame.sequence, (128.0, 96.0))
    assert point is not None
    in_site = device.site_from_rover.points(point)
    assert abs(in_site[2] - scene.ground_z_m(in_site[0], in_site[1])) < 1e-3
    assert device.true_pixel("navcam_left", frame.sequence, point) == pytest.approx((128.0, 96.0), abs=1e-6)


def test_a_rover_that_is_put_somewhere_stands_on_the_ground_there(small_rig: Path, scene: Scene) -> None:
    device, _ = rover(small_rig)
    pose = device.stand(2.0, -1.0, 0.5, 0.1, -0.05)
    assert device.site_from_rover == pose
    assert pose.translation_m == pytest.approx([2.0, -1.0, scene.ground_z_m(2.0, -1.0)])
    assert pose.rotation == pytest.approx(Rotation.from_euler("ZYX", [0.5, 0.1, -0.05]).as_matrix())
    assert pose.vectors([1.0, 0.0, 0.0])[2] < 0, "the nose is up, and down is positive"
    with pytest.raises(BadOptions, match=r"\(28\.1, 0\) m is off the simulated ground"):
        device.stand(28.1, 0.0, 0.0)


def test_a_moving_head_blurs_its_cameras_but_not_those_on_the_body(small_rig: Path) -> None:
    device, clock = rover(small_rig, cameras={"exposure_s": 0.05, "read_noise_dn": 0, "shot_noise_dn": 0})
    device.pan_tilt.move(2.5, -0.6)
    clock.advance(1.5)
    moving = {n: device.cameras[n].next_frame(clock.now_s(), 1.0) for n in ("navcam_left", "hazcam_left")}
    truth = device.frame_truth("navcam_left", moving["navcam_left"].sequence)
    device.pan_tilt.stop()
    clock.advance(2.0)
    settle(device, clock, truth.pan_rad, truth.tilt_rad)
    still = {n: device.cameras[n].next_frame(clock.now_s(), 1.0) for n in moving}
    across = {n: np.abs(np.diff(f.image[100:].astype(float), axis=1)).mean() for n, f in moving.items()}
    across_still = {n: np.abs(np.diff(f.image[100:].astype(float), axis=1)).mean() for n, f in still.items()}
    assert across["navcam_left"] < 0.7 * across_still["navcam_left"]
    np.testing.assert_array_equal(moving["hazcam_left"].image, still["hazcam_left"].image)


def test_the_same_seed_gives_the_same_pictures(small_rig: Path) -> None:
    pictures = []
    for seed in (5, 5, 6):
        device, clock = rover(small_rig, seed=seed)
        settle(device, clock, 0.1, -0.3)
        pictures.append(device.cameras["pancam_right"].next_frame(clock.now_s(), 1.0).image)
    np.testing.assert_array_equal(pictures[0], pictures[1])
    assert (pictures[0] != pictures[2]).any()


def test_frames_nobody_fetched_and_those_long_ago_have_no_truth(small_rig: Path) -> None:
    device, clock = rover(small_rig)
    frame = device.cameras["hazcam_left"].next_frame(clock.now_s(), 1.0)
    device.frame_truth("hazcam_left", frame.sequence)
    for camera, sequence in (("hazcam_left", frame.sequence + 1), ("mastcam_left", 0)):
        with pytest.raises(LookupError, match="is not remembered"):
            device.frame_truth(camera, sequence)
    for sequence in range(1000, 1000 + TRUTH_FRAMES):
        device._remember("hazcam_left", sequence, clock.now_s())
    with pytest.raises(LookupError):
        device.frame_truth("hazcam_left", frame.sequence)
    device.frame_truth("hazcam_left", 1000)


def test_cameras_may_be_asked_from_different_threads(small_rig: Path) -> None:
    device, clock = rover(small_rig)
    settle(device, clock, 0.1, -0.3)
    asked_s = clock.now_s()
    found: dict[str, int] = {}

    def fetch(name: str) -> None:
        found[name] = device.cameras[name].next_frame(asked_s, 5.0).sequence

    threads = [threading.Thread(target=fetch, args=(name,)) for name in device.cameras]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(60)
    assert set(found) == set(device.cameras) and len(set(found.values())) == 1


def test_a_closed_rover_stops_its_head_and_gives_no_frames(small_rig: Path) -> None:
    device, clock = rover(small_rig)
    device.pan_tilt.move(1.0, 0.2)
    clock.advance(0.3)
    device.close()
    with pytest.raises(NoReply):
        device.pan_tilt.read()
    clock.advance(30.0)
    assert device.true_joints(clock.now_s())[0] < 0.9
    with pytest.raises(NoFreshFrame, match="closed"):
        device.cameras["navcam_left"].next_frame(clock.now_s(), 1.0)


def test_a_live_fault_reaches_the_devices(small_rig: Path) -> None:
    device, clock = rover(small_rig)
    device.faults.set("navcam_left", "dark")
    assert device.cameras["navcam_left"].next_frame(clock.now_s(), 1.0).image.max() < 10
    device.faults.clear("navcam_left")
    clock.advance(1.0)
    assert device.cameras["navcam_left"].next_frame(clock.now_s(), 1.0).image.max() > 50


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


def clean(device: SimulatedRover, clock: ManualClock, name: str = "navcam_left") -> np.ndarray:
    """The next frame of a camera without noise."""
    clock.advance(0.5)
    return device.cameras[name].next_frame(clock.now_s(), 1.0).image


QUIET = {"cameras": {"read_noise_dn": 0, "shot_noise_dn": 0}}


def test_a_resting_head_is_drawn_once_and_each_frame_has_noise_of_its_own(
    small_rig: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    device, clock = rover(small_rig)
    settle(device, clock, 0.1, -0.3)
    drawn = []
    draw = device._renderer.image
    monkeypatch.setattr(device._renderer, "image", lambda *a: drawn.append(a) or draw(*a))
    frames = [clean(device, clock) for _ in range(4)]
    assert len(drawn) == 1
    for one, other in pairwise(frames):
        apart = one.astype(float) - other
        assert 1.0 < apart.std() < 5.0 and abs(apart.mean()) < 0.05
        assert abs(np.corrcoef(apart[:-1].ravel(), apart[1:].ravel())[0, 1]) < 0.02


def test_whatever_moves_shows_in_the_next_picture(small_rig: Path) -> None:
    """The smallest move of the head, the rover put elsewhere, one camera and then another."""
    device, clock = rover(small_rig, **QUIET)
    settle(device, clock, 0.1, -0.3)
    first = clean(device, clock)
    np.testing.assert_array_equal(clean(device, clock), first)
    head = device._head
    joints = head.true_joints

    def dithering(time_s: float) -> tuple[float, float]:
        pan, tilt = joints(time_s)
        return pan + 2e-3, tilt

    head.true_joints = dithering  # type: ignore[method-assign]
    moved = clean(device, clock)
    assert (moved != first).mean() > 0.2
    head.true_joints = joints  # type: ignore[method-assign]
    np.testing.assert_array_equal(clean(device, clock), first)
    right = clean(device, clock, "navcam_right")
    assert (right != first).mean() > 0.5
    device.stand(0.3, 0.0, 0.0)
    elsewhere = clean(device, clock)
    assert (elsewhere != first).mean() > 0.5
    device.site_from_rover = Rigid.identity()
    np.testing.assert_array_equal(clean(device, clock), first)


@pytest.mark.parametrize("word", ["dark", "garbage", "frozen", "wrong"])
def test_a_fault_shows_at_rest_and_is_gone_when_cleared(small_rig: Path, word: str) -> None:
    device, clock = rover(small_rig)
    settle(device, clock, 0.1, -0.3)
    before = clean(device, clock)
    more = {"wrong": {"dx_px": 7, "dy_px": 0}}.get(word, {})
    device.faults.set("navcam_left", word, **more)
    clock.advance(0.5)
    faulty = [clean(device, clock) for _ in range(2)]
    if word == "frozen":
        np.testing.assert_array_equal(faulty[0], faulty[1])
    else:
        assert np.abs(faulty[1].astype(float) - before).mean() > 5.0
    device.faults.clear("navcam_left")
    clock.advance(0.5)
    after = clean(device, clock)
    assert np.abs(after.astype(float) - before).mean() < 3.0 and (after != faulty[1]).any()


def test_pictures_drawn_ahead_are_those_that_are_asked_for_and_a_closed_rover_draws_none(
    small_rig: Path,
) -> None:
    device, clock = rover(small_rig)
    device.draw_ahead(clock.now_s())
    drawn = {name: device._at_rest(name, clock.now_s()) for name in device.cameras}
    device.draw_ahead(clock.now_s())
    assert all(device._at_rest(name, clock.now_s()) is image for name, image in drawn.items())
    device.close()
    device.draw_ahead(clock.now_s())  # ends at once, and raises nothing
