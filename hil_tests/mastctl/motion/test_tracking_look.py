"""Starts and looks of a track in a small world whose truth is the test's own geometry."""

from __future__ import annotations

import re
import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from calib.errors import CalibError
from calib.geometry.rig import Rig
from calib.geometry.rigid import Rigid
from calib.matching.track import Track, moved_track
from drivers.errors import NoReply
from hil_tests.mastctl.motion.pointing_world import SIZE_PX, World, rig
from mastctl.answers import Step
from mastctl.devices.frames import StampedFrame
from mastctl.motion.pairs import TrackingSettings
from mastctl.motion.requests import PixelTarget, PointingError
from mastctl.motion.search import NotTrackable, TargetSearch

PIXEL = (110.0, 130.0)
Paint = Callable[[str, int, np.ndarray], np.ndarray]


@dataclass
class Eyes(World):
    """The world, with cameras that do not answer."""

    silent: tuple[str, ...] = ()

    def frames(
        self,
        cameras: Sequence[str],
        exposed_after_s: float,
        timeout_s: float,
        check: Callable[[], None] | None = None,
    ) -> dict[str, StampedFrame]:
        for camera in cameras:
            if camera in self.silent:
                raise NoReply("unplugged", device=camera)
        return super().frames(cameras, exposed_after_s, timeout_s)


def search(world: World, steps: list[Step] | None = None, believed: Rig | None = None) -> TargetSearch:
    record = ([] if steps is None else steps).append
    settings, stopped = TrackingSettings(), threading.Event()
    return TargetSearch(believed or rig(), world, world.clock, settings, record, stopped)  # type: ignore[arg-type]


def begun(world: World) -> tuple[Track, np.ndarray]:
    """A track of what a pixel shows, and where that truly is."""
    frame = world.shoot()
    track, seen = search(world).begin_at_pixel(PixelTarget("navcam_left", frame.frame_id, *PIXEL))
    assert seen.pair == "navcam" and list(seen.pixels) == ["navcam_left", "navcam_right"]
    return track, world.true_point(frame, *PIXEL)


def covered(*cameras: str) -> Paint:
    """Something else in front of some cameras."""
    other = np.random.default_rng(5).integers(60, 200, SIZE_PX[::-1], dtype=np.uint8)

    def paint(camera: str, number: int, image: np.ndarray) -> np.ndarray:
        return other if camera in cameras else image

    return paint


def test_a_start_and_a_look_put_the_target_where_it_is() -> None:
    world = Eyes()
    steps: list[Step] = []
    track, point = begun(world)
    assert np.linalg.norm(track.position_m - point) < 0.03
    after, seen = search(world, steps).find(track)
    assert (seen.state, seen.pair, seen.reason) == ("tracked", "navcam", "")
    assert np.linalg.norm(after.position_m - point) < 0.03
    names = ["choose", "before", "limits", "move", "settle", "look", "find"]
    assert [step["name"] for step in steps] == names
    found = [seen.pixels[camera] for camera in rig().stereo["navcam"]]
    pixels = [np.array([one["x_px"], one["y_px"]]) for one in found]
    middle = (np.array(SIZE_PX) - 1) / 2
    assert np.mean(pixels, axis=0) == pytest.approx(middle, abs=2.0), "pointed before the picture was taken"
    for one, pixel in zip(found, pixels, strict=True):
        assert pixel == pytest.approx(world.true_pixel(one["frame_id"], point), abs=0.3)


def plain(camera: str, number: int, image: np.ndarray) -> np.ndarray:
    """Nothing to hold on to."""
    return np.random.default_rng(number).normal(120, 2, image.shape).astype(np.uint8)


def edge(camera: str, number: int, image: np.ndarray) -> np.ndarray:
    """Two plain halves that meet under the click."""
    halves = np.where(np.arange(image.shape[1]) < PIXEL[0], 90.0, 150.0) * np.ones((image.shape[0], 1))
    return np.random.default_rng(number).normal(halves, 2).astype(np.uint8)


@pytest.mark.parametrize(
    ("paint", "words"),
    [(plain, "texture"), (edge, "along one direction"), (covered("navcam_right"), "epipolar line")],
)
def test_what_cannot_be_followed_is_refused_with_the_reason(paint: Paint, words: str) -> None:
    world = Eyes()
    world.image = paint
    with pytest.raises((PointingError, NotTrackable)) as refused:
        begun(world)
    assert words in str(refused.value)
    assert "\n" not in str(refused.value)


