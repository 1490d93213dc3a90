"""The adapter's pure parts: ROS time, the nearest lens, the frames of tf, and one goal at a time."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from typing import Any

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from calib.files.mast_file import load_rig
from calib.files.twin import grid_px
from calib.geometry.rigid import Rigid, rot_z
from hil_tests.waiting import NET_S, until
from mastctl.client import ClientError
from mastctl.packaged import config_folder
from mastctl.ros2.goals import Goal, GoalOutcome, RosSteering
from mastctl.ros2.state import ClockExchange, DaemonState, NoTransform, RosTime, TfTree

NS = 1_000_000_000
REAL_NS = 1_795_000_000 * NS
ROUNDING_PX = 1e-6


def test_a_stamp_on_the_daemons_own_machine_is_exact_to_the_nanosecond() -> None:
    clock = RosTime()
    assert clock.stamp_ns(5.0) is None
    clock.update(ClockExchange(100.0, 100.002, 100.004, REAL_NS))
    assert clock.stamp_ns(99.987654321) == REAL_NS + 99_987_654_321
    assert clock.steady


def test_a_far_clock_is_taken_from_the_quickest_exchange() -> None:
    clock = RosTime()  # the daemon's clock is 7 s behind; answers are late by different amounts
    for sent_s, there_s, back_s in ((100.0, 0.030, 0.010), (101.0, 0.001, 0.0012), (102.0, 0.050, 0.010)):
        now_s = sent_s + there_s - 7.0
        clock.update(ClockExchange(sent_s, now_s, sent_s + there_s + back_s, REAL_NS))
    used = clock.stamp_ns(50.0)
    assert used is not None
    assert abs(used - (REAL_NS + 57 * NS)) <= 0.0001 * NS  # half of 0.2 ms
    assert clock.steady


def test_a_clock_that_was_set_is_reported_until_the_offset_stays() -> None:
    clock = RosTime()
    clock.update(ClockExchange(10.0, 10.0, 10.0, REAL_NS))
    assert clock.update(ClockExchange(11.0, 11.0, 11.0, REAL_NS + 2 * NS))
    assert not clock.steady
    assert clock.stamp_ns(0.0) == REAL_NS + 2 * NS
    assert not clock.update(ClockExchange(12.0, 12.0, 12.0, REAL_NS + 2 * NS))
    assert clock.steady


@pytest.mark.parametrize("name", ["pancam_right", "navcam_left", "hazcam_left"])
def test_a_lens_in_its_optical_frame_sees_what_the_camera_sees(name: str) -> None:
    rig, state = load_rig(config_folder() / "masts" / "rocky8_simulated.yaml").rig, DaemonState()
    state.use_rig(rig)
    camera = rig.cameras[name].model
    lens, twin, error = state.lenses[name]
    pixels = grid_px(camera.size_px, (25, 19))
    rays = camera.ray(pixels)
    points_m = state.carrier_from_optical(rig, name).inverse.points(rays.origins_m + 20.0 * rays.directions)
    seen, _ = cv2.projectPoints(points_m, np.zeros(3), np.zeros(3), twin.camera_matrix, twin.distortion)
    off_px = np.linalg.norm(seen.reshape(-1, 2) - pixels, axis=1)
    assert off_px.max() <= error.worst_px + ROUNDING_PX
    assert (lens, error.worst_px < 0.25) == (
        ("rational_polynomial", False) if name == "hazcam_left" else ("plumb_bob", True)
    )


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
def test_what_tf_does_not_know_is_named(target: str, source: str, stamp_s: int, said: str) -> None:
    tree = TfTree()
    for at_s in (10, 11):
        tree.put("map", "rover", at_s * NS, Rigid.identity(), static=False)
    tree.put("sea", "island", 0, Rigid.identity(), static=True)
    with pytest.raises(NoTransform, match=said):
        tree.transform(target, source, stamp_s * NS)


class _Daemon:
    """Stands for a daemon and its client: an operation runs until it is stopped."""

    def __init__(self) -> None:
        self.calls: list[str] = []
        self.lost = False
        self._state = "running"

    def __enter__(self) -> _Daemon:
        return self

    def __exit__(self, *ignored: object) -> None:
        pass

    @contextmanager
    def lease(self, **options: Any) -> Any:
        self.calls.append("leased")
        yield
        self.calls.append("released")

    def point(self, **request: Any) -> str:
        self.calls.append(f"point {request['pan_rad']}")
        self._state = "running"
        return "1"

    def operation(self, operation: str) -> Any:
        if self.lost:
            raise ClientError("operation_unknown", "it is another daemon")
        return {"state": self._state, "error": None}

    def stop_operation(self, operation: str) -> None:
        self.calls.append(f"stop {operation}")
        self._state = "stopped"


@pytest.fixture
def daemon() -> _Daemon:
    return _Daemon()


@pytest.fixture
def steering(daemon: _Daemon) -> Iterator[RosSteering]:
    made = RosSteering(lambda: daemon)  # type: ignore[arg-type, return-value]
    yield made
    made.close()


@pytest.fixture
def begin(steering: RosSteering) -> Iterator[Callable[[float], Future[GoalOutcome]]]:
    """Begins a goal in a thread of its own, as ROS does."""
    with ThreadPoolExecutor() as pool:
        yield lambda pan_rad: pool.submit(
            steering.carry_out, Goal(f"pan {pan_rad}", lambda client: {"pan_rad": pan_rad})
        )
        steering.close()


Begin = Callable[[float], "Future[GoalOutcome]"]


def test_a_newer_goal_stops_the_one_before_and_the_end_stops_all(
    daemon: _Daemon, steering: RosSteering, begin: Begin
) -> None:
    first = begin(1.0)
    until(lambda: "point 1.0" in daemon.calls, "the first begins")
    second = begin(2.0)
    until(lambda: "point 2.0" in daemon.calls, "the second begins")
    assert daemon.calls.index("released") < daemon.calls.index("point 2.0")
    steering.close()
    assert daemon.calls[-2:] == ["stop 1", "released"]
    assert [goal.result(NET_S).state for goal in (first, second)] == ["stopped", "stopped"]
    assert begin(3.0).result(NET_S).state == "stopped" and "point 3.0" not in daemon.calls


def test_of_goals_that_wait_only_the_newest_begins(daemon: _Daemon, begin: Begin) -> None:
    first = begin(1.0)
    until(lambda: "point 1.0" in daemon.calls, "the first begins")
    daemon.stop_operation = lambda operation: None  # type: ignore[method-assign]  # it takes its time
    second, third = begin(2.0), None
    third = begin(3.0)
    assert second.result(NET_S).state == "replaced"
    daemon._state = "done"
    until(lambda: "point 3.0" in daemon.calls, "the newest begins")
    daemon._state = "done"
    assert [one.result(NET_S).state for one in (first, third)] == ["done", "done"]
    assert "point 2.0" not in daemon.calls


def test_a_stopped_goal_is_stopped_and_a_lost_daemon_too(
    daemon: _Daemon, steering: RosSteering, begin: Begin
) -> None:
    goal = begin(1.0)
    until(lambda: "point 1.0" in daemon.calls, "it begins")
    steering.stop()
    assert goal.result(NET_S).state == "stopped"
    assert daemon.calls[-2:] == ["stop 1", "released"]
    goal = begin(2.0)
    until(lambda: "point 2.0" in daemon.calls, "the next begins")
    daemon.lost = True
    outcome = goal.result(NET_S)
    assert (outcome.state, outcome.code) == ("failed", "operation_unknown")
    assert daemon.calls[-2:] == ["stop 1", "released"]
