"""The live view as a viewer meets it, on a daemon of this process; what it costs, and what goes wrong."""

from __future__ import annotations

import contextlib
import json
import os
import re
import signal
import socket
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from foxglove_schemas_protobuf.CameraCalibration_pb2 import CameraCalibration
from foxglove_schemas_protobuf.FrameTransforms_pb2 import FrameTransforms
from foxglove_schemas_protobuf.RawImage_pb2 import RawImage
from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate

from calib.errors import BadFile
from hil_tests.mastctl.live.foxglove_client import Viewer
from hil_tests.waiting import until
from mastctl.client import Client
from mastctl.config import Config, Listen, load_config, parse_config
from mastctl.control.publisher import TOPICS
from mastctl.daemon import RunningDaemon
from mastctl.errors import Unable
from mastctl.live.settings import LiveSettings
from mastctl.recorder.feed import ELSEWHERE

IMAGE = "/camera/navcam_left/image"


def config_with(port: int = 0) -> Config:
    config = load_config()
    names = ("navcam_left", "navcam_right")
    cameras = {name: config.hardware.cameras[name] for name in names}
    hardware = replace(config.hardware, cameras=cameras)  # in real time: pictures go on while nobody moves
    return replace(config, listen=Listen(port=0), hardware=hardware, live=LiveSettings(port=port))


@contextmanager
def shown(port: int = 0) -> Iterator[tuple[RunningDaemon, int]]:
    with RunningDaemon(config_with(port)) as daemon:
        live = daemon.service.live
        assert live is not None
        until(lambda: live.port is not None, "the live view listens")
        assert live.port is not None
        yield daemon, live.port


@pytest.fixture(scope="module")
def daemon() -> Iterator[tuple[RunningDaemon, int]]:
    with shown() as both:
        yield both


@pytest.fixture
def running(daemon: tuple[RunningDaemon, int]) -> RunningDaemon:
    return daemon[0]


@pytest.fixture
def viewer(daemon: tuple[RunningDaemon, int]) -> Iterator[Viewer]:
    with Viewer(daemon[1]) as one:
        one.read(lambda seen: IMAGE in seen.channels)
        yield one


def test_every_topic_of_the_page_is_offered_with_its_schema_and_nothing_else_is(
    viewer: Viewer, repository: Path
) -> None:
    assert viewer.server["capabilities"] == [] and viewer.server["name"] == "mastctl"
    kinds = {topic: one["schemaName"] for topic, one in viewer.channels.items()}
    assert kinds[IMAGE] == "foxglove.RawImage" and kinds["/tf"] == "foxglove.FrameTransforms"
    assert kinds["/camera/pancam_left/calibration"] == "foxglove.CameraCalibration"
    assert kinds["/target/scene"] == "foxglove.SceneUpdate"
    page = (repository / "docs/how-to/recording.md").read_text()
    table = page.split("Then, by topic:")[1].split("\nJSON topics")[0]
    rows = [line.split("|")[1] for line in table.splitlines() if line.startswith("| `")]
    documented = {topic for row in rows for topic in re.findall("`(/[^`]+)`", row)}
    offered = {re.sub("^/camera/[^/]+/", "/camera/NAME/", topic) for topic in kinds}
    assert offered == documented - {"/handoff", "/recorder"}
    assert {f"/{topic}" for topic in TOPICS - ELSEWHERE - {"frame"}} <= offered
    for one in viewer.channels.values():
        assert one["encoding"] == ("protobuf" if one["schemaName"].startswith("foxglove.") else "json")
        assert one["schema"]