def test_a_position_starts_with_what_is_there_and_nothing_else() -> None:
    world = Eyes()
    point = world.true_point(world.shoot(), *PIXEL)
    track, seen = search(world).begin_at_position(point)
    assert np.linalg.norm(track.position_m - point) < 0.03
    assert seen.pair == "navcam"
    with pytest.raises(NotTrackable, match=r"m from it; at most 0\.\d\d m is expected"):
        search(world).begin_at_position(point - np.array([0.0, 0.0, 0.5]))
    with pytest.raises(CalibError, match="no stereo pair sees the target"):
        search(world).begin_at_position(np.array([-3.0, 0.0, 0.0]))


def test_one_camera_keeps_a_target_but_does_not_find_a_lost_one() -> None:
    world = Eyes()
    track, point = begun(world)
    world.silent = ("navcam_right", "pancam_left", "pancam_right")
    after, seen = search(world).find(track)
    assert seen.state == "tracked"
    right, left = (seen.pixels[f"navcam_{side}"] for side in ("right", "left"))
    assert (right["verdict"], left["verdict"]) == ("no_frame", "good")
    assert right["reason"] == "navcam_right: unplugged"
    assert np.linalg.norm(after.position_m - point) < 0.03
    world.image = covered("navcam_left")
    lost, seen = search(world).find(after)
    assert (lost.state, lost.misses) == ("lost", 1)
    assert "navcam_right: unplugged" in seen.reason
    world.image = lambda camera, number, image: image
    assert search(world).find(lost)[1].state == "lost", "one eye alone"
    world.silent = ()
    assert search(world).find(lost)[1].state == "tracked"


def test_the_next_pair_looks_where_the_first_finds_nothing() -> None:
    world = Eyes()
    track, point = begun(world)
    world.image = covered("navcam_left", "navcam_right")
    after, seen = search(world).find(track)
    assert (seen.state, seen.pair) == ("tracked", "pancam")
    assert np.linalg.norm(after.position_m - point) < 0.03
    world.image = covered("navcam_left", "navcam_right", "pancam_left", "pancam_right")
    assert search(world).find(track)[1].pair == "navcam", "the first pair says why"


def navcams_turned(by_rad: float) -> Rig:
    """A mast file that believes the Navcams turned to the right of where they look."""
    turn = Rigid(Rotation.from_euler("z", by_rad).as_matrix(), np.zeros(3))
    true = rig()
    cameras = {
        name: replace(camera, model=camera.model.moved(turn)) if name.startswith("navcam") else camera
        for name, camera in true.cameras.items()
    }
    return replace(true, cameras=cameras)


@pytest.mark.parametrize("silent", [(), ("navcam_left",), ("navcam_right",)])
@pytest.mark.parametrize("share", [0.0, 0.5])
def test_pictures_that_did_not_move_with_the_head_are_not_looked_at(
    share: float, silent: tuple[str, ...]
) -> None:
    world = Eyes()
    track, _ = begun(world)
    start = world.true_joints(world.clock.now_s())
    world.view = lambda camera, time_s, joints: (
        (start[0] + share * (joints[0] - start[0]), start[1] + share * (joints[1] - start[1]))
    )
    world.silent = silent
    after, seen = search(world).find(track)
    assert (after.state, seen.state) == ("lost", "lost")
    assert after.position_m == pytest.approx(track.position_m)
    for eye in rig().stereo["navcam"]:
        assert seen.pixels[eye]["verdict"] == "no_frame"
        why = "unplugged" if eye in silent else "joints and pictures contradict each other"
        assert why in seen.pixels[eye]["reason"]


