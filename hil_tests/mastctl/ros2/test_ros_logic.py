"""The adapter's pure parts: ROS time, the nearest lens, the frames of tf, and one wish at a time."""

from __future__ import annotations

import threading
from contextlib import contextmanager
from typing import Any

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from calib.files.mast_file import load_rig
from calib.files.twin import even_axes, kind_of_lens
from calib.geometry.cahvor import CameraModel, Kind
from calib.geometry.rigid import Rigid, rot_z
from hil_tests.waiting import until
from mastctl.cli.main import main
from mastctl.client import ClientError
from mastctl.packaged import config_folder
from mastctl.ros2.lens import GRID, nearest_lens
from mastctl.ros2.names import Names
from mastctl.ros2.steering import Outcome, Steering, Wish
from mastctl.ros2.tf_tree import NoTransform, TfTree
from mastctl.ros2.times import CALM, Exchange, RosTime

NS = 1_000_000_000
REAL_NS = 1_795_000_000 * NS
ROUNDING_PX = 1e-6


def test_a_stamp_on_the_daemons_own_machine_is_exact_to_the_nanosecond() -> None:
    clock = RosTime()
    assert clock.stamp_ns(5.0) is None
    clock.heard(Exchange(100.0, 100.002, 100.004, REAL_NS))
    assert clock.stamp_ns(99.987654321) == REAL_NS + 99_987_654_321
    assert clock.steady


def test_a_far_clock_is_taken_from_the_quickest_exchange() -> None:
    clock = RosTime()  # the daemon's clock is 7 s behind; answers are late by different amounts
    for sent_s, there_s, back_s in ((100.0, 0.030, 0.010), (101.0, 0.001, 0.0012), (102.0, 0.050, 0.010)):
        now_s = sent_s + there_s - 7.0
        clock.heard(Exchange(sent_s, now_s, sent_s + there_s + back_s, REAL_NS))
    used = clock.stamp_ns(50.0)
    assert used is not None
    assert abs(used - (REAL_NS + 57 * NS)) <= 0.0001 * NS  # half of 0.2 ms
    assert clock.steps == 0


def test_of_a_clock_that_was_set_no_exchange_of_before_counts() -> None:
    clock = RosTime()  # the daemon's clock is 7 s behind
    clock.heard(Exchange(10.0, 3.0001, 10.0002, REAL_NS))
    assert clock.heard(Exchange(11.0, 4.002, 11.004, REAL_NS + 2 * NS)), "though it took longer"
    stamp = clock.stamp_ns(0.0)
    assert stamp is not None and abs(stamp - (REAL_NS + 9 * NS)) < 0.001 * NS


def test_a_clock_that_was_set_is_told_until_it_is_calm_again() -> None:
    clock = RosTime()
    clock.heard(Exchange(10.0, 10.0, 10.0, REAL_NS))
    assert clock.heard(Exchange(11.0, 11.0, 11.0, REAL_NS + 2 * NS))
    assert (clock.steps, clock.steady) == (1, False)
    assert clock.stamp_ns(0.0) == REAL_NS + 2 * NS
    for k in range(CALM):
        assert not clock.heard(Exchange(12.0 + k, 12.0 + k, 12.0 + k, REAL_NS + 2 * NS))
    assert clock.steady


@pytest.fixture(scope="module")
def navcam() -> Any:
    rig = load_rig(config_folder() / "masts" / "rocky8_simulated.yaml").rig
    return rig.cameras["navcam_left"].model


def test_the_lens_projects_as_opencv_does_and_its_worst_error_is_that(navcam: Any) -> None:
    lens = nearest_lens(navcam)
    columns, rows = (np.linspace(0.0, size - 1.0, n) for size, n in zip(navcam.size_px, GRID, strict=True))
    pixels = np.stack(np.meshgrid(columns, rows), axis=-1).reshape(-1, 2)
    directions = navcam.ray(pixels).directions @ even_axes(navcam)
    found, _ = cv2.projectPoints(directions, np.zeros(3), np.zeros(3), lens.matrix_px, lens.distortion)
    off_px = np.linalg.norm(found.reshape(-1, 2) - pixels, axis=1)
    assert off_px.max() == pytest.approx(lens.worst_px, abs=ROUNDING_PX)
    assert lens.worst_px < 0.25
    kind = kind_of_lens("pinhole", lens.distortion)
    ours = CameraModel.of_matrix(kind, lens.size_px, lens.matrix_px, lens.distortion, np.eye(3), np.zeros(3))
    assert np.abs(ours.project(directions)[0] - found.reshape(-1, 2)).max() < ROUNDING_PX