def test_a_watched_camera_shows_the_picture_that_the_daemon_took(
    viewer: Viewer, running: RunningDaemon
) -> None:
    viewer.subscribe(IMAGE, "/camera/navcam_left/frame", "/camera/navcam_left/calibration")
    viewer.read(lambda seen: len(seen.of(IMAGE)) > 2 and seen.of("/camera/navcam_left/calibration"))
    seen = [RawImage.FromString(data) for data in viewer.of(IMAGE)]
    facts = [json.loads(data) for data in viewer.of("/camera/navcam_left/frame")]
    last = running.service.kept_frame("navcam_left", facts[2]["frame_id"])
    image = seen[2]
    assert (image.encoding, image.width, image.height) == ("mono8", last.image.shape[1], last.image.shape[0])
    assert np.array_equal(np.frombuffer(image.data, np.uint8).reshape(last.image.shape), last.image)
    assert len({one["frame_id"] for one in facts}) == len(facts), "each picture once"
    calibration = CameraCalibration.FromString(viewer.of("/camera/navcam_left/calibration")[0])
    assert calibration.frame_id == image.frame_id == "navcam_left"


def test_a_pointing_is_shown_with_its_joints_its_frames_and_its_target(
    viewer: Viewer, running: RunningDaemon
) -> None:
    topics = ("/tf", "/joints", "/state", "/operation", "/target/scene", "/residual")
    with Client(running.url) as client:
        client.wait(client.point(pan_rad=0.0, tilt_rad=-0.1))
        viewer.subscribe(*topics)
        viewer.read(lambda seen: seen.of("/state") and seen.of("/tf"))
        shot = client.snapshot("navcam_left")
        done = client.wait(client.point(pixel=("navcam_left", shot.frame_id, 400.0, 500.0)))
    assert done["state"] == "done", done["error"]
    viewer.read(lambda seen: seen.of("/residual") and seen.of("/target/scene"))
    (ball,) = SceneUpdate.FromString(viewer.of("/target/scene")[-1]).entities
    place = ball.spheres[0].pose.position
    assert ball.frame_id == "rover" and [place.x, place.y, place.z] == pytest.approx(done["position_m"])
    assert json.loads(viewer.of("/residual")[-1])["residual_px"] == done["residual_px"]
    frames = FrameTransforms.FromString(viewer.of("/tf")[-1]).transforms
    assert ("rover", "mast") in {(one.parent_frame_id, one.child_frame_id) for one in frames}
    assert len({json.loads(data)["pan_rad"] for data in viewer.of("/joints")}) > 1


def test_a_viewer_that_comes_late_is_told_how_things_stand(viewer: Viewer) -> None:
    viewer.subscribe("/state", "/mast", "/tf", IMAGE)
    viewer.read(lambda seen: all(seen.of(topic) for topic in ("/state", "/mast", "/tf", IMAGE)))
    assert "digest" in json.loads(viewer.of("/mast")[0])


def test_viewers_can_change_nothing(viewer: Viewer) -> None:
    channel = {"id": 1, "topic": "/point", "encoding": "json", "schemaName": "x"}
    viewer.tell(op="advertise", channels=[channel])
    viewer.read(lambda seen: len(seen.statuses) == 1)
    viewer.tell(op="setParameters", parameters=[{"name": "x", "value": 1}])
    viewer.read(lambda seen: len(seen.statuses) == 2)
    viewer.tell(op="subscribeConnectionGraph")
    viewer.read(lambda seen: len(seen.statuses) == 3)
    assert all("does not support" in one["message"] for one in viewer.statuses), viewer.statuses


def test_nothing_is_heard_and_no_camera_asked_while_nobody_watches(
    viewer: Viewer, running: RunningDaemon
) -> None:
    publisher = running.service.machine.publisher
    until(lambda: _live_listeners(running) == 0, "nobody watches yet")
    before = publisher.listeners
    viewer.subscribe(IMAGE)
    viewer.read(lambda seen: len(seen.of(IMAGE)) > 1)
    assert publisher.listeners == before + 1
    viewer.close()
    until(lambda: publisher.listeners == before, "nothing is heard any longer")
    live = running.service.live
    assert live is not None
    assert not any(looker.wanted.is_set() for looker in live._lookers.values())


def _live_listeners(running: RunningDaemon) -> int:
    live = running.service.live
    assert live is not None
    screen = live._screen
    return 0 if screen is None else len(screen.watched)