def test_a_change_of_the_pair_looks_with_both_and_keeps_what_they_saw() -> None:
    world = Eyes()
    steps: list[Step] = []
    track, point = begun(world)
    after, seen = search(world, steps).find(track, "pancam")
    assert (seen.state, seen.pair, seen.reason) == ("tracked", "navcam", "")
    assert np.linalg.norm(after.position_m - point) < 0.03
    one = ["limits", "move", "settle", "look", "find"]
    names = [step["name"] for step in steps if step["name"] != "before"]
    assert names == ["choose", *one, *one, "hand_over"]
    record = seen.matched
    assert record is not None
    assert (record.pair, list(record.found)) == (rig().stereo["pancam"], list(rig().stereo["navcam"]))
    frames = {name[:-7]: name for step in steps for name in step["detail"].get("frame_ids", ())}
    for eye, pixel in zip(record.pair, record.clicks_px, strict=True):
        assert pixel == pytest.approx(world.true_pixel(frames[eye], point), abs=0.6)
    for eye, landed in record.found.items():
        true = world.true_pixel(frames[eye], point)
        assert landed.geometric_px == pytest.approx(true, abs=0.3)
        assert landed.found_px == pytest.approx(true, abs=0.3)
    for eye, at in (("pancam_left", record.joints), ("navcam_left", record.to_joints)):
        frame = world.by_id(frames[eye])
        assert (at.pan_rad, at.tilt_rad) == (frame.pan_rad, frame.tilt_rad)
    assert record.joints.tilt_rad != record.to_joints.tilt_rad
    assert search(world).find(after, "navcam")[1].matched is None, "the same pair looks on"


def test_a_turned_pair_is_recorded_and_takes_over_only_within_bounds() -> None:
    world = Eyes()
    track, _ = begun(world)
    believed = navcams_turned(
        0.003
    )  # 645 px of focal length: targets lie 1.9 px to the left of where believed
    surely = replace(track, covariance_m2=1e-6 * np.eye(3))
    _, seen = search(world, None, believed).find(surely, "pancam")
    assert (seen.state, seen.pair) == ("tracked", "pancam")
    assert seen.reason.startswith("navcam does not take over: the match does not fit the prediction")
    roughly = replace(track, covariance_m2=2e-2**2 * np.eye(3))  # as after half a metre of driving
    _, taken = search(world, None, believed).find(roughly, "pancam")
    assert (taken.state, taken.pair) == ("tracked", "navcam")
    for matched in (seen.matched, taken.matched):
        assert matched is not None
        off = [one.found_px - one.geometric_px for one in matched.found.values()]
        assert np.array(off) == pytest.approx(np.array([[1.93, 0.0]] * 2), abs=0.4)


@pytest.mark.parametrize("found_by", ["navcam", "pancam"])
def test_a_pose_that_the_pictures_contradict_is_told_by_the_look(found_by: str) -> None:
    """The rover stands; a pose says that it went 12 cm to the right, good to 1.5 cm."""
    world = Eyes()
    steps: list[Step] = []
    track, _ = begun(world)
    told = np.diag([1e-3**2] * 3 + [0.015**2] * 3)
    said = moved_track(track, Rigid(np.eye(3), np.array([0.0, -0.12, 0.0])), told)
    _, seen = search(world, steps).find(said, found_by)
    off = re.search(r"([\d.]+) cm \(([\d.]+) sigma\) from where the pose", seen.pose_doubt)
    assert off is not None and float(off[1]) == pytest.approx(12.0, abs=1.5) and float(off[2]) > 4.0
    assert any(step["detail"].get("pose_doubt") == seen.pose_doubt for step in steps)
    honest = moved_track(track, Rigid(np.eye(3), np.zeros(3)), told)
    assert search(world).find(honest, found_by)[1].pose_doubt == ""


def test_without_the_former_pairs_pictures_the_next_looks_alone() -> None:
    world = Eyes()
    track, point = begun(world)
    world.silent = ("pancam_left", "pancam_right")
    after, seen = search(world).find(track, "pancam")
    assert (seen.state, seen.pair, seen.matched) == ("tracked", "navcam", None)
    assert np.linalg.norm(after.position_m - point) < 0.03
    world.silent = ("pancam_left", "pancam_right", "navcam_left", "navcam_right")
    assert search(world).find(track, "pancam")[1].reason == "navcam_left: unplugged; navcam_right: unplugged"
    world.silent = ("navcam_left", "navcam_right")
    _, seen = search(world).find(track, "pancam")
    assert (seen.state, seen.pair, seen.matched) == ("tracked", "pancam", None)
    assert seen.reason == "navcam does not take over: navcam_left: unplugged; navcam_right: unplugged"