@pytest.mark.parametrize(
    ("kind", "name", "distortion"),
    [
        ("OPENCV4", "plumb_bob", [-0.2, 0.05, 0.001, -0.0005]),
        ("OPENCV5", "plumb_bob", [-0.2, 0.05, 0.001, -0.0005, 0.01]),
        ("OPENCV8", "rational_polynomial", [0.3, 0.02, 0.001, -0.0005, 0.001, 0.5, 0.06, 0.002]),
        ("OPENCV_FISHEYE", "equidistant", [0.01, -0.002, 0.001, 0.0]),
    ],
)
def test_a_camera_of_opencv_keeps_its_numbers(kind: Kind, name: str, distortion: list[float]) -> None:
    matrix = [[410.0, 0.0, 322.0], [0.0, 411.0, 236.0], [0.0, 0.0, 1.0]]
    turn = Rotation.from_euler("xyz", [0.2, -0.1, 0.05]).as_matrix()
    model = CameraModel.of_matrix(kind, (640, 480), matrix, distortion, turn, [0.1, 0.2, 0.3])
    lens = nearest_lens(model)
    assert (lens.name, lens.distortion.tolist()[: len(distortion)]) == (name, distortion)
    assert np.allclose(lens.matrix_px, matrix, rtol=1e-15)
    assert lens.worst_px < ROUNDING_PX


def test_a_fisheye_of_the_cahv_family_becomes_equidistant() -> None:
    vectors = {"A": [0.0, 0.0, 1.0], "H": [200.0, 0.0, 319.5], "V": [0.0, 200.0, 239.5]}
    model = CameraModel("CAHVORE", (640, 480), C=[0.0, 0.0, 0.0], **vectors, cahvore_type=2, linearity=0.0)
    lens = nearest_lens(model)
    assert lens.name == "equidistant"
    assert lens.worst_px < ROUNDING_PX