def test_a_taken_port_is_a_fault_that_goes_when_the_port_is_free(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("mastctl.live.view.AGAIN_S", 0.1)
    with (
        socket.create_server(("127.0.0.1", 0)) as taken,
        RunningDaemon(config_with(taken.getsockname()[1])) as running,
        Client(running.url) as client,
    ):
        until(lambda: client.status()["faults"], "the fault is told")
        (fault,) = client.status()["faults"]
        assert fault["device"] == "foxglove" and fault["code"] == "address_in_use"
        assert "another program listens" in fault["message"] and "foxglove.port" in fault["message"]
        assert client.wait(client.point(pan_rad=0.1, tilt_rad=-0.1))["state"] == "done"
        taken.close()
        until(lambda: not client.status()["faults"], "the fault goes")


def test_a_server_that_is_killed_or_hangs_hurts_nobody_and_comes_back(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("mastctl.live.view.AGAIN_S", 0.1)
    with shown() as (running, port), Client(running.url) as client:
        live = running.service.live
        assert live is not None and live._screen is not None
        server = live._screen._process.pid
        with Viewer(port) as viewer:
            viewer.read(lambda seen: IMAGE in seen.channels)
            viewer.subscribe(IMAGE, "/joints", "/tf")
            viewer.read(lambda seen: len(seen.of(IMAGE)) > 1)
            os.kill(server, signal.SIGSTOP)
            for pan_rad in (0.2, 0.0, 0.2):
                assert client.wait(client.point(pan_rad=pan_rad, tilt_rad=-0.1))["state"] == "done"
            client.stop()
            os.kill(server, signal.SIGKILL)
        until(lambda: live.port not in (None, port), "another server is started")
        assert live.port is not None
        with Viewer(live.port) as viewer:
            viewer.read(lambda seen: IMAGE in seen.channels)


def test_the_server_ends_with_the_daemon() -> None:
    with shown() as (running, _):
        live = running.service.live
        assert live is not None and live._screen is not None
        server = live._screen._process.pid
    until(lambda: not Path(f"/proc/{server}").exists(), "the server has ended")


def test_many_connections_cost_the_daemon_no_descriptor_and_the_view_comes_back(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("mastctl.live.view.AGAIN_S", 0.1)
    with shown() as (running, port):
        live = running.service.live
        assert live is not None
        before = len(list(Path("/proc/self/fd").iterdir()))
        held = []
        with contextlib.suppress(ConnectionError):  # that many make it deaf, or end it
            for _ in range(100):
                held.append(socket.create_connection(("127.0.0.1", port), timeout=60.0))
        of_the_daemon = len(list(Path("/proc/self/fd").iterdir())) - len(held)
        for one in held:
            one.close()
        assert of_the_daemon <= before + 2
        until(lambda: live.port not in (None, port) and _is_shown(live.port), "viewers are let in again")
        assert running.service.state().faults == ()


def _is_shown(port: int | None) -> bool:
    assert port is not None
    try:
        with Viewer(port) as viewer:
            viewer.read(lambda seen: seen.channels)
    except ConnectionError:
        return False
    return True


def test_a_live_view_elsewhere_than_on_this_machine_is_refused(tmp_path: Path) -> None:
    plain = Path(load_config().path).read_text()
    for said, words in (
        ("{host: 0.0.0.0}", "foxglove.host: '0.0.0.0' where a loopback address is expected"),
        ("{host: rover.local, port: 8765}", "requires no token"),
        ("{port: 70000}", "foxglove.port"),
        ("{ports: 1}", "ports"),
        ("8765", "foxglove"),
    ):
        with pytest.raises(BadFile, match=words):
            parse_config(f"{plain}\nfoxglove: {said}\n".encode(), tmp_path / "rover.yaml")
    read = parse_config(f"{plain}\nfoxglove: {{port: 9000}}\n".encode(), tmp_path / "rover.yaml")
    assert read.live == LiveSettings("127.0.0.1", 9000) and load_config().live is None


def test_without_the_package_the_daemon_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "foxglove", None)
    with pytest.raises(Unable, match=r"pip install 'mastctl\[foxglove\]'"), RunningDaemon(config_with()):
        pass