def test_a_way_through_tf_is_that_of_its_parts_between_their_stamps() -> None:
    tree = TfTree()
    turn = Rotation.from_euler("zyx", [0.4, -0.2, 0.1])
    map_from_odom = Rigid(np.asarray(turn.as_matrix()), np.array([1.0, 2.0, 3.0]))
    tree.put("map", "odom", 0, map_from_odom, static=True)
    for at_s, angle_rad, x_m in ((10, 0.0, 0.0), (11, 0.5, 4.0)):
        tree.put("odom", "rover", at_s * NS, Rigid(rot_z(angle_rad), np.array([x_m, 0.0, 0.0])), static=False)
    found = tree.transform("map", "rover", 10 * NS + NS // 4)
    wanted = turn * Rotation.from_euler("z", 0.125)
    assert np.allclose(found.rotation, wanted.as_matrix(), atol=1e-12)
    assert np.allclose(found.translation_m, turn.apply([1.0, 0.0, 0.0]) + np.arange(1.0, 4.0), atol=1e-12)
    back = tree.transform("rover", "map", 10 * NS + NS // 4)
    assert np.allclose((back @ found).translation_m, 0.0, atol=1e-12)
    assert tree.transform("odom", "rover", 0).translation_m[0] == 4.0  # 0: the newest


@pytest.mark.parametrize(
    ("target", "source", "stamp_s", "said"),
    [
        ("rover", "moon", 0, "does not know the frame 'moon'"),
        ("rover", "island", 0, "no way"),
        ("map", "rover", 12, "1.000 s after the newest"),
        ("map", "rover", 9, "1.000 s before the oldest"),
    ],
)
def test_what_tf_does_not_know_is_told(target: str, source: str, stamp_s: int, said: str) -> None:
    tree = TfTree()
    for at_s in (10, 11):
        tree.put("map", "rover", at_s * NS, Rigid.identity(), static=False)
    tree.put("sea", "island", 0, Rigid.identity(), static=True)
    with pytest.raises(NoTransform, match=said):
        tree.transform(target, source, stamp_s * NS)


def test_names_are_such_that_ros_takes_them() -> None:
    names = Names("mast_", "base_footprint")
    assert (names.pan, names.base, names.head) == ("mast_pan", "base_footprint", "mast_head")
    assert [names.topic(one) for one in ("navcam_left", "rear-cam", "3d")] == [
        "navcam_left", "rear_cam", "camera_3d",
    ]  # fmt: skip
    assert names.optical("rear-cam") == "mast_rear_cam_optical_frame"


class _Daemon:
    """Stands for a daemon and its client: operations end when they are stopped or allowed to."""

    def __init__(self) -> None:
        self.told: list[str] = []
        self.lost = False
        self._end = threading.Event()
        self._state = "done"

    def __enter__(self) -> _Daemon:
        return self

    def __exit__(self, *ignored: object) -> None:
        pass

    @contextmanager
    def lease(self, **options: Any) -> Any:
        self.told.append("leased")
        yield
        self.told.append("released")

    def point(self, **asked: Any) -> str:
        self.told.append(f"point {asked['pan_rad']}")
        self._end.clear()
        self._state = "done"
        return "1"

    def wait(self, operation: str, timeout_s: float) -> Any:
        until(lambda: self._end.is_set() or self.lost, "the operation's end")
        if self.lost:
            raise ClientError("no_daemon", "gone")
        return {"state": self._state, "error": None}

    def stop(self) -> None:
        self.told.append("stop")
        self._state = "stopped"
        self._end.set()

    def arrive(self) -> None:
        self._end.set()


def _asked(steering: Steering, ends: dict[float, Outcome], pan_rad: float) -> Wish:
    wish = Wish(
        f"pan {pan_rad}", lambda client: {"pan_rad": pan_rad}, lambda outcome: ends.update({pan_rad: outcome})
    )
    steering.ask(wish)
    return wish


def test_a_newer_wish_stops_the_one_before_and_the_end_stops_all() -> None:
    daemon, ends = _Daemon(), dict[float, Outcome]()
    steering = Steering(lambda: daemon)  # type: ignore[arg-type, return-value]
    _asked(steering, ends, 1.0)
    until(lambda: "point 1.0" in daemon.told, "the first begins")
    _asked(steering, ends, 2.0)
    until(lambda: "point 2.0" in daemon.told, "the second begins")
    assert daemon.told.index("stop") < daemon.told.index("point 2.0")
    steering.close()
    assert daemon.told[-2:] == ["stop", "released"]
    assert {key: one.state for key, one in ends.items()} == {1.0: "stopped", 2.0: "stopped"}


def test_a_withdrawn_wish_is_stopped_and_a_lost_daemon_too() -> None:
    daemon, ends = _Daemon(), dict[float, Outcome]()
    steering = Steering(lambda: daemon)  # type: ignore[arg-type, return-value]
    wish = _asked(steering, ends, 1.0)
    until(lambda: "point 1.0" in daemon.told, "it begins")
    steering.withdraw(wish)
    until(lambda: 1.0 in ends, "it ends")
    assert daemon.told[-2:] == ["stop", "released"]
    _asked(steering, ends, 2.0)
    until(lambda: "point 2.0" in daemon.told, "the next begins")
    daemon.lost = True
    until(lambda: 2.0 in ends, "it ends")
    assert (ends[2.0].state, ends[2.0].code, daemon.told[-2:]) == (
        "failed",
        "no_daemon",
        ["stop", "released"],
    )
    steering.close()


def test_without_ros_one_sentence_says_how_to_get_it(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["ros2", "--help"]) == 0
    assert "Needs rclpy" in capsys.readouterr().out
    assert main(["ros2"]) == 1
    said = capsys.readouterr().err
    assert said.count("\n") == 1
    assert "cannot import rclpy" in said and "source /opt/ros/jazzy/setup.bash" in said
